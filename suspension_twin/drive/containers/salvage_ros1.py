# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags (format 2.0), record by record, so that an unindexed or cut-off bag is read too."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import Header, RecordType

from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.drive.containers.inflate import end_of, inflate

__all__ = ["MAGIC", "salvage_ros1"]

MAGIC = b"#ROSBAG V2.0\n"


def _sized(file: BinaryIO, end: int) -> tuple[bytes, bool]:
    """A length word and the bytes it counts, and whether they are all there."""
    word = file.read(4)
    size = int.from_bytes(word, "little")
    data = file.read(min(size, max(end - file.tell(), 0)))
    return word + data, len(word) == 4 and len(data) == size


class _Salvage:
    def __init__(self, contents: Contents, name: str) -> None:
        self.contents = contents
        self.name = name
        self.sinks: dict[int, RawTopic | None] = {}
        self.damaged = 0
        self.messages = 0
        self.index_at = 0

    def walk(self, file: BinaryIO, *, inside_chunk: bool = False) -> bool:
        """Take the records up to the end; False where the last one is not complete."""
        end = end_of(file)
        while True:
            head, whole = _sized(file, end)
            if not whole or len(head) == 4:
                return not head  # else no record: cut off, or the zeros that a power cut leaves behind
            body, whole = _sized(file, end)
            try:
                header = Header.read(BytesIO(head))
                kind = header.get_uint8("op")
                if kind == RecordType.CHUNK and inside_chunk:
                    self.damaged += 1  # a chunk in a chunk is none
                elif kind == RecordType.CHUNK:
                    self.chunk(header, body[4:], whole)
                elif whole:
                    self.record(kind, header, body)
            except (ReaderError, KeyError, ValueError, struct.error):
                self.damaged += whole
            if not whole:
                return False

    def record(self, kind: int, header: Header, body: bytes) -> None:
        if kind == RecordType.MSGDATA:
            sink = self.sinks[header.get_uint32("conn")]
            self.messages += 1
            if sink is not None:
                sink.stamps.append(header.get_time("time"))
                sink.data.append(body[4:])
        elif kind == RecordType.CONNECTION and header.get_uint32("conn") not in self.sinks:
            msgtype = Header.read(BytesIO(body)).get_string("type")
            sink = self.contents.open_topic(header.get_string("topic"), msgtype, "ros1")
            self.sinks[header.get_uint32("conn")] = sink
        elif kind == RecordType.BAGHEADER:
            self.index_at = header.get_uint64("index_pos")

    def chunk(self, header: Header, data: bytes, whole: bool) -> None:
        try:
            records, inflated = inflate(header.get_string("compression"), data, self.contents.budget)
        except ValueError as error:
            self.contents.warnings.append(f"{self.name}: a chunk was left out: {error}")
            return
        sound = self.walk(BytesIO(records), inside_chunk=True) and inflated
        self.damaged += whole and not sound


def salvage_ros1(path: Path, contents: Contents) -> None:
    """Add the messages of a bag to ``contents``, and a warning for each kind of damage."""
    salvage = _Salvage(contents, path.name)
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        whole = salvage.walk(file)
    if not whole or salvage.index_at > path.stat().st_size:
        contents.warnings.append(
            f"{path.name} is cut off or damaged: {salvage.messages} whole messages were read"
        )
    elif not salvage.index_at:
        contents.warnings.append(f"{path.name} was not closed by its recorder: read without its index")
    if salvage.damaged:
        contents.warnings.append(f"{path.name}: {salvage.damaged} damaged records were left out")
