# SPDX-License-Identifier: Apache-2.0
"""The points of clouds along a line, in road coordinates; and what is wrong where a cloud does not cover the line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from suspension_twin.addons.roads.scan.clouds import Cloud
from suspension_twin.addons.roads.scan.placing import SCAN_UNITS, Placing
from suspension_twin.addons.roads.scan.surface import Points
from suspension_twin.arrays import Floats, runs
from suspension_twin.errors import InputError
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.kernels import xy_to_uv

__all__ = ["Gathered", "gather"]

#: Side of the cells that know the nearest point of the line, m, unless the map of them grows too large.
_RASTER, _LARGEST = 0.5, 4_000_000
#: Points of a cloud that are kept to find out why it does not cover the line.
_SAMPLE = 100_000
#: A metre of the line is covered by so many points within the corridor; the line, by this share of its metres.
_COVERED, _ENOUGH = 5, 0.2
#: Cartesian coordinates as far from the origin as this, m, are of a grid of a country or a zone.
_FAR = 100_000.0
#: A unit is in doubt where the cloud covers so much of the line in the other one too.
_BOTH = 0.95
#: Holes up to this, m, are holes of the road; longer ones end it.
_GAP = 5.0


class _Nearest:
    """The nearest point of a line by a raster; -1 far from it."""

    def __init__(self, line: Centreline, reach: float) -> None:
        x0, y0 = line.x.min() - reach, line.y.min() - reach
        wide, high = line.x.max() + reach - x0, line.y.max() + reach - y0
        self.size = max(_RASTER, float(np.sqrt(wide * high / _LARGEST)))
        self.x0, self.y0 = float(x0), float(y0)
        self.shape = int(wide / self.size) + 1, int(high / self.size) + 1
        x, y = (o + self.size * (np.arange(n) + 0.5) for o, n in zip((x0, y0), self.shape, strict=True))
        cells = np.column_stack([c.ravel() for c in np.meshgrid(x, y, indexing="ij")])
        tree = cKDTree(np.column_stack([line.x, line.y]))
        distance, index = tree.query(cells, distance_upper_bound=reach + self.size)
        self.index = np.where(np.isfinite(distance), index, -1)

    def __call__(self, x: Floats, y: Floats) -> NDArray[np.int64]:
        i, j = np.floor((x - self.x0) / self.size), np.floor((y - self.y0) / self.size)
        inside = (i >= 0) & (i < self.shape[0]) & (j >= 0) & (j < self.shape[1])
        flat = np.where(inside, i * self.shape[1] + j, 0).astype(np.int64)
        return np.where(inside, self.index[flat], -1)


@dataclass(frozen=True, eq=False)
class Gathered:
    """``points`` with z m above ``level`` m, how many were ``read``, and a ``note`` where the unit is in doubt."""

    points: Points
    level: float
    read: int
    note: str | None


def gather(
    clouds: Sequence[tuple[Cloud, Placing]],
    line: Centreline,
    half: float,
    path_name: str,
    progress: Callable[[str, float | None], None],
) -> Gathered:
    """Ground or not, all points within ``half`` m of a line, sorted along it.

    Raises InputError where the clouds do not cover the line.
    """
    reach = half + 0.5
    nearest = _Nearest(line, reach)
    flat = road_over(line, np.zeros((line.x.size, 2)), np.array([-half, half]), path_name)
    parts: list[tuple[NDArray[np.float32], ...]] = []
    samples: list[Floats] = []
    level, read = np.nan, 0
    total = sum(c.count or 0 for c, _ in clouds) if all(c.count for c, _ in clouds) else None
    for cloud, placing in clouds:
        box = placing.box(line.x, line.y, reach)
        stride = max(1, (cloud.count or 10 * _SAMPLE) // _SAMPLE)
        for piece in cloud.pieces():
            read += piece.shape[0]
            share = None if total is None else min(1.0, read / total)
            progress(f"reading {cloud.path.name}: {read / 1e6:.1f} million points", share)
            samples.append(piece[::stride])
            points = placing.to_map(placing.within(piece, box))
            at = nearest(points[:, 0], points[:, 1])
            near = at >= 0
            points, at = np.ascontiguousarray(points[near]), np.ascontiguousarray(at[near])
            if not at.size:
                continue
            u, v = np.empty(at.size), np.empty(at.size)
            x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
            xy_to_uv(flat.line, at, x, y, u, v)
            keep = (np.abs(v) <= half) & (u >= 0.0) & (u <= line.length)
            if np.isnan(level) and keep.any():
                level = float(np.median(points[keep, 2]))
            parts.append(tuple(c[keep].astype(np.float32) for c in (u, v, points[:, 2] - level)))
    along, across, high = (
        np.concatenate([p[k] for p in parts] or [np.zeros(0, dtype=np.float32)]) for k in range(3)
    )
    parts.clear()
    metres = np.bincount(along.astype(np.int64), minlength=int(np.ceil(line.length)) + 1)[
        : int(np.ceil(line.length))
    ]
    covered = metres >= _COVERED
    if covered.mean() < _ENOUGH:
        raise InputError(clouds[0][0].path, _why(clouds, samples, line, half, path_name))
    _check_ends(covered, line, path_name)
    order = np.argsort(along, kind="stable")
    note = _doubt(clouds, samples, line, half)
    return Gathered(Points(along[order], across[order], high[order]), level, read, note)


def _check_ends(covered: NDArray[np.bool_], line: Centreline, path_name: str) -> None:
    """A path may leave the cloud for a few metres, which are a hole, and not for more."""
    gaps = [(a, b) for a, b in runs(~covered) if b - a > _GAP or a == 0 or b == covered.size]
    gaps = [(a, b) for a, b in gaps if b - a > 1]
    if not gaps:
        return
    edges = [0, *[e for gap in gaps for e in gap], covered.size]
    low, high = max(zip(edges[::2], edges[1::2], strict=True), key=lambda r: r[1] - r[0])
    high = min(high, int(line.length))
    raise InputError(
        path_name,
        f"leaves the cloud at {gaps[0][0]} m of its {line.length:.0f} m: --section {low} {high} takes what lies within",
    )


class _Share:
    """The share of a line with points within ``half`` m."""

    def __init__(self, line: Centreline, half: float) -> None:
        every = max(1, round(0.5 / line.step))
        self._tree = cKDTree(np.column_stack([line.x[::every], line.y[::every]]))
        self._half = half

    def __call__(self, points: Floats) -> float:
        near, index = (
            np.asarray(c) for c in self._tree.query(points[:, :2], distance_upper_bound=self._half)
        )
        on = np.isfinite(near)
        if not on.any():
            return 0.0
        hits = np.bincount(index[on], minlength=self._tree.n)
        return float((hits > 0).mean())


def _doubt(
    clouds: Sequence[tuple[Cloud, Placing]], samples: list[Floats], line: Centreline, half: float
) -> str | None:
    """A cloud near the origin of its coordinates may cover a line in metres and in feet."""
    cloud, placing = clouds[0]
    if placing.crs is not None or placing.unit != 1.0:
        return None
    feet = placing.altered(unit=SCAN_UNITS["ft"], up=SCAN_UNITS["ft"])
    if _Share(line, half)(feet.to_map(np.concatenate(samples))) < _BOTH:
        return None
    return f"{cloud.path.name} is taken for metres, but covers the path in feet too: --unit ft if that is its unit"


def _why(
    clouds: Sequence[tuple[Cloud, Placing]],
    samples: list[Floats],
    line: Centreline,
    half: float,
    path_name: str,
) -> str:
    """Why a cloud does not cover the line, in words: another unit, other axes, another place."""
    placing = clouds[0][1]
    raw = np.concatenate(samples)
    share = _Share(line, half)
    tries: list[tuple[float, str]] = []
    for unit, factor in SCAN_UNITS.items():
        if placing.crs is None and factor != placing.unit and unit != "us-ft":  # two millionths from the foot
            tries.append(
                (share(placing.altered(unit=factor, up=factor).to_map(raw)), f"in {unit}: --unit {unit}")
            )
    for order in permutations(range(3)):
        axes = tuple((k, 1.0) for k in order)
        up_is_y = order == (0, 2, 1)
        if up_is_y:
            axes = ((0, 1.0), (2, -1.0), (1, 1.0))
        if axes != placing.axes:
            name = "".join(("-" if s < 0 else "") + "xyz"[k] for k, s in axes)
            tries.append((share(placing.altered(axes=axes).to_map(raw)), f"with other axes: --axes {name}"))
    best, words = max(tries, default=(0.0, ""))
    if best > 0.6:
        return f"does not cover {path_name} as it is, but does if it is {words}"
    points = placing.to_map(raw)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    gap = np.hypot(
        *np.maximum(0.0, np.maximum(low - [line.x.max(), line.y.max()], [line.x.min(), line.y.min()] - high))
    )
    hint = (
        ", as coordinates of a national grid are: --crs names it"
        if placing.crs is None and gap > _FAR
        else ""
    )
    return (
        f"is of another place than {path_name}: it lies at x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} to "
        f"{high[1]:.0f} m of map, the path at x {line.x.min():.0f} to {line.x.max():.0f} m, y {line.y.min():.0f} to "
        f"{line.y.max():.0f} m, {gap:.0f} m off{hint}"
    )
