# SPDX-License-Identifier: Apache-2.0
"""Decompression in pieces, within a budget, of what may be cut off or damaged: the bytes before the damage count."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any, BinaryIO, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from suspension_twin.drive.budget import Budget

__all__ = ["ZSTD_MAGIC", "Inflated", "end_of", "inflate"]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: Bytes fed at a time. They make 32 MiB at most (zstd: blocks of 4 bytes for 128 KiB), and a decompressor that fails
#: returns nothing of the bytes that it was given last.
_PIECE: Final = 1 << 10

_STREAMS: Final[dict[str, Callable[[], Any]]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


class Inflated:
    """The decompressed pieces of ``file``, each taken from ``budget``; ``complete`` once they came to a proper end.

    ``compression`` is ``zstd``, ``lz4`` or ``bz2``; ValueError for another. Raises TooLarge as it goes.
    """

    def __init__(self, compression: str, file: BinaryIO, budget: Budget) -> None:
        if compression not in _STREAMS:
            raise ValueError(f"compression {compression[:20]!r} is not known")
        self.complete = False
        self._stream = _STREAMS[compression]()
        self._file, self._budget = file, budget

    def __iter__(self) -> Iterator[bytes]:
        while not self.complete and (piece := self._file.read(_PIECE)):
            try:
                data = self._stream.decompress(piece)
            except (zstandard.ZstdError, RuntimeError, OSError, EOFError, MemoryError):
                return
            self.complete = bool(self._stream.eof)
            self._budget.take(len(data))
            yield data


def inflate(compression: str, data: bytes, budget: Budget) -> tuple[bytes, bool]:
    """The decompressed bytes up to the first damage, and whether the block is complete.

    ``compression`` is as in :class:`Inflated`, or empty or ``none``; these too are taken from ``budget``, as an index
    may name a block a thousand times.
    """
    if compression in ("", "none"):
        budget.take(len(data))
        return data, True
    pieces = Inflated(compression, BytesIO(data), budget)
    return b"".join(pieces), pieces.complete


def end_of(file: BinaryIO) -> int:
    """Where a file ends now; it stays where it stands."""
    at = file.tell()
    end = file.seek(0, 2)
    file.seek(at)
    return end
