# SPDX-License-Identifier: Apache-2.0
"""One drive over the road that is sought: its measured channels, and where its wheels were on the road's line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import sosfreqz
from scipy.sparse import csr_matrix

from suspension_twin.addons.roads.drives.transfer import CHANNELS
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import Observation
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.types import Trajectory
from suspension_twin.road.build import Centreline
from suspension_twin.road.road import Road
from suspension_twin.vehicle.twin import Twin

__all__ = ["FINE", "LANE_SIGMA", "Pass", "line_of", "make_pass", "smoothed_line"]

#: Wheels are placed on the line so many times in each sample.
FINE = 2
#: A pass is on the move above this, m/s: below, clocks and maps blur what little the wheels meet.
_MOVING = 1.0
#: s at both ends of a pass over which its weight rises: the road before it is not known.
_TAPER = 1.5
_SHORTEST = 4.0
#: Receivers that are less certain than this, m, cannot tell in which lane they are.
LANE_SIGMA = 0.3
#: Drives farther apart than this, m, have other wheel paths.
LANE = 0.6
_OTHER_ROAD = 30.0
#: m beside the line beyond which a drive has left it; with a receiver that cannot tell lanes apart so many, or that
#: many of its standard deviations; rad by which it goes another way.
_BESIDE, _ASTRAY, _SIGMAS, _AGAINST = 2.0, 12.0, 3.0, math.radians(60.0)
#: A line has a point every so many m, smoothed over about so many.
_KNOT, _SMOOTH = 0.5, 1.5
#: Time in s between the knots of a pass's shift along the road.
KNOT = 4.0


@dataclass(frozen=True, eq=False)
class Pass:
    """A part of a drive on uniform samples.

    n is a number of samples that Fourier transforms are fast at: after the ``recorded`` ones their weight is zero.
    ``t`` (n,) s; ``measured`` (3, n) the channels; ``u`` (4, FINE n) m of the wheels on the line, at FINE times the
    rate, and ``v`` (4, FINE n) m by which they are to the left of their wheel path; ``weight`` (n,) 0 to 1 of each
    sample; ``shaped`` (k,) gain of the filter that the channels went through; ``base`` (FINE n,) m by which the pass
    lies farther on than its receiver says; ``knots`` (j, FINE n) shares of the knots of a shift along the road;
    ``shift_sigma`` m, its prior.
    """

    name: str
    prepared: Observation
    t: Floats
    measured: Floats
    u: Floats
    v: Floats
    weight: Floats
    shaped: Floats
    base: Floats
    knots: Floats
    shift_sigma: float

    @property
    def recorded(self) -> int:
        """Samples that were recorded."""
        return int(self.prepared.t.size)

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.prepared.rate

    @property
    def speed(self) -> float:
        """Median speed in m/s."""
        return float(np.median(self.prepared.speed[self.prepared.speed > _MOVING]))

    def placed(self, shift: Floats, du: float, count: int, across: Floats) -> list[csr_matrix]:
        """For each wheel a matrix (FINE n, k count) from heights on a grid to heights under the wheel.

        ``shift`` (j,) m by which the pass lies farther on at its knots; the grid has lines ``across`` (k,) m to the
        left of the wheel path with ``count`` heights every ``du`` m each. Linear between the heights; beyond the
        outermost lines as on them.
        """
        moved = self.u + self.base + shift @ self.knots
        out = []
        rows = np.arange(moved.shape[1])
        for u, v in zip(moved, self.v, strict=True):
            along = np.clip(u / du, 0.0, count - 1.001)
            first = np.floor(along).astype(np.int64)
            part = along - first
            place = np.interp(v, across, np.arange(across.size))
            line = np.minimum(np.floor(place).astype(np.int64), max(across.size - 2, 0))
            beside = place - line
            lines = [(line, 1.0 - beside)] + ([(line + 1, beside)] if across.size > 1 else [])
            ends = [(k * count + first + i, w * p) for k, w in lines for i, p in ((0, 1.0 - part), (1, part))]
            where = np.concatenate([rows] * len(ends)), np.concatenate([column for column, _ in ends])
            data = np.concatenate([value for _, value in ends])
            out.append(csr_matrix((data, where), shape=(rows.size, across.size * count)))
        return out

    def simulated(self, twin: Twin, road: Road, shift: Floats) -> Floats:
        """The channels (3, n) of the twin over a road, through the same filter."""
        path = self.prepared.trajectory
        fine = self.t[0] + np.arange(self.u.shape[1]) / (FINE * self.rate)
        along = np.interp(path.t, fine, self.base + shift @ self.knots)
        moved = replace(path, x=path.x + along * np.cos(path.yaw), y=path.y + along * np.sin(path.yaw))
        driven = excitation(moved, twin.vehicle, road, self.prepared.settings.max_step, twin.gps.position[2])
        found = self.prepared.condition(simulate_twin(twin, driven))
        return np.array([_padded(found[name], self.t.size) for name in CHANNELS])


def line_of(paths: Sequence[Trajectory], step: float, margin: float) -> Centreline:
    """A line along the drives: the longest one's own path on the move, ``margin`` m longer at both ends."""
    lines = []
    for path in paths:
        on = path.speed > _MOVING
        if on.sum() > 10:
            lines.append((path.x[on], path.y[on]))
    if not lines:
        raise InputError("drives", f"none of them moves faster than {_MOVING:g} m/s")
    x, y = max(lines, key=lambda p: float(np.hypot(np.diff(p[0]), np.diff(p[1])).sum()))
    return smoothed_line(x, y, step, margin)


def smoothed_line(x: Floats, y: Floats, step: float, margin: float = 0.0) -> Centreline:
    """A line through points (n,) m, smoothed over about a metre and a half, ``margin`` m longer at both ends."""
    rough = Centreline(x, y, _KNOT)
    # Straight on at both ends, in the direction of the first and of the last metres.
    more = math.ceil((margin + 4.0 * _SMOOTH) / _KNOT)
    reach = min(round(3.0 / _KNOT), rough.x.size - 1)
    points = np.column_stack([rough.x, rough.y])
    steps = np.arange(1, more + 1)[:, None] * _KNOT
    first, last = ((points[i] - points[j]) for i, j in ((0, reach), (-1, -1 - reach)))
    before = points[0] + steps[::-1] * first / np.hypot(*first)
    after = points[-1] + steps * last / np.hypot(*last)
    # A path wavers where the drive is slow; a line that turns on the spot has no road to its sides.
    smooth = gaussian_filter1d(np.vstack([before, points, after]), _SMOOTH / _KNOT, axis=0, mode="nearest")
    extra = more - math.ceil(margin / _KNOT)
    smooth = smooth[extra : smooth.shape[0] - extra]
    at = np.arange(smooth.shape[0])
    fine = CubicSpline(at, smooth)(np.linspace(0.0, at[-1], 20 * (at.size - 1) + 1))
    return Centreline(fine[:, 0], fine[:, 1], step)


def make_pass(prepared: Observation, line: Road, track: float) -> Pass:
    """A prepared drive as a pass over the road whose line ``line`` has, with wheel paths ``track`` m apart."""
    n = int(next_fast_len(prepared.t.size, real=True))
    grid = prepared.t[0] + np.arange(n) / prepared.rate
    fine = grid[0] + np.arange(FINE * n) / (FINE * prepared.rate)
    along = _along(prepared, line, fine)
    prepared, across = _snapped(prepared, line)
    path = prepared.trajectory
    x, y, yaw = (np.interp(fine, path.t, getattr(path, name)) for name in ("x", "y", "yaw"))
    wheels = prepared.twin.vehicle.wheel_positions
    places = [
        line.xy_to_uv(x + np.cos(yaw) * a - np.sin(yaw) * b, y + np.sin(yaw) * a + np.cos(yaw) * b)
        for a, b in wheels
    ]
    u = np.array([place[0] for place in places])
    v = np.array(
        [place[1] - math.copysign(0.5 * track, b) for place, (_, b) in zip(places, wheels, strict=True)]
    )
    on = (u.min(axis=0) > line.u_first) & (u.max(axis=0) < line.u_last) & along
    recorded = on[::FINE][: prepared.t.size] & (prepared.speed > _MOVING) & prepared.mask
    usable = np.concatenate([recorded, np.zeros(n - recorded.size, dtype=np.bool_)])
    if prepared.position_sigma < LANE_SIGMA and abs(across) > LANE:
        raise InputError(
            prepared.name,
            f"was driven {abs(across):.2f} m beside the first drive: its wheels met another road",
        )
    weight = _tapered(usable, prepared.rate)
    if weight.sum() < _SHORTEST * prepared.rate:
        raise InputError(prepared.name, f"has less than {_SHORTEST:g} s on the road of the other drives")
    _, gain = sosfreqz(
        prepared.settings.filter.sections(prepared.rate),
        worN=np.fft.rfftfreq(n, 1.0 / prepared.rate),
        fs=prepared.rate,
    )
    count = max(2, round((grid[-1] - grid[0]) / KNOT) + 1)
    at = np.linspace(fine[0], fine[-1], count)
    knots = np.array([np.interp(fine, at, row) for row in np.eye(count)])
    return Pass(
        name=prepared.name,
        prepared=prepared,
        t=grid,
        measured=np.array([_padded(prepared.measured[name], n) for name in CHANNELS]),
        u=u,
        v=v,
        weight=weight,
        shaped=np.abs(gain) ** 2,
        base=np.zeros(FINE * n),
        knots=knots,
        shift_sigma=max(prepared.position_sigma, 0.01),
    )


def _along(prepared: Observation, line: Road, t: Floats) -> NDArray[np.bool_]:
    """Where (n,) at the times ``t`` a drive is on the line and goes its way: it may leave it, or come back on it."""
    path = prepared.trajectory
    x, y, yaw = (np.interp(t, path.t, getattr(path, name)) for name in ("x", "y", "yaw"))
    u, v = line.xy_to_uv(x, y)
    at = np.clip(np.rint((u - line.u_first) / line.u_step).astype(np.int64), 0, line.x.size - 2)
    dx, dy = line.x[at + 1] - line.x[at], line.y[at + 1] - line.y[at]
    same = dx * np.cos(yaw) + dy * np.sin(yaw) > math.cos(_AGAINST) * line.u_step
    return np.asarray((np.abs(v) < _reach(prepared)) & same, dtype=np.bool_)


def _reach(prepared: Observation) -> float:
    """m beside the line within which a drive may be on it."""
    sigma = prepared.position_sigma
    return _BESIDE if sigma < LANE_SIGMA else max(_ASTRAY, _SIGMAS * sigma)


def _snapped(prepared: Observation, line: Road) -> tuple[Observation, float]:
    """A drive whose receiver cannot tell lanes apart, moved onto the line; and how far beside it (m) the drive was."""
    path = prepared.trajectory
    u, v = line.xy_to_uv(path.x, path.y)
    on = (u > line.u_first) & (u < line.u_last) & (path.speed > _MOVING)
    if not on.any():
        raise InputError(prepared.name, "is nowhere on the road of the other drives")
    near = on & (np.abs(v) < _reach(prepared))
    across = float(np.median(v[near if near.any() else on]))
    if abs(across) > _OTHER_ROAD:
        raise InputError(
            prepared.name, f"is nowhere on the road of the other drives, but {abs(across):.0f} m off"
        )
    if prepared.position_sigma < LANE_SIGMA:
        return prepared, across
    x, y = line.uv_to_xy(u, np.zeros(u.size))
    moved = replace(prepared.source, trajectory=replace(path, x=x, y=y))
    return replace(prepared, reading=moved), across


def _padded(values: Floats, n: int) -> Floats:
    """Values (m,) with zeros after them, (n,)."""
    return np.concatenate([values, np.zeros(n - values.size)])


def _tapered(usable: NDArray[np.bool_], rate: float) -> Floats:
    """Weights (n,) that rise over the taper from each edge of what is usable."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]).astype(np.int8)))
    weight = np.zeros(usable.size)
    for low, high in edges.reshape(-1, 2):
        i = np.arange(high - low)
        near = np.minimum(i, high - low - 1 - i) / (_TAPER * rate)
        weight[low:high] = 0.5 - 0.5 * np.cos(np.pi * np.clip(near, 0.0, 1.0))
    return weight
