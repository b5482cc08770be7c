# SPDX-License-Identifier: Apache-2.0
"""How late a receiver is beyond its stamps: its speeds beside what the accelerometer integrates to."""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["LATE", "ReceiverLateness"]

#: s, standard deviation of a phone's lateness where nothing is known of it (prior: 0.1 to 0.5 s of filters and buses).
LATE = 0.4
#: s: latenesses that are weighed, twice that standard deviation and beyond.
_TRIED = np.arange(0.0, 1.0001, 0.05)
#: s between two speeds whose difference is compared, at least and at most: shorter ones are noise, over longer ones
#: tilt and bias add up.
_APART = (0.9, 2.5)
#: s of the integral that are kept.
_KEPT = _APART[1] + 2.0
#: s after which an old comparison counts half as much: a receiver's lateness changes with its mode, if at all.
_MEMORY = 120.0
#: m/s, least standard deviation of the difference of two speeds (Doppler of a good receiver).
_LEAST = 0.05
#: s, standard deviation of those that are tried, before any speed.
_IGNORANT = float(np.sqrt(np.cov(_TRIED, aweights=np.exp(-0.5 * (_TRIED / LATE) ** 2), ddof=0)))


class ReceiverLateness:
    """Weighs latenesses by how well speeds fit to the integral of the forward specific force so much earlier.

    ``seconds`` is the lateness that is sure, 0 at first, and ``spread`` s the standard deviation about it.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.seconds, self.spread = 0.0, LATE
        self._t: list[float] = []
        self._gained: list[float] = []
        self._before = (math.nan, 0.0)
        self._count = 0.0
        self._sum, self._squares = np.zeros((2, _TRIED.size))

    def feel(self, t: float, ahead: float) -> None:
        """One sample of the forward specific force at ``t`` s in m/s²."""
        last = self._t[-1] if self._t else t
        dt = t - last
        if not 0.0 <= dt < _APART[0]:
            self._t, self._gained, dt = [], [], 0.0
        if self._t and t - self._t[0] > 2.0 * _KEPT:
            kept = bisect_left(self._t, t - _KEPT)
            del self._t[:kept], self._gained[:kept]
        self._t.append(t)
        self._gained.append((self._gained[-1] if self._gained else 0.0) + ahead * dt)

    def velocity(self, t: float, speed: float) -> None:
        """One speed of the receiver, stamped ``t`` s, in m/s."""
        before, slower = self._before
        dt = t - before
        if dt < _APART[0] and dt > 0.0:
            return
        self._before = t, speed
        if not _APART[0] <= dt <= _APART[1] or not self._t or self._t[0] > before - _TRIED[-1]:
            return
        then, now = (np.interp(stamp - _TRIED, self._t, self._gained) for stamp in (before, t))
        self._weigh(speed - slower - (now - then), 0.5 ** (dt / _MEMORY))

    def _weigh(self, off: Floats, kept: float) -> None:
        """One more difference, ``off`` m/s for each lateness; a constant one is a slope or a bias."""
        self._count = kept * self._count + 1.0
        self._sum = kept * self._sum + off
        self._squares = kept * self._squares + off**2
        left = self._squares - self._sum**2 / self._count
        variance = max(float(left.min()) / max(self._count - 1.0, 1.0), 2.0 * _LEAST**2)
        weights = np.exp(-0.5 * (left - left.min()) / variance - 0.5 * (_TRIED / LATE) ** 2)
        weights /= weights.sum()
        mean = float(weights @ _TRIED)
        spread = math.sqrt(float(weights @ (_TRIED - mean) ** 2))
        # shrunk to none as long as the speeds say little
        self.seconds = mean * max(0.0, 1.0 - (spread / _IGNORANT) ** 2)
        self.spread = math.hypot(spread, mean - self.seconds)
