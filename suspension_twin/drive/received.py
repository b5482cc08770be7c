# SPDX-License-Identifier: Apache-2.0
"""Positions and velocities as receivers and phones give them: held, repeated, incomplete."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np
import pymap3d
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import FixData, VelocityData

__all__ = [
    "LivePlaces",
    "held_places",
    "held_velocities",
    "one_per_epoch",
    "velocities_from_fixes",
    "with_vertical",
]

Bools: TypeAlias = NDArray[np.bool_]

#: A receiver computes at least one position a second; one that computes fewer is followed at this interval in s.
_SLOWEST: Final = 1.0
#: A vehicle that covered ground at this speed in m/s did not stand at the place that was repeated meanwhile. At a lower
#: one, a receiver that writes five decimals of a degree (1.1 m) at 10 Hz repeats places of its own.
_MOVING: Final = 5.0
#: Parts of the interval between two computed positions. A position that is repeated after the first, or later, is a
#: computed one of a vehicle that stands, given at the receiver's own pace. Of those given at another pace one is taken
#: for computed that comes when the next one is overdue by the second (tolerances, by hand).
_OWN_PACE, _OVERDUE = 2 / 3, 0.5
_METRES: Final = math.radians(6_371_000.0)  # m of a degree on the mean sphere
#: Intervals between positions that a live stream is judged by, and how many are needed.
_INTERVALS, _FEWEST = 25, 2


def held_places(fix: FixData) -> Bools:
    """Which fixes (n,) repeat the place of the one before them although the receiver had not computed a new one.

    The interval between two computed positions is the median of those between different ones, a second where there are
    too few. Places that are repeated while the vehicle moves are held. A vehicle that stands has one place for long,
    too, of which one in each interval stays: the stream has no hole there.
    """
    step, places = np.diff(fix.t), np.column_stack([fix.latitude, fix.longitude, fix.status])
    same = np.concatenate([[False], (np.diff(places, axis=0) == 0).all(axis=1)])[: len(fix)]
    first = np.flatnonzero(~same)
    if first.size == len(fix):
        return np.zeros(len(fix), dtype=np.bool_)
    lasted = np.diff(fix.t[first])
    interval = min(float(np.median(lasted)), _SLOWEST) if lasted.size >= _FEWEST else _SLOWEST
    east = np.diff(fix.longitude[first]) * np.cos(np.radians(fix.latitude[first[:-1]]))
    moved = _METRES * np.hypot(east, np.diff(fix.latitude[first])) > _MOVING * lasted
    run = np.cumsum(~same) - 1
    own_pace = np.concatenate([[True], step >= _OWN_PACE * interval])
    number = np.maximum(np.floor((fix.t - fix.t[first][run]) / interval - _OVERDUE), 0.0)
    overdue = np.concatenate([[True], np.diff(number) > 0])
    return np.asarray(same & (np.append(moved, False)[run] | ~(own_pace | overdue)))


def held_velocities(velocity: VelocityData, stamps: Floats) -> Bools:
    """Which velocities (n,) repeat the one before them at one of the ``stamps`` (k,) s of held places."""
    same = np.concatenate([[False], (np.diff(velocity.enu, axis=0) == 0).all(axis=1)])[: len(velocity)]
    return np.asarray(same & np.isin(velocity.t, stamps))


class LivePlaces:
    """Tells held places apart as they come, by the same rule, but for what only later places show."""

    def __init__(self) -> None:
        self._place: tuple[float, ...] = ()
        self._t = self._taken = self._changed = -math.inf
        self._lasted: deque[float] = deque(maxlen=_INTERVALS)

    def repeats(self, t: float, place: tuple[float, ...]) -> bool:
        """Whether the next fix is held; ``place`` is all that tells it from another."""
        held = False
        if place != self._place:
            if self._place:
                self._lasted.append(t - self._changed)
            self._place, self._changed = place, t
        elif len(self._lasted) >= _FEWEST:
            interval = min(float(np.median(self._lasted)), _SLOWEST)
            own_pace = t - self._t >= _OWN_PACE * interval
            held = not own_pace and t - self._taken < (1.0 + _OVERDUE) * interval
        if not held:
            self._taken = t
        self._t = t
        return held

    def held(self, fix: FixData) -> Bools:
        """Which of the next fixes (n,) are held, or have the stamp of the one before them."""
        rows = zip(
            fix.t.tolist(), fix.latitude.tolist(), fix.longitude.tolist(), fix.status.tolist(), strict=True
        )
        return np.array([t == self._t or self.repeats(t, tuple(place)) for t, *place in rows], dtype=np.bool_)


def one_per_epoch(fix: FixData) -> Bools:
    """Which fixes (n,) to keep of those that follow one another with one stamp: the first of the most complete ones."""
    epoch = np.cumsum(np.diff(fix.t, prepend=-np.inf) != 0)
    known = np.isfinite(np.column_stack([fix.altitude, fix.sigma])).sum(axis=1) + 8 * (fix.status >= 0)
    order = np.lexsort((-known, epoch))
    kept = np.zeros(len(fix), dtype=np.bool_)
    kept[order[np.diff(epoch[order], prepend=0) > 0]] = True
    return kept


def with_vertical(velocity: VelocityData) -> tuple[VelocityData, int]:
    """Velocities with 0 m/s for a vertical part that is not known, and the number of those."""
    unknown = np.isfinite(velocity.enu[:, :2]).all(axis=1) & ~np.isfinite(velocity.enu[:, 2])
    enu = np.where(unknown[:, None] & [False, False, True], 0.0, velocity.enu)
    return (replace(velocity, enu=enu) if unknown.any() else velocity), int(unknown.sum())


def velocities_from_fixes(fix: FixData) -> VelocityData:
    """Slopes of parabolas through five neighbouring positions each (three where there are no more).

    A central difference of the same noise would need the same five fixes and lag at the ends. Fixes
    beyond a gap of five periods belong to another segment; segments under three fixes give none.
    """
    good = (fix.status >= 0) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & np.isfinite(fix.t)
    t, fresh = np.unique(fix.t[good], return_index=True)
    if t.size < 3:
        return VelocityData.empty()
    latitude, longitude = fix.latitude[good][fresh], fix.longitude[good][fresh]
    altitude = np.nan_to_num(fix.altitude[good][fresh])
    origin = (latitude[0], longitude[0], altitude[0])
    place = np.stack(pymap3d.geodetic2enu(latitude, longitude, altitude, *origin), axis=1)
    breaks = np.flatnonzero(np.diff(t) > 5 * np.median(np.diff(t))) + 1
    segments = [slice(*ends) for ends in zip([0, *breaks], [*breaks, t.size], strict=True)]
    segments = [s for s in segments if s.stop - s.start >= 3]
    if not segments:
        return VelocityData.empty()
    slopes = [_slopes(t[s], place[s]) for s in segments]
    return VelocityData(np.concatenate([t[s] for s in segments]), np.concatenate(slopes))


def _slopes(t: Floats, place: Floats) -> Floats:
    """(n, 3) derivative at each stamp of the parabola fitted to its window."""
    n, size = t.size, min(5, t.size)
    start = np.clip(np.arange(n) - size // 2, 0, n - size)
    window = start[:, None] + np.arange(size)
    x = t[window] - t[:, None]
    # least squares a + b x + c x², of which b is the derivative at the stamp itself
    design = np.stack([np.ones_like(x), x, x * x], axis=2)
    return np.asarray((np.linalg.pinv(design) @ place[window])[:, 1, :])
