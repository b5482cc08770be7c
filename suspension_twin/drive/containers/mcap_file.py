# SPDX-License-Identifier: Apache-2.0
"""MCAP, record by record, so that a file without its end reads as far as it goes.

Format: the MCAP specification, version 0. Schemas and channels are parsed by the ``mcap``
library; messages, of which there are very many, are found here.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.drive.containers.inflate import ZSTD_MAGIC, inflate

__all__ = ["MAGIC", "read_mcap"]

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<H4xQ8x")
_CHUNK = struct.Struct("<QQQLL")
_SIZE = struct.Struct("<Q")


class _Reader:
    def __init__(self, contents: Contents, name: str) -> None:
        self.contents = contents
        self.name = name
        self.schemas: dict[int, str] = {}
        self.sinks: dict[int, RawTopic | None] = {}
        self.whole = False
        self.damaged = 0
        self.doubtful = 0
        self.messages = 0

    def walk(self, data: bytes | mmap.mmap, at: int, end: int) -> bool:
        """Take the records between two offsets; False where the last one is not whole."""
        sinks = self.sinks
        while at < end:
            if at + 9 > end:
                return False
            opcode, size = _HEAD.unpack_from(data, at)
            if not opcode:
                return False  # no record: the zeros that a power cut leaves behind
            body = at + 9
            at = body + size
            if opcode == Opcode.CHUNK:
                self.chunk(data, body, min(at, end))
            if at > end:
                return False
            if opcode == Opcode.MESSAGE:
                if size < 22:
                    self.damaged += 1
                    continue
                channel, stamp = _MESSAGE.unpack_from(data, body)
                self.messages += 1
                sink = sinks.get(channel)
                if sink is not None:
                    sink.stamps.append(stamp)
                    sink.data.append(data[body + 22 : at])
            elif opcode == Opcode.CHANNEL or opcode == Opcode.SCHEMA:
                self.describe(opcode, data[body:at])
            elif opcode == Opcode.DATA_END:
                self.whole = True  # the summary that follows names the topics without messages
            elif opcode == Opcode.FOOTER:
                return True
        return True

    def describe(self, opcode: int, record: bytes) -> None:
        stream = ReadDataStream(BytesIO(record))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema.name
                if schema.encoding == "ros2msg":
                    self.contents.definitions[schema.name] = schema.data.decode("utf-8", "replace")
                return
            channel = Channel.read(stream)
        except (McapError, struct.error, UnicodeDecodeError, ValueError):
            self.damaged += 1
            return
        if channel.id in self.sinks:
            return
        if channel.message_encoding != "cdr":
            self.contents.open_topic(channel.topic, f"{channel.message_encoding} messages")
            self.sinks[channel.id] = None
            return
        msgtype = self.schemas.get(channel.schema_id, "unknown")
        self.sinks[channel.id] = self.contents.open_topic(channel.topic, msgtype)

    def chunk(self, data: bytes | mmap.mmap, body: int, end: int) -> None:
        """Take the records of a chunk, of which only the part before ``end`` is there."""
        try:
            _, _, _, checksum, name_size = _CHUNK.unpack_from(data, body)
            at = body + _CHUNK.size + name_size
            compression = data[body + _CHUNK.size : at].decode()
            (size,) = _SIZE.unpack_from(data, at)
        except (struct.error, UnicodeDecodeError):
            return  # cut off within the chunk's own header
        at += _SIZE.size
        try:
            records, whole = inflate(compression, data[at : min(at + size, end)])
        except ValueError as error:
            self.contents.warnings.append(f"{self.name}: a chunk was left out: {error}")
            return
        sound = self.walk(records, 0, len(records)) and whole
        if at + size <= end:  # else it is cut off, which is said of the whole file
            self.damaged += not sound
            self.doubtful += sound and checksum not in (0, zlib.crc32(records))


def read_mcap(path: Path, contents: Contents) -> None:
    """Add the messages of one file to ``contents``; a warning where it is not whole."""
    size = path.stat().st_size
    reader = _Reader(contents, path.name)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        reader.walk(data, len(MAGIC), size)
    if not reader.whole:
        contents.warnings.append(
            f"{path.name} is cut off or damaged: {reader.messages} whole messages were read"
        )
    if reader.damaged:
        contents.warnings.append(f"{path.name}: {reader.damaged} damaged records were left out")
    if reader.doubtful:
        contents.warnings.append(
            f"{path.name}: {reader.doubtful} chunks fail their check sum: values may be wrong"
        )
    for topic in contents.topics.values():
        if topic.data and topic.data[0].startswith(ZSTD_MAGIC):
            topic.data = [inflate("zstd", data)[0] for data in topic.data]
