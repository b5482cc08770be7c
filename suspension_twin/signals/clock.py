# SPDX-License-Identifier: Apache-2.0
"""Stamps as they come: out of order, repeated, jittered, missing, jumping back."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.stamps import JUMP_BACK, jumps_back
from suspension_twin.errors import InputError

__all__ = [
    "JUMP_BACK",
    "MAX_STAMP",
    "Cleaned",
    "LiveClock",
    "Stamp",
    "clean_stamps",
    "find_gaps",
    "nominal_rate",
]

#: s since the epoch that no clock shows; beyond it a stamp's fraction is lost, too.
MAX_STAMP = 1.0e11


@dataclass(frozen=True, eq=False)
class Cleaned:
    """Usable stamps of a recording, and the faults of the others.

    ``keep`` (n,) indices into the original in the order of time, ``stamps`` (n,) s strictly
    rising; counts of ``invalid`` (not finite or before 1), ``duplicates``, ``reordered`` samples
    and of samples in ``other_loops`` (dropped because the clock had been set back).
    """

    keep: NDArray[np.intp]
    stamps: Floats
    invalid: int
    duplicates: int
    reordered: int
    other_loops: int


def clean_stamps(t: Floats, usable: NDArray[np.bool_] | None = None) -> Cleaned:
    """Order ``t`` (n,), drop what repeats or is not ``usable``; of a recording whose clock jumps back
    by more than a second keep the longest stretch."""
    t = np.asarray(t, dtype=np.float64)
    good = np.abs(t) < MAX_STAMP
    if usable is not None:
        good &= usable
    index = np.flatnonzero(good)
    invalid = int(t.size - index.size)
    kept = t[index]
    other = 0
    if kept.size:
        starts = jumps_back(kept)
        if starts.size:
            bounds = np.concatenate([[0], starts, [kept.size]])
            longest = int(np.argmax(np.diff(bounds)))
            chosen = slice(int(bounds[longest]), int(bounds[longest + 1]))
            other = int(kept.size - (chosen.stop - chosen.start))
            index, kept = index[chosen], kept[chosen]
    reordered = int(np.count_nonzero(np.diff(kept) < 0))
    order = np.argsort(kept, kind="stable")
    index, kept = index[order], kept[order]
    fresh = np.ones(kept.size, dtype=np.bool_)
    fresh[1:] = np.diff(kept) > 0
    return Cleaned(
        keep=index[fresh],
        stamps=kept[fresh],
        invalid=invalid,
        duplicates=int(kept.size - np.count_nonzero(fresh)),
        reordered=reordered,
        other_loops=other,
    )


def nominal_rate(stamps: Floats) -> float:
    """Samples per second of strictly rising ``stamps`` (n,), gaps, jitter and coarse stamps aside.

    The mean of the intervals within half to one and a half of the median: exact for stamps
    rounded to milliseconds, where the median alone is not. Raises InputError for fewer than two.
    """
    dt = np.diff(stamps)
    dt = dt[dt > 0]
    if not dt.size:
        raise InputError("stamps", "fewer than two samples with different stamps: the rate is undefined")
    middle = float(np.median(dt))
    return 1.0 / float(np.mean(dt[(dt > 0.5 * middle) & (dt < 1.5 * middle)]))


def find_gaps(stamps: Floats, rate: float, samples: float = 3.5) -> Floats:
    """(k, 2) start and end in s of the intervals longer than ``samples`` nominal ones."""
    dt = np.diff(stamps)
    at = np.flatnonzero(dt > samples / rate)
    return np.column_stack([stamps[at], stamps[at + 1]]) if at.size else np.empty((0, 2))


class Stamp(enum.Enum):
    """Kinds of a live stamp, compared with those before it."""

    FIRST = "first"
    NEXT = "next"
    GAP = "gap"
    LATE = "late"
    DUPLICATE = "duplicate"
    JUMP_BACK = "jump back"
    INVALID = "invalid"


class LiveClock:
    """Judges stamps one by one and measures their rate.

    ``rate`` is None until ``warmup`` intervals were seen, then follows slowly. A gap is an interval
    longer than ``gap`` s and 3.5 nominal ones.
    """

    def __init__(self, warmup: int = 16, gap: float = 0.1) -> None:
        self._warmup = warmup
        self._gap = gap
        self.reset()

    def reset(self) -> None:
        """Start anew, as before the first stamp."""
        self.last = math.nan
        self.rate: float | None = None
        self._recent: list[float] = []
        self._period = math.nan
        self._odd = 0

    def classify(self, t: float) -> Stamp:
        """Judge ``t`` s and take it as the newest unless it is late, repeated or invalid."""
        if not abs(t) < MAX_STAMP:
            return Stamp.INVALID
        if math.isnan(self.last):
            self.last = t
            return Stamp.FIRST
        dt = t - self.last
        if dt <= 0.0:
            if dt == 0.0:
                return Stamp.DUPLICATE
            return Stamp.JUMP_BACK if dt < -JUMP_BACK else Stamp.LATE
        self.last = t
        if self.rate is None:
            if dt < max(self._gap, 0.25):
                self._measure(dt)
                return Stamp.NEXT
            return Stamp.GAP
        if dt > self._gap and dt > 3.5 * self._period:
            return Stamp.GAP
        self._follow(dt)
        return Stamp.NEXT

    def _measure(self, dt: float) -> None:
        self._recent.append(dt)
        if len(self._recent) >= self._warmup:
            self._period = 1.0 / nominal_rate(np.concatenate([[0.0], np.cumsum(self._recent)]))
            self.rate = 1.0 / self._period
            self._recent = []

    def _follow(self, dt: float) -> None:
        if 0.5 * self._period < dt < 1.5 * self._period:
            self._period += 0.002 * (dt - self._period)
            self.rate = 1.0 / self._period
            self._odd = max(0, self._odd - 1)
        else:
            # Many intervals that do not fit: the sensor was switched to another rate.
            self._odd += 2
            if self._odd > 100:
                self.rate = None
                self._odd = 0
