# SPDX-License-Identifier: Apache-2.0
"""Decompression that gives what it can of a block that is cut off or damaged."""

from __future__ import annotations

import bz2
from typing import Protocol

import lz4.frame  # type: ignore[import-untyped]
import zstandard

__all__ = ["ZSTD_MAGIC", "inflate"]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE = 1 << 16
_LARGEST = 1 << 32


class _Stream(Protocol):
    def decompress(self, data: bytes, /) -> bytes: ...


def _stream(compression: str) -> _Stream:
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj()
    if compression == "lz4":
        stream: _Stream = lz4.frame.LZ4FrameDecompressor()
        return stream
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    raise ValueError(f"compression {compression!r} is not known")


def inflate(compression: str, data: bytes) -> tuple[bytes, bool]:
    """The bytes that can be had, and whether the block is whole.

    ``compression`` is ``zstd``, ``lz4``, ``bz2``, or empty or ``none``; ValueError for another.
    """
    if compression in ("", "none"):
        return data, True
    stream = _stream(compression)
    pieces: list[bytes] = []
    total = 0
    try:
        for at in range(0, len(data), _PIECE):
            piece = stream.decompress(data[at : at + _PIECE])
            pieces.append(piece)
            total += len(piece)
            if total > _LARGEST:
                return b"".join(pieces), False
            if getattr(stream, "eof", False):
                return b"".join(pieces), True
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError, MemoryError):
        return b"".join(pieces), False
    return b"".join(pieces), bool(getattr(stream, "eof", False))
