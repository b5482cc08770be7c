# SPDX-License-Identifier: Apache-2.0
"""``ntrip://USER:PASSWORD@CASTER:PORT/MOUNTPOINT``: corrections, passed on to the receivers of the same command.

NTRIP 1.0 (RTCM 10410.0), which casters of version 2 speak, too. Nothing queues up: what a receiver's port does not take
at once is dropped and counted. The caster is sent the position every ten seconds as a GGA sentence, which virtual
reference stations need (``gga=0``: never).
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import math
from collections.abc import Sequence
from typing import Final

from pynmeagps import GET, NMEAMessage

from suspension_twin import __version__
from suspension_twin.addons.sources.common.connection import Address, PlainSource, Stay, keep_connected
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError

__all__ = ["EXAMPLE", "TITLE", "Ntrip", "make"]

TITLE = "NTRIP caster"
EXAMPLE = "ntrip://user:password@caster.example:2101/MOUNT"

_PORT: Final = 2101
_PATIENCE: Final = 30.0  # s without a byte after which the connection is made anew
_HEAD: Final = 8192  # bytes of the caster's answer
_EVERY: Final = 10.0  # s between two positions for the caster
_LOOK: Final = 0.5  # s between two looks whether there is a position: a tolerance, below a receiver's second


class Ntrip(PlainSource):
    """One mountpoint of one caster."""

    steps: Sequence[str] = (
        "The receiver needs the same frequency bands as the caster's station, some 30 km at most from it.",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        address.check_options(("gga",))
        self._mount = address.path.strip("/")
        if not address.host or not self._mount:
            raise InputError(
                str(address), "names no mountpoint: write ntrip://USER:PASSWORD@CASTER:PORT/MOUNTPOINT"
            )
        if not self._mount.isascii() or not self._mount.isprintable() or " " in self._mount:
            raise InputError(str(address), "a mountpoint has no blanks and ASCII characters alone")
        self._gga = bool(address.number("gga", 1, 0, 1))
        self._address, self._hub = address, hub
        self._name = f"caster {address.host}"
        self.received = 0
        self.notes = [f"NTRIP: corrections from {address.host}, mountpoint {self._mount}"]

    async def start(self) -> None:
        """InputError where there is no receiver that could use the corrections."""
        if not self._hub.correctors:
            raise InputError(
                str(self._address), "there is no receiver to correct: add --source ubx:... or nmea:..."
            )

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        await keep_connected(self._hub, self._name, self._session)

    async def _session(self) -> None:
        host, port = self._address.host, self._address.port or _PORT
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port, limit=_HEAD), _PATIENCE)
        positions: asyncio.Task[None] | None = None
        try:
            writer.write(self._request(host, port))
            chunked = await asyncio.wait_for(self._answer(reader), _PATIENCE)
            self._hub.notify("ok", f"connection {self._name}", f"{self._name}: corrections come")
            begun = chunked
            positions = asyncio.create_task(self._send_positions(writer))
            while True:
                data = await asyncio.wait_for(_part(reader, chunked), _PATIENCE)
                if not data:
                    raise EOFError("the caster has closed the connection")
                if not begun:  # the empty line behind ICY 200 OK, which some casters leave out
                    data, begun = data.lstrip(b"\r\n"), True
                self.received += len(data)
                for corrector in self._hub.correctors:
                    corrector(data)
        finally:
            if positions is not None:
                positions.cancel()
            writer.close()
            with contextlib.suppress(OSError, asyncio.TimeoutError):
                await asyncio.wait_for(writer.wait_closed(), 1.0)

    async def _send_positions(self, writer: asyncio.StreamWriter) -> None:
        """Tell the caster the position, the first as soon as it is known: some send nothing before."""
        while self._gga:
            sentence = _gga(self._hub)
            if sentence:
                writer.write(sentence)
            await asyncio.sleep(_EVERY if sentence else _LOOK)

    def _request(self, host: str, port: int) -> bytes:
        lines = [
            f"GET /{self._mount} HTTP/1.0",
            f"Host: {host}:{port}",
            f"User-Agent: NTRIP suspension_twin/{__version__}",
        ]
        if self._address.user:
            secret = f"{self._address.user}:{self._address.password}".encode()
            lines.append(f"Authorization: Basic {base64.b64encode(secret).decode()}")
        return ("\r\n".join(lines) + "\r\n\r\n").encode("ascii", "replace")

    async def _answer(self, reader: asyncio.StreamReader) -> bool:
        """Whether the body comes in chunks. Stay for an answer that another attempt would not change."""
        try:
            first = (await reader.readline()).decode("latin-1").strip()
            if first.startswith("ICY 200"):
                return False
            head = ""
            while (line := (await reader.readline()).decode("latin-1").strip()) and len(head) < _HEAD:
                head += line.lower() + "\n"
        except (ValueError, asyncio.LimitOverrunError):
            raise InputError(self._name, "does not speak NTRIP") from None
        if "401" in first:
            raise Stay("user or password are wrong")
        if first.startswith("SOURCETABLE") or "404" in first or "gnss/sourcetable" in head:
            raise Stay(f"has no mountpoint {self._mount}")
        if not (first.startswith("HTTP/") and " 200" in first):
            raise InputError(
                self._name, f"answers {first[:60]!r}" if first else "closes the connection at once"
            )
        return "transfer-encoding: chunked" in head


async def _part(reader: asyncio.StreamReader, chunked: bool) -> bytes:
    """Some bytes of the stream; nothing at its end."""
    if not chunked:
        return await reader.read(4096)
    try:
        size = int((await reader.readline()).split(b";")[0], 16)
        if not 0 < size <= 1 << 20:
            return b""
        data = await reader.readexactly(size)
        await reader.readline()
        return data
    except (ValueError, asyncio.IncompleteReadError):
        return b""


def _gga(hub: Hub) -> bytes:
    """The last position as a sentence; empty while there is none."""
    device = hub.chosen.get("fix")
    if device is None or device.place is None:
        return b""
    latitude, longitude, height = (round(value, 9) for value in device.place)  # no 60.0 minutes
    if not math.isfinite(height):
        return b""
    values = {
        "lat": latitude,
        "lon": longitude,
        "alt": round(height, 1),
        "quality": 1,
        "numSV": 12,
        "HDOP": 1.0,
    }
    sentence = NMEAMessage("GP", "GGA", GET, hpnmeamode=True, **values, altUnit="M", sepUnit="M", diffAge="")
    return bytes(sentence.serialize())


#: See ``SourceModule``.
make = Ntrip
