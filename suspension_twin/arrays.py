# SPDX-License-Identifier: Apache-2.0
"""The array type that the whole package computes with, interpolation of its columns, and runs of flags."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Floats", "interpolated", "runs"]

Floats = NDArray[np.float64]


def interpolated(at: Floats, t: Floats, values: Floats) -> Floats:
    """Values (n,) or columns (n, k) given at ``t`` (n,), linearly interpolated at ``at``."""
    if values.ndim == 1:
        return np.interp(at, t, values)
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of consecutive True flags (n,): start, end (exclusive)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
