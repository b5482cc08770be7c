# SPDX-License-Identifier: Apache-2.0
"""Roads that differ between candidates: shifted, scaled, smoothed, averaged over a tyre's patch.

The road is sampled once along the paths of the four wheels, over the distance driven and, where the
map is shifted sideways, along paths beside them. A candidate's heights are the exact ones plus the
difference of two profiles interpolated from these samples, its own and the plain one: what the
sampling loses cancels as the change goes to zero, and no change is no change to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError
from suspension_twin.models.excitation import walk
from suspension_twin.models.hooks import RoadChange
from suspension_twin.models.rows import WIDTH
from suspension_twin.models.types import Excitation, HeightField

__all__ = [
    "SPACING",
    "PathSamples",
    "RoadStretch",
    "WheelPaths",
    "ahead_of",
    "candidate_heights",
    "reach_of",
    "wheel_paths_of",
]

#: Distance in m between samples along a path.
SPACING = 0.02
#: Distance in m between paths side by side.
BESIDE = 0.05
#: Distance in m that the samples go on beyond both ends of the drive, the last heights held.
MARGIN = 8.0
_REACH = 4.0  # of a Gaussian, in sigmas
_NONE = np.empty((0, 4, WIDTH))
#: Largest gain by which waves are raised that smoothing has damped in a road file.
LARGEST_GAIN = 10.0


class PathSamples:
    """The road along a way of base_link, given every SPACING m from the distance ``start`` m on."""

    def __init__(
        self, x: Floats, y: Floats, yaw: Floats, start: float, wheels: Floats, ground: HeightField
    ) -> None:
        self.start = start
        self.count = x.size
        self._x, self._y, self._yaw, self._wheels, self._ground = x, y, yaw, wheels, ground
        self._columns: dict[int, Floats] = {}

    def column(self, index: int) -> Floats:
        """(4, count) m heights along paths ``index * BESIDE`` m left of the wheels."""
        known = self._columns.get(index)
        if known is None:
            shifted = self._wheels + np.array([0.0, index * BESIDE])
            c, s = np.cos(self._yaw), np.sin(self._yaw)
            wx = self._x + c * shifted[:, :1] - s * shifted[:, 1:]
            wy = self._y + s * shifted[:, :1] + c * shifted[:, 1:]
            known = np.array(self._ground.heights(wx, wy), dtype=np.float64)
            if not np.isfinite(known).all():
                raise InputError("road", f"has no height everywhere {index * BESIDE:+.2f} m left of the way")
            self._columns[index] = known
        return known


class WheelPaths(PathSamples):
    """The road along the way of one excitation, sampled as it is asked for."""

    def __init__(self, excitation: Excitation) -> None:
        path = excitation.path
        x, y, yaw = path.x, path.y, path.yaw
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        #: distance in m and time in s at every row of ``excitation.road``
        self.distance = self._at_rows(excitation, travelled)
        self.time = self._at_rows(excitation, excitation.t)
        moving = np.concatenate([[True], np.diff(travelled) > 1e-9])
        s = travelled[moving]
        at = np.arange(math.ceil((s[-1] + 2 * MARGIN) / SPACING) + 2) * SPACING - MARGIN
        way = tuple(np.interp(at, s, values[moving]) for values in (x, y, yaw))
        super().__init__(way[0], way[1], way[2], -MARGIN, path.wheels, path.ground)

    def stretch(self, road: Floats, part: slice) -> RoadStretch:
        """The rows ``part`` of ``road`` (m, 4), of the excitation."""
        t, start = self.time[part], self.time[0]

        def earlier(delay: float, drift: float) -> Floats:
            return np.asarray(np.interp(t - delay - drift * (t - start), self.time, self.distance))

        return RoadStretch(self, road[part], self.distance[part], road[0], earlier)

    @staticmethod
    def _at_rows(excitation: Excitation, travelled: Floats) -> Floats:
        out, unused = np.empty((2, excitation.road.shape[0], 4))
        zero = np.zeros_like(travelled)
        count, first, here = excitation.substeps, excitation.first, np.zeros((4, 2))
        walk(travelled, zero, zero, count, first, 0, travelled.size, here, out, unused)
        return np.ascontiguousarray(out[:, 0])


@dataclass(frozen=True, eq=False)
class RoadStretch:
    """A stretch of a drive, and the samples around it: ``road`` (rows, 4) m and ``distance`` (rows,) m along the way.

    ``reference`` (4,) m is what heights are scaled about. ``earlier`` gives the distances (rows,) m at a time less a
    delay in s and a drift in s/s; without it there are neither.
    """

    paths: PathSamples
    road: Floats
    distance: Floats
    reference: Floats
    earlier: Callable[[float, float], Floats] | None = None


_known: WeakKeyDictionary[Excitation, WheelPaths] = WeakKeyDictionary()


def wheel_paths_of(excitation: Excitation) -> WheelPaths:
    """The wheel paths of an excitation, sampled once as long as it lives."""
    paths = _known.get(excitation)
    if paths is None:
        paths = _known[excitation] = WheelPaths(excitation)
    return paths


def ahead_of(
    x: tuple[float, float],
    y: tuple[float, float],
    yaw: float,
    reach: float,
    wheels: Floats,
    ground: HeightField,
) -> PathSamples:
    """The road along the straight from x, y [0] to [1] and ``reach`` m on at both ends, for live use."""
    length = math.hypot(x[1] - x[0], y[1] - y[0])
    at = np.arange(math.ceil((length + 2 * reach) / SPACING) + 3) * SPACING - reach
    c, s = (
        ((x[1] - x[0]) / length, (y[1] - y[0]) / length) if length > 1e-3 else (math.cos(yaw), math.sin(yaw))
    )
    way = np.array([x[0] + at * c, y[0] + at * s, np.full(at.size, yaw)], dtype=np.float64)
    return PathSamples(way[0], way[1], way[2], -reach, wheels, ground)


def reach_of(change: RoadChange) -> float:
    """Distance in m beyond a point over which the lanes of ``change`` depend on the road."""
    widest = _REACH * change.smoothing + change.patch / 2 + np.abs(change.ahead)
    return float(widest.max()) + 4 * SPACING


def candidate_heights(
    stretch: RoadStretch, change: RoadChange, lane0: int, count: int, strict: bool = True
) -> tuple[Floats, Floats]:
    """Heights in m that the lanes of one block see, for a stretch of the drive: (rows, 4) where all see the same, and
    (rows, 4, WIDTH) each lane's own, or none.

    ``change`` of all L lanes, of which lanes ``lane0``.. (``count`` of them) are in this block. A lane that looks where
    the ground has no height raises InputError where ``strict``; else it gets no heights at all, and fails alone.
    """
    paths, road, distance = stretch.paths, stretch.road, stretch.distance
    low_distance, high_distance = float(distance.min()), float(distance.max())
    need, alike = change.changed, change.alike(lane0, count)
    heights = np.empty((count, 4, road.shape[0]))
    for i in range(count):
        lane = lane0 + i
        if alike[i] < i:  # candidates mostly differ in something else
            heights[i] = heights[alike[i]]
            continue
        if not need[lane]:
            heights[i] = road.T
            continue
        ahead, left = np.full(distance.size, float(change.ahead[lane])), float(change.left[lane])
        delay, drift = float(change.delay[lane]), float(change.drift[lane])
        if stretch.earlier is not None and (delay or drift):
            ahead += stretch.earlier(delay, drift) - distance
        sigma, patch = float(change.smoothing[lane]), float(change.patch[lane])
        sharp = float(change.sharpening[lane])
        if ahead.any() or left or sigma or sharp or patch:
            reach = _REACH * (sigma + 2 * sharp) + patch / 2 + float(np.abs(ahead).max()) + 3 * SPACING
            low = max(0, int((low_distance - paths.start - reach) / SPACING))
            high = min(paths.count, int((high_distance - paths.start + reach) / SPACING) + 2)
            plain = paths.column(0)[:, low:high]
            try:
                own = _beside(paths, left)[:, low:high]
            except InputError:
                if strict:
                    raise
                heights[i] = np.nan
                continue
            own = _smoothed(_sharpened(own, sharp), sigma)
            if patch > 0:
                own = _averaged(own, patch / 2 / SPACING)
            first = paths.start + low * SPACING
            _with_difference(road, plain, own, distance, first, ahead / SPACING, heights[i])
        else:
            heights[i] = road.T
        scale = float(change.scale[lane])
        if scale != 1.0:
            heights[i] += (scale - 1.0) * (heights[i] - stretch.reference[:, None])
    if max(alike) == 0:
        return np.ascontiguousarray(heights[0].T), _NONE
    out = np.empty((road.shape[0], 4, WIDTH))
    _side_by_side(heights, out)
    return road, out


def _beside(paths: PathSamples, left: float) -> Floats:
    """(4, n) m heights ``left`` m beside the wheels' paths, interpolated between the two sampled paths next to it."""
    index = math.floor(left / BESIDE)
    share = left / BESIDE - index
    own = paths.column(index)
    return (1 - share) * own + share * paths.column(index + 1) if share else own


def _smoothed(profile: Floats, sigma: float) -> Floats:
    """Profiles (4, n) through a Gaussian of ``sigma`` m along them, ends held."""
    reach = math.ceil(_REACH * sigma / SPACING)
    if reach < 1:
        return profile
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * SPACING / sigma) ** 2)
    weights /= weights.sum()
    held = np.pad(profile, ((0, 0), (reach, reach)), mode="edge")
    return np.stack([np.convolve(row, weights, mode="valid") for row in held])


def _sharpened(profile: Floats, sigma: float) -> Floats:
    """Profiles (4, n) before a Gaussian of ``sigma`` m was applied, as far as that can be estimated.

    The regularised inverse of the Gaussian: short waves are raised by at most LARGEST_GAIN, and waves
    that the Gaussian removed stay as they are. Odd extension at both ends: no edge to ring.
    """
    if sigma <= 0:
        return profile
    n = profile.shape[1]
    line = profile[:, :1] + np.linspace(0.0, 1.0, n) * (profile[:, -1:] - profile[:, :1])
    rest = profile - line
    odd = np.concatenate([rest, -rest[:, -2:0:-1]], axis=1)
    kept = np.exp(-2 * (math.pi * sigma * np.fft.rfftfreq(odd.shape[1], SPACING)) ** 2)
    floor = 1 / (4 * LARGEST_GAIN**2)
    gain = np.maximum((1 + floor) * kept / (kept**2 + floor), 1.0)
    out: Floats = np.fft.irfft(np.fft.rfft(odd, axis=1) * gain, n=odd.shape[1], axis=1)[:, :n] + line
    return out


@compiled
def _averaged(profile: Floats, half: float) -> Floats:
    """Profiles (4, n) averaged over ``half`` samples to both sides, exactly for linear interpolation."""
    n = profile.shape[1]
    out = np.empty_like(profile)
    total = np.empty(n)
    for c in range(profile.shape[0]):
        total[0] = 0.0
        for k in range(1, n):
            total[k] = total[k - 1] + 0.5 * (profile[c, k] + profile[c, k - 1])
        for k in range(n):
            integral = 0.0
            for sign in (1.0, -1.0):
                at = k + sign * half
                inside = min(max(at, 0.0), n - 1.0)
                j = min(int(inside), n - 2)
                f = inside - j
                here = total[j] + profile[c, j] * f + 0.5 * (profile[c, j + 1] - profile[c, j]) * f * f
                integral += sign * (here + (at - inside) * profile[c, 0 if at < 0.0 else n - 1])
            out[c, k] = integral / (2.0 * half)
    return out


@compiled
def _with_difference(
    road: Floats, plain: Floats, own: Floats, distance: Floats, first: float, ahead: Floats, out: Floats
) -> None:
    """Fill ``out`` (4, rows): ``road`` (rows, 4) plus ``own`` ahead of where it is less ``plain`` there.

    Profiles (4, n) begin at the distance ``first`` m; ``ahead`` (rows,) counts in samples.
    """
    n = plain.shape[1]
    for row in range(distance.size):
        at = (distance[row] - first) / SPACING
        p = min(max(at, 0.0), n - 1.001)
        q = min(max(at + ahead[row], 0.0), n - 1.001)
        i, j = int(p), int(q)
        f, g = p - i, q - j
        for c in range(4):
            here = plain[c, i] + f * (plain[c, i + 1] - plain[c, i])
            there = own[c, j] + g * (own[c, j + 1] - own[c, j])
            out[c, row] = road[row, c] + (there - here)


@compiled
def _side_by_side(heights: Floats, out: Floats) -> None:
    """Lanes (count, 4, rows) into ``out`` (rows, 4, WIDTH), the last one repeated."""
    count = heights.shape[0]
    for row in range(out.shape[0]):
        for c in range(4):
            for i in range(WIDTH):
                out[row, c, i] = heights[min(i, count - 1), c, row]
