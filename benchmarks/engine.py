# SPDX-License-Identifier: Apache-2.0
"""From the sample of an IMU to the frame of an engine that shows it, and how far from its true place a car is drawn.

A driver publishes the samples of a car that goes straight on at one speed, 100 a second, with the time of sending as
their stamps; the four nodes answer in a process of their own; an engine draws at a rate of its own, as the example for
CARLA in ``docs/engines.md`` does. The age of a frame is from the sample's stamp to the frame: what a picture is behind
the sensor where poses are held. The place is that of the held pose and of the one carried on to the frame, against the
true one. An engine's own time to draw comes on top of either.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from typing import Any

import live  # sets the ROS domain
import numpy as np
from options import parse_options

from suspension_twin.addons.view.frames import FramePoses


class Engine:
    """Draws at ``rate`` Hz: at each frame its moment in s, the stamp of the newest pose, and the places along x of that
    pose and of the one carried on."""

    def __init__(self, rate: float) -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped
        from rclpy.executors import SingleThreadedExecutor

        self.frames: list[tuple[float, float, float, float]] = []
        self._rate, self._poses, self._held = rate, FramePoses(), 0.0
        self._node = rclpy.create_node("engine", namespace="twin")
        self._node.create_subscription(PoseStamped, "twin/pose", self._take, 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _take(self, message: Any) -> None:
        stamp, p, q = message.header.stamp, message.pose.position, message.pose.orientation
        self._held = p.x
        self._poses.push(stamp.sec + 1e-9 * stamp.nanosec, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

    def _run(self) -> None:
        due = time.perf_counter()
        while not self._ends.is_set():
            due += 1.0 / self._rate
            while (left := due - time.perf_counter()) > 0:
                self._executor.spin_once(timeout_sec=left)
            now = time.time_ns() / 1e9
            pose = self._poses.at(now)
            if pose is not None:
                self.frames.append((now, pose.stamp, self._held, pose.place[0]))

    def close(self) -> None:
        """Draw no more."""
        self._ends.set()
        self._thread.join()
        self._node.destroy_node()


def measure(seconds: float, warm_up: float, rate: float) -> dict[str, float]:
    """Ages in ms and distances from the true place in m over all frames."""
    import rclpy

    nodes = live.Child(live.twin)
    rclpy.init(args=[])
    driver, engine = live.Driver("twin"), Engine(rate)
    driver.drive(100.0, warm_up, seconds)
    engine.close()
    nodes.stop()
    rclpy.shutdown()
    first, last = (ns / 1e9 for ns in (min(driver.sent), max(driver.sent)))
    frames = np.array([f for f in engine.frames if first + 0.5 < f[0] < last])
    if not len(frames):
        raise SystemExit("engine.py: no pose came")
    now, stamp, held, ahead = frames.T
    # The car goes straight on at one speed: the line through all poses at their stamps is its way.
    true = np.polyval(np.polyfit(stamp - first, held, 1), now - first)
    age = 1e3 * (now - stamp)
    rows = {"age_ms": age, "held_off_m": np.abs(true - held), "carried_on_off_m": np.abs(true - ahead)}
    percentiles = {f"{name}_p{p}": float(np.percentile(v, p)) for name, v in rows.items() for p in (50, 99)}
    return {"frames": len(frames), **percentiles}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the measurement")
    parser.add_argument("--warm-up", type=float, default=5.0, help="s of driving before")
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second of the engine")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    arguments = parse_options(parser, seconds=3.0, warm_up=2.0)
    found = measure(arguments.seconds, arguments.warm_up, arguments.rate)
    if arguments.json:
        print(json.dumps(found))
        return 0
    print(
        f"{found['frames']} frames, {arguments.rate:g} a second, at {3.6 * live.SPEED:g} km/h:       p50     p99"
    )
    for name, text in (
        ("age_ms", "from a sample of the IMU to the frame, ms"),
        ("held_off_m", "off the car's place where poses are held, m"),
        ("carried_on_off_m", "off it where they are carried on, m"),
    ):
        print(f"  {text:46} {found[f'{name}_p50']:7.3f} {found[f'{name}_p99']:7.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
