# SPDX-License-Identifier: Apache-2.0
"""Messages of a rosbag2 sqlite3 file found page by page, without its tree.

The inner pages of a table's tree are written late, so that a file cut off early holds thousands
of messages that SQLite can no longer reach. Its leaves stand on their own: this walks them.
Format: "Database File Format", sections 1.6 (b-tree pages) and 2.1 (records), sqlite.org.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

__all__ = ["message_rows"]

_LEAF = 0x0D
_CELL_POINTERS = 8


class _Damaged(Exception):
    pass


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i in range(9):
        if at >= len(data):
            raise _Damaged
        byte = data[at]
        at += 1
        if i == 8:
            return value << 8 | byte, at
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at
    raise _Damaged


class _Pages:
    def __init__(self, data: mmap.mmap) -> None:
        self.data = data
        size = int.from_bytes(data[16:18], "big")
        self.size = 65536 if size == 1 else max(size, 512)
        self.usable = self.size - data[20]
        self.count = len(data) // self.size  # a half page at the end is no page

    def page(self, number: int) -> bytes:
        """Page ``number``, counted from 1."""
        if not 1 <= number <= self.count:
            raise _Damaged
        return self.data[(number - 1) * self.size : number * self.size]

    def payload(self, page: bytes, at: int) -> tuple[int, bytes]:
        """Row id and payload of the cell at ``at``, with what overflowed onto other pages."""
        total, at = _varint(page, at)
        row, at = _varint(page, at)
        most = self.usable - 35
        if total <= most:
            if at + total > self.usable:
                raise _Damaged
            return row, page[at : at + total]
        least = (self.usable - 12) * 32 // 255 - 23
        local = least + (total - least) % (self.usable - 4)
        local = local if local <= most else least
        pieces = [page[at : at + local]]
        following = int.from_bytes(page[at + local : at + local + 4], "big")
        left = total - local
        while left > 0:
            overflow = self.page(following)
            pieces.append(overflow[4 : 4 + min(left, self.usable - 4)])
            left -= self.usable - 4
            following = int.from_bytes(overflow[:4], "big")
        return row, b"".join(pieces)


def _integer(kind: int) -> int:
    """Bytes of an integer of serial type ``kind``."""
    if kind in (8, 9):
        return 0
    if 1 <= kind <= 6:
        return (1, 2, 3, 4, 6, 8)[kind - 1]
    raise _Damaged


def _message(payload: bytes) -> tuple[int, int, bytes]:
    """Topic, stamp and data if the record is (NULL, integer, integer, blob), as messages are."""
    header, at = _varint(payload, 0)
    kinds = []
    while at < header:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] != 0 or kinds[3] < 12 or kinds[3] % 2:
        raise _Damaged
    numbers = []
    for kind in kinds[1:3]:
        size = _integer(kind)
        value = int.from_bytes(payload[at : at + size], "big", signed=True) if size else kind - 8
        numbers.append(value)
        at += size
    size = (kinds[3] - 12) // 2
    if at + size != len(payload):
        raise _Damaged
    return numbers[0], numbers[1], payload[at:]


def message_rows(path: Path) -> Iterator[tuple[int, int, int, bytes]]:
    """Row id, topic id, stamp in ns and data of every message on a whole page, in page order."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        pages = _Pages(data)
        for number in range(2, pages.count + 1):
            page = pages.page(number)
            if page[0] != _LEAF:
                continue
            for i in range(int.from_bytes(page[3:5], "big")):
                at = _CELL_POINTERS + 2 * i
                try:
                    row, payload = pages.payload(page, int.from_bytes(page[at : at + 2], "big"))
                    yield (row, *_message(payload))
                except (_Damaged, IndexError):
                    continue
