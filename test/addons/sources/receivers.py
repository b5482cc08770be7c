# SPDX-License-Identifier: Apache-2.0
"""Emulators of GNSS receivers that play a drive: NMEA 0183, u-blox's UBX, gpsd, and a caster of corrections.

Written from the NMEA 0183 sentences as receivers' manuals have them, the u-blox F9 interface description, gpsd_json(5)
and NTRIP 1.0: bytes are put together by hand, not by the libraries that read them.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import pty
import struct
from collections.abc import Iterator
from datetime import datetime, timezone

import numpy as np

from suspension_twin.drive.types import Drive

__all__ = ["Caster", "Port", "gpsd_lines", "nmea_epochs", "serve_lines", "ubx_epochs"]

KNOT = 0.514444444


class Port:
    """A serial port: what is written to it comes out of ``path``; ``heard`` is what the other side has sent."""

    def __init__(self) -> None:
        self._master, slave = pty.openpty()
        self.path = os.ttyname(slave)
        self._slave = slave
        os.set_blocking(self._master, False)
        self.heard = b""

    async def play(self, parts: list[bytes], pause: float = 0.002, cut: int = 0) -> None:
        """Send the parts, each in pieces of ``cut`` bytes if that is given."""
        for part in parts:
            for piece in [part[i : i + cut] for i in range(0, len(part), cut)] if cut else [part]:
                while True:
                    try:
                        os.write(self._master, piece)
                        break
                    except BlockingIOError:
                        await asyncio.sleep(0.001)
            await asyncio.sleep(pause)
            self.listen()

    def listen(self) -> bytes:
        """What has come from the other side so far."""
        with contextlib.suppress(OSError):
            self.heard += os.read(self._master, 65536)
        return self.heard

    def close(self) -> None:
        for descriptor in (self._slave, self._master):
            os.close(descriptor)


def _rows(drive: Drive) -> Iterator[tuple]:
    fix, velocity = drive.fix, drive.velocity
    for i, t in enumerate(fix.t.tolist()):
        k = int(np.argmin(np.abs(velocity.t - t)))
        yield t, fix.latitude[i], fix.longitude[i], fix.altitude[i], fix.sigma[i], velocity.enu[k]


def sentence(body: str) -> bytes:
    """A sentence of NMEA 0183 with its checksum."""
    check = 0
    for byte in body.encode():
        check ^= byte
    return f"${body}*{check:02X}\r\n".encode()


def _minutes(value: float, digits: int) -> str:
    degrees = int(abs(value))
    return f"{degrees:0{digits}d}{(abs(value) - degrees) * 60.0:010.7f}"


def nmea_epochs(
    drive: Drive, quality: int = 4, heading: float | None = None, gst: bool = True
) -> list[bytes]:
    """The sentences of each fix; stamps in hundredths of a second, as receivers send them."""
    found = []
    for t, latitude, longitude, height, sigma, (east, north, _) in _rows(drive):
        at = datetime.fromtimestamp(round(t, 2), timezone.utc)
        clock = f"{at:%H%M%S}.{round(at.microsecond / 1e4):02d}"
        course = np.degrees(np.arctan2(east, north)) % 360.0
        where = f"{_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'}"
        where += f",{_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
        lines = [
            f"GNRMC,{clock},A,{where},{np.hypot(east, north) / KNOT:.4f},{course:.3f},{at:%d%m%y},,,R",
            f"GNVTG,{course:.3f},T,,M,0.0,N,0.0,K,R",
            f"GNGGA,{clock},{where},{quality},12,0.9,{height - 40.0:.4f},M,40.0000,M,1.0,0000",
            "GPGSV,1,1,01,02,45,180,40",
        ]
        if gst:
            lines.append(f"GNGST,{clock},0.1,,,,{sigma[1]:.4f},{sigma[0]:.4f},{sigma[2]:.4f}")
        if heading is not None:
            lines.append(f"GNHDT,{heading:.2f},T")
        found.append(b"".join(map(sentence, lines)))
    return found


def _frame(kind: bytes, payload: bytes) -> bytes:
    body = kind + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes((a, b))


def ubx_epochs(drive: Drive, precise: bool = True, heading: float | None = None) -> list[bytes]:
    """NAV-PVT of each fix, with NAV-HPPOSLLH and NAV-RELPOSNED if they are wanted, and a NAV-DOP among them."""
    found = []
    for t, latitude, longitude, height, sigma, (east, north, up) in _rows(drive):
        whole = round(t)  # the calendar fields are those of the nearest second, nano is signed
        at = datetime.fromtimestamp(whole, timezone.utc)
        week_ms = round((t * 1e3) % 604_800_000)
        horizontal = float(sigma[0]) * np.sqrt(2.0)
        lat, lat_below = divmod(round(latitude * 1e9), 100)
        lon, lon_below = divmod(round(longitude * 1e9), 100)
        mm, mm_below = divmod(round(height * 1e4), 10)
        pvt = struct.pack(
            "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHH4xihH",
            week_ms,
            *(at.year, at.month, at.day, at.hour, at.minute, at.second),
            0b0111,
            20,
            round((t - whole) * 1e9),
            *(3, 0b10000011, 0, 20),
            *(lon, lat, mm, mm - 40_000),
            *(round(horizontal * 1e3), round(float(sigma[2]) * 1e3)),
            *(round(north * 1e3), round(east * 1e3), round(-up * 1e3)),
            *(round(np.hypot(east, north) * 1e3), 0),
            *(50, 100_000, 120, 0, 0, 0, 0),
        )
        assert len(pvt) == 92
        parts = [_frame(b"\x01\x07", pvt), _frame(b"\x01\x04", struct.pack("<I7H", week_ms, *[100] * 7))]
        if precise:
            hp = struct.pack(
                "<BxxBIiiiibbbbII",
                *(0, 0, week_ms, lon, lat, mm, mm - 40_000),
                *(lon_below, lat_below, mm_below, 0),
                *(round(horizontal * 1e4), round(float(sigma[2]) * 1e4)),
            )
            parts.append(_frame(b"\x01\x14", hp))
        if heading is not None:
            relative = struct.pack(
                "<BxHIiiiiixxxxbbbbIIIIIxxxxI",
                *(1, 0, week_ms, 100, 0, 0, 100, round(heading * 1e5)),
                *(0, 0, 0, 0, 10, 10, 10, 10, 100, 0b1_0000_0101),
            )
            assert len(relative) == 64
            parts.append(_frame(b"\x01\x3c", relative))
        found.append(b"".join(parts))
    return found


def gpsd_lines(drive: Drive) -> list[bytes]:
    """VERSION, DEVICES, and a TPV of each fix."""
    lines = [{"class": "VERSION", "release": "3.25", "proto_major": 3, "proto_minor": 15}]
    lines.append({"class": "TPV", "device": "/dev/ttyACM0", "mode": 1})
    for t, latitude, longitude, height, sigma, (east, north, up) in _rows(drive):
        at = datetime.fromtimestamp(round(t, 3), timezone.utc)
        lines.append(
            {
                "class": "TPV",
                "device": "/dev/ttyACM0",
                "mode": 3,
                "status": 3,
                "time": f"{at:%Y-%m-%dT%H:%M:%S}.{round(at.microsecond / 1e3):03d}Z",
                "lat": latitude,
                "lon": longitude,
                "altHAE": height,
                "altMSL": height - 40.0,
                "epx": float(sigma[0]),
                "epy": float(sigma[1]),
                "epv": float(sigma[2]),
                "velN": float(north),
                "velE": float(east),
                "velD": float(-up),
                "speed": float(np.hypot(east, north)),
            }
        )
        lines.append({"class": "SKY", "device": "/dev/ttyACM0", "satellites": []})
    return [json.dumps(line).encode() + b"\r\n" for line in lines]


async def serve_lines(lines: list[bytes], pause: float = 0.002) -> tuple[asyncio.Server, int, list[bytes]]:
    """A TCP server that waits for a line and then sends these; the server, its port, and what it was told."""
    told: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        told.append(await reader.readline())
        for line in lines:
            writer.write(line)
            await writer.drain()
            await asyncio.sleep(pause)
        await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    return server, server.sockets[0].getsockname()[1], told


class Caster:
    """An NTRIP caster with one mountpoint; ``close_after`` parts it closes the connection, ``version`` 1 or 2."""

    def __init__(
        self, parts: list[bytes], version: int = 1, close_after: int = 0, mount: str = "NEAR"
    ) -> None:
        self.parts, self.version, self.close_after, self.mount = parts, version, close_after, mount
        self.positions: list[bytes] = []
        self.connections = 0

    async def __aenter__(self) -> Caster:
        self.server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self.server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exception: object) -> None:
        self.server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        wanted = base64.b64encode(b"user:secret").decode()
        if f"Authorization: Basic {wanted}" not in head:
            writer.write(b"HTTP/1.0 401 Unauthorized\r\n\r\n")
        elif not head.startswith(f"GET /{self.mount} "):
            writer.write(b"SOURCETABLE 200 OK\r\nContent-Type: text/plain\r\n\r\nENDSOURCETABLE\r\n")
        else:
            chunked = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nTransfer-Encoding: chunked\r\n\r\n"
            writer.write(b"ICY 200 OK\r\n\r\n" if self.version == 1 else chunked)
            listener = asyncio.ensure_future(self._listen(reader))
            for number, part in enumerate(self.parts):
                if self.close_after and number == self.close_after and self.connections == 1:
                    break
                writer.write(part if self.version == 1 else b"%x\r\n%s\r\n" % (len(part), part))
                await asyncio.sleep(0.01)
            else:
                await asyncio.sleep(3600 if not self.close_after or self.connections > 1 else 0)
            listener.cancel()
        await writer.drain()
        writer.close()

    async def _listen(self, reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            self.positions.append(line)
