# SPDX-License-Identifier: Apache-2.0
"""Decompression of a block that may be cut off or damaged: the bytes before the damage are returned."""

from __future__ import annotations

import bz2
from contextlib import suppress
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard

__all__ = ["ZSTD_MAGIC", "inflate"]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: Bytes fed at a time: a decompressor that fails returns nothing of the bytes it was given last.
_PIECE = 1 << 16


def inflate(compression: str, data: bytes) -> tuple[bytes, bool]:
    """The decompressed bytes up to the first damage, and whether the block is complete.

    ``compression`` is ``zstd``, ``lz4``, ``bz2``, or empty or ``none``; ValueError for another.
    """
    stream: Any
    if compression in ("", "none"):
        return data, True
    if compression == "zstd":
        stream = zstandard.ZstdDecompressor().decompressobj()
    elif compression == "lz4":
        stream = lz4.frame.LZ4FrameDecompressor()
    elif compression == "bz2":
        stream = bz2.BZ2Decompressor()
    else:
        raise ValueError(f"compression {compression!r} is not known")
    pieces: list[bytes] = []
    with suppress(zstandard.ZstdError, RuntimeError, OSError, EOFError, MemoryError):
        for at in range(0, len(data), _PIECE):
            pieces.append(stream.decompress(data[at : at + _PIECE]))
            if stream.eof:
                break
    return b"".join(pieces), bool(stream.eof)
