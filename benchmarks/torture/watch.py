# SPDX-License-Identifier: Apache-2.0
"""The running twin, watched from another process."""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torture.commands import PROGRAM, ROOT, environment
from torture.ledger import Tally

os.environ.setdefault("ROS_DOMAIN_ID", str(60 + os.getpid() % 40))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"  # shared memory leaks from killed processes

__all__ = ["BAG", "Broken", "Twin", "recovers", "running", "stamped", "watched"]

BAG = ROOT / "bags" / "crg_road"
SPACE = "tortured"
#: Of the recorded drive: the car moves and its heading is soon known.
_FROM, _WARM = 5.0, 12.0
PATIENCE = 1.0  # s to an answer


class Twin:
    """``suspension-twin run`` in a process of its own, and everything that it publishes.

    An answer counts from when the twin published it, by the stamp that the middleware puts on: how late the watcher
    takes it out of its queue is the watcher's affair.
    """

    def __init__(
        self,
        space: str = SPACE,
        arguments: Sequence[str] = (),
        clock: bool = False,
        answers_alone: bool = False,
    ) -> None:
        """``arguments`` are further ones of the command; ``clock``: publish ``/clock`` with every message of a drive;
        ``answers_alone``: of what the twin publishes take the simulated acceleration only."""
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import AccelStamped, PoseStamped, QuaternionStamped, TwistStamped
        from nav_msgs.msg import Odometry
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile
        from rclpy.utilities import ok
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import Imu, JointState, NavSatFix

        from suspension_twin.drive.recording import read_recording
        from suspension_twin_interfaces.msg import Gap

        self.said = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [*PROGRAM, "run", "--twin", str(BAG / "twin.yaml"), "--namespace", space, *arguments],
            stdout=subprocess.DEVNULL,
            stderr=self.said,
            env=environment(),
        )
        if not ok():  # one for all twins
            rclpy.init(args=["--ros-args", "--log-level", "error"])
        self.node = rclpy.create_node("torturer", namespace=space)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        kinds = {"/imu/data_raw": Imu, "/fix": NavSatFix, "/vel": TwistStamped, "/heading": QuaternionStamped}
        qos = QoSProfile(depth=2000)
        self.out = {name: self.node.create_publisher(kind, name[1:], qos) for name, kind in kinds.items()}
        self.clock = self.node.create_publisher(Clock, "/clock", 10) if clock else None
        #: Whether the simulated clock goes on with the drive.
        self.ticking = True
        #: Stamp of a sample: when its answer was published, s since the epoch.
        self.answered: dict[int, float] = {}
        #: The answers themselves, m/s².
        self.values: dict[int, float] = {}
        #: Longest time in s that an answer waited for the watcher.
        self.watched_late = 0.0
        self.wrong: list[str] = []
        self.levels: list[str] = []
        #: Resets that the nodes have told of.
        self.resets: dict[str, int] = {}
        self.alive = False
        self.listeners: list[tuple[Any, Callable[[Any, float], None]]] = []
        for kind, name in (
            (Imu, "imu/data"),
            (AccelStamped, "imu/vertical_acceleration"),
            (Odometry, "twin/odom"),
            (AccelStamped, "twin/vertical_acceleration"),
            (Imu, "twin/imu"),
            (PoseStamped, "twin/pose"),
            (JointState, "joint_states"),
            (Gap, "twin/gap"),
        ):
            if not answers_alone or name == "twin/vertical_acceleration":
                self._listen(kind, name, self._listener(name))
        self._listen(DiagnosticArray, "/diagnostics", self._on_diagnostics)
        self.space = space
        contents = read_recording(BAG)
        rows = [
            (stamp, name, bytes(data))
            for name, topic in contents.topics.items()
            if name in kinds
            for stamp, data in zip(topic.stamps, topic.data, strict=True)
        ]
        rows.sort(key=lambda row: row[0])
        first = rows[0][0]
        self.rows = [(s - first, n, d) for s, n, d in rows if s - first >= _FROM * 1e9]
        self.samples: dict[str, list[bytes]] = {}
        for _, name, data in self.rows:
            self.samples.setdefault(name, []).append(data)
        self.clients: list[Any] = []
        self.time = time.time_ns()  # stamp of the next clean message
        self.at = 0  # row of the drive that it is

    def _listen(self, kind: type, name: str, heard: Callable[[Any, float], None]) -> None:
        def taken(message: Any, about: dict[str, int]) -> None:
            heard(message, about["source_timestamp"] / 1e9)

        listen: Any = self.node.create_subscription  # its types know no callback with the message's times
        self.listeners.append((listen(kind, name, taken, 2000), heard))

    def hear_answers(self, heard: Callable[[Any, float], None]) -> None:
        """Call ``heard(message, published)`` for every simulated acceleration, in place of all else."""
        self.node.destroy_subscription(self.listeners[0][0])
        del self.listeners[0]
        from geometry_msgs.msg import AccelStamped

        self._listen(AccelStamped, "twin/vertical_acceleration", heard)

    def _listener(self, name: str) -> Callable[[Any, float], None]:
        last = name.startswith("twin/vertical")

        def heard(message: Any, published: float) -> None:
            if last:
                stamp = message.header.stamp
                ns = stamp.sec * 1_000_000_000 + stamp.nanosec
                self.answered[ns], self.values[ns] = published, message.accel.linear.z
                self.watched_late = max(self.watched_late, time.time() - published)
            if name == "twin/gap":  # NaN while unknown, as its definition says
                message.noise_rms = message.normalised = 0.0
            if len(self.wrong) < 20 and not _finite(message):
                self.wrong.append(f"{name} is not finite")

        return heard

    def _on_diagnostics(self, message: Any, _published: float) -> None:
        own = [status for status in message.status if status.name.startswith(f"{self.space}/")]
        self.alive = self.alive or bool(own)
        for status in own:
            for pair in status.values:
                if pair.key == "resets after a jump back in time (count)":
                    self.resets[status.name] = int(pair.value)
        self.levels += [status.message for status in own if status.level != b"\0"]
        del self.levels[:-200]

    def wait(self, seconds: float = 300.0) -> None:
        """Until the twin listens, and says so."""
        until = time.monotonic() + seconds
        while time.monotonic() < until and self.process.poll() is None:
            self.take(0.1)
            if self.alive and self.out["/vel"].get_subscription_count():
                return
        raise RuntimeError(f"the twin does not listen (exit status {self.process.poll()})")

    def take(self, seconds: float) -> None:
        """All that waits; then wait for more, so long at most."""
        for subscription, heard in self.listeners:
            while (taken := subscription.handle.take_message(subscription.msg_type, False)) is not None:
                heard(taken[0], taken[1]["source_timestamp"] / 1e9)
        self.executor.spin_once(timeout_sec=max(seconds, 0.0))

    def listen(self, seconds: float) -> None:
        """Take what comes."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.take(min(left, 0.05))

    def send(self, name: str, data: bytes) -> None:
        """A message as bytes, whatever is in them."""
        self.out[name].publish(data)

    def drive(self, seconds: float, speed: float = 1.0, enough: int = 0) -> list[int]:
        """The next stretch of the drive, its stamps going on from ``time``; the stamps of its IMU samples.

        Ends early once ``enough`` of them are answered.
        """
        began, start, sent, taken = time.monotonic(), self.time, [], time.monotonic()
        base = self.time - self.rows[self.at][0]
        while self.time - start < seconds * 1e9:
            offset, name, data = self.rows[self.at]
            self.time = base + offset
            while (left := began + (self.time - start) / 1e9 / speed - time.monotonic()) > 0:
                self.take(left)
                taken = time.monotonic()
            if time.monotonic() - taken > 0.05:  # behind time, but not deaf
                self.take(0.0)
                taken = time.monotonic()
            if self.clock is not None and self.ticking:
                self.tick(self.time)
            self.send(name, stamped(data, self.time))
            if name == "/imu/data_raw":
                sent.append(self.time)
            if enough and sum(stamp in self.answered for stamp in sent) >= enough:
                break
            self.at = (self.at + 1) % len(self.rows)
            if self.at == 0:  # the car is back where it began, which the twin has to see through
                base = self.time + 10_000_000 - self.rows[0][0]
        self.time += 10_000_000
        return sent

    def tick(self, ns: int) -> None:
        """The simulated clock shows ``ns``."""
        from builtin_interfaces.msg import Time
        from rosgraph_msgs.msg import Clock

        assert self.clock is not None
        self.clock.publish(Clock(clock=Time(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)))

    def memory(self) -> float:
        """Resident memory of the twin in MiB."""
        text = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        found = re.search(r"VmRSS:\s*(\d+)", text)
        return int(found[1]) / 1024 if found else 0.0

    def starved(self) -> float:
        """Seconds that the twin's main thread has waited for a processor so far."""
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/schedstat")
        try:
            return int(path.read_text(encoding="ascii").split()[1]) / 1e9
        except (OSError, IndexError):
            return 0.0

    def problem(self) -> str | None:
        """What is wrong with the twin by now."""
        if self.process.poll() is not None:
            self.said.seek(0)
            last = self.said.read().decode(errors="replace").strip().splitlines()[-1:]
            return f"the twin died with exit status {self.process.returncode}: {' '.join(last)}"
        return self.wrong.pop() if self.wrong else None

    def close(self) -> None:
        """End everything."""
        self.process.terminate()
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self.executor.shutdown()
        self.node.destroy_node()


def _finite(message: Any) -> bool:
    """Whether all numbers of a message are; covariances and what is said to be unknown included."""
    if isinstance(message, float):
        return math.isfinite(message)
    if hasattr(message, "get_fields_and_field_types"):
        return all(_finite(getattr(message, name)) for name in message.get_fields_and_field_types())
    if isinstance(message, np.ndarray):
        return bool(np.isfinite(message).all())
    if isinstance(message, (list, tuple)) or type(message).__name__ == "array":
        return all(_finite(part) for part in message)
    return True


def stamped(data: bytes, stamp: int) -> bytes:
    """A message in CDR with another header stamp, ns."""
    return data[:4] + struct.pack("<iI", stamp // 1_000_000_000, stamp % 1_000_000_000) + data[12:]


@contextlib.contextmanager
def running(tally: Tally, clock: bool = False, answers_alone: bool = False) -> Iterator[Twin]:
    """A twin that has its heading; ``clock``: with simulated time."""
    busy = os.getloadavg()[0] / (os.cpu_count() or 1)
    if busy > 1.5:
        tally.note("other processes were at work")
        tally.measure("processes at work for each core", busy)
    arguments = ("--", "--ros-args", "-p", "use_sim_time:=true") if clock else ()
    twin = Twin(arguments=arguments, clock=clock, answers_alone=answers_alone)
    try:
        twin.wait()
        twin.drive(_WARM)
        yield twin
    finally:
        twin.close()


def recovers(tally: Tally, twin: Twin, more: float = 0.0) -> str | None:
    """Clean messages again: how long until one is answered, and whether nothing else is wrong.

    ``more`` s are allowed beyond :data:`PATIENCE`. An answer that comes late because the twin waited for the processor
    most of the time is this machine's affair.
    """
    began, waited, twin.watched_late = time.time(), twin.starved(), 0.0
    sent = twin.drive(10.0, enough=5)
    twin.take(0.0)
    answered = [twin.answered[s] - began for s in sent if s in twin.answered]
    if problem := twin.problem():
        return problem
    if not answered:
        return f"no answer within 10 s; says: {'; '.join(dict.fromkeys(twin.levels[-5:]))[:200]}"
    tally.measure("first answer, s", min(answered))
    tally.measure("watched late, s", twin.watched_late)
    if min(answered) <= PATIENCE + more:
        return None
    if twin.starved() - waited > 0.5 * (time.time() - began):
        tally.count("late, for want of the processor")
        return None
    return f"answers after {min(answered):.1f} s"


def watched(
    tally: Tally, trial: Callable[[Twin, np.random.Generator, int], tuple[str, float]], clock: bool = False
) -> None:
    """Trials on one twin, which is started again where it fails; memory from the tenth trial on.

    A trial gives its name and the seconds that its answer may take beyond :data:`PATIENCE`, or raises Broken.
    """
    done = False
    while not done:
        with running(tally, clock) as twin:
            settled = 0.0
            for here, number in enumerate(tally.numbers(), 1):
                twin.answered.clear()
                try:
                    what, more = trial(twin, tally.rng(number), number)
                    twin.answered.clear()
                    problem = twin.problem() or recovers(tally, twin, more)
                except Broken as broken:
                    what, problem = broken.args
                tally.count(what)
                if here == 10:
                    settled = twin.memory()
                if here > 10 and twin.process.poll() is None:
                    tally.measure("memory grown, MiB", twin.memory() - settled)
                if problem:
                    tally.fail(f"{what}: {problem}")
                    if twin.process.poll() is not None or "no answer" in problem:
                        break
            else:
                done = True
        done = done or tally.left() < 30


class Broken(Exception):
    """A trial's name, and what the twin did that it must not."""
