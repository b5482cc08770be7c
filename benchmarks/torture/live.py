# SPDX-License-Identifier: Apache-2.0
"""The running twin under bad messages, wrong clocks and load, watched from another process."""

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

__all__ = ["BARS", "clocks", "load", "messages"]

BARS = {
    "messages": "no node dies, nothing published that is not finite, memory flat, an answer within 1 s of the last",
    "time": "resets, says so, no drift of memory or state; answers within 1 s on the new time",
    "load": "no loss at 1 kHz where the machine allows, else said; memory flat within 5 MiB",
}

_BAG = ROOT / "bags" / "crg_road"
_SPACE = "tortured"
#: Of the recorded drive: the car moves and its heading is soon known.
_FROM, _WARM = 5.0, 12.0
_PATIENCE = 1.0  # s to an answer
_NUMBERS = [math.nan, math.inf, -math.inf, 1.8e308, -1e300, 1e30, 5e-324, 0.0, -0.0, 1e9, -1e9]
_STAMPS = [(0, 0), (-1, 0), (-(1 << 31), 0), ((1 << 31) - 1, 999_999_999), (1 << 30, 0xFFFFFFFF), (5, 5)]


class Twin:
    """``suspension-twin run`` in a process of its own, and everything that it publishes.

    An answer counts from when the twin published it, by the stamp that the middleware puts on: how late the watcher
    takes it out of its queue is the watcher's affair.
    """

    def __init__(self, space: str = _SPACE, arguments: Sequence[str] = (), clock: bool = False) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import AccelStamped, PoseStamped, QuaternionStamped, TwistStamped
        from nav_msgs.msg import Odometry
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import Imu, JointState, NavSatFix

        from suspension_twin.drive.recording import read_recording
        from suspension_twin_interfaces.msg import Gap

        self.said = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [*PROGRAM, "run", "--twin", str(_BAG / "twin.yaml"), "--namespace", space, *arguments],
            stdout=subprocess.DEVNULL,
            stderr=self.said,
            env=environment(),
        )
        if not rclpy.ok():
            rclpy.init(args=["--ros-args", "--log-level", "error"])
        self.node = rclpy.create_node("torturer", namespace=space)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        kinds = {"/imu/data_raw": Imu, "/fix": NavSatFix, "/vel": TwistStamped, "/heading": QuaternionStamped}
        qos = QoSProfile(depth=2000)
        self.out = {name: self.node.create_publisher(kind, name[1:], qos) for name, kind in kinds.items()}
        self.clock = self.node.create_publisher(Clock, "/clock", 10) if clock else None
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
            self._listen(kind, name, self._listener(name))
        self._listen(DiagnosticArray, "/diagnostics", self._on_diagnostics)
        self.space = space
        contents = read_recording(_BAG)
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

        self.listeners.append((self.node.create_subscription(kind, name, taken, 2000), heard))

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
            if self.clock is not None:
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

        self.clock.publish(Clock(clock=Time(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)))

    def memory(self) -> float:
        """Resident memory of the twin in MiB."""
        text = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        found = re.search(r"VmRSS:\s*(\d+)", text)
        return int(found[1]) / 1024 if found else 0.0

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


def _bad(rng: np.random.Generator, data: bytes, now: int) -> bytes:
    """A message that no sensor sends."""
    kind = int(rng.integers(6))
    if kind == 0:  # cut off
        return data[: int(rng.integers(len(data)))]
    if kind == 1:  # bits
        changed = bytearray(data)
        for _ in range(int(rng.integers(1, 30))):
            changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    if kind == 2:
        sec, nanosec = _STAMPS[int(rng.integers(len(_STAMPS)))]
        return data[:4] + struct.pack("<iI", sec, nanosec) + data[12:]
    if kind == 3:
        data = stamped(data, max(now + int(rng.normal(0, 1e9) * 10.0 ** rng.integers(0, 6)), 0))
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):  # doubles follow the header
        begin = len(changed) - 8 * int(rng.integers(1, 30))
        if begin > 12:
            changed[begin : begin + 8] = struct.pack("<d", _NUMBERS[int(rng.integers(len(_NUMBERS)))])
    if kind == 5:
        changed[16:20] = struct.pack("<I", int(rng.choice([0, 1, 1 << 20, (1 << 32) - 1])))
        return bytes(changed)
    return bytes(changed) if kind == 3 else stamped(bytes(changed), now)


def _calls(twin: Twin, rng: np.random.Generator) -> None:
    """Services with what nobody should ask for; the answers are taken as they come."""
    from std_srvs.srv import Trigger

    from suspension_twin_interfaces.srv import LoadTwin, SetDatum

    if not twin.clients:
        services = ((Trigger, "reset"), (LoadTwin, "load_twin"))
        twin.clients = [twin.node.create_client(kind, f"suspension_model/{name}") for kind, name in services]
        twin.clients.append(twin.node.create_client(SetDatum, "pose_injector/set_datum"))
    client = twin.clients[int(rng.integers(len(twin.clients)))]
    request = client.srv_type.Request()
    for name, kind in request.get_fields_and_field_types().items():
        if kind == "string":
            setattr(request, name, str(rng.choice(["", "/dev/zero", "x" * 100_000, "[/b]\n", "/etc/passwd"])))
        elif kind in ("double", "float"):
            setattr(request, name, float(rng.choice(_NUMBERS[:6])))
        elif "GeoPoint" in kind or hasattr(getattr(request, name), "latitude"):
            getattr(request, name).latitude = math.nan
    if client.service_is_ready():
        client.call_async(request)


@contextlib.contextmanager
def _running(tally: Tally) -> Iterator[Twin]:
    busy = os.getloadavg()[0] / (os.cpu_count() or 1)
    if busy > 1.5:
        tally.note(f"other processes were at work: {busy:.0f} for each core, so answers come late")
    twin = Twin()
    try:
        twin.wait()
        twin.drive(_WARM)
        yield twin
    finally:
        twin.close()


def _recovers(tally: Tally, twin: Twin) -> str | None:
    """Clean messages again: how long until one is answered, and whether nothing else is wrong."""
    began, twin.watched_late = time.time(), 0.0
    sent = twin.drive(10.0, enough=5)
    twin.take(0.0)
    answered = [twin.answered[s] - began for s in sent if s in twin.answered]
    if problem := twin.problem():
        return problem
    if not answered:
        return f"no answer within 10 s; says: {'; '.join(dict.fromkeys(twin.levels[-5:]))[:200]}"
    tally.measure("first answer, s", min(answered))
    tally.measure("watched late, s", twin.watched_late)
    return f"answers after {min(answered):.1f} s" if min(answered) > _PATIENCE else None


def _watched(tally: Tally, trial: Callable[[Twin, np.random.Generator, int], str]) -> None:
    """Trials on one twin, which is started again where it fails; memory from the tenth trial on."""
    done = False
    while not done:
        with _running(tally) as twin:
            settled = 0.0
            for here, number in enumerate(tally.numbers(), 1):
                what = trial(twin, tally.rng(number), number)
                twin.answered.clear()
                problem = twin.problem() or _recovers(tally, twin)
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


def messages(tally: Tally) -> None:
    """Five hundred bad messages and two calls a trial."""

    def trial(twin: Twin, rng: np.random.Generator, number: int) -> str:
        names = list(twin.samples)
        for k in range(500):
            name = names[int(rng.integers(len(names)))]
            data = twin.samples[name][int(rng.integers(len(twin.samples[name])))]
            twin.send(name, _bad(rng, data, twin.time + k * 1_000_000))
            if k % 50 == 0:
                twin.listen(0.01)
        for _ in range(2):
            _calls(twin, rng)
        twin.listen(0.1)
        twin.time += 600_000_000
        return "500 bad messages"

    _watched(tally, trial)


def clocks(tally: Tally) -> None:
    """One thing that clocks do, a trial."""

    def jump(seconds: float) -> Callable[[Twin], None]:
        def act(twin: Twin) -> None:
            twin.time += int(seconds * 1e9)

        return act

    def stop(twin: Twin) -> None:
        data = stamped(twin.samples["/imu/data_raw"][0], twin.time)
        for _ in range(200):
            twin.send("/imu/data_raw", data)
            twin.listen(0.001)

    def two(twin: Twin) -> None:
        for k, data in enumerate(twin.samples["/imu/data_raw"][:200]):
            twin.send("/imu/data_raw", stamped(data, twin.time + k * 10_000_000))
            twin.send("/imu/data_raw", stamped(data, twin.time + k * 10_000_000 - 3_000_000))
            twin.listen(0.002)
        twin.time += 200 * 10_000_000

    def loops(twin: Twin) -> None:
        start = twin.time
        for _ in range(20):
            twin.time = start
            twin.drive(1.0, speed=100.0)
        twin.time = start

    def fast(twin: Twin) -> None:
        twin.drive(20.0, speed=100.0)

    def disorder(twin: Twin) -> None:
        order = np.random.default_rng(0).permutation(100)
        for k in order:
            twin.send(
                "/imu/data_raw",
                stamped(twin.samples["/imu/data_raw"][int(k)], twin.time + int(k) * 10_000_000),
            )
        twin.time += 100 * 10_000_000

    kinds: dict[str, Callable[[Twin], None]] = {
        "an hour forward": jump(3600.0),
        "an hour back": jump(-3600.0),
        "NTP step forward": jump(0.5),
        "NTP step back": jump(-0.5),
        "leap second": jump(-1.0),
        "a day back": jump(-86_400.0),
        "stamps stand still": stop,
        "two publishers": two,
        "100 times as fast": fast,
        "looped": loops,
        "out of order": disorder,
    }

    def trial(twin: Twin, rng: np.random.Generator, number: int) -> str:
        name = list(kinds)[number % len(kinds)]
        twin.drive(float(rng.uniform(0.2, 1.0)))
        kinds[name](twin)
        return name

    _watched(tally, trial)


def load(tally: Tally) -> None:
    """Ten seconds of IMU at 1 kHz, every other time beside a calibration on the same cores."""
    with _running(tally) as twin:
        settled = 0.0
        for number in tally.numbers():
            beside = None
            if number % 2:
                bag = ROOT / "bags" / "bump_15kmh"
                out = Path("/tmp") / f"torture_load_{os.getpid()}.yaml"
                beside = subprocess.Popen(
                    [*PROGRAM, "calibrate", "--twin", str(bag / "twin.yaml"), str(bag), "--out", str(out)],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=environment(),
                )
                time.sleep(3.0)
            twin.answered.clear()
            sent: dict[int, float] = {}
            began, base = time.monotonic(), twin.time
            imu = twin.samples["/imu/data_raw"]
            for k in range(10_000):
                while (left := began + k / 1000 - time.monotonic()) > 0:
                    twin.executor.spin_once(timeout_sec=left)
                stamp = base + k * 1_000_000
                if k % 100 == 0:
                    for name in ("/fix", "/vel"):
                        rows = twin.samples[name]
                        twin.send(name, stamped(rows[k // 100 % len(rows)], stamp))
                sent[stamp] = time.monotonic()
                twin.send("/imu/data_raw", stamped(imu[k // 10 % len(imu)], stamp))
            late = time.monotonic() - began - 10.0
            twin.listen(1.0)
            twin.time = base + 11_000_000_000
            if beside is not None:
                beside.kill()
                beside.wait()
            delays = sorted(twin.answered[s] - t for s, t in sent.items() if s in twin.answered)
            what = "beside a calibration" if beside is not None else "alone"
            tally.count(what)
            if problem := twin.problem():
                tally.fail(problem)
                return
            if not delays:
                tally.fail(f"{what}: no answer")
                continue
            tally.measure(f"lost {what}, %", 100 * (1 - len(delays) / len(sent)))
            tally.measure(f"p99 {what}, ms", 1e3 * delays[int(0.99 * len(delays))])
            if late > 0.2:
                tally.note(f"this machine could not send 1 kHz {what}: 10 s took {10 + late:.1f} s")
            if number == 0:
                settled = twin.memory()
            elif settled:
                tally.measure("memory grown, MiB", twin.memory() - settled)
