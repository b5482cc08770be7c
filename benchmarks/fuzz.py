#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Mutated requests and bytes for the live sources: none may kill or block them.

    python benchmarks/fuzz.py                       # 100 000 requests to `suspension-twin record`, some minutes
    python benchmarks/fuzz.py --requests 5000 --json

A receiver of Sensor Logger's messages runs as users run it, in a process of its own. It is sent messages whose JSON or
whose bytes are mutated, by HTTP and WebSocket, and HTTP requests that are none. Every request has to be answered or its
connection closed within five seconds, an untouched one is answered with 200 all the while, and at the end the
samples of untouched ones are in the recording. The parsers of receivers and of the other apps get mutated bytes
directly.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

from options import parse_options

PATIENCE = 5.0  # s
TOKEN = "fuzzing-fuzzing"
#: What stands in for a value of JSON.
JUNK: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1e308,
    -1e308,
    10**30,
    2**63,
    1.5,
    "",
    "x",
    "../../etc/passwd",
    "\x00\x1b[2J\n",
    "é" * 300,
    [],
    {},
    [[[[]]]],
    {"x": 1},
    "NaN",
)
TOKENS = (
    b"{",
    b"}",
    b"[",
    b"]",
    b'"',
    b",",
    b":",
    b"NaN",
    b"Infinity",
    b"1e999",
    b"\xff",
    b"\x00",
    b"\\u0000",
    b"9" * 400,
)


def message(number: int, start: float = 1.7e9) -> dict[str, Any]:
    """An untouched message of a tenth of a second at rest."""
    payload = []
    for k in range(10):
        t = round((start + 0.1 * number + 0.01 * k) * 1e9)
        for name, z in (("totalacceleration", 9.81), ("gyroscope", 0.0)):
            payload.append({"name": name, "time": t, "accuracy": 3, "values": {"x": 0.1, "y": 0.0, "z": z}})
    place = {"latitude": 47.4, "longitude": 19.3, "altitude": 120.0, "speed": 3.0, "bearing": 90.0}
    place |= {"horizontalAccuracy": 3.0, "verticalAccuracy": 5.0}
    payload.append({"name": "location", "time": round((start + 0.1 * number) * 1e9), "values": place})
    return {"messageId": number, "sessionId": "good", "deviceId": "good", "payload": payload}


def mutated_object(rng: random.Random, value: Any) -> Any:
    """The value with some of its parts replaced, removed or repeated."""
    for _ in range(rng.randint(1, 3)):
        nodes: list[tuple[Any, Any]] = []

        def walk(node: Any, nodes: list[tuple[Any, Any]] = nodes) -> None:
            for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
                nodes.append((node, key))
                walk(node[key])

        walk(value)
        if not nodes:
            return deepcopy(rng.choice(JUNK))
        parent, key = rng.choice(nodes)
        what = rng.random()
        if what < 0.6:
            parent[key] = deepcopy(rng.choice(JUNK))
        elif what < 0.8:
            del parent[key]
        elif isinstance(parent, list):
            parent.extend(deepcopy(parent[key]) for _ in range(rng.randint(1, 50)))
        else:
            parent[str(rng.choice(JUNK))] = deepcopy(parent[key])
    return value


def mutated_bytes(rng: random.Random, data: bytes) -> bytes:
    """The bytes with some of them changed, cut out, repeated, or put in."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 30))):
        at = rng.randrange(len(out) + 1)
        what = rng.random()
        if what < 0.4 and at < len(out):
            out[at] = rng.randrange(256)
        elif what < 0.6:
            del out[at : at + rng.choice((1, 1, 4, 60, 1000))]
        elif what < 0.8:
            out[at:at] = rng.choice(TOKENS)
        else:
            out[at:at] = out[at : at + rng.choice((1, 8, 100))]
    return bytes(out)


def mutated_message(rng: random.Random, number: int) -> bytes:
    """A message, mutated as an object or as bytes."""
    whole = message(number) | {"sessionId": f"s{rng.randrange(5)}", "deviceId": f"d{rng.randrange(30)}"}
    if rng.random() < 0.6:
        whole = mutated_object(rng, whole)
        try:
            return json.dumps(whole).encode("utf-8", "replace")
        except (ValueError, RecursionError):
            return b"{"
    return mutated_bytes(rng, json.dumps(whole).encode())


def head(body: bytes, path: str = f"/?token={TOKEN}") -> bytes:
    """The head of an HTTP request with this body."""
    lines = f"POST {path} HTTP/1.1\r\nHost: phone\r\nContent-Type: application/json\r\nContent-Length: {len(body)}"
    return lines.encode() + b"\r\n\r\n"


def raw_requests(rng: random.Random) -> Iterator[bytes]:
    """Requests that are none."""
    body = json.dumps(message(0) | {"deviceId": "raw"}).encode()
    whole = head(body) + body
    while True:
        what = rng.random()
        if what < 0.7:
            edge = rng.randrange(len(head(body)))
            yield mutated_bytes(rng, whole[:edge]) + whole[edge:]
        elif what < 0.8:
            yield whole[: rng.randrange(len(whole))]
        elif what < 0.9:
            chunk = b"%x\r\n" % rng.choice((0, 5, 2**31, 2**70)) + body[:5]
            yield head(b"").replace(b"Content-Length: 0", b"Transfer-Encoding: chunked") + chunk
        else:
            yield os.urandom(rng.randrange(1, 3000))


def frame(rng: random.Random, payload: bytes) -> bytes:
    """A WebSocket frame, masked, with now and then a wrong head."""
    mask = rng.randbytes(4)
    size = len(payload)
    first = rng.choice((0x81, 0x81, 0x81, 0x82, 0x01, 0x80, 0x89, 0xF1, 0x83))
    length = bytes([0x80 | size]) if size < 126 else b"\xfe" + struct.pack(">H", size & 0xFFFF)
    return bytes([first]) + length + mask + bytes(b ^ mask[i % 4] for i, b in enumerate(payload))


# -- against a process -------------------------------------------------------------------------------


class Client:
    """Sends requests one after the other, and counts what comes of them."""

    def __init__(self, port: int, seed: int) -> None:
        self.port, self.rng = port, random.Random(seed)
        self.outcomes: Counter[str] = Counter()
        self.slowest = 0.0
        self._open: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if self._open is None or self._open[1].is_closing():
            self._open = await asyncio.open_connection("127.0.0.1", self.port)
        return self._open

    def close(self) -> None:
        if self._open is not None:
            self._open[1].close()
            self._open = None

    async def post(self, body: bytes) -> str:
        """The status of the answer, or ``closed``."""
        began = time.monotonic()
        try:
            reader, writer = await self._connect()
            writer.write(head(body) + body)
            answer = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
            size = int(answer.lower().partition(b"content-length:")[2].split(b"\r\n")[0] or 0)
            await asyncio.wait_for(reader.readexactly(size), PATIENCE)
            status = answer.split(b" ", 2)[1].decode()
            if b"connection: close" in answer.lower():
                self.close()
        except asyncio.TimeoutError:
            status = "no answer"
            self.close()
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            status = "closed"
            self.close()
        self.slowest = max(self.slowest, time.monotonic() - began)
        return status

    async def raw(self, data: bytes) -> str:
        """Send and close this end; the status, or ``closed``."""
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
            writer.write(data)
            with contextlib.suppress(OSError):
                writer.write_eof()
            answer = await asyncio.wait_for(reader.read(4096), PATIENCE)
            writer.close()
        except asyncio.TimeoutError:
            writer.close()
            return "no answer"
        except OSError:
            return "closed"
        return (
            answer.split(b" ", 2)[1].decode("ascii", "replace") if answer.startswith(b"HTTP/") else "closed"
        )

    async def socket(self, frames: list[bytes]) -> str:
        """Open a WebSocket and send these frames."""
        key = f"GET /?token={TOKEN} HTTP/1.1\r\nHost: phone\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        key += "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        return await self.raw(key.encode() + b"".join(frames))


async def attack(port: int, requests: int, seed: int, progress: Callable[[int], None]) -> dict[str, Any]:
    """Send so many mutated requests, and untouched ones among them."""
    client, steady = Client(port, seed), Client(port, seed)
    rng, raw = client.rng, raw_requests(client.rng)
    good = 0
    for k in range(requests):
        what = rng.random()
        if what < 0.8:
            kind, status = "message", await client.post(mutated_message(rng, rng.randrange(1000)))
        elif what < 0.95:
            kind, status = "request", await client.raw(next(raw))
        else:
            frames = [frame(rng, mutated_message(rng, rng.randrange(1000))) for _ in range(rng.randint(1, 4))]
            kind, status = "WebSocket", await client.socket(frames)
        client.outcomes[f"{kind}: {status}"] += 1
        if k % 100 == 99:
            status = await steady.post(json.dumps(message(good)).encode())
            steady.outcomes[status] += 1
            good += 1
            progress(k + 1)
    client.close()
    steady.close()
    return {
        "requests": requests,
        "outcomes": dict(sorted(client.outcomes.items())),
        "untouched": dict(steady.outcomes),
        "slowest_untouched_s": round(steady.slowest, 3),
        "unanswered": sum(n for name, n in client.outcomes.items() if name.endswith("no answer")),
        "sent_samples": 10 * good,
    }


def resident(pid: int) -> float:
    """Resident memory of a process in MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def attack_process(requests: int, seed: int) -> dict[str, Any]:
    """Start ``record``, attack it, end it, and look into the recording."""
    from suspension_twin.drive.read import read_drive

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        url = f"sensorlogger://127.0.0.1:{port}?token={TOKEN}&device=good"
        command = [
            sys.executable,
            "-m",
            "suspension_twin",
            "record",
            "--source",
            url,
            "--out",
            f"{folder}/bag",
        ]
        words = Path(folder) / "words"
        with words.open("w") as file:
            process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        try:
            while True:
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                if process.poll() is not None:
                    raise SystemExit(f"record ended: {words.read_text()}")
                time.sleep(0.1)
            marks: list[float] = []

            def progress(done: int) -> None:
                if process.poll() is not None:
                    raise SystemExit(f"killed after {done} requests: {words.read_text()}")
                if done % max(requests // 20, 100) == 0:
                    marks.append(round(resident(process.pid), 1))
                    print(f"\r{done} of {requests}, {marks[-1]} MiB", end="", file=sys.stderr, flush=True)

            began = time.monotonic()
            found = asyncio.run(attack(port, requests, seed, progress))
            found["seconds"] = round(time.monotonic() - began, 1)
            print(file=sys.stderr)
            process.send_signal(2)
            process.wait(timeout=60)
            found["words_kib"] = round(words.stat().st_size / 1024, 1)
        finally:
            process.kill()
        found["status"] = process.returncode
        found["recorded_samples"] = len(read_drive(f"{folder}/bag").imu) if process.returncode == 0 else 0
        found["memory_mib"] = marks
        if process.returncode:
            print(words.read_text(), file=sys.stderr)
    return found


# -- parsers -----------------------------------------------------------------------------------------


def attack_parsers(rounds: int, seed: int) -> dict[str, int]:
    """Mutated bytes for everything else that reads from outside; how many pieces each took. Raises what they raise."""
    from suspension_twin.addons.sources import make_sources
    from suspension_twin.addons.sources.common.hub import Hub
    from suspension_twin.addons.sources.common.receiver import Receiver

    rng, hub = random.Random(seed), Hub()
    nmea = b"$GNRMC,120044.10,A,4724.15,N,01917.04,E,8.1,45.2,010124,,,R*00\r\n$GNGGA,120044.10,4724.15,N,01917.04,E,"
    nmea += b"4,12,0.9,122.9,M,40.1,M,1.0,0001*7B\r\n$GNGST,120044.10,0.1,,,,0.01,0.01,0.02*6A\r\n$GNHDT,1.0,T*1B\r\n"
    pvt = b"\x01\x07\x5c\x00" + struct.pack("<IHBBBBBB", 1000, 2024, 1, 1, 12, 0, 4, 7) + bytes(80)
    ubx = b"".join(b"\xb5\x62" + body + _checked(body) for body in (pvt, b"\x01\x14\x24\x00" + bytes(36)))
    tpv = b'{"class":"TPV","mode":3,"time":"2024-01-01T12:00:00.100Z","lat":47.4,"lon":19.3,"epx":1.0,"speed":3}\n'
    gps = {
        "longitude": 19.3,
        "latitude": 47.4,
        "altitude": 1.0,
        "bearing": 0.0,
        "accuracy": 3.0,
        "speed": 1.0,
    }
    event = {
        "values": [0.1, 0.2, 9.8],
        "timestamp": 3925657519043709,
        "accuracy": 3,
        "type": "android.sensor.gyroscope",
    }
    taken: Counter[str] = Counter()
    receivers = make_sources(["nmea://h:1", "ubx://h:1?heading=0", "gpsd://h"], hub)
    for k in range(rounds):
        for source, data in zip(receivers, (nmea, ubx, tpv), strict=True):
            assert isinstance(source, Receiver)
            source.feed(mutated_bytes(rng, data), 1.7e9 + k)
            source.feed(data, 1.7e9 + k)
            taken[type(source).__name__] += 1
        hub.take(), hub.events()
    messages = {
        page: [json.dumps(mutated_object(rng, deepcopy(whole))) for _ in range(rounds)]
        for page, whole in (("/sensors/connect", event), ("/gps", gps | {"time": 1.7e12}))
    }
    taken["SensorServer"] = asyncio.run(attack_phone(messages))
    return dict(taken)


async def attack_phone(messages: dict[str, list[str]]) -> int:
    """Send these messages, by page, as the app SensorServer does, until all are read; their number. RuntimeError where
    the source failed over one."""
    from aiohttp import web

    from suspension_twin.addons.sources import make_sources
    from suspension_twin.addons.sources.common.hub import Hub
    from suspension_twin.addons.sources.common.runner import running

    hub, left = Hub(), {page: iter(own) for page, own in messages.items()}
    read = {page: asyncio.Event() for page in messages}

    async def serve(request: web.Request) -> web.WebSocketResponse:
        connection = web.WebSocketResponse(compress=False)
        await connection.prepare(request)
        count = 0
        with contextlib.suppress(ConnectionError):  # it hangs up on a message that is too long
            for text in left[request.path]:
                await connection.send_str(text)
                count += 1
        if not count:  # it comes again once it has read all of the connection before
            read[request.path].set()
        await connection.close()
        return connection

    app = web.Application()
    app.add_routes([web.get(page, serve) for page in messages])
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        sources = make_sources([f"sensorserver://127.0.0.1:{runner.addresses[0][1]}"], hub)
        async with running(sources, hub):
            await asyncio.gather(*(event.wait() for event in read.values()))
    finally:
        await runner.cleanup()
    failures = [found.text for found in hub.events() if found.code == "source failed"]
    if failures:
        raise RuntimeError(failures[0])
    return sum(map(len, messages.values()))


def _checked(body: bytes) -> bytes:
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def main() -> int:
    """Attack, print a table or JSON; status 1 where anything was killed, blocked or lost."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--requests", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    arguments = parse_options(parser, requests=300)
    result = attack_process(arguments.requests, arguments.seed)
    result["parsers"] = attack_parsers(arguments.requests // 10, arguments.seed)
    good = (
        result["status"] == 0
        and not result["unanswered"]
        and set(result["untouched"]) <= {"200"}
        and result["recorded_samples"] == result["sent_samples"]
    )
    if arguments.json:
        print(json.dumps(result | {"passed": good}))
    else:
        for name, count in result["outcomes"].items():
            print(f"{name:28} {count:8}")
        print(
            f"untouched requests: {result['untouched']}, the slowest took {result['slowest_untouched_s']} s"
        )
        print(f"recorded {result['recorded_samples']} of {result['sent_samples']} untouched samples")
        print(
            f"memory {result['memory_mib'][0]} to {result['memory_mib'][-1]} MiB; parsers: {result['parsers']}"
        )
        print(f"what it has said: {result['words_kib']} KiB")
        print(f"{result['requests']} requests in {result['seconds']} s: {'passed' if good else 'FAILED'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
