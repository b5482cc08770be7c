# SPDX-License-Identifier: Apache-2.0
"""rosbag2 sqlite3 files found page by page, without the tree that joins the pages.

The inner pages of a table's tree are written last, so that a file cut off early holds thousands of
messages that SQLite cannot reach. Each leaf page stands on its own: all of them are read here.
Format: "Database File Format", sections 1.6 (b-tree pages) and 2.1 (records), sqlite.org.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from suspension_twin.drive.budget import Budget
from suspension_twin.drive.containers.contents import Contents, RawTopic
from suspension_twin.errors import InputError

__all__ = ["MAGIC", "salvage_sqlite"]

MAGIC = b"SQLite format 3\0"

_TABLE_LEAF = 0x0D
_LEAF_HEADER = 8  # bytes before the pointers to the cells of a leaf page
_INTEGER_BYTES = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)  # by serial type; 8 and 9 are the constants 0 and 1

#: Bytes: a size and a row id of one byte, and a pointer of two (SQLite, Database File Format, 1.6).
_LEAST_CELL = 4

Value = int | str | bytes | None


class _Damaged(Exception):
    pass


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A variable-length integer and the offset behind it."""
    value = 0
    for i in range(9):
        byte = data[at + i]
        if i == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    raise _Damaged


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
        """Row id and payload of the cell that begins there, with what overflowed onto other pages, and the bytes that
        it takes of its own page."""
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

    def rows(self) -> Iterator[tuple[int, list[Value]]]:
        """Row id and values of every row on a complete leaf page, in the order of the pages."""
        for number in range(2, self.count + 1):
            try:
                page = self.page(number)
            except _Damaged:
                return
            if page[0] != _TABLE_LEAF:
                continue
            left = self.size  # cells do not overlap: a page that says so is damaged
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


def _values(payload: bytes) -> list[Value]:
    """Columns of a record; of the tables of a recording none holds floating-point numbers."""
    header, at = _varint(payload, 0)
    kinds = []
    while at < header:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    values: list[Value] = []
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
    """Add the messages on complete pages of a file to ``contents``, with a warning.

    Raises InputError if it is no recording or too little of it is there to find its topics.
    """
    sinks: dict[int, RawTopic | None] = {}
    found: dict[int, tuple[int, int, bytes]] = {}
    length = path.stat().st_size
    with path.open("rb") as file:
        if length >= 512 and b"CREATE TABLE topics" not in file.read(1 << 16):
            raise InputError(path, "a database, but not a rosbag2 recording (it has no topics)")
        for row, values in _Pages(file, length, contents.budget).rows() if length >= 512 else ():
            match values:
                case [None, int(topic), int(stamp), bytes(message)]:
                    found[row] = topic, stamp, message
                case [None, str(name), str(kind), str(encoding), *_] if name.startswith("/"):
                    sinks[row] = contents.open_topic(name, kind, encoding)
                case [None, str(kind), "ros2msg", str(text), *_]:
                    contents.definitions[kind] = text
    if not sinks:
        raise InputError(path, "cut off or damaged before its topics")
    count = 0
    for row in sorted(found):
        topic, stamp, message = found[row]
        sink = sinks.get(topic)
        if sink is not None:
            sink.stamps.append(stamp)
            sink.data.append(message)
            count += 1
    contents.warnings.append(f"{path.name} is cut off or damaged: {count} whole messages were read")
