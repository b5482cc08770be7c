# SPDX-License-Identifier: Apache-2.0
"""A road as the compiled kernels take it: plain tuples of arrays and numbers, SI units.

Plain, because numba's cache remembers the types of a kernel's arguments: a class among them, and a
cache left by another version of this package could no longer be read.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Grid", "Line", "held"]

from suspension_twin.arrays import Floats

#: The reference line: its points x and y (nu,); cos and sin of the heading before the start, then
#: after the end (4,); u of the first and the last point and the step between them; whether the line
#: is straight; whether it could be closed into a track.
Line = tuple[Floats, Floats, Floats, float, float, float, bool, bool]

#: The heights over the line: z (nu, nv) without a NaN; True (nu-1, nv-1) where a corner of the cell
#: had no data, or (0, 0) if there is none; v (nv,) and its step, 0 where it is uneven; height and
#: banking of the line (nu,); length of the smoothing zone and base height at the start, then at the
#: end (4,), a negative length for no zone; u of the first and the last cross section and their step.
Grid = tuple[Floats, NDArray[np.bool_], Floats, float, Floats, Floats, Floats, float, float, float]


def held(z: Floats) -> Floats:
    """Heights with the missing ones taken from the data of their cross section.

    Between data linearly, beyond them the last one; a cross section without data from its
    neighbours along the road.
    """
    held = np.array(z)
    columns = np.arange(z.shape[1])
    good = ~np.isnan(z)
    some = good.any(axis=1)
    for i in np.flatnonzero(some & ~good.all(axis=1)):
        held[i] = np.interp(columns, columns[good[i]], z[i, good[i]])
    if not some.all():
        rows = np.arange(z.shape[0])
        for j in columns:
            held[~some, j] = np.interp(rows[~some], rows[some], held[some, j])
    return held
