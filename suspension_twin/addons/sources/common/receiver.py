# SPDX-License-Identifier: Apache-2.0
"""GNSS receivers on a serial port or behind TCP: bytes in and, for corrections, out."""

from __future__ import annotations

import asyncio
import os
import stat
import termios
import tty
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from typing import Final

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import Address, PlainSource, keep_connected
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.errors import InputError

__all__ = ["RECEIVER_RANK", "ByteStream", "DescriptorStream", "Receiver", "open_stream"]

#: A receiver's positions count before those of any phone.
RECEIVER_RANK: Final = 100

_CHUNK: Final = 4096
#: Bytes without anything in them that can be read, after which the speed of the port is doubted.
_NOISE: Final = 2000
_BAUDS: Final = {
    n: getattr(termios, f"B{n}") for n in (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
}


class ByteStream:
    """An open port. ``lost`` counts the bytes that could not be written at once: nothing queues up."""

    def __init__(self) -> None:
        self.lost = 0

    async def read(self) -> bytes:
        """The bytes that have come; EOFError at the end."""
        raise NotImplementedError

    def write(self, data: bytes) -> None:
        """Send what can be sent without waiting."""
        raise NotImplementedError


class DescriptorStream(ByteStream):
    """An open device file that does not block."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor

    async def read(self) -> bytes:
        """See the base class."""
        loop, ready = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(self._descriptor, ready.set)
        try:
            while True:
                await ready.wait()
                try:
                    data = os.read(self._descriptor, _CHUNK)
                except BlockingIOError:
                    ready.clear()
                    continue
                if not data:
                    raise EOFError("the device was unplugged")
                return data
        finally:
            loop.remove_reader(self._descriptor)

    def write(self, data: bytes) -> None:
        """See the base class."""
        try:
            written = os.write(self._descriptor, data)
        except OSError:
            written = 0
        self.lost += len(data) - written


class _Tcp(ByteStream):
    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__()
        self._reader, self._writer = reader, writer

    async def read(self) -> bytes:
        data = await self._reader.read(_CHUNK)
        if not data:
            raise EOFError("the connection was closed")
        return data

    def write(self, data: bytes) -> None:
        if self._writer.transport.get_write_buffer_size() > _CHUNK:
            self.lost += len(data)
        else:
            self._writer.write(data)


@asynccontextmanager
async def open_stream(address: Address, baud: int) -> AsyncIterator[ByteStream]:
    """The serial port of the address, raw and at ``baud`` bit/s, or its host and port over TCP."""
    if address.host:
        reader, writer = await asyncio.wait_for(asyncio.open_connection(address.host, address.port), 5.0)
        try:
            yield _Tcp(reader, writer)
        finally:
            writer.close()
        return
    descriptor = os.open(address.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        if os.isatty(descriptor):
            tty.setraw(descriptor, termios.TCSANOW)
            settings = termios.tcgetattr(descriptor)
            settings[4] = settings[5] = _BAUDS[baud]
            termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        yield DescriptorStream(descriptor)
    finally:
        os.close(descriptor)


class Receiver(PlainSource):
    """A receiver that is read from; a subclass has ``feed``, and ``opened`` if there is something to send first."""

    def __init__(
        self, address: Address, hub: Hub, rank: int, title: str, baud: int, options: Collection[str] = ()
    ) -> None:
        address.check_options(("baud", *options))
        self.baud = int(address.number("baud", baud, min(_BAUDS), max(_BAUDS)))
        if self.baud not in _BAUDS:
            raise InputError(str(address), "baud", f"must be one of {', '.join(map(str, _BAUDS))}")
        if address.host and not address.port:
            raise InputError(str(address), f"has no port: write {address.scheme}://HOST:PORT")
        self.address = address
        self.hub = hub
        name = f"receiver {address.host or os.path.basename(address.path)}"
        self.device = hub.own_device(str(address), name, rank=RECEIVER_RANK + rank)
        self.understood = 0
        self.notes = [f"{title}: reads {address.where.removeprefix('//')}"]
        self._noise = 0
        self._stream: ByteStream | None = None
        hub.correctors.append(self._correct)

    async def start(self) -> None:
        """InputError for a port that is not there; one that is unplugged later is waited for."""
        if self.address.host:
            return
        try:
            mode = os.stat(self.address.path).st_mode
        except OSError as error:
            raise InputError(self.address.path, error.strerror or "cannot be read") from None
        if not stat.S_ISCHR(mode):
            raise InputError(
                self.address.path, "is no serial port: a recorded log is for suspension-twin import"
            )
        if not os.access(self.address.path, os.R_OK | os.W_OK):
            raise InputError(self.address.path, "permission denied (the group dialout may use serial ports)")

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        await keep_connected(self.hub, self.device.name, self._session)

    async def _session(self) -> None:
        async with open_stream(self.address, self.baud) as stream:
            self._stream = stream
            try:
                self.opened(stream)
                while True:
                    data = await stream.read()
                    before = self.understood
                    self.feed(data, host_time())
                    self._doubt(len(data), self.understood > before)
            finally:
                self._stream = None

    def opened(self, stream: ByteStream) -> None:
        """The port has been opened."""

    def feed(self, data: bytes, arrival: float) -> None:
        """Take bytes as they come; counts in ``understood`` what could be read."""
        raise NotImplementedError

    def _doubt(self, size: int, understood: bool) -> None:
        before = self._noise
        self._noise = 0 if understood else before + size
        if before < _NOISE <= self._noise:
            self.hub.notify("warn", f"noise {self.device.name}", f"{self.device.name}: {self.doubt()}")

    def doubt(self) -> str:
        """Possible cause where nothing can be read."""
        return f"sends nothing that can be read at {self.baud} bit/s: try another ?baud="

    def _correct(self, data: bytes) -> None:
        if self._stream is not None:
            self._stream.write(data)
            self.device.counts["bytes of corrections"] += len(data)
            if self._stream.lost:
                self.device.counts["bytes of corrections lost"] = self._stream.lost
