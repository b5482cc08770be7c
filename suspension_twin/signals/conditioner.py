# SPDX-License-Identifier: Apache-2.0
"""One linear path from jittered samples to a filtered uniform grid, for measured and simulated alike.

The difference of two signals means something only if both went the same way: the same
interpolation between the same stamps, the same filter, the same ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError
from suspension_twin.signals.clock import clean_stamps, find_gaps, nominal_rate
from suspension_twin.signals.filters import FilterSpec, filter_lanes, settling_time

__all__ = ["Conditioner"]


@compiled
def _weights(
    stamps: Floats, grid: Floats, index: NDArray[np.int64], weight: Floats
) -> None:  # pragma: no cover - compiled
    """Cubic Lagrange through the four stamps around each grid point.

    Linear at the ends and where the four are far from evenly spaced: there a cubic overshoots.
    """
    n = stamps.size
    period = (grid[-1] - grid[0]) / max(grid.size - 1, 1)
    j = 0
    for i in range(grid.size):
        t = grid[i]
        while j < n - 2 and stamps[j + 1] <= t:
            j += 1
        index[i] = min(max(j - 1, 0), max(n - 4, 0))
        for k in range(4):
            weight[i, k] = 0.0
        first = index[i]
        even = 0 < j < n - 2
        if even:
            for k in range(3):
                step = stamps[first + k + 1] - stamps[first + k]
                even = even and 0.4 * period < step < 2.2 * period
        if not even:
            u = (t - stamps[j]) / (stamps[j + 1] - stamps[j])
            weight[i, j - first] = 1.0 - u
            weight[i, j + 1 - first] = u
            continue
        for k in range(4):
            w = 1.0
            for m in range(4):
                if m != k:
                    w *= (t - stamps[first + m]) / (stamps[first + k] - stamps[first + m])
            weight[i, k] = w


@compiled
def _resample(x: Floats, index: NDArray[np.int64], weight: Floats) -> Floats:  # pragma: no cover - compiled
    m, lanes = index.size, x.shape[1]
    taps = min(4, x.shape[0])
    out = np.empty((m, lanes))
    for i in range(m):
        for k in range(lanes):
            out[i, k] = 0.0
        for tap in range(taps):
            w = weight[i, tap]
            if w != 0.0:
                row = index[i] + tap
                for k in range(lanes):
                    out[i, k] += w * x[row, k]
    return out


@dataclass(frozen=True, eq=False)
class Conditioner:
    """The filter of one recording, the same for measured and simulated signals: to a uniform grid, then the
    low-pass.

    Make it with :meth:`for_stamps`, use it with :meth:`apply`.

    Parameters
    ----------
    spec : FilterSpec
        The low-pass.
    zero_phase : bool
        Forward and backward, or causal.
    stamps : (n,) array
        s, strictly rising.
    keep : (n,) array of int
        Indices of the stamps in what was given.
    grid : (m,) array
        s, uniform.
    rate : float
        Hz of the grid.
    valid : (m,) array of bool
        False in gaps and while the filter settles at their edges and at both ends.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 3.0, 0.01)
    >>> conditioner = Conditioner.for_stamps(t, FilterSpec())
    >>> conditioner.apply(np.zeros((t.size, 2))).shape == (conditioner.grid.size, 2)
    True
    """

    spec: FilterSpec
    zero_phase: bool
    stamps: Floats
    keep: NDArray[np.intp]
    grid: Floats
    rate: float
    valid: NDArray[np.bool_]
    _taps: tuple[NDArray[np.int64], Floats]

    @classmethod
    def for_stamps(cls, t: ArrayLike, spec: FilterSpec, zero_phase: bool = True) -> Conditioner:
        """The path for samples at stamps ``t`` (s, any order, repeats and NaN allowed).

        Raises InputError for fewer than four samples or a cut-off too high for their rate.
        """
        cleaned = clean_stamps(np.asarray(t, dtype=np.float64))
        stamps = cleaned.stamps
        if stamps.size < 4:
            raise InputError("stamps", f"{stamps.size} usable samples are too few to filter")
        rate = nominal_rate(stamps)
        settle = settling_time(spec, rate)  # refuses an impossible cut-off before anything is built
        count = max(2, math.floor((stamps[-1] - stamps[0]) * rate + 1e-6) + 1)
        if count > 100 * stamps.size:
            raise InputError(
                "stamps", "span far more time than their rate explains: mixed clocks or stray stamps"
            )
        grid = stamps[0] + np.arange(count) / rate
        grid = np.minimum(grid, stamps[-1])
        index = np.empty(count, dtype=np.int64)
        weight = np.empty((count, 4))
        _weights(stamps, grid, index, weight)
        valid = np.ones(count, dtype=np.bool_)
        before = settle if zero_phase else 0.0
        for start, end in find_gaps(stamps, rate):
            valid[(grid > start - before) & (grid < end + settle)] = False
        valid[grid > stamps[-1] - before] = False
        valid[grid < stamps[0] + settle] = False
        return cls(spec, zero_phase, stamps, cleaned.keep, grid, rate, valid, (index, weight))

    def apply(self, x: ArrayLike) -> Floats:
        """(n, ...) samples at ``stamps`` to (m, ...) on ``grid``. Linear; every lane on its own."""
        values = np.asarray(x, dtype=np.float64)
        if values.ndim < 1 or len(values) != self.stamps.size:
            raise InputError(
                "signal", f"has shape {values.shape}, must have {self.stamps.size} samples first"
            )
        lanes = np.ascontiguousarray(values.reshape(len(values), -1))
        uniform = _resample(lanes, *self._taps)
        out = filter_lanes(self.spec, self.rate, uniform, zero_phase=self.zero_phase)
        return out.reshape(self.grid.size, *values.shape[1:])
