# SPDX-License-Identifier: Apache-2.0
"""Decompression within a limit: how much memory a file may take once it is unpacked.

Recordings of sensors shrink to a tenth at best. A file that unpacks to thousands of times its size is made to fill a
memory, and is refused while it unpacks, not after.
"""

from __future__ import annotations

import bz2
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from suspension_twin.errors import InputError

__all__ = ["VARIABLE", "ZSTD_MAGIC", "Budget", "TooLarge", "inflate"]

#: The environment variable that raises the limit, in MiB.
VARIABLE: Final = "SUSPENSION_TWIN_UNPACKED_MIB"
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"

_FLOOR: Final = 64 << 20
_RATIO: Final = 32
#: Bytes fed at a time. They make 32 MiB at most (zstd: blocks of 4 bytes for 128 KiB), and a decompressor that fails
#: returns nothing of the bytes that it was given last.
_PIECE: Final = 1 << 10


class TooLarge(InputError):
    """A file unpacks to more than it may."""


@final
class Budget:
    """Bytes that ``source`` of ``size`` bytes on disk may take in memory; each part read is taken from it.

    Raises InputError if the environment variable is no number of MiB.
    """

    def __init__(self, source: str | Path, size: int) -> None:
        given = os.environ.get(VARIABLE, "")
        if given and not (given.isascii() and given.isdigit()):
            raise InputError(VARIABLE, f"must be a number of MiB, is {given[:40]!r}")
        self.source = source
        self.allowed = self.left = int(given) << 20 if given else max(_FLOOR, _RATIO * size)

    def take(self, count: int) -> None:
        """``count`` bytes more; raises TooLarge where they are too many."""
        self.left -= count
        if self.left < 0:
            raise TooLarge(
                self.source,
                f"unpacks to more than {self.allowed >> 20} MiB: if that is right, {VARIABLE}="
                f"{2 * max(self.allowed >> 20, 1)} in the environment allows more",
            )


class _Decompressor(Protocol):
    """The interface that the decompressors of zstandard, lz4 and bz2 share."""

    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, /) -> bytes: ...


_STREAMS: Final[dict[str, Callable[[], _Decompressor]]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def inflate(compression: str, data: bytes, budget: Budget) -> tuple[bytes, bool]:
    """The decompressed bytes up to the first damage, and whether they came to a proper end.

    ``compression`` is ``zstd``, ``lz4`` or ``bz2``, or empty or ``none``; ValueError for another. Each piece is taken
    from ``budget``, uncompressed ones too, as an index may name a block a thousand times. Raises TooLarge as it goes.
    """
    if compression in ("", "none"):
        budget.take(len(data))
        return data, True
    if compression not in _STREAMS:
        raise ValueError(f"compression {compression[:20]!r} is not known")
    stream = _STREAMS[compression]()
    pieces = []
    for at in range(0, len(data), _PIECE):
        try:
            pieces.append(stream.decompress(data[at : at + _PIECE]))
        except (zstandard.ZstdError, RuntimeError, OSError, EOFError, MemoryError):
            break
        budget.take(len(pieces[-1]))
        if stream.eof:
            return b"".join(pieces), True
    return b"".join(pieces), False
