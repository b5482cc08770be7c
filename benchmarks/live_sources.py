# SPDX-License-Identifier: Apache-2.0
"""``live.py --source``: phones that push over HTTP, from their request to ``twin/imu``, beside a bare relay.

Phones, in a process of their own, push messages of Sensor Logger to the twin as ``run --source`` starts it, and to
a relay: an HTTP server that reads the same JSON and publishes the samples of the same phone as they are. Latency is
from just before the request of a sample is written to the callback of whoever subscribes to the answer.
"""

from __future__ import annotations

import asyncio
import json
import math
import multiprocessing
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["measure_source", "print_source"]

#: The twin's p99 may be this many times the relay's.
BAR = 1.5
FOLLOWED = "phone0000"
ANSWERS = {"relay": "/relay/relayed", "twin": "/twin/twin/imu"}
_TENTH_MS = 100_000  # ns: stamps are matched to this, as seconds in a double hold a tenth of a microsecond


@dataclass(frozen=True)
class Load:
    """What the phones send: ``rate`` Hz of each sensor, a message every ``batch`` s; ``phones`` at once."""

    phones: int
    rate: float
    batch: float


# -- the systems under test ----------------------------------------------------------------------------


def relay(control: Connection) -> None:
    """A server that publishes what the followed phone sends."""
    import rclpy
    from aiohttp import web
    from sensor_msgs.msg import Imu

    rclpy.init(args=[])
    node = rclpy.create_node("relay", namespace="relay")
    publisher, message = node.create_publisher(Imu, ANSWERS["relay"], 100), Imu()
    received: dict[str, int] = {}

    async def handle(request: web.Request) -> web.Response:
        data = json.loads(await request.read())
        force = sorted(
            (r for r in data["payload"] if r["name"] == "totalacceleration"), key=lambda r: r["time"]
        )
        rate = sorted((r for r in data["payload"] if r["name"] == "gyroscope"), key=lambda r: r["time"])
        received[data["deviceId"]] = received.get(data["deviceId"], 0) + len(force)
        if data["deviceId"] == FOLLOWED:
            for a, w in zip(force, rate, strict=True):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(a["time"], 1_000_000_000)
                for vector, values in (
                    (message.linear_acceleration, a["values"]),
                    (message.angular_velocity, w["values"]),
                ):
                    vector.x, vector.y, vector.z = values["x"], values["y"], values["z"]
                publisher.publish(message)
        return web.Response(text="ok")

    async def work() -> None:
        app = web.Application(client_max_size=1 << 24)
        app.router.add_post("/", handle)
        runner = web.AppRunner(app, access_log=None)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        control.send(runner.addresses[0][1])
        while True:
            await asyncio.sleep(0.05)
            if control.poll():
                if control.recv() == "stop":
                    return
                control.send((time.process_time(), received))

    asyncio.run(work())


def twin(control: Connection) -> None:
    """The four nodes and the source, as ``run --source`` starts them."""
    from suspension_twin.addons.nodes.source import SourceNode
    from suspension_twin.cli.common import bundled
    from suspension_twin.nodes.composed import Composed
    from suspension_twin.nodes.process import ros_context

    url = f"sensorlogger://127.0.0.1:0?device={FOLLOWED[:5]}"
    with ros_context(["--ros-args", "--log-level", "error"]) as context:
        file = bundled("config", "twins", "ford_mondeo_mk4.yaml")
        composed = Composed(context, file, namespace="twin", sources=[url])
        composed.settle_memory()
        source = composed.nodes["source"]
        assert isinstance(source, SourceNode)
        control.send(int(composed.notes[0].rpartition(":")[2].strip("/")))
        while True:
            composed.step()
            if control.poll():
                if control.recv() == "stop":
                    break
                counts = {
                    name.removeprefix("phone "): device.counts["imu"]
                    for name, device in source.hub.devices.items()
                }
                control.send((time.process_time(), counts))
        composed.close()


# -- the phones ----------------------------------------------------------------------------------------


def phones(control: Connection) -> None:
    """Push to the port that is told, for so long; answer with the stamps (ns) and times of the followed phone."""
    control.send("ready")
    numbers: dict[str, int] = {}
    while (order := control.recv()) != "stop":
        port, load, seconds, system = order
        control.send(asyncio.run(_drive(port, load, seconds, numbers, system)))


async def _drive(
    port: int, load: Load, seconds: float, numbers: dict[str, int], system: str
) -> tuple[list[tuple[int, float]], int]:
    start, began = time.time_ns(), time.perf_counter()
    sent: list[tuple[int, float]] = []

    async def drive(phone: int) -> int:
        name = f"phone{phone:04}"
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        each = max(round(load.rate * load.batch), 1)
        total, key = int(seconds * load.rate), f"{system} {name}"
        for first in range(0, total, each):
            stamps = [start + round(k / load.rate * 1e9) for k in range(first, min(first + each, total))]
            payload: list[dict[str, Any]] = []
            for ns in stamps:
                t = ns * 1e-9
                z = 9.81 + 0.5 * math.sin(9.0 * (t % 1000.0))
                values = {
                    "x": 0.05 * math.sin(70.0 * (t % 1000.0)),
                    "y": 0.05 * math.cos(60.0 * (t % 1000.0)),
                    "z": z,
                }
                payload.append({"name": "totalacceleration", "time": ns, "accuracy": 3, "values": values})
                turn = {
                    "x": 0.01 * math.sin(50.0 * (t % 1000.0)),
                    "y": 0.01 * math.cos(40.0 * (t % 1000.0)),
                    "z": 1e-3 * math.sin(t % 1000.0),
                }
                payload.append({"name": "gyroscope", "time": ns, "accuracy": 3, "values": turn})
            if first % round(load.rate) < each:
                payload.append({"name": "location", "time": stamps[-1], "values": _place(stamps[-1])})
            number = numbers[key] = numbers.get(key, -1) + 1
            body = json.dumps(
                {"messageId": number, "sessionId": "s", "deviceId": name, "payload": payload},
                separators=(",", ":"),
            ).encode()
            head = f"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n".encode()
            due = began + (first + len(stamps) - 1) / load.rate + 0.2 * phone / load.phones * load.batch
            await asyncio.sleep(max(due - time.perf_counter(), 0.0))
            if name == FOLLOWED:
                now = time.perf_counter()
                sent.extend((ns, now) for ns in stamps)
            writer.write(head + body)
            answer = await reader.readuntil(b"\r\n\r\n")
            assert answer.startswith(b"HTTP/1.1 200"), answer
            await reader.readexactly(int(answer.lower().partition(b"content-length: ")[2].split(b"\r\n")[0]))
        writer.close()
        return total

    totals = await asyncio.gather(*(drive(phone) for phone in range(load.phones)))
    return sent, sum(totals)


def _place(ns: int) -> dict[str, float]:
    east = 10.0 * (ns * 1e-9 % 10_000.0)
    place = {"latitude": 47.4025, "longitude": 19.284 + east / 75_540.0, "altitude": 100.0, "speed": 10.0}
    return place | {"bearing": 90.0, "horizontalAccuracy": 0.03, "verticalAccuracy": 0.05}


# -- measuring -----------------------------------------------------------------------------------------


class _Child:
    def __init__(self, target: Callable[[Connection], None]) -> None:
        context = multiprocessing.get_context("spawn")
        self.control, there = context.Pipe()
        self.process = context.Process(target=target, args=(there,), daemon=True)
        self.process.start()
        self.first = self.control.recv()

    def ask(self) -> tuple[float, dict[str, int]]:
        self.control.send("how")
        answer: tuple[float, dict[str, int]] = self.control.recv()
        return answer

    def stop(self) -> None:
        self.control.send("stop")
        self.process.join(5.0)
        if self.process.is_alive():
            self.process.kill()

    def resident(self) -> float:
        """MiB."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text(encoding="ascii").split()[1])
        return pages * 4096 / 2**20


def measure_source(load: Load, seconds: float, rounds: int, warm_up: float) -> dict[str, Any]:
    """Both systems in turns; latencies of the followed phone, losses of all."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Imu

    systems, sender = {"relay": _Child(relay), "twin": _Child(twin)}, _Child(phones)
    rclpy.init(
        args=[], signal_handler_options=SignalHandlerOptions.NO
    )  # a signal ends this program, not only ROS
    node = rclpy.create_node("listener")
    answered: dict[str, dict[int, float]] = {s: {} for s in ANSWERS}

    def hear(system: str) -> Callable[[Any], None]:
        kept = answered[system]

        def on_answer(message: Any) -> None:
            stamp = message.header.stamp
            kept[round((stamp.sec * 1_000_000_000 + stamp.nanosec) / _TENTH_MS)] = time.perf_counter()

        return on_answer

    for system, topic in ANSWERS.items():
        node.create_subscription(Imu, topic, hear(system), 10_000)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    rows: dict[str, Any] = {
        s: {"latencies": [], "p99s": [], "sent": 0, "lost": 0, "total": 0, "cpu": 0.0} for s in ANSWERS
    }
    memory: list[float] = []
    for _ in range(rounds):
        for system, child in systems.items():
            before, began = child.ask()[0], time.perf_counter()
            sender.control.send((child.first, load, warm_up + seconds / rounds, system))
            while not sender.control.poll():
                executor.spin_once(timeout_sec=0.05)
                if system == "twin" and time.perf_counter() - began > len(memory) * max(seconds / 100.0, 1.0):
                    memory.append(round(child.resident(), 1))
            sent, total = sender.control.recv()
            until = time.perf_counter() + 0.5
            while time.perf_counter() < until:
                executor.spin_once(timeout_sec=0.05)
            row, kept = rows[system], answered[system]
            row["cpu"] += (child.ask()[0] - before) / (time.perf_counter() - began) / rounds
            row["total"] += total
            warm = sent[0][1] + warm_up
            stamped = [(round(ns / _TENTH_MS), at) for ns, at in sent if at > warm]
            latencies = [kept[key] - at for key, at in stamped if key in kept]
            row["sent"] += len(stamped)
            row["lost"] += len(stamped) - len(latencies)
            row["latencies"] += latencies
            row["p99s"].append(float(np.percentile(latencies, 99)) if latencies else math.inf)
            kept.clear()
    received = {system: sum(child.ask()[1].values()) for system, child in systems.items()}
    for child in (*systems.values(), sender):
        child.stop()
    rclpy.shutdown()
    result: dict[str, Any] = {"bar": BAR, "phones": load.phones, "rate": load.rate, "batch": load.batch}
    for system, row in rows.items():
        if not row["latencies"]:
            raise SystemExit(f"{system}: no answer to any of {row['sent']} samples")
        p50, p99 = np.percentile(np.array(row["latencies"]) * 1e6, [50, 99])
        result[system] = {
            "p50_us": round(float(p50), 1),
            "p99_us": round(float(p99), 1),
            "cpu_share": round(row["cpu"], 4),
            "sent": row["sent"],
            "unanswered": row["lost"],
            "sent_by_all": row["total"],
            "lost_of_all": row["total"] - received[system],
        }
    result["p99_ratio"] = round(result["twin"]["p99_us"] / result["relay"]["p99_us"], 3)
    ratios = [t / r for t, r in zip(rows["twin"]["p99s"], rows["relay"]["p99s"], strict=True)]
    result["p99_ratio_median_of_rounds"] = round(float(np.median(ratios)), 3)
    result["within_bar"] = bool(result["p99_ratio"] <= BAR)
    result["memory_mib"] = memory
    return result


def print_source(result: dict[str, Any]) -> None:
    """The table for people."""
    per = max(round(result["rate"] * result["batch"]), 1)
    print(
        f"{result['phones']} phones at {result['rate']:g} Hz, {per} sample{'s' if per > 1 else ''} a message; latency "
        "from a sample's request to twin/imu"
    )
    print(
        f"{'system':>7} {'p50 µs':>8} {'p99 µs':>8} {'CPU of a core':>14} {'unanswered':>14} {'lost of all':>16}"
    )
    for system in ANSWERS:
        row = result[system]
        print(
            f"{system:>7} {row['p50_us']:8.0f} {row['p99_us']:8.0f} {100 * row['cpu_share']:12.1f} % "
            f"{row['unanswered']:>5} of {row['sent']:>5} {row['lost_of_all']:>5} of {row['sent_by_all']:>7}"
        )
    word = "within" if result["within_bar"] else "beyond"
    print(
        f"p99 of the twin / of the relay: {result['p99_ratio']:.2f}, {word} the bar of {result['bar']:g} "
        f"(median of the rounds {result['p99_ratio_median_of_rounds']:.2f}); "
        f"memory of the twin {result['memory_mib'][0]} to {result['memory_mib'][-1]} MiB"
    )
