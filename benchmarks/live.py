# SPDX-License-Identifier: Apache-2.0
"""Latency and load of the live twin beside a bare rclpy relay, in the same run.

A driver in a process of its own publishes sensor_msgs/Imu (and GPS) as a phone would and takes back
what the system under test, in another process, answers to each sample: the four nodes as
``suspension-twin run`` starts them, or a node that does nothing but publish the very message that it
received. Latency is from just before ``publish`` to the driver's callback. Both go the same way,
so their ratio is what the twin costs. The systems take turns in short rounds: whatever else the
machine does meanwhile hits both alike.

``--viewers N`` compares the twin alone with the twin while the process of the page (``run --view``) serves N viewers,
who take every frame, in turns again.

The memory part replays an hour of driving at full speed and watches the resident memory.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

os.environ.setdefault("ROS_DOMAIN_ID", "88")
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
from options import parse_options

#: The twin's p99 may be this many times the relay's.
BAR = 2.0
RATES = (100, 1000)
ANSWERS = {"relay": "relayed", "twin": "twin/vertical_acceleration"}
SPEED = 10.0
#: s after which a system that never answers is measured all the same.
LONGEST_WARM_UP = 30.0
#: s without an answer after which a drive is over: several times what a busy machine keeps a process waiting.
QUIET_AFTER = 2.0
QUIET = ["--ros-args", "--log-level", "error"]


def twin_file() -> Path:
    """The ready twin of the car paper's vehicle, on a level road."""
    from suspension_twin.cli.common import bundled

    return bundled("config", "twins", "ford_mondeo_mk4.yaml")


# -- the systems under test -------------------------------------------------------------------------


def relay(control: Connection) -> None:
    """A bare node on rclpy's own executor that publishes what it receives."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu

    rclpy.init(args=[])
    node = rclpy.create_node("relay", namespace="relay")
    publisher = node.create_publisher(Imu, ANSWERS["relay"], 100)
    # As deep as the twin's, so that neither loses for want of a queue.
    profile = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(Imu, "imu/data_raw", publisher.publish, profile)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _serve(control, lambda: executor.spin_once(timeout_sec=0.1))


def twin(control: Connection) -> None:
    """The four nodes in one process."""
    from suspension_twin.nodes.composed import Composed
    from suspension_twin.nodes.process import ros_context

    with ros_context(QUIET) as context:
        composed = Composed(context, twin_file(), namespace="twin")
        composed.settle_memory()
        _serve(control, composed.step)
        composed.close()


def _serve(control: Connection, step: Callable[[], None]) -> None:
    control.send("ready")
    while True:
        step()
        if control.poll():
            if control.recv() == "stop":
                return
            control.send(time.process_time())


# -- the driver -------------------------------------------------------------------------------------


class Driver:
    """A phone on a car that drives east, at any IMU rate."""

    def __init__(self, system: str) -> None:
        import rclpy
        from geometry_msgs.msg import AccelStamped, TwistStamped
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

        self.node = rclpy.create_node("driver", namespace=system)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.imu, self.fix, self.vel = Imu(), NavSatFix(), TwistStamped()
        self.imu.header.frame_id, self.fix.header.frame_id = "imu_link", "gps_link"
        self.fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
        self.fix.status.status = NavSatStatus.STATUS_FIX
        self.fix.position_covariance[0] = self.fix.position_covariance[4] = 1e-4
        self.out = self.node.create_publisher(Imu, "imu/data_raw", 1000)
        self.fix_out = self.node.create_publisher(NavSatFix, "fix", 10)
        self.vel_out = self.node.create_publisher(TwistStamped, "vel", 10)
        self.sent: dict[int, float] = {}
        self.answered: dict[int, float] = {}
        kind = Imu if system == "relay" else AccelStamped
        self.node.create_subscription(kind, f"/{system}/{ANSWERS[system]}", self._on_answer, 1000)
        self.began = 0

    def _on_answer(self, message: Any) -> None:
        now = time.perf_counter()
        stamp = message.header.stamp
        self.answered[stamp.sec * 1_000_000_000 + stamp.nanosec] = now

    def drive(self, rate: float, warm_up: float, seconds: float) -> None:
        """Drive for so long; ``sent`` and ``answered`` hold what happened since the warm-up, in which
        nodes are discovered and the rate is learnt: it lasts until the first answer, at most a minute."""
        while not self.out.get_subscription_count():
            self.executor.spin_once(timeout_sec=0.05)
        warm, count = int(warm_up * rate), int(seconds * rate)
        longest = warm + int(LONGEST_WARM_UP * rate)
        began, stamp = time.perf_counter(), time.time_ns()
        self.began = self.began or stamp
        noise = np.random.default_rng(0).normal(0.0, 0.05, (warm + count, 3)).tolist()
        self.sent.clear()
        self.answered.clear()
        k = 0
        while len(self.sent) < count:
            due = began + k / rate
            while (left := due - time.perf_counter()) > 0:
                self.executor.spin_once(timeout_sec=left)
            ns = stamp + round(k / rate * 1e9)
            message = self.imu
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 1_000_000_000)
            vector = message.linear_acceleration
            vector.x, vector.y, vector.z = noise[k % len(noise)]
            vector.z += 9.81 + 0.5 * math.sin(9.0 * k / rate)
            vector = message.angular_velocity
            vector.x, vector.y, vector.z = (0.02 * v for v in noise[-(k % len(noise)) - 1])
            if k % int(rate // 10) == 0:
                self._send_gps(ns)
            if self.sent or (k >= warm and self.answered) or k >= longest:
                self.sent[ns] = time.perf_counter()
            self.out.publish(message)
            k += 1
        # A system that lags behind still answers what it holds: over is when nothing comes any more.
        came, quiet = len(self.answered), time.perf_counter()
        while time.perf_counter() < quiet + QUIET_AFTER:
            self.executor.spin_once(timeout_sec=0.05)
            if len(self.answered) > came:
                came, quiet = len(self.answered), time.perf_counter()

    def _send_gps(self, ns: int) -> None:
        self.fix.header.stamp.sec, self.fix.header.stamp.nanosec = divmod(ns, 1_000_000_000)
        self.vel.header.stamp = self.fix.header.stamp
        east = SPEED * (ns - self.began) / 1e9  # on through the turns of the others, as the stamps go on
        self.fix.latitude, self.fix.longitude = 47.4025, 19.284 + east / 75_540.0
        self.vel.twist.linear.x = SPEED
        self.fix_out.publish(self.fix)
        self.vel_out.publish(self.vel)

    def latencies(self) -> list[float]:
        """Seconds from publish to answer of every answered sample of the last drive."""
        return [self.answered[ns] - at for ns, at in self.sent.items() if ns in self.answered]


def listen_to_all(control: Connection) -> None:
    """A dashboard: takes everything that the twin publishes."""
    import rclpy
    from geometry_msgs.msg import AccelStamped, PoseStamped
    from nav_msgs.msg import Odometry
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Imu, JointState
    from tf2_msgs.msg import TFMessage

    from suspension_twin_interfaces.msg import Gap

    rclpy.init(args=[])
    node = rclpy.create_node("dashboard", namespace="twin")
    for kind, topic in (
        (Imu, "imu/data"),
        (AccelStamped, "imu/vertical_acceleration"),
        (Odometry, "twin/odom"),
        (Imu, "twin/imu"),
        (PoseStamped, "twin/pose"),
        (JointState, "joint_states"),
        (TFMessage, "/tf"),
        (Gap, "twin/gap"),
    ):
        node.create_subscription(kind, topic, lambda _: None, 100)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _serve(control, lambda: executor.spin_once(timeout_sec=0.1))


#: Of the page; whoever sees the arguments of this benchmark's processes may look on.
TOKEN = "benchmark"


def watch(control: Connection, port: int, viewers: int) -> None:
    """So many pages that are open: each takes every frame through its WebSocket; answers with the frames so far."""
    import asyncio

    from aiohttp import ClientSession, WSMsgType

    frames = [0] * viewers

    async def look(number: int) -> None:
        async with (
            ClientSession() as session,
            session.ws_connect(f"http://127.0.0.1:{port}/ws?token={TOKEN}") as page,
        ):
            async for message in page:
                frames[number] += message.type is WSMsgType.TEXT

    async def work() -> None:
        pages = [asyncio.ensure_future(look(number)) for number in range(viewers)]
        while not all(frames):
            await asyncio.sleep(0.05)
            for page in pages:
                if page.done():
                    page.result()
        control.send("ready")
        while True:
            await asyncio.sleep(0.1)
            if control.poll():
                if control.recv() == "stop":
                    break
                control.send(sum(frames))
        for page in pages:
            page.cancel()

    asyncio.run(work())


@contextmanager
def pages_open(viewers: int) -> Iterator[Child]:
    """The node of the page in a process of its own, as ``run --view`` starts it, and its viewers."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = int(probe.getsockname()[1])
    with tempfile.TemporaryDirectory() as folder:
        given = {"twin": str(twin_file()), "port": port, "folder": folder, "token": TOKEN}
        words = [w for name, value in given.items() for w in ("-p", f"{name}:={value}")]
        command = [
            sys.executable,
            "-m",
            "suspension_twin.addons.nodes.viewer",
            *QUIET,
            "-r",
            "__ns:=/twin",
            *words,
        ]
        command = ["nice", "-n", "5", *command] if shutil.which("nice") else command
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            until = time.perf_counter() + 120.0
            while True:
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                if process.poll() is not None or time.perf_counter() > until:
                    raise SystemExit("the page's process does not serve")
                time.sleep(0.1)
            pages = Child(watch, port, viewers)
            try:
                yield pages
            finally:
                pages.stop()
        finally:
            process.terminate()
            process.wait(10.0)


# -- measuring --------------------------------------------------------------------------------------


class Child:
    """A process that serves until it is told to stop."""

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self.control, there = context.Pipe()
        self.process = context.Process(target=target, args=(there, *arguments), daemon=True)
        self.process.start()
        assert self.control.recv() == "ready"

    def cpu(self) -> float:
        """Seconds of processor time so far; of pages, their frames."""
        self.control.send("cpu")
        return float(self.control.recv())

    def stop(self) -> None:
        """End it."""
        self.control.send("stop")
        self.process.join(5.0)
        if self.process.is_alive():
            self.process.kill()


def measure_latency(seconds: float, rounds: int, warm_up: float, dashboard: bool) -> dict[str, Any]:
    """Both systems at every rate, in turns."""
    import rclpy

    children = {"relay": Child(relay), "twin": Child(twin)}
    if dashboard:
        children["dashboard"] = Child(listen_to_all)
    rclpy.init(args=[])
    drivers = {system: Driver(system) for system in ANSWERS}
    found: dict[str, Any] = {}
    for rate in RATES:
        rows = {s: {"latencies": [], "p99s": [], "cpu": 0.0, "sent": 0} for s in ANSWERS}
        for _ in range(rounds):
            for system, driver in drivers.items():
                before, began = children[system].cpu(), time.perf_counter()
                driver.drive(rate, warm_up, seconds / rounds)
                row: Any = rows[system]
                row["cpu"] += (children[system].cpu() - before) / (time.perf_counter() - began) / rounds
                latencies = driver.latencies()
                row["latencies"] += latencies
                row["p99s"].append(float(np.percentile(latencies, 99)) if latencies else math.inf)
                row["sent"] += len(driver.sent)
        found[str(rate)] = _summary(rows)
    for child in children.values():
        child.stop()
    rclpy.shutdown()
    return found


def measure_viewers(viewers: int, seconds: float, rounds: int, warm_up: float, rate: float) -> dict[str, Any]:
    """The twin's latency with nobody looking on, and with ``viewers`` pages open, in turns."""
    import rclpy

    children = {"relay": Child(relay), "twin": Child(twin)}
    rclpy.init(args=[])
    drivers = {system: Driver(system) for system in ANSWERS}
    rows: dict[str, Any] = {
        state: {s: {"latencies": [], "p99s": [], "cpu": 0.0, "sent": 0} for s in ANSWERS}
        for state in ("alone", "watched")
    }
    frames = 0.0
    for _ in range(rounds):
        for state in rows:
            with pages_open(viewers) if state == "watched" else nullcontext() as pages:
                for system, driver in drivers.items():
                    before, began = children[system].cpu(), time.perf_counter()
                    seen = pages.cpu() if pages is not None else 0.0
                    driver.drive(rate, warm_up, seconds / rounds)
                    took = time.perf_counter() - began
                    if pages is not None and system == "twin":
                        frames += (pages.cpu() - seen) / took / viewers / rounds
                    row = rows[state][system]
                    row["cpu"] += (children[system].cpu() - before) / took / rounds
                    latencies = driver.latencies()
                    row["latencies"] += latencies
                    row["p99s"].append(float(np.percentile(latencies, 99)) if latencies else math.inf)
                    row["sent"] += len(driver.sent)
    for child in children.values():
        child.stop()
    rclpy.shutdown()
    found: dict[str, Any] = {state: _summary(systems) for state, systems in rows.items()}
    ratios = {
        name: [w / a for w, a in zip(rows["watched"][s]["p99s"], rows["alone"][s]["p99s"], strict=True)]
        for name, s in (("p99_watched_over_alone", "twin"), ("p99_of_the_relay_watched_over_alone", "relay"))
    }
    found |= {name: round(float(np.median(values)), 3) for name, values in ratios.items()}
    return found | {"viewers": viewers, "rate": rate, "frames_per_second": round(frames, 1)}


def _summary(rows: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for system, row in rows.items():
        if not row["latencies"]:
            raise SystemExit(f"{system}: no answer to any of {row['sent']} samples")
        p50, p99 = np.percentile(np.array(row["latencies"]) * 1e6, [50, 99])
        out[system] = {
            "p50_us": round(float(p50), 1),
            "p99_us": round(float(p99), 1),
            "cpu_share": round(row["cpu"], 4),
            "sent": row["sent"],
            "lost": row["sent"] - len(row["latencies"]),
        }
    out["p99_ratio"] = round(out["twin"]["p99_us"] / out["relay"]["p99_us"], 3)
    # Each round has its own neighbours on the machine: the middle of the rounds' ratios is steadier.
    ratios = [t / r for t, r in zip(rows["twin"]["p99s"], rows["relay"]["p99s"], strict=True)]
    out["p99_ratio_median_of_rounds"] = round(float(np.median(ratios)), 3)
    out["within_bar"] = bool(out["p99_ratio"] <= BAR)
    return out


def synthetic_hour(seconds: float, rate: float = 100.0) -> Any:
    """A drive round a circle of 60 m, with noise, GPS at 10 Hz."""
    from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
    from suspension_twin.pose.local_map import LocalMap
    from suspension_twin.vehicle.twin import load_twin

    radius, rng = 60.0, np.random.default_rng(1)
    t = np.arange(int(seconds * rate)) / rate
    force = rng.normal(0.0, 0.05, (t.size, 3)) + np.array([0.0, SPEED**2 / radius, 9.81])
    force[:, 2] += 0.5 * np.sin(9.0 * t)
    turn = rng.normal(0.0, 0.002, (t.size, 3)) + np.array([0.0, 0.0, SPEED / radius])
    at = t[:: int(rate // 10)]
    angle = SPEED / radius * at
    datum = load_twin(twin_file()).datum
    assert datum is not None
    place = LocalMap(datum).to_geodetic(
        np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), np.zeros(at.size)])
    )
    velocity = SPEED * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(at.size)])
    fix = FixData(
        1.7e9 + at,
        place[:, 0],
        place[:, 1],
        place[:, 2],
        np.zeros(at.size, dtype=np.int8),
        np.full((at.size, 3), 0.02),
    )
    return Drive("hour", ImuData(1.7e9 + t, force, turn), fix, VelocityData(1.7e9 + at, velocity))


def measure_memory(seconds: float) -> dict[str, Any]:
    """Resident memory while ``seconds`` of driving are replayed at full speed."""
    from suspension_twin.nodes.composed import Composed, Playback
    from suspension_twin.nodes.process import ros_context

    drive = synthetic_hour(seconds)
    marks: list[tuple[float, float]] = []
    with ros_context(QUIET) as context:
        composed = Composed(context, twin_file(), "memory", Playback(drive, math.inf))
        composed.settle_memory()
        answered = composed.nodes["suspension_model"].outputs["twin/vertical_acceleration"]
        began = time.perf_counter()
        while not composed.finished:
            composed.step()
            assert composed.player is not None
            if composed.player.position >= len(marks) * seconds / 100:
                marks.append((composed.player.position, resident()))
        took = time.perf_counter() - began
        sent, lost = answered.sent, len(drive.imu) - answered.sent
        composed.close()
    # The first tenth fills caches and windows; after it nothing may grow.
    late = np.array([m for m in marks if m[0] > 0.1 * seconds])
    slope = float(np.polyfit(late[:, 0] / 3600.0, late[:, 1], 1)[0])
    return {
        "replayed_s": seconds,
        "took_s": round(took, 1),
        "times_real_time": round(seconds / took, 1),
        "answers": sent,
        "unanswered": lost,
        "first_mib": round(marks[0][1], 1),
        "last_mib": round(marks[-1][1], 1),
        "growth_mib_per_hour": round(slope, 2),
    }


def resident() -> float:
    """Resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> int:
    """Measure, print a table or JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="measured seconds per system and rate; 0: none"
    )
    parser.add_argument("--rounds", type=int, default=5, help="turns that the systems take")
    parser.add_argument("--warm-up", type=float, default=2.0, help="seconds of a turn that do not count")
    parser.add_argument(
        "--dashboard", action="store_true", help="a further process takes all that the twin publishes"
    )
    parser.add_argument(
        "--replay", type=float, default=3600.0, help="seconds of driving for the memory; 0: none"
    )
    parser.add_argument(
        "--source",
        action="store_true",
        help="phones that push over HTTP instead, from their request to twin/imu",
    )
    parser.add_argument(
        "--viewers",
        type=int,
        default=0,
        help="the twin with so many pages open, beside none; 0: not measured",
    )
    parser.add_argument("--phones", type=int, default=4, help="with --source: how many at once")
    parser.add_argument("--imu-rate", type=float, default=400.0, help="with --source: Hz of each phone")
    parser.add_argument(
        "--batch", type=float, default=0.0, help="with --source: s between messages; 0: one a sample"
    )
    arguments = parse_options(parser, seconds=1.0, rounds=1, warm_up=0.5, replay=20.0)
    if arguments.source:
        from live_sources import Load, measure_source, print_source

        load = Load(arguments.phones, arguments.imu_rate, arguments.batch)
        found = measure_source(load, arguments.seconds, arguments.rounds, arguments.warm_up)
        if arguments.json:
            print(json.dumps(found))
        else:
            print_source(found)
        return 0
    if arguments.viewers:
        found = measure_viewers(
            arguments.viewers, arguments.seconds, arguments.rounds, arguments.warm_up, RATES[0]
        )
        if arguments.json:
            print(json.dumps(found))
        else:
            _print_viewers(found)
        return 0
    result: dict[str, Any] = {"bar": BAR, "cores": os.cpu_count(), "dashboard": arguments.dashboard}
    result["rates"] = {}
    if arguments.seconds > 0:
        result["rates"] = measure_latency(
            arguments.seconds, arguments.rounds, arguments.warm_up, arguments.dashboard
        )
    if arguments.replay > 0:
        result["memory"] = measure_memory(arguments.replay)
    if arguments.json:
        print(json.dumps(result))
    else:
        _print(result)
    return 0


def _print_viewers(result: dict[str, Any]) -> None:
    print(
        f"{result['rate']:g} Hz, {result['viewers']} viewers at {result['frames_per_second']:g} frames a second each"
    )
    print(f"{'pages':>8} {'system':>7} {'p50 µs':>8} {'p99 µs':>8} {'CPU of a core':>14} {'lost':>13}")
    for state in ("alone", "watched"):
        for system in ANSWERS:
            row = result[state][system]
            print(
                f"{state:>8} {system:>7} {row['p50_us']:8.0f} {row['p99_us']:8.0f} {100 * row['cpu_share']:12.1f} % "
                f"{row['lost']:>5} of {row['sent']:>5}"
            )
    print(
        f"p99 watched / alone, median of the rounds: twin {result['p99_watched_over_alone']:.2f}, "
        f"relay {result['p99_of_the_relay_watched_over_alone']:.2f}"
    )


def _print(result: dict[str, Any]) -> None:
    if result["rates"]:
        print(f"{'IMU rate':>9} {'system':>7} {'p50 µs':>8} {'p99 µs':>8} {'CPU of a core':>14} {'lost':>13}")
    for rate, rows in result["rates"].items():
        for system in ANSWERS:
            row = rows[system]
            lost = f"{row['lost']} of {row['sent']}"
            share = f"{100 * row['cpu_share']:.1f} %"
            print(
                f"{rate + ' Hz':>9} {system:>7} {row['p50_us']:8.0f} {row['p99_us']:8.0f} {share:>14} {lost:>13}"
            )
        word = "within" if rows["within_bar"] else "beyond"
        print(
            f"{'':>9} p99 of the twin / of the relay: {rows['p99_ratio']:.2f}, {word} the bar of {result['bar']:g} "
            f"(median of the rounds {rows['p99_ratio_median_of_rounds']:.2f})"
        )
    if "memory" in result:
        m = result["memory"]
        print(
            f"replay of {m['replayed_s']:.0f} s in {m['took_s']} s ({m['times_real_time']} times real time), "
            f"{m['answers']} answers, {m['unanswered']} without; memory {m['first_mib']} to {m['last_mib']} MiB, "
            f"{m['growth_mib_per_hour']:+.2f} MiB an hour after the first tenth"
        )


if __name__ == "__main__":
    sys.exit(main())
