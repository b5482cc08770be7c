# SPDX-License-Identifier: Apache-2.0
"""MCAP, record by record, so that a file without its end is read as far as it goes.

Format: the MCAP specification, version 0. The records themselves are parsed by the ``mcap`` library.
"""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.drive.containers.inflate import end_of, inflate

__all__ = ["MAGIC", "salvage_mcap"]

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")


class _Salvage:
    def __init__(self, contents: Contents, name: str) -> None:
        self.contents = contents
        self.name = name
        self.schemas: dict[int, str] = {}
        self.sinks: dict[int, RawTopic | None] = {}
        self.complete = False
        self.damaged = 0
        self.doubtful = 0
        self.messages = 0

    def walk(self, file: BinaryIO, *, inside_chunk: bool = False) -> bool:
        """Take the records of ``file`` from where it stands; False where the last one is not complete.

        The file may shrink meanwhile: it is read, not mapped, and ends where a read ends.
        """
        end = end_of(file)
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            opcode, size = _HEAD.unpack(head)
            if not opcode:
                return False  # no record: the zeros that a power cut leaves behind
            body = file.read(
                min(size, end - file.tell())
            )  # Python takes memory for what is asked, not what is there
            whole = len(body) == size
            try:
                if opcode == Opcode.CHUNK and not inside_chunk:
                    self.chunk(Chunk.read(ReadDataStream(BytesIO(body))), whole)
                elif whole:
                    self.record(opcode, body)
            except (McapError, struct.error, ValueError, OverflowError):
                self.damaged += whole
            if opcode == Opcode.FOOTER:
                return True
            if not whole:
                return False
        return not head

    def record(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.MESSAGE:
            message = Message.read(stream, len(body))
            self.messages += 1
            sink = self.sinks.get(message.channel_id)
            if sink is not None:
                sink.stamps.append(message.log_time)
                sink.data.append(message.data)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema.name
            if schema.encoding == "ros2msg":
                self.contents.definitions[schema.name] = schema.data.decode("utf-8", "replace")
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            if channel.id not in self.sinks:
                msgtype = self.schemas.get(channel.schema_id, "unknown")
                sink = self.contents.open_topic(channel.topic, msgtype, channel.message_encoding)
                self.sinks[channel.id] = sink
        elif opcode == Opcode.DATA_END:
            self.complete = True  # the summary that follows names the topics without messages

    def chunk(self, chunk: Chunk, whole: bool) -> None:
        try:
            records, inflated = inflate(chunk.compression, chunk.data, self.contents.budget)
        except ValueError as error:
            self.contents.warnings.append(f"{self.name}: a chunk was left out: {error}")
            return
        sound = self.walk(BytesIO(records), inside_chunk=True) and inflated
        if whole:  # else it is cut off, which is said of the file
            self.damaged += not sound
            self.doubtful += sound and chunk.uncompressed_crc not in (0, zlib.crc32(records))


def salvage_mcap(path: Path, contents: Contents) -> None:
    """Add the messages of a file to ``contents``, and a warning for each kind of damage."""
    salvage = _Salvage(contents, path.name)
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        salvage.walk(file)
    if not salvage.complete:
        contents.warnings.append(
            f"{path.name} is cut off or damaged: {salvage.messages} whole messages were read"
        )
    if salvage.damaged:
        contents.warnings.append(f"{path.name}: {salvage.damaged} damaged records were left out")
    if salvage.doubtful:
        contents.warnings.append(
            f"{path.name}: {salvage.doubtful} chunks fail their check sum: values may be wrong"
        )
