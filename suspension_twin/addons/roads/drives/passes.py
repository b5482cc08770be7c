# SPDX-License-Identifier: Apache-2.0
"""One drive over the road that is sought: its measured channels, and where its wheels were along the road's line.

A phone's receiver is metres off and wanders, but two passes over one road see the same profile. ``lags_along`` compares
their estimates in windows at all lags and finds, by dynamic programming, the path of lags that correlates best and
changes slowly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.signal import butter, sosfiltfilt, sosfreqz
from scipy.sparse import csr_matrix

from suspension_twin.addons.roads.drives.transfer import CHANNELS
from suspension_twin.addons.roads.recording import MOVING, Observation, simulated_channels
from suspension_twin.arrays import Floats, runs
from suspension_twin.errors import InputError
from suspension_twin.road.road import Road
from suspension_twin.vehicle.twin import Twin

__all__ = ["FINE", "LANE_SIGMA", "RoadPass", "banded", "lags_along", "make_pass"]

#: Wheels are placed on the line so many times in each sample.
FINE = 2
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
#: Time in s between the knots of a pass's shift along the road.
KNOT = 4.0
#: m. Windows that are compared.
_WINDOW, _HOP = 40.0, 5.0
#: A lag may change by so much of the way: a receiver wanders by some centimetres in a metre.
_DRIFT = 0.08
#: Cost of a change of lag of one grid step from window to window, in units of correlation.
_PRICE = 0.004
#: Of the typical power: a window with less shows no lag.
_QUIET = 0.05


@dataclass(frozen=True, eq=False)
class RoadPass:
    """A part of a drive on n uniform samples over the line of a road.

    n is a number of samples that Fourier transforms are fast at: after the recorded ones the weight is zero.

    Parameters
    ----------
    prepared : Observation
        The drive.
    measured : (3, n) array
        Channels in the order of ``CHANNELS``.
    u, v : (4, FINE n) array
        Places of the wheels at FINE times the rate: m along the line, and m to the left of their wheel path.
    weight : (n,) array
        0 to 1 of each sample.
    base : (FINE n,) array
        m by which the pass lies farther on than its receiver says.
    knots : (j, FINE n) array
        Shares of the knots of a shift along the road.
    shift_sigma : float
        Prior standard deviation of that shift in m.
    """

    prepared: Observation
    measured: Floats
    u: Floats
    v: Floats
    weight: Floats
    base: Floats
    knots: Floats
    shift_sigma: float

    @property
    def name(self) -> str:
        """Of the drive."""
        return self.prepared.name

    @property
    def size(self) -> int:
        """Number of samples n."""
        return int(self.weight.size)

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.prepared.rate

    @property
    def speed(self) -> float:
        """Median speed in m/s."""
        return float(np.median(self.prepared.speed[self.prepared.speed > MOVING]))

    @property
    def frequencies(self) -> Floats:
        """(k,) Hz of the transform of n samples."""
        return np.asarray(np.fft.rfftfreq(self.size, 1.0 / self.rate), dtype=np.float64)

    @cached_property
    def low_pass(self) -> Floats:
        """(k,) gain of the filter that the channels went through."""
        sections = self.prepared.settings.filter.sections(self.rate)
        return np.asarray(np.abs(sosfreqz(sections, worN=self.frequencies, fs=self.rate)[1]) ** 2)

    @property
    def on_the_move(self) -> NDArray[np.bool_]:
        """(FINE n,) where the pass has weight."""
        return np.repeat(self.weight > 0.5, FINE)

    def wheel_matrices(self, shift: Floats, du: float, count: int, across: Floats) -> list[csr_matrix]:
        """For each wheel a matrix (FINE n, k count) from heights on a grid to heights under the wheel.

        ``shift`` (j,) m by which the pass lies farther on at its knots; the grid has lines ``across`` (k,) m to the
        left of the wheel path with ``count`` heights every ``du`` m each. Linear between the heights; beyond the
        outermost lines as on them.
        """
        moved = self.u + self.base + shift @ self.knots
        rows, out = np.arange(moved.shape[1]), []
        for u, v in zip(moved, self.v, strict=True):
            along = np.clip(u / du, 0.0, count - 1.001)
            first = np.floor(along).astype(np.int64)
            part = along - first
            place = np.interp(v, across, np.arange(across.size))
            line = np.minimum(np.floor(place).astype(np.int64), max(across.size - 2, 0))
            beside = place - line
            lines = [(line, 1.0 - beside)] + ([(line + 1, beside)] if across.size > 1 else [])
            ends = [(k * count + first + i, w * p) for k, w in lines for i, p in ((0, 1.0 - part), (1, part))]
            columns, values = (np.concatenate(arrays) for arrays in zip(*ends, strict=True))
            where = np.concatenate([rows] * len(ends)), columns
            out.append(csr_matrix((values, where), shape=(rows.size, across.size * count)))
        return out

    def simulated(self, twin: Twin, road: Road, shift: Floats) -> Floats:
        """The channels (3, n) of the twin over a road, through the same filter."""
        drive = self.prepared
        fine = drive.t[0] + np.arange(self.u.shape[1]) / (FINE * self.rate)
        path = drive.trajectory
        along = np.interp(path.t, fine, self.base + shift @ self.knots)
        moved = replace(path, x=path.x + along * np.cos(path.yaw), y=path.y + along * np.sin(path.yaw))
        found = simulated_channels(drive, twin, road, drive.settings.max_step, moved)
        return _padded(found, self.size)


def _padded(channels: Mapping[str, Floats], n: int) -> Floats:
    """The channels of an estimate with zeros after them, (3, n)."""
    return np.array([np.concatenate([c, np.zeros(n - c.size)]) for c in (channels[k] for k in CHANNELS)])


def make_pass(prepared: Observation, line: Road, track: float) -> RoadPass:
    """A prepared drive as a pass over the road whose line ``line`` has, with wheel paths ``track`` m apart.

    Raises InputError, naming the drive, where it does not lie on that road.
    """
    n = int(next_fast_len(prepared.t.size, real=True))
    fine = prepared.t[0] + np.arange(FINE * n) / (FINE * prepared.rate)
    along = _follows(prepared, line, fine)
    prepared, across = _snapped(prepared, line)
    x, y, yaw = _pose_at(prepared, fine)
    wheels = prepared.twin.vehicle.wheel_positions
    places = [
        line.xy_to_uv(x + np.cos(yaw) * a - np.sin(yaw) * b, y + np.sin(yaw) * a + np.cos(yaw) * b)
        for a, b in wheels
    ]
    u, v = (np.array(rows) for rows in zip(*places, strict=True))
    v = v - np.copysign(0.5 * track, wheels[:, 1:])
    on = (u.min(axis=0) > line.u_first) & (u.max(axis=0) < line.u_last) & along
    recorded = on[::FINE][: prepared.t.size] & (prepared.speed > MOVING) & prepared.mask
    usable = np.concatenate([recorded, np.zeros(n - recorded.size, dtype=np.bool_)])
    if prepared.position_sigma < LANE_SIGMA and abs(across) > LANE:
        raise InputError(
            prepared.name,
            f"was driven {abs(across):.2f} m beside the first drive: its wheels met another road",
        )
    weight = _tapered(usable, prepared.rate)
    if weight.sum() < _SHORTEST * prepared.rate:
        raise InputError(prepared.name, f"has less than {_SHORTEST:g} s on the road of the other drives")
    count = max(2, round((n - 1) / prepared.rate / KNOT) + 1)
    at = np.linspace(fine[0], fine[-1], count)
    return RoadPass(
        prepared=prepared,
        measured=_padded(prepared.measured, n),
        u=u,
        v=v,
        weight=weight,
        base=np.zeros(FINE * n),
        knots=np.array([np.interp(fine, at, row) for row in np.eye(count)]),
        shift_sigma=max(prepared.position_sigma, 0.01),
    )


def _pose_at(prepared: Observation, t: Floats) -> tuple[Floats, Floats, Floats]:
    """x, y and yaw of a drive at the times ``t``."""
    path = prepared.trajectory
    return np.interp(t, path.t, path.x), np.interp(t, path.t, path.y), np.interp(t, path.t, path.yaw)


def _follows(prepared: Observation, line: Road, t: Floats) -> NDArray[np.bool_]:
    """Where (n,) at the times ``t`` a drive is on the line and goes its way: it may leave it, or come back on it."""
    x, y, yaw = _pose_at(prepared, t)
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
    on = (u > line.u_first) & (u < line.u_last) & (path.speed > MOVING)
    near = on & (np.abs(v) < _reach(prepared))
    across = float(np.median(v[near if near.any() else on])) if on.any() else math.inf
    if abs(across) > _OTHER_ROAD:
        off = f", but {abs(across):.0f} m off" if on.any() else ""
        raise InputError(prepared.name, f"is nowhere on the road of the other drives{off}")
    if prepared.position_sigma < LANE_SIGMA:
        return prepared, across
    x, y = line.uv_to_xy(u, np.zeros(u.size))
    return replace(prepared, reading=replace(prepared.source, trajectory=replace(path, x=x, y=y))), across


def _tapered(usable: NDArray[np.bool_], rate: float) -> Floats:
    """Weights (n,) that rise over the taper from each edge of the usable samples."""
    weight = np.zeros(usable.size)
    for low, high in runs(usable):
        i = np.arange(high - low)
        near = np.minimum(i, high - low - 1 - i) / (_TAPER * rate)
        weight[low:high] = 0.5 - 0.5 * np.cos(np.pi * np.clip(near, 0.0, 1.0))
    return weight


def banded(z: Floats, step: float, low: float = 0.1, high: float = 1.0) -> Floats:
    """Heights (..., n) m every ``step`` m, waves between ``low`` and ``high`` cycles/m alone."""
    sections = butter(2, [low, min(high, 0.4 / step)], "bandpass", fs=1.0 / step, output="sos")
    return np.asarray(sosfiltfilt(sections, z, axis=-1), dtype=np.float64)


def lags_along(reference: Floats, other: Floats, step: float, reach: float) -> tuple[Floats, Floats, Floats]:
    """Lag of one profile against another along the road.

    Parameters
    ----------
    reference, other : (lines, n) array
        Heights in m every ``step`` m, of the same band; 0 where nothing is known.
    step : float
        m.
    reach : float
        Largest lag looked for in m.

    Returns
    -------
    at, lag, correlation : (k,) array
        Middles of the windows in m from the first height, how many m farther on ``other`` has what ``reference``
        has there, and the correlation at that lag.
    """
    coarse = max(1, round(0.1 / step))
    a, b = (z[:, ::coarse] for z in (reference, other))
    d = step * coarse
    n, most = a.shape[1], round(reach / d)
    window, hop = round(_WINDOW / d), round(_HOP / d)
    lags = np.arange(-most, most + 1)
    padded = np.pad(b, ((0, 0), (most, most)))
    starts = np.arange(0, max(n - window, 0) + 1, hop)
    ends = np.minimum(starts + window, n)
    products = np.array([(a * padded[:, i : i + n]).sum(axis=0) for i in range(lags.size)])
    total = np.concatenate([np.zeros((lags.size, 1)), np.cumsum(products, axis=1)], axis=1)
    power_a, power_b = (np.concatenate([[0.0], np.cumsum((z**2).sum(axis=0))]) for z in (a, padded))
    least = _QUIET * (power_a[-1] / n) * window
    pa = np.maximum(power_a[ends] - power_a[starts], least)[:, None]
    pb = np.maximum(power_b[lags + most + ends[:, None]] - power_b[lags + most + starts[:, None]], least)
    scores = (total[:, ends] - total[:, starts]).T / np.sqrt(pa * pb)
    # Viterbi: the best path of lags whose steps are within the drift.
    allowed = max(1, round(_DRIFT * _HOP / d))
    best, origin = scores[0], np.zeros(scores.shape, dtype=np.int64)
    for k in range(1, starts.size):
        options = np.full((2 * allowed + 1, lags.size), -np.inf)
        for j, move in enumerate(range(-allowed, allowed + 1)):
            low, high = max(0, move), min(lags.size, lags.size + move)
            options[j, low:high] = best[low - move : high - move] - _PRICE * abs(move)
        origin[k] = np.arange(lags.size) - (options.argmax(axis=0) - allowed)
        best = options.max(axis=0) + scores[k]
    path = [int(best.argmax())]
    for row in origin[:0:-1]:
        path.append(row[path[-1]])
    chosen = np.array(path[::-1])
    at: Floats = np.asarray((starts + 0.5 * window) * d, dtype=np.float64)
    return at, np.asarray(lags[chosen] * d, dtype=np.float64), scores[np.arange(starts.size), chosen]
