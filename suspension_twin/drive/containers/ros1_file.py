# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags (format 2.0), record by record, so that an unindexed or cut-off bag reads too."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.drive.containers.inflate import inflate

__all__ = ["MAGIC", "read_ros1"]

MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG, _CHUNK, _CONNECTION = 2, 3, 5, 7
_U32 = struct.Struct("<I")
_STAMP = struct.Struct("<II")


class _Damaged(Exception):
    pass


def _fields(header: bytes) -> dict[bytes, bytes]:
    """``name=value`` fields of a record's header."""
    fields = {}
    at, end = 0, len(header)
    while at < end:
        if at + 4 > end:
            raise _Damaged
        (size,) = _U32.unpack_from(header, at)
        at += 4
        name, equals, value = header[at : at + size].partition(b"=")
        if not equals or at + size > end:
            raise _Damaged
        fields[name] = value
        at += size
    return fields


class _Reader:
    def __init__(self, contents: Contents, name: str) -> None:
        self.contents = contents
        self.name = name
        self.sinks: dict[bytes, RawTopic | None] = {}
        self.damaged = 0
        self.messages = 0
        self.index_at: int | None = None

    def walk(self, data: bytes | mmap.mmap, at: int, end: int) -> bool:
        """Take the records between two offsets; False where the last one is not whole."""
        while at < end:
            if at + 4 > end:
                return False
            (head_size,) = _U32.unpack_from(data, at)
            head_end = at + 4 + head_size
            if not head_size or head_end + 4 > end:
                return False  # no record: cut off, or the zeros that a power cut leaves behind
            header = data[at + 4 : head_end]
            (size,) = _U32.unpack_from(data, head_end)
            body = head_end + 4
            at = body + size
            try:
                fields = _fields(header)
                kind = fields[b"op"][0]
                if kind == _CHUNK:
                    self.chunk(fields, data, body, min(at, end), at <= end)
                if at > end:
                    return False
                if kind == _MESSAGE:
                    self.message(fields, data[body:at])
                elif kind == _CONNECTION:
                    self.connection(fields, data[body:at])
                elif kind == _BAG:
                    self.index_at = int.from_bytes(fields[b"index_pos"], "little")
            except (_Damaged, KeyError, IndexError, struct.error):
                self.damaged += 1
                if at > end:
                    return False
        return True

    def message(self, fields: dict[bytes, bytes], body: bytes) -> None:
        sink = self.sinks[fields[b"conn"]]
        self.messages += 1
        if sink is not None:
            sec, nanosec = _STAMP.unpack(fields[b"time"])
            sink.stamps.append(sec * 1_000_000_000 + nanosec)
            sink.data.append(body)

    def connection(self, fields: dict[bytes, bytes], body: bytes) -> None:
        number = fields[b"conn"]
        if number not in self.sinks:
            topic = fields[b"topic"].decode("utf-8", "replace")
            msgtype = _fields(body)[b"type"].decode("utf-8", "replace")
            self.sinks[number] = self.contents.open_topic(topic, msgtype)

    def chunk(
        self, fields: dict[bytes, bytes], data: bytes | mmap.mmap, body: int, end: int, whole: bool
    ) -> None:
        compression = fields[b"compression"].decode("ascii", "replace")
        if compression == "none":
            inner_whole = self.walk(data, body, end)
        else:
            try:
                records, inflated = inflate(compression, data[body:end])
            except ValueError as error:
                self.contents.warnings.append(f"{self.name}: a chunk was left out: {error}")
                return
            inner_whole = self.walk(records, 0, len(records)) and inflated
        if whole and not inner_whole:
            self.damaged += 1


def read_ros1(path: Path, contents: Contents) -> None:
    """Add the messages of one bag to ``contents``; a warning where it is not whole."""
    size = path.stat().st_size
    reader = _Reader(contents, path.name)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        whole = reader.walk(data, len(MAGIC), size)
    if not whole or (reader.index_at or 0) > size:
        contents.warnings.append(
            f"{path.name} is cut off or damaged: {reader.messages} whole messages were read"
        )
    elif not reader.index_at:
        contents.warnings.append(f"{path.name} was not closed by its recorder: read without its index")
    if reader.damaged:
        contents.warnings.append(f"{path.name}: {reader.damaged} damaged records were left out")
