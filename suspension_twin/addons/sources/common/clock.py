# SPDX-License-Identifier: Apache-2.0
"""Clocks of devices against the host's, estimated while samples arrive.

A sample with the stamp t that arrives at the host's time a has the delay d = a - t, which is the offset of the
two clocks plus what the sample spent on its way. The way can be long but not shorter than some minimum, so the
offset is the lower envelope of the delays: the line below all of them that comes nearest to them. It is the edge of
their lower convex hull over their centroid (Moon, Skelly, Towsley, "Estimation and removal of clock skew from
network delay measurements", INFOCOM 1999). The minimum itself cannot be told from an offset.
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["ArrivalClock", "host_time"]

_EPOCH: Final = time.time() - time.monotonic()

#: s of one minimum, and how many minima are kept (two minutes).
_BIN, _BINS = 0.5, 240
#: s of data before a drift is estimated, and before it is shown.
_DRIFT_AFTER, _DRIFT_SHOWN_AFTER = 20.0, 60.0
#: Quartz is off by some 20 ppm, a bad one by 100; a clock beyond this bound is no live clock.
_MAX_DRIFT, _NOT_LIVE = 500e-6, 0.05
#: Smallest step of a clock in s that is looked for, and back in time at once (less is disorder).
_STEP, _STEP_BACK = 0.15, 1.0
#: Bins for which a new level of the delays must hold to be a step, and their spread in s; and the share of the step by
#: which stamps must have been repeated then: a clock that is set back shows a time twice, a network that has become
#: slower does not.
_LEVEL_BINS, _LEVEL_SPREAD, _REPEATED = 6, 0.05, 0.5


def host_time() -> float:
    """UTC of this machine in s when the program started, and steadily from there: its clock may step, this one
    does not."""
    return _EPOCH + time.monotonic()


class Few:
    """Lets ``most`` texts of a kind pass in ``seconds``, of which none is another's repetition.

    Whoever sends something can make its text a new one each time.
    """

    def __init__(self, most: int = 3, seconds: float = 10.0, kinds: int = 200) -> None:
        self._most, self._seconds, self._kinds = most, seconds, kinds
        self._passed: dict[str, list[tuple[str, float]]] = {}

    def allows(self, kind: str, text: str, *, again: bool = False) -> bool:
        """Whether ``text`` passes now; ``again``: as a repetition, too."""
        now = host_time()
        recent = [(old, at) for old, at in self._passed.get(kind, ()) if now - at < self._seconds]
        if len(recent) >= self._most or (not again and text in [old for old, _ in recent]):
            return False
        if len(self._passed) >= self._kinds:
            self._passed.clear()
        self._passed[kind] = [*recent, (text, now)]
        return True


class ArrivalClock:
    """Offset, drift and steps of one device's clock.

    ``epoch`` tells whether its stamps are UTC. ``offset`` s is what the host's clock shows more than the device's
    (and the shortest way of a sample), ``drift`` s/s how fast that grows, both NaN while not known; ``jitter`` s the
    median delay beyond the shortest. ``shift`` s is what steps of the clock have to be made up by: it is to be added
    to stamps.
    """

    def __init__(self, epoch: bool = True) -> None:
        self.epoch = epoch
        self.shift = 0.0
        self.steps = 0
        self.last_step = 0.0
        self.offset = math.nan
        self.drift = math.nan
        self.jitter = math.nan
        self.live = False
        self._last = math.nan
        self._period = math.nan
        self._origin = math.nan
        self._level = self._slope = math.nan  # of the envelope, at the origin
        self._unsteady = 0.0  # s by which minima lie above the envelope: nine in ten by less
        self._bins: deque[tuple[float, float, float, float]] = deque(maxlen=_BINS)
        self._bin_began = -math.inf
        self._bin = (0.0, math.inf)
        self._behind = 0.0  # s that stamps of this bin lay behind earlier ones at most
        self._delays: list[float] = []

    def push(self, t: Floats, arrival: float) -> Floats:
        """Stamps (n,) in s of samples that arrived together, in rising order; returns them without the clock's steps.

        ``arrival`` is :func:`host_time` when they came.
        """
        if not t.size:
            return t
        shifts = self._find_step(t, arrival)
        steady = t + shifts
        newest = float(steady[-1])
        if t.size > 1:
            self._period = float(t[-1] - t[0]) / (t.size - 1)
        elif t[-1] > self._last:
            interval = float(t[-1]) - self._last
            self._period = interval if math.isnan(self._period) else min(interval, 1.5 * self._period)
        if not self._stepped and t[0] < self._last:
            self._behind = max(self._behind, self._last - float(t[0]))
        if math.isnan(self._last) or t[-1] > self._last or self._stepped:
            self._last = float(t[-1])
        self._collect(newest, arrival - newest, arrival)
        return steady

    def at(self, t: float) -> float:
        """The envelope of the delays in s at a stamp ``t`` s (without steps)."""
        return self._level + self._slope * (t - self._origin)

    # Steps

    _stepped = False

    def _find_step(self, t: Floats, arrival: float) -> Floats | float:
        """Correction of each stamp; remembers a step that lies before or among them."""
        self._stepped = False
        if not self.live or math.isnan(self._last):
            return self.shift
        early = self.at(float(t[-1]) + self.shift) - (arrival - float(t[-1]) - self.shift)
        period = 0.0 if math.isnan(self._period) else self._period
        # A way that was slow and is free after a pause looks like a clock that is ahead. Its delays vary before.
        if early > _STEP + self._unsteady:
            gaps = np.diff(t, prepend=self._last)
            at = int(np.argmax(gaps))
            if gaps[at] > _STEP + 5.0 * period:
                # ahead: less time has passed on the host than between the two stamps
                step = float(gaps[at]) - period
                return self._take_step(step if step - early < 0.5 else early, at, t.size)
        back = float(t[0]) - self._last - period
        if back < -_STEP_BACK and early < 0.5 * back:
            return self._take_step(back, 0, t.size)
        return self.shift

    def _take_step(self, step: float, at: int, size: int) -> Floats:
        before = self.shift
        self.shift -= step
        self.steps += 1
        self.last_step = step
        self._stepped = True
        return np.where(np.arange(size) < at, before, self.shift)

    # The envelope

    def _collect(self, t: float, delay: float, arrival: float) -> None:
        if math.isnan(self._origin):
            self._origin, self._level, self._slope = t, delay, 0.0
        if arrival - self._bin_began >= _BIN:
            if self._bin[1] < math.inf:
                self._bins.append((*self._bin, float(np.median(self._delays)), self._behind))
                self._fit()
            self._bin_began, self._bin, self._delays, self._behind = arrival, (t, delay), [], 0.0
        elif delay < self._bin[1]:
            self._bin = (t, delay)
        if len(self._delays) < 100:
            self._delays.append(delay)
        if delay < self.at(t):  # never above what was seen
            self._level += delay - self.at(t)
        self.offset = self.at(t)

    def _fit(self) -> None:
        t, delay, middle, _ = np.array(self._bins).T
        x = t - self._origin
        span = float(x[-1] - x[0])
        if span < 2.0 and x.size < 5:
            return
        third = max(x.size // 3, 1)
        first, last = int(np.argmin(delay[:third])), x.size - third + int(np.argmin(delay[-third:]))
        trend = (delay[last] - delay[first]) / max(float(x[last] - x[first]), 1e-3)
        self.live = abs(trend) < _NOT_LIVE
        if not self.live:
            self._level, self._slope = float(delay[-1]), 0.0
            self.drift = math.nan
            return
        if x.size >= 3 * _LEVEL_BINS and self._new_level(x, delay):
            return
        self._slope = _envelope_slope(x, delay) if span >= _DRIFT_AFTER else 0.0
        self._level = float(np.min(delay - self._slope * x))
        self.drift = self._slope if span >= _DRIFT_SHOWN_AFTER else math.nan
        envelope = self._level + self._slope * x
        self.jitter = max(float(np.median(middle - envelope)), 0.0)
        self._unsteady = float(np.quantile(delay - envelope, 0.9))

    def _new_level(self, x: Floats, delay: Floats) -> bool:
        """A clock that was set back by less than disorder makes up shows as delays that are longer for good, from
        stamps on that lie behind earlier ones."""
        recent = delay[-_LEVEL_BINS:] - (self._level + self._slope * x[-_LEVEL_BINS:])
        if recent.min() < _STEP or np.ptp(recent) > _LEVEL_SPREAD:
            return False
        step = -float(recent.min())
        if max(behind for *_, behind in list(self._bins)[-_LEVEL_BINS - 1 :]) < _REPEATED * -step:
            return False
        self.shift -= step
        self.steps += 1
        self.last_step = step
        # The stamps of these bins, had they been shifted then.
        bins = list(self._bins)
        moved = [(t - step, d + step, m + step, 0.0) for t, d, m, _ in bins[-_LEVEL_BINS:]]
        self._bins = deque([*bins[:-_LEVEL_BINS], *moved], maxlen=_BINS)
        return True


def _envelope_slope(x: Floats, y: Floats) -> float:
    """Slope of the edge of the lower convex hull of the points (n,) that lies over their centroid."""
    hull: list[tuple[float, float]] = []
    order = np.argsort(x, kind="stable")
    for px, py in zip(x[order].tolist(), y[order].tolist(), strict=True):
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2:]
            if (by - ay) * (px - ax) < (py - ay) * (bx - ax):
                break
            hull.pop()
        hull.append((px, py))
    centre = float(np.mean(x))
    for (ax, ay), (bx, by) in zip(hull, hull[1:], strict=False):
        if ax <= centre <= bx and bx > ax:
            return max(-_MAX_DRIFT, min(_MAX_DRIFT, (by - ay) / (bx - ax)))
    return 0.0
