# SPDX-License-Identifier: Apache-2.0
"""What a game receives of a twin through Unity's ROS-TCP-Endpoint: loss and latency at 60 Hz.

``--endpoint`` is a folder with the endpoint's sources (branch main-ros2), which are run as they are. The twin replays a
bundled drive; a client that speaks the endpoint's protocol (length, destination, length, CDR) subscribes as a Unity
project would. Latency is from a message's arrival at a plain ROS subscription in the client's process to its arrival
at the client's socket: what the way through the endpoint adds.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("ROS_DOMAIN_ID", "87")
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
from extras import unavailable
from options import parse_options

TOPICS = {
    "/twin/pose": "geometry_msgs/PoseStamped",
    "/joint_states": "sensor_msgs/JointState",
    "/tf": "tf2_msgs/TFMessage",
}
#: Where the first stamp lies in a message: behind the encapsulation; a TFMessage has its number of transforms first.
STAMP = {"/twin/pose": 4, "/joint_states": 4, "/tf": 8}
BAG = Path(__file__).resolve().parents[1] / "bags" / "bump_15kmh"


class Client:
    """As ROS-TCP-Connector: registers its topics, then reads."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self.arrived: dict[str, dict[int, float]] = {topic: {} for topic in TOPICS}
        for topic, kind in TOPICS.items():
            self._send("__subscribe", json.dumps({"topic": topic, "message_name": kind}).encode() + b"\0")
        threading.Thread(target=self._read, daemon=True).start()

    def _send(self, destination: str, data: bytes) -> None:
        name = destination.encode()
        self.socket.sendall(struct.pack("<I", len(name)) + name + struct.pack("<I", len(data)) + data)

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            more = self.socket.recv(size - len(data))
            if not more:
                raise ConnectionError
            data += more
        return data

    def _block(self) -> bytes:
        return self._exactly(struct.unpack("<I", self._exactly(4))[0])

    def _read(self) -> None:
        self.socket.settimeout(None)
        try:
            while True:
                topic, data = self._block().decode(), self._block()
                if topic in self.arrived:
                    self.arrived[topic][stamp_of(topic, data)] = time.perf_counter()
        except OSError:
            return


def stamp_of(topic: str, data: bytes) -> int:
    """The message's first stamp in ns."""
    seconds, nanoseconds = struct.unpack_from("<iI", data, STAMP[topic])
    return int(seconds * 1_000_000_000 + nanoseconds)


def measure(endpoint: Path, seconds: float) -> list[dict[str, Any]]:
    """One row for each topic."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import QoSProfile
    from rclpy.utilities import try_shutdown
    from sensor_msgs.msg import JointState
    from tf2_msgs.msg import TFMessage

    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(endpoint), os.environ.get("PYTHONPATH", "")])
    }
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = [sys.executable, "-m", "ros_tcp_endpoint.default_server_endpoint", "--ros-args"]
    server += ["-p", "ROS_IP:=127.0.0.1", "-p", f"ROS_TCP_PORT:={port}"]
    twin = [
        sys.executable,
        "-m",
        "suspension_twin",
        "run",
        "--twin",
        BAG / "twin.yaml",
        "--bag",
        BAG,
        "--loop",
    ]
    processes = [
        subprocess.Popen(
            list(map(str, command)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        for command in (server, twin)
    ]
    rclpy.init(args=[])
    try:
        client = _connected(port, processes[0])
        node = rclpy.create_node("beside")
        beside: dict[str, dict[int, float]] = {topic: {} for topic in TOPICS}
        for topic, kind in zip(TOPICS, (PoseStamped, JointState, TFMessage), strict=True):

            def keep(data: bytes, topic: str = topic) -> None:
                beside[topic][stamp_of(topic, data)] = time.perf_counter()

            node.create_subscription(kind, topic, keep, QoSProfile(depth=1000), raw=True)
        until = time.perf_counter() + 60.0
        while not (all(client.arrived.values()) and all(beside.values())) and time.perf_counter() < until:
            rclpy.spin_once(node, timeout_sec=0.05)
        began = time.perf_counter() + 2.0
        while time.perf_counter() < began + seconds + 1.0:
            rclpy.spin_once(node, timeout_sec=0.05)
        return [row(topic, beside[topic], client.arrived[topic], began, began + seconds) for topic in TOPICS]
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            try:
                process.wait(3.0)
            except subprocess.TimeoutExpired:  # the endpoint waits for its threads
                process.kill()
        try_shutdown()


def _connected(port: int, server: subprocess.Popen[bytes]) -> Client:
    until = time.monotonic() + 60.0
    while True:
        try:
            return Client(port)
        except OSError:
            if server.poll() is not None or time.monotonic() > until:
                raise SystemExit("the endpoint did not start: is --endpoint its folder?") from None
            time.sleep(0.2)


def row(
    topic: str, sent: dict[int, float], got: dict[int, float], begin: float, end: float
) -> dict[str, Any]:
    """Loss and latency of what came to the plain subscription in a stretch of time."""
    wanted = [ns for ns, at in sent.items() if begin <= at < end]
    added = 1e3 * np.array([got[ns] - sent[ns] for ns in wanted if ns in got])
    p50, p99 = np.percentile(added, [50, 99]) if added.size else (float("nan"), float("nan"))
    return {
        "topic": topic,
        "sent": len(wanted),
        "lost": len(wanted) - added.size,
        "p50_ms": p50,
        "p99_ms": p99,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--endpoint", type=Path, required=True, help="folder of ROS-TCP-Endpoint, branch main-ros2"
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the measurement")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    arguments = parse_options(parser, seconds=2.0)
    if not (arguments.endpoint / "ros_tcp_endpoint").is_dir():
        unavailable(f"{arguments.endpoint}: no folder of ROS-TCP-Endpoint, branch main-ros2")
    rows = measure(arguments.endpoint, arguments.seconds)
    if arguments.json:
        print(json.dumps({"seconds": arguments.seconds, "topics": rows}))
        return 0
    print(f"Through the endpoint, {arguments.seconds:g} s:")
    for r in rows:
        print(
            f"  {r['topic']:14} {r['sent']:6} sent {r['lost']:5} lost   "
            f"added p50 {r['p50_ms']:.2f} ms, p99 {r['p99_ms']:.2f} ms"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
