# SPDX-License-Identifier: Apache-2.0
"""How much a compressed file may unpack to: 64 MiB, or 32 times its size, or what the user allows.

Recordings of sensors shrink to a tenth at best. What unpacks to thousands of times its size is made to fill a memory,
and is refused while it unpacks, not after.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, final

from suspension_twin.errors import InputError

__all__ = ["VARIABLE", "Budget", "TooLarge"]

#: The environment variable that raises the limit, in MiB.
VARIABLE: Final = "SUSPENSION_TWIN_UNPACKED_MIB"

_FLOOR: Final = 64 << 20
_RATIO: Final = 32


class TooLarge(InputError):
    """A file unpacks to more than it may."""


@final
class Budget:
    """Bytes that ``source`` of ``size`` bytes on disk may take in memory; each part read is taken from it.

    Raises InputError if the environment variable is no number of MiB.
    """

    def __init__(self, source: str | Path, size: int) -> None:
        self.source = source
        given = os.environ.get(VARIABLE, "")
        allowed = max(_FLOOR, _RATIO * size)
        if given:
            if not (given.isascii() and given.isdigit()):
                raise InputError(VARIABLE, f"must be a number of MiB, is {given[:40]!r}")
            allowed = max(int(given) << 20, 0)
        self.allowed = self.left = allowed

    def take(self, count: int) -> None:
        """``count`` bytes more; raises TooLarge where they are too many."""
        self.left -= count
        if self.left < 0:
            raise TooLarge(
                self.source,
                f"unpacks to more than {self.allowed >> 20} MiB: if that is right, {VARIABLE}="
                f"{2 * max(self.allowed >> 20, 1)} in the environment allows more",
            )
