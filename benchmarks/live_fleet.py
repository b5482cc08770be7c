# SPDX-License-Identifier: Apache-2.0
"""How many live twins this machine carries, and how late their answers are.

A driver in a process of its own publishes sensor_msgs/Imu (and GPS at 10 Hz) for every vehicle of a fleet, their
samples spread evenly over time, and takes back what each twin answers to each sample. The twins run as
``suspension-twin run --fleet`` holds them, in ``--processes`` processes. Latency is from just before ``publish`` to the
driver's callback.

The machine carries so many twins if every sample is answered and the 99th percentile of the latency is below the period
of the samples. Without ``--twins`` the largest such number is searched: doubled until it is too many, then halved in
between; a number that fails is tried once more, since other programs on the machine delay single samples. How late the
driver itself sent says whether the machine had room for the measurement at all.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from functools import partial
from typing import Any

os.environ.setdefault("ROS_DOMAIN_ID", "89")
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import psutil
from options import parse_options

SPEED = 10.0
QUIET = ["--ros-args", "--log-level", "error"]
#: s before the measurement, in which the rate of the IMU is learnt and the pose found.
WARM_UP = 3.0


class Driver:
    """The sensors of many vehicles that drive east."""

    def __init__(self, namespaces: list[str]) -> None:
        import rclpy
        from geometry_msgs.msg import AccelStamped, TwistStamped
        from rclpy.experimental.events_executor import EventsExecutor
        from rclpy.utilities import get_default_context
        from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

        self.node = rclpy.create_node("driver")
        self.executor = EventsExecutor(context=get_default_context())
        self.executor.add_node(self.node)
        self.imu, self.fix, self.vel = Imu(), NavSatFix(), TwistStamped()
        self.imu.header.frame_id, self.fix.header.frame_id = "imu_link", "gps_link"
        self.fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
        self.fix.status.status = NavSatStatus.STATUS_FIX
        self.fix.position_covariance[0] = self.fix.position_covariance[4] = 1e-4
        self.outs = []
        self.sent: list[dict[int, float]] = [{} for _ in namespaces]
        self.latencies: list[float] = []
        for number, name in enumerate(namespaces):
            self.outs.append(
                (
                    self.node.create_publisher(Imu, f"/{name}/imu/data_raw", 100),
                    self.node.create_publisher(NavSatFix, f"/{name}/fix", 10),
                    self.node.create_publisher(TwistStamped, f"/{name}/vel", 10),
                )
            )
            self.node.create_subscription(
                AccelStamped,
                f"/{name}/twin/vertical_acceleration",
                partial(self._on_answer, number),
                1000,
            )

    def _on_answer(self, number: int, message: Any) -> None:
        stamp = message.header.stamp
        at = self.sent[number].pop(stamp.sec * 1_000_000_000 + stamp.nanosec, None)
        if at is not None:
            self.latencies.append(time.perf_counter() - at)

    def found(self) -> bool:
        """Whether every twin listens to every sensor."""
        return all(p.get_subscription_count() for out in self.outs for p in out)

    def wait(self, seconds: float) -> None:
        """Take answers for so long."""
        until = time.perf_counter() + seconds
        while (left := until - time.perf_counter()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def drive(self, rate: float, seconds: float) -> tuple[int, list[float]]:
        """Drive for so long after the warm-up; returns samples sent and the s by which each was sent late."""
        many = len(self.outs)
        warm, total = int(WARM_UP * rate), int((WARM_UP + seconds) * rate)
        noise = np.random.default_rng(0).normal(0.0, 0.05, (total, 6)).tolist()
        began, stamp = time.perf_counter(), time.time_ns()
        late: list[float] = []
        for k in range(total):
            for number, out in enumerate(self.outs):
                due = (k + number / many) / rate
                while (left := began + due - time.perf_counter()) > 0.0:
                    self.executor.spin_once(timeout_sec=left)
                if k >= warm:
                    late.append(time.perf_counter() - began - due)
                self._send(out, number, stamp, due, noise[k], k % int(rate // 10) == 0, k >= warm)
        return (total - warm) * many, late

    def _send(
        self, out: Any, number: int, start: int, due: float, noise: list[float], gps: bool, counts: bool
    ) -> None:
        ns = start + round(due * 1e9)
        stamp = self.imu.header.stamp
        stamp.sec, stamp.nanosec = divmod(ns, 1_000_000_000)
        force, turn = self.imu.linear_acceleration, self.imu.angular_velocity
        force.x, force.y, force.z = noise[:3]
        force.z += 9.81 + 0.5 * math.sin(9.0 * due)
        turn.x, turn.y, turn.z = (0.02 * v for v in noise[3:])
        if gps:
            self.fix.header.stamp = self.vel.header.stamp = stamp
            self.fix.latitude, self.fix.longitude = 47.4025 + 1e-3 * number, 19.284 + SPEED * due / 75_540.0
            self.vel.twist.linear.x = SPEED
            out[1].publish(self.fix)
            out[2].publish(self.vel)
        if counts:
            self.sent[number][ns] = time.perf_counter()
        out[0].publish(self.imu)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()


def measure(twins: int, processes: int, rate: float, seconds: float) -> dict[str, Any]:
    """Latency and processor time of so many twins."""
    from suspension_twin.cli.common import bundled
    from suspension_twin.nodes.composed import Helpers

    names = [f"car_{number}" for number in range(twins)]
    file = str(bundled("config", "twins", "ford_mondeo_mk4.yaml"))
    shares = [dict.fromkeys(names[k::processes], file) for k in range(min(processes, twins))]
    driver = Driver(names)
    try:
        with Helpers(shares, QUIET) as helpers:
            helpers.wait(lambda: True)
            children = [psutil.Process(pid) for pid in helpers.pids]
            until = time.monotonic() + 60.0
            while not driver.found():
                driver.wait(0.1)
                if time.monotonic() > until:
                    raise SystemExit("the twins do not listen")
            driver.wait(1.0)
            before, own, began = (
                [sum(c.cpu_times()[:2]) for c in children],
                time.process_time(),
                time.perf_counter(),
            )
            sent, late = driver.drive(rate, seconds)
            took = time.perf_counter() - began
            used = [sum(c.cpu_times()[:2]) - b for c, b in zip(children, before, strict=True)]
            share = (time.process_time() - own) / took
            memory = sum(c.memory_info().rss for c in children)
            driver.wait(1.0)
    finally:
        driver.close()
    p50, p99 = np.percentile(driver.latencies or [math.inf], [50, 99]) * 1e3
    return {
        "twins": twins,
        "sent": sent,
        "lost": sent - len(driver.latencies),
        "p50_ms": round(float(p50), 3),
        "p99_ms": round(float(p99), 3),
        "cpu_per_twin": round(sum(used) / took / twins, 4),
        "busiest_process": round(max(used) / took, 3),
        "memory_mib": round(memory / (1 << 20)),
        "driver_cpu": round(share, 3),
        "driver_late_p99_ms": round(float(np.percentile(late, 99)) * 1e3, 3),
        "carried": bool(sent == len(driver.latencies) and p99 < 1e3 / rate),
    }


def search(most: int, **given: Any) -> list[dict[str, Any]]:
    """Rows of :func:`measure` around the largest number that is carried."""
    rows = []
    low, high, number = 0, most + 1, 1
    while low < number < high:
        for _ in range(2):
            row = measure(number, **given)
            rows.append(row)
            show(row)
            if row["carried"]:
                break
        low, high = (number, high) if row["carried"] else (low, number)
        number = min(2 * low, most) if high > most else (low + high) // 2
        if high - low <= max(1, low // 10):
            break
    return rows


COLUMNS = {
    "twins": "twins",
    "lost": "lost",
    "p50_ms": "p50 [ms]",
    "p99_ms": "p99 [ms]",
    "cpu_per_twin": "cores a twin",
    "busiest_process": "busiest process",
    "memory_mib": "MiB",
    "driver_cpu": "driver",
    "driver_late_p99_ms": "driver late p99 [ms]",
    "carried": "carried",
}
QUIETLY = False


def show(row: dict[str, Any]) -> None:
    """One line for people."""
    if not QUIETLY:
        print("  ".join(f"{row[key]!s:>{len(name)}}" for key, name in COLUMNS.items()), flush=True)


def main() -> None:
    global QUIETLY
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--twins", type=int, nargs="+", help="measure these numbers instead of searching")
    parser.add_argument("--most", type=int, default=128, help="largest number that is tried")
    parser.add_argument("--processes", type=int, default=1, help="processes that hold the twins")
    parser.add_argument("--rate", type=float, default=100.0, help="Hz of the IMU")
    parser.add_argument("--seconds", type=float, default=10.0, help="s of every measurement")
    parser.add_argument("--json", action="store_true", help="figures as one JSON object")
    options = parse_options(parser, twins=[1], seconds=2.0)
    QUIETLY = options.json
    import rclpy

    rclpy.init(args=[])
    if not QUIETLY:
        print("  ".join(COLUMNS.values()), flush=True)
    given = {"processes": options.processes, "rate": options.rate, "seconds": options.seconds}
    if options.twins:
        rows = []
        for number in options.twins:
            rows.append(measure(number, **given))
            show(rows[-1])
    else:
        rows = search(options.most, **given)
    carried = max((row["twins"] for row in rows if row["carried"]), default=0)
    load = os.getloadavg()[0]
    if options.json:
        print(json.dumps({"rows": rows, "carried": carried, **given, "cores": os.cpu_count(), "load": load}))
    else:
        print(
            f"{carried} twins at {options.rate:g} Hz in {options.processes} process(es) on {os.cpu_count()} cores; "
            f"load of the machine {load:.1f}"
        )
    rclpy.shutdown()


if __name__ == "__main__":
    main()
