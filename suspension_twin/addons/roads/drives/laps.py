# SPDX-License-Identifier: Apache-2.0
"""A drive that goes on, cut into passes: one ends where the vehicle comes back to where it was in it.

Within a pass no place is driven over twice in the same direction, so that its path can be the line of
a road.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["Laps", "Span"]

#: m of path between two points that are remembered.
_EVERY = 1.0
#: m of path after which a place near one of the path counts as come back to.
_AWAY = 50.0
#: m within which a place is the same, at least; a receiver's own uncertainty widens it so many times.
_SAME, _SIGMAS = 4.0, 2.0
_ALIKE = math.radians(45.0)  # between two directions that are the same
_MOVING = 1.0  # m/s
#: m after which a pass ends in any case: what is estimated from it is to come in time.
_LONGEST = 5000.0
#: m and s of motion below which there is nothing to learn from.
_SHORTEST, _BRIEFEST = 20.0, 8.0


class Span(NamedTuple):
    """A pass: ``start`` and ``end`` s, ``length`` m."""

    start: float
    end: float
    length: float


class Laps:
    """Finds the passes of a path as it grows.

    Examples
    --------
    >>> laps = Laps()
    >>> circle = [(t, 20.0 * math.cos(0.25 * t), 20.0 * math.sin(0.25 * t), 0.25 * t + math.pi / 2)
    ...           for t in np.arange(0.0, 30.0, 0.1)]
    >>> [round(span.length) for row in circle if (span := laps.push(*row, speed=5.0))]
    [122]
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin the next pass here."""
        self._points = np.empty((0, 4))  # x, y, yaw, m of path
        self._count = 0
        self._start = self._end = math.nan
        self._moved = 0.0
        self._last: tuple[float, float, float] | None = None
        self.length = 0.0

    @property
    def worth(self) -> bool:
        """Whether the present pass is long enough to learn from."""
        return self.length >= _SHORTEST and self._moved >= _BRIEFEST

    def push(self, t: float, x: float, y: float, yaw: float, speed: float, sigma: float = 0.0) -> Span | None:
        """Go on to ``x``, ``y`` m at ``t`` s, with the receiver's standard deviation ``sigma`` m; the pass that ends
        here, or None."""
        before, self._last = self._last, (t, x, y)
        if speed < _MOVING or before is None:
            return None
        if math.isnan(self._start):
            self._start = t
        self._end = t
        self._moved += t - before[0]
        self.length += math.hypot(x - before[1], y - before[2])
        if self._count and self.length - self._points[self._count - 1, 3] < _EVERY:
            return None
        if self.length > _LONGEST or self._returned(x, y, yaw, max(_SAME, _SIGMAS * sigma)):
            return self.close()
        if self._count == self._points.shape[0]:
            self._points = np.concatenate([self._points, np.zeros((max(256, self._count), 4))])
        self._points[self._count] = x, y, yaw, self.length
        self._count += 1
        return None

    def close(self) -> Span | None:
        """End the present pass; None where it is too short."""
        span = Span(self._start, self._end, self.length) if self.worth else None
        self.restart()
        return span

    def _returned(self, x: float, y: float, yaw: float, reach: float) -> bool:
        earlier: Floats = self._points[: self._count]
        earlier = earlier[self.length - earlier[:, 3] > _AWAY]
        near = earlier[np.hypot(earlier[:, 0] - x, earlier[:, 1] - y) < reach]
        return bool((np.cos(near[:, 2] - yaw) > math.cos(_ALIKE)).any())
