# SPDX-License-Identifier: Apache-2.0
"""Positions and velocities as receivers and phones give them: held, interpolated, repeated, incomplete."""

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
    "interpolated_places",
    "one_per_epoch",
    "velocities_from_fixes",
    "velocity_fault",
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


#: s between positions of usual receivers (1 to 10 Hz, by their data sheets), and how many more have to be written for
#: them to be looked for (tolerance, by hand).
_RECEIVERS, _WRITTEN = (1.0, 0.5, 0.2, 0.1), 4
#: Which of the positions that may be computed ones are looked at: those where the velocity changes most, so many at
#: least, where a curve leaves its chord by so many m (tolerances, by hand). Of that, positions between computed ones
#: that are not interpolated leave it by 0.9 at least (24 s each of bundled and public drives), and in noise by more.
_MOST, _LEAST, _BENT, _STRAIGHT = 1 / 3, 8, 1e-3, 0.5
#: s between looks at a live stream, and how many positions they go back (40 s at 100 Hz; tolerances, by hand).
_LOOK_EVERY, _LOOK_BACK = 5.0, 4000

#: s of driving over which ways are compared, and between velocities beyond which nothing is known of a way
#: (tolerances, by hand: a phone has a fix a second).
_STRETCH, _HOLE = 10.0, 2.5
#: Ways that are needed, their least rms in m and in standard deviations of a position; that of a phone where it is not
#: known, in m (tolerances, by hand).
_WAYS, _FAR, _CLEAR, _ROUGH = 10, 10.0, 7.0, 3.0
#: What ways of one vehicle have at least: correlation, and by how much it exceeds that with east and north exchanged
#: (tolerances, by hand); the ratio of their lengths and the angle in rad between them at most.
_ALIKE, _EXCHANGED, _RATIO, _ANGLE = 0.7, 0.15, 1.3, 0.5
#: Share of the ways below which velocities say of none (tolerance, by hand).
_STILL = 0.05
#: m/s in a unit of speed, by exact definitions, and how far a ratio may be from it (tolerance, by hand).
_SPEEDS: Final = {"km/h": 3.6, "knots": 3600.0 / 1852.0, "mph": 3600.0 / 1609.344, "ft/s": 1.0 / 0.3048}
_UNIT: Final = 1.08


def velocity_fault(fix: FixData, velocity: VelocityData) -> str:
    """Fault of the velocities by the ways between the positions, in words: their unit or direction. Empty where they
    agree, and where too little is known."""
    good = fix.status >= 0
    t, order = np.unique(fix.t[good], return_index=True)
    own, first = np.unique(velocity.t, return_index=True)
    if t.size < _WAYS or own.size < _WAYS:
        return ""
    place = _plane(fix.latitude[good][order], fix.longitude[good][order])
    motion = velocity.enu[first, 0] + 1j * velocity.enu[first, 1]
    way = np.concatenate([[0.0], np.cumsum(0.5 * (motion[1:] + motion[:-1]) * np.diff(own))])
    holes = np.searchsorted(own[1:][np.diff(own) > _HOLE], t)
    end = np.searchsorted(t, t + _STRETCH)
    begin = np.flatnonzero((end < t.size) & (t >= own[0]))
    end = end[begin]
    whole = (t[end] <= own[-1]) & (t[end] - t[begin] < 1.5 * _STRETCH) & (holes[begin] == holes[end])
    begin, end = begin[whole], end[whole]
    travelled = np.interp(t, own, way.real) + 1j * np.interp(t, own, way.imag)
    seen, said = place[end] - place[begin], travelled[end] - travelled[begin]
    sigma = fix.sigma[np.isfinite(fix.sigma[:, 0]), 0]
    clear = max(_FAR, _CLEAR * (float(np.median(sigma)) if sigma.size else _ROUGH))
    if begin.size < _WAYS or _size(seen) < clear:
        return ""
    if _size(said) < _STILL * _size(seen):
        return "the velocities say that the vehicle stands, and its positions move"
    plain, exchanged = (abs(_correlation(seen, one)) for one in (said, 1j * said.conj()))
    if exchanged > max(_ALIKE, plain + _EXCHANGED):
        return "positions and velocities mirror each other: east and north, or latitude and longitude, are exchanged"
    if plain < _ALIKE:
        return "the velocities are not those of the positions: what they say adds up to other ways"
    turn = float(np.angle(np.vdot(said, seen)))
    if abs(turn) > _ANGLE:
        return f"the velocities point {abs(math.degrees(turn)):.0f}° beside the ways between the positions"
    ratio = abs(complex(np.vdot(said, said) / np.vdot(said, seen)))
    if 1.0 / _RATIO < ratio < _RATIO:
        return ""
    unit = next((u for u, k in _SPEEDS.items() if 1.0 / _UNIT < ratio / k < _UNIT), "")
    text = f"the velocities are {ratio:.2f} times as fast as the positions move"
    return f"{text}: they come in {unit}, not in m/s" if unit else f"{text}: check their unit"


def _plane(latitude: Floats, longitude: Floats) -> NDArray[np.complex128]:
    """Places (n,) in m from the first one, east + 1j north."""
    east = np.unwrap(longitude, period=360.0) - longitude[0]
    return np.asarray(_METRES * (east * np.cos(np.radians(latitude[0])) + 1j * (latitude - latitude[0])))


def _size(ways: NDArray[np.complex128]) -> float:
    return float(np.sqrt(np.mean(np.abs(ways) ** 2)))


def _correlation(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> complex:
    return complex(np.vdot(b, a) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))


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


def interpolated_places(fix: FixData) -> Bools:
    """Which fixes (n,) lie on straight lines between positions that the receiver computed.

    Where the velocity changes by v from one interval of T s to the next, a vehicle leaves the chord of its way by
    v T / 8; interpolated positions do not. At constant velocity nothing tells them apart, and nothing depends on it.
    """
    between = np.zeros(len(fix), dtype=np.bool_)
    good = np.flatnonzero((fix.status >= 0) & np.isfinite(fix.latitude + fix.longitude))
    t, order = np.unique(fix.t[good], return_index=True)
    if t.size < _WRITTEN * _LEAST / _MOST:
        return between
    good, step = good[order], float(np.median(np.diff(t)))
    place = _plane(fix.latitude[good], fix.longitude[good])
    for interval in _RECEIVERS:
        if interval < (_WRITTEN - 0.5) * step or t[-1] - t[0] > interval * t.size:
            break
        begin = t[0] - 0.5 * step + interval * np.arange((t[-1] - t[0]) // interval + 1.0)
        offsets = np.arange(0.0, interval, max(step, 0.01 * interval))
        choices = [np.unique(np.searchsorted(t[:-1], begin + offset)) for offset in offsets]
        bends = [_bend_between(t, place, c, interval) for c in choices]
        best = int(np.argmin(bends))
        if bends[best] < _STRAIGHT:
            between[good] = True
            between[good[choices[best]]] = False
            break
    return between


def _bend_between(
    t: Floats, place: NDArray[np.complex128], knots: NDArray[np.intp], interval: float
) -> float:
    """How far the places between the knots (k,), indices of those that may be computed, leave their chords, in parts of
    what they would on a curve; infinite where that is too little."""
    first, last = knots[:-1], knots[1:]
    whole = np.abs(t[last] - t[first] - interval) < 0.25 * interval
    whole = whole[1:] & whole[:-1]
    if whole.sum() < _LEAST:
        return math.inf
    speed = (place[last] - place[first]) / (t[last] - t[first])
    inner = first + ((last - first) * np.array([[1], [2], [3]])) // 4
    chord = place[first] + speed * (t[inner] - t[first])
    left = np.abs(place[inner] - chord).max(axis=0)
    left, curve = np.maximum(left[1:], left[:-1])[whole], np.abs(np.diff(speed))[whole] * interval / 8.0
    most = np.argsort(curve)[-max(_LEAST, int(_MOST * curve.size)) :]
    if np.median(curve[most]) < _BENT:
        return math.inf
    return float(np.median(left[most]) / np.median(curve[most]))


def held_velocities(velocity: VelocityData, stamps: Floats) -> Bools:
    """Which velocities (n,) repeat the one before them at one of the ``stamps`` (k,) s of held places."""
    same = np.concatenate([[False], (np.diff(velocity.enu, axis=0) == 0).all(axis=1)])[: len(velocity)]
    return np.asarray(same & np.isin(velocity.t, stamps))


class LivePlaces:
    """Tells held and interpolated places apart as they come, by the same rules, but for what only later ones show."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, ...]] = deque(maxlen=_LOOK_BACK)
        self._looked = self._computed = -math.inf
        self._interval = 0.0
        self._place: tuple[float, ...] = ()
        self._t = self._taken = self._changed = -math.inf
        self._lasted: deque[float] = deque(maxlen=_INTERVALS)

    def repeats(self, t: float, place: tuple[float, ...]) -> bool:
        """Whether the next fix is held or interpolated; ``place``: latitude, longitude, status."""
        held = False
        if abs(t - self._t) > _LOOK_EVERY:  # it may go on as another
            self._interval, self._looked = 0.0, t
            self._recent.clear()
        if not self._interval:
            self._recent.append((t, *place))
            if t - self._looked > _LOOK_EVERY:
                self._looked = t
                self._look()
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
            if self._interval:
                ends = t - self._computed + 0.5 * (t - self._t) * np.array([-1.0, 1.0])
                held = not np.diff(ends // self._interval)
        self._t = t
        return bool(held)

    def _look(self) -> None:
        """Find the interval and the time of a computed place."""
        t, latitude, longitude, status = np.array(self._recent).T
        none = np.zeros((t.size, 3))
        fix = FixData(t, latitude, longitude, none[:, 0], status, none)
        fix = fix.select(~held_places(fix))
        between = interpolated_places(fix)
        if between.any():
            own = fix.t[~between]
            # the last one is the last of the stream
            self._computed, self._interval = float(own[-2]), float(np.median(np.diff(own)))

    def held(self, fix: FixData) -> Bools:
        """Which of the next fixes (n,) are held or interpolated, or have the stamp of the one before them."""
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
