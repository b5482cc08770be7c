# SPDX-License-Identifier: Apache-2.0
"""Which pose belongs to which sample: by stamp, whatever order the two topics arrive in."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

__all__ = ["Pairing", "PlanarRow", "Yielded"]

_NS = 1_000_000_000
#: A sample waits this long (in stamps) for a pose, and a pose is kept this long for samples.
_LIMIT = 2 * _NS


class PlanarRow(NamedTuple):
    """Planar motion of ``base_link`` at a stamp in ns: m, rad, m/s, rad/s; ``known`` False where the yaw
    is only a guess."""

    ns: int
    x: float
    y: float
    yaw: float
    speed: float
    lateral_speed: float
    yaw_rate: float
    known: bool


class Yielded(NamedTuple):
    """A sample with its pose: ``row.ns`` is its stamp, ``measured`` its value."""

    row: PlanarRow
    measured: float


class Pairing:
    """Poses and samples of the same stamps usually come at the same time. Where a pose is missing or
    the poses have stamps of their own, the sample gets what lies between its neighbours."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything that waits."""
        self.lost = 0
        self._rows: deque[PlanarRow] = deque()
        self._samples: deque[tuple[int, float]] = deque()
        self._last_sample = 0

    def pose(self, row: PlanarRow) -> list[Yielded]:
        """A pose has come; what can be paired now, in the order of time."""
        rows = self._rows
        if rows and row.ns <= rows[-1].ns:
            return []
        rows.append(row)
        while row.ns - rows[0].ns > _LIMIT:
            rows.popleft()
        return self._pair() if self._samples else []

    def sample(self, ns: int, value: float) -> list[Yielded]:
        """A sample has come; what can be paired now, in the order of time."""
        if ns <= self._last_sample:
            return []
        self._last_sample = ns
        self._samples.append((ns, value))
        if ns - self._samples[0][0] > _LIMIT:
            self._samples.popleft()
            self.lost += 1
        return self._pair() if self._rows else []

    def _pair(self) -> list[Yielded]:
        rows, samples, ready = self._rows, self._samples, []
        newest = rows[-1].ns
        while samples and samples[0][0] <= newest:
            ns, value = samples.popleft()
            if rows[-1].ns == ns:
                ready.append(Yielded(rows[-1], value))
                continue
            while len(rows) > 1 and rows[1].ns <= ns:
                rows.popleft()
            if rows[0].ns == ns:
                ready.append(Yielded(rows[0], value))
            elif rows[0].ns > ns:
                self.lost += 1  # from before the first pose
            else:
                ready.append(Yielded(_between(rows[0], rows[1], ns), value))
        return ready


def _between(a: PlanarRow, b: PlanarRow, ns: int) -> PlanarRow:
    share = (ns - a.ns) / (b.ns - a.ns)
    turn = math.remainder(b.yaw - a.yaw, 2.0 * math.pi)
    x, y, speed, lateral, rate = (
        p + share * (q - p)
        for p, q in (
            (a.x, b.x),
            (a.y, b.y),
            (a.speed, b.speed),
            (a.lateral_speed, b.lateral_speed),
            (a.yaw_rate, b.yaw_rate),
        )
    )
    return PlanarRow(ns, x, y, a.yaw + share * turn, speed, lateral, rate, a.known and b.known)
