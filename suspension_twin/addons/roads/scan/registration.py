# SPDX-License-Identifier: Apache-2.0
"""Registration of clouds in coordinates of their own with a drive: the rigid transform under which the measured
motion is that of a car on the scanned ground.

Two things must fit. The wheels rolled on ground that the scanner saw, and the vertical acceleration follows from its
heights. A place is a turn psi about the vertical and a shift of the path onto a raster of the ground. Over all turns,
shifts of the path onto covered ground are found by correlation of rasters; each is scored by

    S = -n ln(1 - r^2),

with the correlation r > 0, over the n samples on the ground, of the measured vertical acceleration with that of a mass
on a spring and damper that follows the mean height of the four wheels. The best places are refined with the twin
itself instead of the mass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, signal

from suspension_twin.addons.roads.recording import MOVING, Observation, simulated_channels
from suspension_twin.addons.roads.scan.clouds import Cloud, Georeference
from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError, WorkError
from suspension_twin.vehicle.twin import Twin

__all__ = ["Ambiguous", "Registration", "register"]

# Tolerances of the search.
#: Cells of the raster of heights, and of that of covered ground, in m: a third of the shortest bump that a car feels
#: whole, and half a lane's play.
CELL, _COVER = 0.25, 1.0
_LARGEST = 4000  # cells of a side: 1 km
_RATE = 50.0  # Hz of the first search
_SETTLE = 0.5  # s after ground without heights that are not compared
_LEAD = 2.0  # s that the twin drives before and after the ground
_LEAST = 20.0  # m of path on the ground
_TURNS = 180  # turns of the search for covered places
_COVERED = 0.8  # of the best cover, from which on a place is tried
_PLACES, _RANKED = 400_000, 20_000  # tried at most, and the best of them among which those apart are chosen
_TRIED, _FITTED = 8, 4  # the best places that are refined, and of them those that the twin is driven over
#: Places nearer than this, m and rad, are one.
_SAME = 3.0, math.radians(10.0)
# Priors.
#: Points up to this height in m above the lowest of a cell are ground: below a kerb, above noise and slope of a cell.
_GROUND = 0.06
#: Height in m within a cell of covered ground from which on it is no road: above a kerb or a hump, below a wall.
_ROUGH = 0.25
#: Natural frequency of the body in Hz and its damping ratio: passenger cars have 1 to 1.5 Hz and 0.2 to 0.4 (Gillespie,
#: Fundamentals of Vehicle Dynamics, chapter 5). Low-pass in Hz of the first search: below wheel hop.
_NATURAL, _DAMPING, _LOW = 1.3, 0.3, 4.0
# Thresholds, chosen by hand on five development drives; they decide whether a place is refused, not which one it is.
#: Correlation of the twin's vertical acceleration with the drive's below which a place is not believed, and factor by
#: which another place has to leave more of the measured variance unexplained (geometric mean of the channels).
_BELIEVED, _DISTINCT = 0.6, 1.1
#: rad and m of a place that one unit of the local search stands for.
_UNIT = np.array([math.radians(0.5), 0.3, 0.3])
_CHANNELS = ("vertical_acceleration", "roll_rate", "pitch_rate")


class Ambiguous(InputError):
    """A cloud fits a drive in several places alike."""


@dataclass(frozen=True)
class Registration:
    """Map positions are ``turn`` rad about the vertical from the cloud's, then ``move`` m (east, north) on.

    ``correlation`` of the twin's vertical acceleration with the drive's over ``seconds`` on the ground, and at the
    ``next_best`` place (0 without one).
    """

    turn: float
    move: tuple[float, float]
    correlation: float
    next_best: float
    seconds: float

    def __str__(self) -> str:
        return (
            f"fitted to the drive: turned by {math.degrees(self.turn):.2f} deg, moved by {self.move[0]:.2f} m east and "
            f"{self.move[1]:.2f} m north; vertical acceleration correlates {self.correlation:.2f} over "
            f"{self.seconds:.0f} s, at the next best place {self.next_best:.2f}"
        )


def register(
    clouds: Sequence[tuple[Cloud, Georeference]],
    drive: Observation,
    twin: Twin,
    progress: Callable[[str, float | None], None] = lambda text, share: None,
) -> Registration:
    """The place of clouds on a drive.

    Parameters
    ----------
    clouds : sequence of (Cloud, Georeference)
        Clouds in one common frame of their own, z up, with their unit and axes.
    drive : Observation
        Over the scanned ground; its heights are not used.
    twin : Twin
        A car like the one that drove.
    progress : callable, optional
        Called with a text and the share of the work that is done.

    Returns
    -------
    Registration
        The transform and how well it fits.

    Raises
    ------
    InputError
        No place fits; :class:`Ambiguous` where several do alike.
    """
    name = clouds[0][0].path
    ground = _raster(clouds, progress)
    search = _Search(ground, drive, twin)
    progress("looking for the place of the cloud", None)
    refined = [search.refined(at) for at in search.first_places(name)]
    refined.sort(key=lambda f: -f[0])
    progress("fitting the place of the cloud", None)
    fits = [_fitted(ground, drive, twin, search.centre, at) for _, at in _apart(refined, _FITTED)]
    best, *others = sorted(fits, key=lambda f: f.unexplained)
    if best.correlation < _BELIEVED:
        raise InputError(
            name,
            f"fits the drive {drive.name} nowhere: its vertical acceleration correlates "
            f"{best.correlation:.2f} at best",
        )
    if any(f.unexplained < best.unexplained + math.log(_DISTINCT) for f in others):
        raise Ambiguous(
            name,
            f"fits the drive {drive.name} in several places alike: give a longer drive over it, or its coordinate "
            "reference system with --crs",
        )
    turn, x, y = best.at.tolist()
    c, s = math.cos(turn), math.sin(turn)
    # the path p is at R (p - centre) + (x, y) of the raster: its inverse takes the cloud to the map
    east, north = search.centre - np.array([c * x + s * y, -s * x + c * y])
    other = max((f.correlation for f in others), default=0.0)
    return Registration(-turn, (float(east), float(north)), best.correlation, other, best.seconds)


@dataclass(frozen=True, eq=False)
class _Ground:
    """Heights ``z`` (nx, ny) m of cells of CELL m whose first centre is at ``x0``, ``y0``; NaN where there are none."""

    z: Floats
    x0: float
    y0: float

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """(nx, ny) cells with points, and those beside them."""
        return ndimage.binary_dilation(np.isfinite(self.z), iterations=2)

    @cached_property
    def filled(self) -> Floats:
        """(nx, ny) heights, those of the nearest cell where there are none."""
        return _filled(self.z)

    @cached_property
    def cover(self) -> Floats:
        """1 in cells of _COVER m that a car could drive on, 0 elsewhere."""
        n = round(_COVER / CELL)
        padded = np.pad(self.z, [(0, -s % n) for s in self.z.shape], constant_values=np.nan)
        blocks = padded.reshape(padded.shape[0] // n, n, -1, n)
        seen = np.isfinite(blocks)
        high = np.where(seen, blocks, -np.inf).max(axis=(1, 3))
        low = np.where(seen, blocks, np.inf).min(axis=(1, 3))
        return np.asarray(
            ndimage.binary_closing(high - low < _ROUGH) & seen.any(axis=(1, 3)), dtype=np.float64
        )


def _filled(z: Floats) -> Floats:
    """(nx, ny) heights, those of the nearest known cell where they are not finite."""
    _, (i, j) = ndimage.distance_transform_edt(~np.isfinite(z), return_indices=True)
    return np.ascontiguousarray(z[i, j])


def _raster(
    clouds: Sequence[tuple[Cloud, Georeference]], progress: Callable[[str, float | None], None]
) -> _Ground:
    """The ground of clouds: the mean of the points of a cell that lie just above its lowest."""

    def pieces() -> Iterator[Floats]:
        for cloud, georeference in clouds:
            yield from (georeference.to_map(points) for points in cloud.pieces() if points.size)

    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    progress("reading the clouds", None)
    for p in pieces():
        low, high = np.minimum(low, p[:, :2].min(axis=0)), np.maximum(high, p[:, :2].max(axis=0))
    name = clouds[0][0].path
    if not np.isfinite(low).all():
        raise InputError(name, "holds no points")
    nx, ny = (np.floor((high - low) / CELL).astype(int) + 1).tolist()
    if max(nx, ny) > _LARGEST:
        raise InputError(
            name,
            f"is {max(high - low):.0f} m wide, a cloud is fitted to a drive up to {_LARGEST * CELL:.0f} m: cut it, or "
            "name its coordinate reference system with --crs",
        )

    def cell(p: Floats) -> NDArray[np.intp]:
        i, j = np.floor((p[:, :2] - low) / CELL).astype(np.intp).T
        return np.asarray(i * ny + j)

    lowest = np.full(nx * ny, np.inf)
    for p in pieces():
        np.minimum.at(lowest, cell(p), p[:, 2])
    # a point below the ground, of a reflection, is no ground: the cells around give the height
    around = ndimage.median_filter(_filled(lowest.reshape(nx, ny)), 3, mode="nearest").ravel()
    around = np.maximum(around - _GROUND, lowest)
    total, count = np.zeros((2, nx * ny))
    for p in pieces():
        at = cell(p)
        near = (p[:, 2] >= around[at]) & (p[:, 2] <= around[at] + _GROUND)
        total += np.bincount(at[near], p[near, 2], nx * ny)
        count += np.bincount(at[near], minlength=nx * ny)
    z = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(nx, ny)
    return _Ground(z, float(low[0]) + 0.5 * CELL, float(low[1]) + 0.5 * CELL)


class _Search:
    """Search of the place of a drive's path on the ground.

    A place (3,) is a turn in rad and x and y in m of the ``centre`` (2,) of the path.
    """

    def __init__(self, ground: _Ground, drive: Observation, twin: Twin) -> None:
        self.ground, way = ground, drive.trajectory
        t = np.arange(drive.t[0], drive.t[-1], 1.0 / _RATE)
        x, y, speed = (np.interp(t, way.t, v) for v in (way.x, way.y, way.speed))
        yaw = np.interp(t, way.t, np.unwrap(way.yaw))
        self._moving = np.abs(speed) > MOVING
        if self._moving.sum() < 4 * _RATE:
            raise InputError(drive.name, "moves for less than 4 s: no cloud can be fitted to it")
        self.centre = np.array([x[self._moving].mean(), y[self._moving].mean()])
        x, y = x - self.centre[0], y - self.centre[1]
        at, c, s = twin.vehicle.wheel_positions, np.cos(yaw), np.sin(yaw)
        # (2, 4, n) m of the wheels about the centre
        self._wheels = np.array([x + c * at[:, :1] - s * at[:, 1:], y + s * at[:, :1] + c * at[:, 1:]])
        low = signal.butter(2, _LOW, fs=_RATE, output="sos")
        w = 2.0 * np.pi * _NATURAL
        poles = w * np.exp(1j * np.array([1.0, -1.0]) * (np.pi - math.acos(_DAMPING)))
        # the acceleration of a mass on a moving base, proper by one more pole far above the compared band
        mass = signal.bilinear_zpk(
            [0.0, 0.0, -w / (2.0 * _DAMPING)], [*poles, -2.0 * np.pi * 5.0 * _LOW], 1.0, _RATE
        )
        self._sections = np.concatenate([signal.zpk2sos(*mass), low])
        measured = np.interp(t, drive.t, drive.measured["vertical_acceleration"])
        self._measured = signal.sosfilt(low, measured)
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        every = np.arange(0.0, travelled[-1], _COVER)
        rising = np.concatenate([[True], np.diff(travelled) > 1e-9])
        self._points = [np.interp(every, travelled[rising], v[rising]) for v in (x, y)]

    def scores(self, places: Floats) -> Floats:
        """Score S (n,) of places (n, 3)."""
        out, ground = np.empty(len(places)), self.ground
        _score(
            ground.filled,
            ground.known,
            ground.x0,
            ground.y0,
            self._wheels,
            self._measured,
            self._sections,
            self._moving,
            round(_SETTLE * _RATE),
            np.ascontiguousarray(places),
            out,
        )
        return out

    def first_places(self, name: Path) -> list[Floats]:
        """The best places that are apart, after a search over all turns and shifts onto covered ground."""
        most, found, counts = 0.0, [], []
        for turn in np.arange(_TURNS) * (2.0 * np.pi / _TURNS):
            count, (x0, y0) = self._covered(turn)
            most = max(most, float(count.max()))
            i, j = np.nonzero(count >= max(_COVERED * most, 1.0))
            found.append(np.stack([np.full(i.size, turn), x0 + i * _COVER, y0 + j * _COVER], axis=1))
            counts.append(count[i, j])
        if most * _COVER < _LEAST:
            raise InputError(name, f"holds no {_LEAST:.0f} m of ground on which the path could lie")
        coarse = np.concatenate(found)[np.concatenate(counts) >= _COVERED * most]
        if len(coarse) > _PLACES // 8:
            raise InputError(
                name, "is so wide that the path could lie anywhere on it: cut it to the road that was driven"
            )
        half = 0.5 * _COVER
        shifts = [(t, a, b) for t in (0.0, math.pi / _TURNS) for a in (0.0, half) for b in (0.0, half)]
        places = np.concatenate([coarse + np.array(s) for s in shifts])
        scores = self.scores(places)
        order = np.argsort(-scores, kind="stable")[:_RANKED]
        return [at for _, at in _apart([(float(scores[k]), places[k]) for k in order], _TRIED)]

    def _covered(self, turn: float) -> tuple[Floats, tuple[float, float]]:
        """How many points of the path lie on covered ground, by shift (nx, ny), and the place of the first shift."""
        c, s = math.cos(turn), math.sin(turn)
        x, y = self._points
        x, y = c * x - s * y, s * x + c * y
        x0, y0 = x.min(), y.min()
        i, j = (np.rint((v - v0) / _COVER).astype(int) for v, v0 in ((x, x0), (y, y0)))
        path = np.zeros((i.max() + 1, j.max() + 1))
        np.add.at(path, (i, j), 1.0)
        count = np.rint(signal.fftconvolve(self.ground.cover, path[::-1, ::-1]))
        # shift (a, b) puts the first corner of the path at cell (a, b) - (shape of the path - 1)
        first = (
            self.ground.x0 - 0.5 * CELL + (0.5 - (path.shape[0] - 1)) * _COVER - x0,
            self.ground.y0 - 0.5 * CELL + (0.5 - (path.shape[1] - 1)) * _COVER - y0,
        )
        return np.asarray(count), first

    def refined(self, at: Floats) -> tuple[float, Floats]:
        """The score and the place of the best nearby."""

        def cost(u: Floats) -> float:
            return -float(self.scores((at + _UNIT * u)[None])[0])

        u = _minimum(cost, 1.0, 120)
        return -cost(u), at + _UNIT * u


def _minimum(cost: Callable[[Floats], float], size: float, iterations: int) -> Floats:
    """(3,) where a cost is lowest near zero, by Nelder and Mead from a simplex of a ``size``."""
    options = {
        "initial_simplex": size * np.eye(4, 3, -1),
        "maxiter": iterations,
        "xatol": 0.02,
        "fatol": 1e-4,
    }
    found = optimize.minimize(cost, np.zeros(3), method="Nelder-Mead", options=options)  # type: ignore[call-overload]
    return np.asarray(found.x)


def _apart(ranked: Sequence[tuple[float, Floats]], count: int) -> list[tuple[float, Floats]]:
    """The first places of a list, best first, that are not the same."""
    kept: list[tuple[float, Floats]] = []
    for score, at in ranked:
        off = [at - other for _, other in kept]
        if all(
            math.hypot(d[1], d[2]) > _SAME[0] or abs(math.remainder(d[0], 2.0 * math.pi)) > _SAME[1]
            for d in off
        ):
            kept.append((score, at))
        if len(kept) == count:
            break
    return kept


@dataclass(frozen=True, eq=False)
class _PlacedGround:
    """The ground in ``map``, under a path whose ``centre`` is at a place."""

    ground: _Ground
    centre: Floats
    at: Floats

    def heights(self, x: Floats, y: Floats) -> Floats:
        """Heights in m at ``map`` positions."""
        cells = self._cells(x, y)
        return np.asarray(ndimage.map_coordinates(self.ground.filled, cells, order=1, mode="nearest"))

    def known(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Where the scanner saw ground."""
        cells = np.rint(self._cells(x, y)).astype(int)
        return np.asarray(ndimage.map_coordinates(self.ground.known, cells, order=0, mode="constant"))

    def _cells(self, x: Floats, y: Floats) -> list[Floats]:
        turn, mx, my = self.at.tolist()
        c, s = math.cos(turn), math.sin(turn)
        a, b = np.asarray(x) - self.centre[0], np.asarray(y) - self.centre[1]
        return [(c * a - s * b + mx - self.ground.x0) / CELL, (s * a + c * b + my - self.ground.y0) / CELL]


@dataclass(frozen=True)
class _Fit:
    """The twin at a place: mean log of the share of variance that is ``unexplained`` over the channels, the
    ``correlation`` of the vertical acceleration, and the ``seconds`` compared."""

    at: Floats
    unexplained: float = 0.0
    correlation: float = 0.0
    seconds: float = 0.0


def _fitted(ground: _Ground, drive: Observation, twin: Twin, centre: Floats, at: Floats) -> _Fit:
    """The best place nearby by the twin, which drives the part of the drive that lies on the ground."""
    way = drive.trajectory
    seen = way.t[_PlacedGround(ground, centre, at).known(way.x, way.y)]
    if not seen.size:
        return _Fit(at)
    drive = drive.part(float(seen[0]) - _LEAD, float(seen[-1]) + _LEAD)
    way = drive.trajectory

    def compared(u: Floats) -> _Fit:
        there = at + _UNIT * u
        placed = _PlacedGround(ground, centre, there)
        on = placed.known(way.x, way.y) & (np.abs(way.speed) > MOVING)
        on = ndimage.binary_erosion(on, iterations=max(1, round(_SETTLE * drive.rate)))
        mask = np.interp(drive.t, way.t, on.astype(np.float64)) > 0.99
        if mask.sum() < 2.0 * drive.rate:
            return _Fit(there)
        try:
            found = simulated_channels(drive, twin, placed, 2.5e-3)
        except WorkError:
            return _Fit(there)
        r = [float(np.corrcoef(found[c][mask], drive.measured[c][mask])[0, 1]) for c in _CHANNELS]
        left = np.log1p(-(np.maximum(np.nan_to_num(r), 0.0) ** 2))
        return _Fit(there, float(left.mean()), r[0], float(mask.sum() / drive.rate))

    return compared(_minimum(lambda u: compared(u).unexplained, 0.5, 60))


@compiled
def _score(
    z: Floats,
    known: NDArray[np.bool_],
    x0: float,
    y0: float,
    wheels: Floats,
    measured: Floats,
    sections: Floats,
    moving: NDArray[np.bool_],
    settle: int,
    places: Floats,
    out: Floats,
) -> None:  # pragma: no cover - compiled
    """Score (p,) of places (p, 3)."""
    nx, ny = z.shape
    n, stages = measured.size, sections.shape[0]
    state = np.zeros((stages, 2))
    for p in range(places.shape[0]):
        c, s = math.cos(places[p, 0]), math.sin(places[p, 0])
        state[:] = 0.0
        count, wait, first = 0, settle, True
        zero = 0.0
        sa = sb = saa = sbb = sab = 0.0
        for k in range(n):
            mean, seen = 0.0, moving[k]
            for w in range(4):
                a, b = wheels[0, w, k], wheels[1, w, k]
                x = (c * a - s * b + places[p, 1] - x0) / CELL
                y = (s * a + c * b + places[p, 2] - y0) / CELL
                i, j = math.floor(x), math.floor(y)
                if i < 0 or j < 0 or i >= nx - 1 or j >= ny - 1:
                    seen = False
                    break
                seen = seen and known[i, j] and known[i + 1, j + 1]
                f, g = x - i, y - j
                low = z[i, j] + g * (z[i, j + 1] - z[i, j])
                mean += 0.25 * (low + f * (z[i + 1, j] + g * (z[i + 1, j + 1] - z[i + 1, j]) - low))
            if not seen:
                first, wait = True, settle
                continue
            if first:
                state[:] = 0.0
                zero, first = mean, False
            value = mean - zero
            for m in range(stages):
                o = sections[m, 0] * value + state[m, 0]
                state[m, 0] = sections[m, 1] * value - sections[m, 4] * o + state[m, 1]
                state[m, 1] = sections[m, 2] * value - sections[m, 5] * o
                value = o
            if wait > 0:
                wait -= 1
                continue
            count += 1
            sa += value
            sb += measured[k]
            saa += value * value
            sbb += measured[k] * measured[k]
            sab += value * measured[k]
        out[p] = 0.0
        if count > 2 * settle:
            va, vb = saa - sa * sa / count, sbb - sb * sb / count
            if va > 0.0 and vb > 0.0:
                r = (sab - sa * sb / count) / math.sqrt(va * vb)
                if r > 0.0:
                    out[p] = -count * math.log(1.0 - min(r * r, 0.999))
