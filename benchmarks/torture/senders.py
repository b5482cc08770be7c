# SPDX-License-Identifier: Apache-2.0
"""Phones, receivers, brokers and casters that send anything but what they should."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import struct
import subprocess
import tempfile
from collections.abc import Callable

import numpy as np

from torture.commands import PROGRAM, environment
from torture.ledger import Tally

__all__ = ["BAR", "torture"]

BAR = "the command ends by itself with status 1, below 500 MB, with a few short lines and no traceback"
_SECONDS, _MOST_MEMORY, _MOST_TEXT, _PATIENCE = 3.0, 500.0, 3000, 60.0  # s, MB, bytes, s
_PIECE = 65536

Write = Callable[[bytes], None]
_URLS = {
    "nmea": "nmea://127.0.0.1:{}",
    "ubx": "ubx://127.0.0.1:{}",
    "gpsd": "gpsd://127.0.0.1:{}",
    "phyphox": "phyphox://127.0.0.1:{}",
    "sensorserver": "sensorserver://127.0.0.1:{}",
    "mqtt": "mqtt://127.0.0.1:{}/sensor-logger",
    "ntrip": "ntrip://user:password@127.0.0.1:{0}/M --source nmea://127.0.0.1:{0}",
}
_WORDS = (
    *("", "nan", "inf", "-1", "999999", "1e400", "9" * 40, "N", "Z", "246060.5", "235960.99", "4807.038"),
    *("A", "310299", "000000"),
)
_VALUES: tuple[object, ...] = (
    None,
    "x",
    1e308,
    -1,
    [],
    {},
    "2024-01-01T00:00:00Z",
    "9999-12-31T23:59:60Z",
    10**400,
    True,
    47.0,
)


def _frame(kind: bytes, payload: bytes) -> bytes:
    body, a, b = kind + struct.pack("<H", len(payload)) + payload, 0, 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes([a, b])


def _nearly(scheme: str, rng: np.random.Generator) -> bytes:
    """A message in the form of the protocol with wrong contents."""
    if scheme == "ubx":
        payload = bytearray(rng.bytes(92))
        payload[11] |= 7  # time and date are valid
        message = bytes([1, int(rng.choice([0x07, 0x14, 0x3C]))])
        return _frame(message, bytes(payload[: int(rng.choice([0, 36, 64, 92]))]))
    if scheme in ("nmea", "ntrip"):
        fields = rng.choice(_WORDS, int(rng.choice([0, 1, 9, 14, 30])))
        text = ",".join([f"GP{rng.choice(['GGA', 'RMC', 'GST', 'HDT', 'THS'])}", *fields])
        return f"${text}*{int(np.bitwise_xor.reduce(list(text.encode()))):02X}\r\n".encode()
    if scheme == "gpsd":
        names = ("time", "lat", "lon", "alt", "status", "track", "speed", "heading", "velN")
        values = {name: _VALUES[rng.integers(len(_VALUES))] for name in names}
        kind = str(rng.choice(["TPV", "ATT"]))
        return json.dumps({"class": kind, "mode": 3, **values}).encode() + b"\n"
    if scheme == "mqtt":
        size = int(rng.integers(0, 60))
        return bytes([int(rng.choice([0x30, 0x32, 0x34, 0x90, 0xD0, 0xF0])), size]) + rng.bytes(size)
    answer = {
        "inputs": [{"source": _VALUES[rng.integers(len(_VALUES))], "outputs": [{"x": 1}]}],
        "buffers": [1],
        "buffer": {"acc_time": {"buffer": [_VALUES[rng.integers(len(_VALUES))]]}},
        "status": {},
    }
    body = json.dumps(answer).encode() if rng.random() < 0.7 else b"[" + b"{}," * 3_000_000 + b"{}]"
    return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body


async def _misbehave(way: str, scheme: str, rng: np.random.Generator, writer: asyncio.StreamWriter) -> None:
    if scheme == "mqtt":
        writer.write(b"\x20\x02\x00\x00")  # the connection is accepted
    if way == "endless" and scheme == "mqtt":
        writer.write(b"\x30\xff\xff\xff\x7f\x00\x0dsensor-logger")
    elif way == "endless" and scheme in ("phyphox", "sensorserver"):
        writer.write(b"HTTP/1.1 200 OK\r\nX: ")
    while way != "closes":
        await writer.drain()
        await asyncio.sleep({"silent": 1.0, "slow": 0.2}.get(way, 0.002))
        if way == "garbage":
            writer.write(rng.bytes(_PIECE))
        elif way in ("slow", "endless"):
            writer.write(b"$" if way == "slow" else b"$GPGGA," + b"1" * _PIECE)
        elif way == "nearly":
            writer.write(_nearly(scheme, rng))


async def _trial(scheme: str, way: str, rng: np.random.Generator, out: str) -> tuple[int, str, float]:
    """Status, what was said, and the largest memory in MB."""

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.CancelledError):
            await _misbehave(way, scheme, rng, writer)
        writer.transport.abort()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    urls = _URLS[scheme].format(server.sockets[0].getsockname()[1]).split()
    words = ["record", "--source", *urls, "--out", out, "--seconds", str(_SECONDS)]
    process = subprocess.Popen(
        [*PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment()
    )
    assert process.stderr is not None
    said = asyncio.ensure_future(asyncio.to_thread(process.stderr.read))
    try:
        await asyncio.wait_for(asyncio.shield(said), _PATIENCE)
    except asyncio.TimeoutError:
        process.kill()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    server.close()
    return process.returncode, (await said).decode("utf-8", "replace"), used.ru_maxrss / 1000


def torture(tally: Tally) -> None:
    """A recording from a sender of some kind that misbehaves in some way."""
    for number in tally.numbers():
        rng = tally.rng(number)
        scheme = str(rng.choice(list(_URLS)))
        way = str(rng.choice(["closes", "silent", "slow", "garbage", "endless", "nearly", "nearly"]))
        with tempfile.TemporaryDirectory() as folder:
            status, said, memory = asyncio.run(_trial(scheme, way, rng, f"{folder}/out.mcap"))
        tally.count(f"{scheme}, {way}")
        tally.measure("memory, MB", memory)
        tally.measure("bytes of text", len(said))
        wrong = status not in (0, 1) or "Traceback" in said or "unexpected" in said or "failed" in said
        if wrong or memory > _MOST_MEMORY or len(said) > _MOST_TEXT:
            tally.fail(f"{scheme}, {way}: status {status}, {memory:.0f} MB, {len(said)} bytes: {said[-200:]}")
