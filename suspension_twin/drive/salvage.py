# SPDX-License-Identifier: Apache-2.0
"""Damaged recordings, read record by record: cut-off MCAP files and ROS 1 bags, SQLite databases without their index.

Formats: the MCAP specification, version 0 (records parsed by the ``mcap`` library); ROS bags of format 2.0 (headers
parsed by ``rosbags``); "Database File Format", sections 1.6 (b-tree pages) and 2.1 (records), sqlite.org.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1.reader import Header, RecordType

from suspension_twin.drive.contents import Contents, RawTopic
from suspension_twin.drive.unpack import Budget, inflate
from suspension_twin.errors import InputError
from suspension_twin.files import open_file

__all__ = ["MCAP_MAGIC", "ROS1_MAGIC", "SQLITE_MAGIC", "salvage_mcap", "salvage_ros1", "salvage_sqlite"]

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
ROS1_MAGIC: Final = b"#ROSBAG V2.0\n"
SQLITE_MAGIC: Final = b"SQLite format 3\0"


class _Records:
    """Messages collected from the records of one file, and the damage met on the way."""

    def __init__(self, contents: Contents, name: str) -> None:
        self.contents, self.name = contents, name
        self.topics: dict[int, RawTopic | None] = {}
        self.messages = self.damaged = self.doubtful = 0

    def walk(self, file: BinaryIO, *, inside_chunk: bool = False) -> bool:
        """Take the records of ``file`` from where it stands; False where the last one is not complete.

        The file may shrink meanwhile: it is read, not mapped, and ends where a read ends.
        """
        raise NotImplementedError

    def message(self, topic: RawTopic | None, stamp: int, data: bytes) -> None:
        self.messages += 1
        if topic is not None:
            topic.add(stamp, data)

    def chunk(self, compression: str, data: bytes, whole: bool, crc: int = 0) -> None:
        """Take the records of a chunk; ``crc`` is the check sum of the unpacked ones, 0 for none."""
        try:
            records, inflated = inflate(compression, data, self.contents.budget)
        except ValueError as error:
            self.contents.warnings.append(f"{self.name}: a chunk was left out: {error}")
            return
        sound = self.walk(BytesIO(records), inside_chunk=True) and inflated
        if whole:  # else the file is cut off, which has its own warning
            self.damaged += not sound
            self.doubtful += sound and crc not in (0, zlib.crc32(records))

    def report(self, *, cut_off: bool) -> None:
        """Add a warning for each kind of damage."""
        warnings = self.contents.warnings
        if cut_off:
            warnings.append(f"{self.name} is cut off or damaged: {self.messages} whole messages were read")
        if self.damaged:
            warnings.append(f"{self.name}: {self.damaged} damaged records were left out")
        if self.doubtful:
            warnings.append(f"{self.name}: {self.doubtful} chunks fail their check sum: values may be wrong")


def _left(file: BinaryIO) -> int:
    """Bytes from the position in a file to its present end: memory is taken for these, not for a claimed length."""
    at = file.tell()
    end = file.seek(0, 2)
    file.seek(at)
    return end - at


# MCAP

_MCAP_HEAD: Final = struct.Struct("<BQ")


class _McapRecords(_Records):
    def __init__(self, contents: Contents, name: str) -> None:
        super().__init__(contents, name)
        self.schemas: dict[int, str] = {}
        self.complete = False

    def walk(self, file: BinaryIO, *, inside_chunk: bool = False) -> bool:
        end = file.tell() + _left(file)
        while len(head := file.read(_MCAP_HEAD.size)) == _MCAP_HEAD.size:
            opcode, size = _MCAP_HEAD.unpack(head)
            if not opcode:
                return False  # no record: the zeros that a power cut leaves behind
            body = file.read(min(size, end - file.tell()))
            whole = len(body) == size
            try:
                if opcode == Opcode.CHUNK and not inside_chunk:
                    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
                    self.chunk(chunk.compression, chunk.data, whole, chunk.uncompressed_crc)
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
            self.message(self.topics.get(message.channel_id), message.log_time, message.data)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema.name
            if schema.encoding == "ros2msg":
                self.contents.definitions[schema.name] = schema.data.decode("utf-8", "replace")
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            if channel.id not in self.topics:
                kind = self.schemas.get(channel.schema_id, "unknown")
                self.topics[channel.id] = self.contents.open_topic(
                    channel.topic, kind, channel.message_encoding
                )
        elif opcode == Opcode.DATA_END:
            self.complete = True  # the summary that follows names the topics without messages


def salvage_mcap(path: Path, contents: Contents) -> None:
    """Add the messages of an MCAP file to ``contents``, and a warning for each kind of damage."""
    records = _McapRecords(contents, path.name)
    with open_file(path) as file:
        file.seek(len(MCAP_MAGIC))
        records.walk(file)
    records.report(cut_off=not records.complete)


# ROS 1


class _Ros1Records(_Records):
    index_at = 0

    def walk(self, file: BinaryIO, *, inside_chunk: bool = False) -> bool:
        end = file.tell() + _left(file)
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
                    self.chunk(header.get_string("compression"), body[4:], whole)
                elif whole:
                    self.record(kind, header, body)
            except (ReaderError, KeyError, ValueError, struct.error):
                self.damaged += whole
            if not whole:
                return False

    def record(self, kind: int, header: Header, body: bytes) -> None:
        if kind == RecordType.MSGDATA:
            self.message(self.topics[header.get_uint32("conn")], header.get_time("time"), body[4:])
        elif kind == RecordType.CONNECTION and header.get_uint32("conn") not in self.topics:
            msgtype = Header.read(BytesIO(body)).get_string("type")
            topic = self.contents.open_topic(header.get_string("topic"), msgtype, "ros1")
            self.topics[header.get_uint32("conn")] = topic
        elif kind == RecordType.BAGHEADER:
            self.index_at = header.get_uint64("index_pos")


def _sized(file: BinaryIO, end: int) -> tuple[bytes, bool]:
    """A length word and the bytes it counts, and whether they are all there."""
    word = file.read(4)
    size = int.from_bytes(word, "little")
    data = file.read(min(size, max(end - file.tell(), 0)))
    return word + data, len(word) == 4 and len(data) == size


def salvage_ros1(path: Path, contents: Contents) -> None:
    """Add the messages of a ROS 1 bag to ``contents``, and a warning for each kind of damage."""
    records = _Ros1Records(contents, path.name)
    with open_file(path) as file:
        file.seek(len(ROS1_MAGIC))
        whole = records.walk(file) and records.index_at <= path.stat().st_size
    if whole and not records.index_at:
        contents.warnings.append(f"{path.name} was not closed by its recorder: read without its index")
    records.report(cut_off=not whole)


# SQLite. The inner pages of a table's tree are written last, so that a file cut off early holds thousands of messages
# that SQLite cannot reach. Each leaf page stands on its own: all of them are read here.

_TABLE_LEAF: Final = 0x0D
_LEAF_HEADER: Final = 8  # bytes before the pointers to the cells of a leaf page
_INTEGER_BYTES: Final = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)  # by serial type; 8 and 9 are the constants 0 and 1
#: Bytes: a size and a row id of one byte, and a pointer of two.
_LEAST_CELL: Final = 4

_Value = int | str | bytes | None


class _Damaged(Exception):
    pass


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A variable-length integer and the offset behind it."""
    value = 0
    for i in range(8):
        byte = data[at + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    return value << 8 | data[at + 8], at + 9


class _Pages:
    def __init__(self, file: BinaryIO, length: int, budget: Budget) -> None:
        self.file, self.length, self.budget = file, length, budget
        file.seek(0)
        head = file.read(100)
        size = int.from_bytes(head[16:18], "big")
        self.size = 65536 if size == 1 else max(size, 512)
        self.usable = self.size - head[20]
        self.count = length // self.size  # an incomplete page at the end is not one

    def page(self, number: int) -> bytes:
        """Page ``number``, counted from 1."""
        if not 1 <= number <= self.count:
            raise _Damaged
        self.file.seek((number - 1) * self.size)
        page = self.file.read(self.size)
        if len(page) < self.size:  # the file shrank
            raise _Damaged
        return page

    def payload(self, page: bytes, begin: int) -> tuple[int, bytes, int]:
        """Row id and payload of the cell that begins there, overflow pages included, and the bytes
        that it takes of its own page."""
        total, at = _varint(page, begin)
        row, at = _varint(page, at)
        if total > self.length or self.usable < 36:
            raise _Damaged
        self.budget.take(total)  # cells may share the pages that they flow over to
        most = self.usable - 35
        least = (self.usable - 12) * 32 // 255 - 23
        local = total
        if total > most:
            local = least + (total - least) % (self.usable - 4)
            local = local if local <= most else least
        pieces = [page[at : at + local]]
        following = int.from_bytes(page[at + local : at + local + 4], "big")
        for _ in range(-(-(total - local) // (self.usable - 4))):
            overflow = self.page(following)
            pieces.append(overflow[4 : self.usable])
            following = int.from_bytes(overflow[:4], "big")
        payload = b"".join(pieces)[:total]
        if len(payload) < total:
            raise _Damaged
        return row, payload, at + local - begin

    def rows(self) -> Iterator[tuple[int, list[_Value]]]:
        """Row id and values of every row on a complete leaf page, in the order of the pages."""
        for number in range(2, self.count + 1):
            try:
                page = self.page(number)
            except _Damaged:
                return
            if page[0] != _TABLE_LEAF:
                continue
            left = self.size  # cells do not overlap: a page where they do is damaged
            for i in range(int.from_bytes(page[3:5], "big")):
                at, taken = _LEAF_HEADER + 2 * i, _LEAST_CELL
                try:
                    row, payload, taken = self.payload(page, int.from_bytes(page[at : at + 2], "big"))
                    yield row, _values(payload)
                except (_Damaged, IndexError):
                    pass
                left -= taken
                if left < 0:
                    break


def _values(payload: bytes) -> list[_Value]:
    """Columns of a record; of the tables of a recording none holds floating-point numbers."""
    header, at = _varint(payload, 0)
    kinds = []
    while at < header:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    values: list[_Value] = []
    for kind in kinds:
        size = _INTEGER_BYTES[kind] if kind < 10 else (kind - 12) // 2
        data = payload[at : at + size]
        at += size
        if kind >= 12:
            values.append(data.decode("utf-8", "replace") if kind % 2 else data)
        elif kind == 0:
            values.append(None)
        else:
            values.append(int.from_bytes(data, "big", signed=True) if size else kind - 8)
    if at != len(payload):
        raise _Damaged
    return values


def salvage_sqlite(path: Path, contents: Contents) -> None:
    """Add the messages on complete pages of a database to ``contents``, with a warning.

    Raises InputError if it is no recording or too little of it is there to find its topics.
    """
    records = _Records(contents, path.name)
    found: dict[int, tuple[int, int, bytes]] = {}
    length = path.stat().st_size
    with open_file(path) as file:
        if length >= 512 and b"CREATE TABLE topics" not in file.read(1 << 16):
            raise InputError(path, "a database, but not a rosbag2 recording (it has no topics)")
        for row, values in _Pages(file, length, contents.budget).rows() if length >= 512 else ():
            match values:
                case [None, int(topic), int(stamp), bytes(message)]:
                    found[row] = topic, stamp, message
                case [None, str(name), str(kind), str(encoding), *_] if name.startswith("/"):
                    records.topics[row] = contents.open_topic(name, kind, encoding)
                case [None, str(kind), "ros2msg", str(text), *_]:
                    contents.definitions[kind] = text
    if not records.topics:
        raise InputError(path, "cut off or damaged before its topics")
    for _, (topic, stamp, message) in sorted(found.items()):
        if (wanted := records.topics.get(topic)) is not None:
            records.message(wanted, stamp, message)
    records.report(cut_off=True)
