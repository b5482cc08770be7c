# SPDX-License-Identifier: Apache-2.0
"""Simulated laser scanners over a road of known heights: independent of the package's own way from points to a road.

The ground is a raster of heights; rays are followed over it step by step, so that bumps and cars hide what lies
behind them. A footprint is two rays, half its divergence above and below the middle one: their mean range is what is
measured, which makes mixed points at edges; beyond 0.4 m of difference the first one counts.

- ``terrestrial``: tripods beside the road, a full turn each; cars pass while it turns, a person stands there for one
  of the stations, grass and a kerb beside the lane, wet patches without a return.
- ``mobile``: a profiler on a car that drives along the path; one car comes towards it, one overtakes, a person
  stands in the lane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["Ground", "Scan", "mobile", "terrestrial"]

Floats = NDArray[np.float64]
_SKIP = 25  # raster cells of a block of which the highest point is kept
_PULSE = 0.4  # m: surfaces nearer to each other than this are one return


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights ``z`` (nx, ny) m every ``step`` m from ``x0``, ``y0``; the lane runs along x.

    ``grass`` and ``wet`` (nx, ny): where blades stand, and where nothing comes back.
    """

    z: Floats
    step: float
    x0: float
    y0: float
    grass: NDArray[np.bool_]
    wet: NDArray[np.bool_]

    @property
    def x_end(self) -> float:
        """Last x in m."""
        return float(self.x0 + self.step * (self.z.shape[0] - 1))

    def blocks(self) -> Floats:
        """The highest height of every block and its neighbours."""
        nx, ny = (math.ceil(n / _SKIP) for n in self.z.shape)
        padded = np.full((nx * _SKIP, ny * _SKIP), -np.inf)
        padded[: self.z.shape[0], : self.z.shape[1]] = self.z
        top = padded.reshape(nx, _SKIP, ny, _SKIP).max(axis=(1, 3))
        wide = np.pad(top, 1, mode="edge")
        return np.asarray(np.max([wide[i : i + nx, j : j + ny] for i in range(3) for j in range(3)], axis=0))


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (n, 3) m; ``kind`` (n,) of what each lies on: 1 ground, 2 a thing, 3 grass; ``steep`` (n,), the sine of
    the ray's elevation: the share of an error of the range that is an error of the height."""

    points: Floats
    kind: NDArray[np.int8]
    steep: Floats


# Things: rows of kind, x, y at time 0, speed along x, and sizes. Kind 0: a box x ± a, y ± b, z from c to d.
# Kind 1: an upright cylinder of radius a, z from c to d. Kind 2: a wheel of radius a and width 2 b, on the ground.
_WIDTH = 9  # kind, x, y, speed, a, b, c, d, and the times between which it is there: from, to


def _car(x: float, y: float, speed: float) -> list[list[float]]:
    always = [-1e9, 1e9]
    rows = [
        [0, x, y, speed, 2.2, 0.9, 0.2, 0.85, *always],
        [0, x - 0.2, y, speed, 1.2, 0.8, 0.85, 1.45, *always],
    ]
    rows += [
        [2, x + dx, y + dy, speed, 0.31, 0.1, 0.0, 0.62, *always]
        for dx in (-1.35, 1.35)
        for dy in (-0.75, 0.75)
    ]
    return rows


def _person(x: float, y: float, start: float, end: float) -> list[list[float]]:
    rows = [[1, x, y + dy, 0.0, 0.08, 0.0, 0.08, 0.85, start, end] for dy in (-0.12, 0.12)]
    rows += [[0, x + 0.05, y + dy, 0.0, 0.15, 0.05, 0.0, 0.1, start, end] for dy in (-0.12, 0.12)]
    return [*rows, [1, x, y, 0.0, 0.22, 0.0, 0.85, 1.75, start, end]]


@njit(cache=True, nogil=True)
def _height(z: Floats, x0: float, y0: float, step: float, x: float, y: float) -> float:
    fx, fy = (x - x0) / step, (y - y0) / step
    i, j = int(fx), int(fy)
    a, b = fx - i, fy - j
    low = z[i, j] + b * (z[i, j + 1] - z[i, j])
    high = z[i + 1, j] + b * (z[i + 1, j + 1] - z[i + 1, j])
    return float(low + a * (high - low))


@njit(cache=True, nogil=True)
def _ground_hit(z, top, highest, x0, y0, step, ox, oy, oz, dx, dy, dz, far):  # type: ignore[no-untyped-def]
    """Range at which a ray meets the raster; infinite where it does not."""
    nx, ny = z.shape
    level = math.sqrt(dx * dx + dy * dy)
    stride = step / max(level, 1e-6)
    if level < 0.05:
        stride = 0.3 * step / 0.05
    block = _SKIP * step
    t = 0.0
    if dz < 0.0 and oz > highest:
        t = (oz - highest) / -dz
    while t < far:
        x, y, h = ox + t * dx, oy + t * dy, oz + t * dz
        if not (x0 < x < x0 + (nx - 2) * step and y0 < y < y0 + (ny - 2) * step):
            if (x <= x0 and dx <= 0) or (x >= x0 + (nx - 2) * step and dx >= 0):
                return math.inf
            if (y <= y0 and dy <= 0) or (y >= y0 + (ny - 2) * step and dy >= 0):
                return math.inf
            t += 10.0 * stride
            continue
        # Nothing in this block or beside it reaches the ray within a block's length.
        ahead = block / max(level, 0.2)
        if h + ahead * min(dz, 0.0) > top[int((x - x0) / block), int((y - y0) / block)]:
            t += ahead
            continue
        if h <= _height(z, x0, y0, step, x, y):
            low, high = max(t - stride, 0.0), t
            for _ in range(16):
                middle = 0.5 * (low + high)
                if oz + middle * dz <= _height(z, x0, y0, step, ox + middle * dx, oy + middle * dy):
                    high = middle
                else:
                    low = middle
            return 0.5 * (low + high)
        t += stride
    return math.inf


@njit(cache=True, nogil=True)
def _thing_hit(things, z, x0, y0, step, time, ox, oy, oz, dx, dy, dz, reach):  # type: ignore[no-untyped-def]
    """Range at which a ray meets the first thing nearer than ``reach``."""
    for k in range(things.shape[0]):
        row = things[k]
        if not row[8] <= time < row[9]:
            continue
        cx, cy, a, b = row[1] + row[3] * time, row[2], row[4], row[5]
        if cx < x0 + 1.0 or cx > x0 + (z.shape[0] - 3) * step - 1.0:
            continue
        # Far from the ray's line: no need to look closer.
        side = max(a, b) + 0.1
        level2 = dx * dx + dy * dy
        near = ((cx - ox) * dx + (cy - oy) * dy) / max(level2, 1e-9)
        ex, ey = ox + near * dx - cx, oy + near * dy - cy
        if ex * ex + ey * ey > 2.0 * side * side or near < -side:
            continue
        ground = _height(z, x0, y0, step, cx, cy)
        low, high = ground + row[6], ground + row[7]
        if row[0] == 1.0:
            c0 = (ox - cx) ** 2 + (oy - cy) ** 2 - a * a
            c1 = (ox - cx) * dx + (oy - cy) * dy
            disc = c1 * c1 - level2 * c0
            if disc > 0.0:
                t = (-c1 - math.sqrt(disc)) / level2
                if 0.0 < t < reach and low <= oz + t * dz <= high:
                    reach = t
            if dz < 0.0:
                t = (high - oz) / dz
                if 0.0 < t < reach and (ox + t * dx - cx) ** 2 + (oy + t * dy - cy) ** 2 < a * a:
                    reach = t
        elif row[0] == 0.0:
            t0, t1 = 0.0, reach
            for axis in range(3):
                o, d = (ox, dx) if axis == 0 else ((oy, dy) if axis == 1 else (oz, dz))
                lo = cx - a if axis == 0 else (cy - b if axis == 1 else low)
                hi = cx + a if axis == 0 else (cy + b if axis == 1 else high)
                if abs(d) < 1e-12:
                    if o < lo or o > hi:
                        t1 = -1.0
                    continue
                u, w = (lo - o) / d, (hi - o) / d
                t0, t1 = max(t0, min(u, w)), min(t1, max(u, w))
            if 0.0 < t0 < t1:
                reach = t0
        else:
            hub = ground + a
            q = dx * dx + dz * dz
            c1 = (ox - cx) * dx + (oz - hub) * dz
            disc = c1 * c1 - q * ((ox - cx) ** 2 + (oz - hub) ** 2 - a * a)
            if disc > 0.0 and q > 1e-12:
                t = (-c1 - math.sqrt(disc)) / q
                if 0.0 < t < reach and abs(oy + t * dy - cy) < b:
                    reach = t
            if abs(dy) > 1e-9:
                t = (cy - math.copysign(b, dy) - oy) / dy
                if 0.0 < t < reach and (ox + t * dx - cx) ** 2 + (oz + t * dz - hub) ** 2 < a * a:
                    reach = t
    return reach


@njit(cache=True, nogil=True)
def _cast(z, top, x0, y0, step, grass, wet, things, o, d, time, half, far, noise, rng):  # type: ignore[no-untyped-def]
    """Ranges (n,) of rays from ``o`` (n, 3) along ``d`` (n, 3) at ``time`` (n,), and what each met.

    0 nothing, 1 ground, 2 a thing, 3 grass. ``half`` the half divergence in rad.
    """
    n = d.shape[0]
    highest = top.max()
    out = np.zeros(n)
    both = np.zeros(2)
    kind = np.zeros(n, dtype=np.int8)
    for i in range(n):
        dx, dy, dz = d[i]
        level = math.sqrt(dx * dx + dy * dy)
        is_thing = False
        for k in range(2):
            turn = half * (2 * k - 1)
            # Turned in the upright plane of the ray.
            c, s = math.cos(turn), math.sin(turn)
            new = level * c - dz * s
            f = new / max(level, 1e-9)
            ex, ey, ez = dx * f, dy * f, dz * c + level * s
            t = _ground_hit(z, top, highest, x0, y0, step, o[i, 0], o[i, 1], o[i, 2], ex, ey, ez, far)
            hit = _thing_hit(
                things, z, x0, y0, step, time[i], o[i, 0], o[i, 1], o[i, 2], ex, ey, ez, min(t, far)
            )
            if hit < min(t, far):
                t = hit
                is_thing = True
            both[k] = t
        first = min(both[0], both[1])
        if not first < far:
            continue
        t = 0.5 * (both[0] + both[1]) if abs(both[0] - both[1]) < _PULSE else first
        x, y = o[i, 0] + t * dx, o[i, 1] + t * dy
        a, b = int((x - x0) / step), int((y - y0) / step)
        if not (0 <= a < z.shape[0] and 0 <= b < z.shape[1]):
            continue
        kind[i] = 2 if is_thing else 1
        if not is_thing and wet[a, b]:
            kind[i] = 0
            continue
        if not is_thing and grass[a, b]:
            # A blade stands in the way somewhere above the ground.
            t -= min(rng.exponential(0.04), 0.25) / max(-dz, 0.1)
            kind[i] = 3
        out[i] = t + noise * rng.standard_normal()
    return out, kind


def _gathered(
    ground: Ground, things: list[list[float]], o: Floats, d: Floats, time: Floats, divergence: float, far: float,
    noise: float, rng: np.random.Generator,
) -> Scan:  # fmt: skip
    rows = np.array(things, dtype=np.float64).reshape(-1, 10)
    t, kind = _cast(
        ground.z, ground.blocks(), ground.x0, ground.y0, ground.step, ground.grass, ground.wet, rows,
        np.ascontiguousarray(o), np.ascontiguousarray(d), time, 0.5 * divergence, far, noise, rng,
    )  # fmt: skip
    seen = kind > 0
    return Scan(o[seen] + t[seen, None] * d[seen], kind[seen], np.abs(d[seen, 2]))


def terrestrial(
    ground: Ground, seed: int, *, noise: float = 0.003, step: float = 1.4e-3, every: float = 18.0, beside: float = 4.6,
    height: float = 1.9, reach: float = 30.0, divergence: float = 3e-4,
) -> Scan:  # fmt: skip
    """Tripods on alternate sides, ``every`` m; rays ``step`` rad apart, range noise ``noise`` m."""
    rng = np.random.default_rng([seed, 1])
    begin, end = ground.x0 + 4.0, ground.x_end - 4.0
    count = max(2, round((end - begin) / every) + 1)
    turn = 120.0  # s of a full turn
    parts = []
    for k, x in enumerate(np.linspace(begin, end, count)):
        y = beside if k % 2 else -beside
        floor = ground.z[int((x - ground.x0) / ground.step), int((y - ground.y0) / ground.step)]
        origin = np.array([x, y, floor + height])
        azimuth = np.arange(0.0, 2.0 * np.pi, step)
        elevation = np.arange(math.atan(0.8 * height / reach), 1.2, step)
        # Two cars pass while the instrument turns towards the lane.
        things = []
        for j in (0, 1):
            speed = rng.uniform(6.0, 11.0) * (1 if j == 0 else -1)
            moment = turn * rng.uniform(0.1, 0.9)
            things += _car(x - speed * moment + rng.uniform(-6, 6), 0.2 if j == 0 else 2.4, speed)
        if k == 1:
            things += _person(x + 3.0, 0.75 * (1 if y < 0 else -1), 0.0, turn)
        for block in np.array_split(azimuth, 16):
            a, e = np.meshgrid(block, elevation, indexing="ij")
            d = np.column_stack(
                [(np.cos(e) * np.cos(a)).ravel(), (np.cos(e) * np.sin(a)).ravel(), -np.sin(e).ravel()]
            )
            time = np.repeat(turn * block / (2.0 * np.pi), elevation.size)
            # Only what falls near the lane is worth following.
            foot = origin[:2] + d[:, :2] * (height / -d[:, 2])[:, None]
            near = (np.abs(foot[:, 1]) < 7.0) & (np.hypot(*(foot - origin[:2]).T) < reach)
            d, time = d[near], time[near]
            o = np.broadcast_to(origin, d.shape)
            parts.append(_gathered(ground, things, o, d, time, divergence, 2.0 * reach, noise, rng))
    return _together(parts)


def mobile(
    ground: Ground, seed: int, *, noise: float = 0.004, speed: float = 9.0, lines: float = 200.0, step: float = 2e-3,
    height: float = 2.2, yaw: float = 30.0, divergence: float = 5e-4,
) -> Scan:  # fmt: skip
    """A profiler on a car at ``speed`` m/s, ``lines`` a second; its plane is turned by ``yaw`` deg from across."""
    rng = np.random.default_rng([seed, 2])
    begin, end = ground.x0 + 1.0, ground.x_end - 1.0
    count = int((end - begin) / speed * lines)
    time = np.arange(count) / lines
    things = _car(end + 5.0, 2.6, -11.0) + _car(begin - 10.0, 2.4, speed + 3.0)
    things += _person(0.5 * (begin + end) + 3.0, -0.8, -1e9, 1e9)
    angle = np.arange(-1.25, 1.25, step)  # from straight down
    across = np.array([-math.sin(math.radians(yaw)), math.cos(math.radians(yaw)), 0.0])
    fan = np.sin(angle)[:, None] * across + np.cos(angle)[:, None] * np.array([0.0, 0.0, -1.0])
    x = begin + speed * time
    floor = np.interp(x, ground.x0 + ground.step * np.arange(ground.z.shape[0]),
                      ground.z[:, int(-ground.y0 / ground.step)])  # fmt: skip
    # The trajectory is known; the car's body floats over the road's short waves.
    floor = np.convolve(np.pad(floor, 200, mode="edge"), np.ones(401) / 401, mode="same")[200:-200]
    parts = []
    for block in np.array_split(np.arange(count), max(1, count // 400)):
        o = np.repeat(
            np.column_stack([x[block], np.zeros(block.size), floor[block] + height]), angle.size, axis=0
        )
        d = np.tile(fan, (block.size, 1))
        t = np.repeat(time[block], angle.size)
        parts.append(_gathered(ground, things, o, d, t, divergence, 12.0, noise, rng))
    return _together(parts)


def _together(parts: list[Scan]) -> Scan:
    return Scan(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("points", "kind", "steep")))
