# SPDX-License-Identifier: Apache-2.0
"""The array type that the whole package computes with, and runs of flags."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Floats", "runs"]

Floats = NDArray[np.float64]


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of consecutive True flags (n,): start, end (exclusive)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
