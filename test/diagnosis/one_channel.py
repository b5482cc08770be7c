# SPDX-License-Identifier: Apache-2.0
"""A bench of drives with one channel, for functions that need no vehicle."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

RATE, CHANNEL = 100.0, "vertical_acceleration"


def bench(lengths: list[int], values: np.ndarray, active: tuple[bool, ...] | None = None) -> Any:
    """A bench of drives of ``lengths`` samples end to end with one channel."""
    ends = np.cumsum([0, *lengths])
    segments = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    measured = SimpleNamespace(
        channels=(CHANNEL,),
        segments=segments,
        drives=list(range(len(lengths))),
        rate=RATE,
        independent=0.4,
        values=values,
    )
    problem = SimpleNamespace(measured=measured, channels=measured.channels)
    return SimpleNamespace(active=active or (True,) * len(lengths), problem=problem)
