# SPDX-License-Identifier: Apache-2.0
"""The ground among the points of a scan: without cars, people, plants and branches over the road.

1. In every cell of some decimetres the lowest layer that enough points lie in.
2. An object on the ground is higher than an opening of these heights (the lowest within a window, then the highest of
   those) with windows from a foot's length to a car's (Zhang et al., IEEE Trans. Geosci. Remote Sens. 41 (2003) 872),
   and has steep sides.
3. Where many points lie above the layer, an object stood. Without a gap above the layer it is a part of the object,
   such as a leg. Cells around it have to agree with an interpolation between cells farther off: the tread of a tyre
   and the sole of a shoe do not.
4. Points near the heights of their cell and its neighbours are ground; a wall of a pothole lies between those.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array

from suspension_twin.addons.roads.scan.surface import Points
from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError

__all__ = ["Cells", "ground_cells", "ground_points"]

#: m. Sides of cells that are tried: the first with enough points in most of them. Narrower than an obstacle, whose top
#: would lie above the ground of all cells around it otherwise.
_SIZES = (0.1, 0.2, 0.3, 0.5)
_WANTED, _LEAST, _MOST = 8, 3, 0.8
#: A layer's share of a cell's points at least: less are reflections from below.
_SHARE, _LAYER = 0.03, 0.03
#: Length of a window in m, and how far above the opening a cell may be, m. Speed humps are up to 0.15 m high.
_OPENINGS = ((0.6, 0.12), (1.2, 0.16), (2.4, 0.2), (6.5, 0.25))
#: m by which an object rises from the ground around it.
_SIDE = 0.1
#: More than this share of a cell's points above its layer, up to a person's height: an object stood there.
_STANDING, _PERSON = 0.15, 2.2
#: Under an object, ground has more points than the layer right above it; a leg has not.
_CONTINUED = 0.5
#: Cells nearer to an object than this, m, have to agree with those around within so many m.
_NEAR, _AGREE = 0.45, 0.02
#: Beyond the heights of a cell and its neighbours, m.
_MARGIN = 0.03
#: Ground is smooth: the median step between neighbouring cells of plants and roofs is larger than this, m.
_ROUGH = 0.06
#: Share of the cells that hold points at least.
_PRESENT = 0.25


@dataclass(frozen=True, eq=False)
class Cells:
    """Square cells along a road, and the ground in them.

    Parameters
    ----------
    size, v0 : float
        m of a side, and m across at which they begin.
    z : (nu, nv) array
        Heights of the ground in m; NaN where there is none.
    rise : (nu, nv) array
        m by which the ground goes up within a cell.
    objects : (nu, nv) array of bool
        Left out because an object stood on them.
    """

    size: float
    v0: float
    z: Floats
    rise: Floats
    objects: NDArray[np.bool_]


def ground_cells(points: Points, length: float, half: float, name: str) -> Cells:
    """The ground in cells over ``length`` m by ``half`` m to both sides; raises InputError where there is none."""
    size = _cell_size(points, half)
    shape = math.ceil(length / size), math.ceil(2.0 * half / size)
    which, count = _cell_of(points, size, -half, shape), shape[0] * shape[1]
    # The points of each cell in their order, as the rows of a sparse matrix.
    flags = np.ones(which.size, dtype=np.bool_)
    by_cell = coo_array((flags, (which, np.arange(which.size))), shape=(count, which.size)).tocsr()
    first, order = by_cell.indptr.astype(np.int32), by_cell.indices.astype(np.int32)
    low, above, next_layer, rise = layers = np.empty((4, *shape))
    _lowest_surface(
        points.z, first, order, _LEAST, _SHARE, _LAYER, _PERSON, _OPENINGS[0][1], *layers.reshape(4, -1)
    )
    standing = above > _STANDING
    if np.isfinite(low).mean() < _PRESENT:
        raise InputError(
            name,
            f"has ground in {100 * np.isfinite(low).mean():.0f} % of the road's width alone: too narrow a scan "
            "(--width), or up is another axis (--axes)",
        )
    _check_smooth(low, name)
    flat, trend = _without_trend(low, size)
    objects = standing & (next_layer > _CONTINUED)
    for window, allowed in _OPENINGS:
        width = max(3, round(window / size) | 1)
        with np.errstate(invalid="ignore"):
            high = (
                flat - _extreme(_extreme(np.where(objects, np.nan, flat), np.inf, width), -np.inf, width)
                > allowed
            )
        objects |= _steep_sided(flat, objects, high & ~objects)
    kept = np.where(objects, np.nan, flat)
    stood = objects | standing
    near = np.isfinite(kept) & stood.any() & (ndimage.distance_transform_edt(~stood) <= _NEAR / size)
    if near.any() and np.isfinite(np.where(near, np.nan, kept)).any():
        expected = _filled(np.where(near, np.nan, kept))
        wrong = near & (np.abs(kept - expected) > _AGREE)
        objects |= wrong
        kept = np.where(wrong, np.nan, kept)
    # Beside an object points that go up without a gap are a part of it, such as a shoe.
    return Cells(size, -half, kept + trend[:, None], np.where(near, 0.0, rise), objects)


def _cell_of(points: Points, size: float, v0: float, shape: tuple[int, int]) -> NDArray[np.int32]:
    """Number (n,) of the cell of each point, row by row along the road."""
    i, j = (
        np.clip(((c.astype(np.float64) - start) / size).astype(np.int32), 0, n - 1)
        for c, start, n in ((points.u, 0.0, shape[0]), (points.v, v0, shape[1]))
    )
    return np.asarray(i * shape[1] + j)


def _cell_size(points: Points, half: float) -> float:
    """The smallest size at which most cells hold enough points, by the density in cells of the largest size."""
    coarse = _SIZES[-1]
    nv = math.ceil(2.0 * half / coarse)
    at = (points.u / coarse).astype(np.int64) * nv + ((points.v + half) / coarse).astype(np.int64)
    counts = np.bincount(at)
    counts = counts[counts > 0]
    if not counts.size:
        return coarse
    density = float(np.quantile(counts, 1.0 - _MOST)) / coarse**2
    return next((s for s in _SIZES if density * s * s >= _WANTED), coarse)


def ground_points(points: Points, cells: Cells) -> Points:
    """The points near the ground of their cells."""
    low = _extreme(cells.z, np.inf, 3) - _MARGIN
    high = _extreme(cells.z + cells.rise, -np.inf, 3) + _MARGIN
    # A cell under an object has no ground of its own.
    low, high = (np.where(cells.objects, np.nan, bound).ravel() for bound in (low, high))
    which = _cell_of(points, cells.size, cells.v0, (cells.z.shape[0], cells.z.shape[1]))
    return points[(low[which] <= points.z) & (points.z <= high[which])]


def _extreme(z: Floats, missing: float, width: int) -> Floats:
    """Lowest (``missing`` is inf) or highest (-inf) of the known heights within ``width`` cells."""
    choose = ndimage.minimum_filter if missing > 0.0 else ndimage.maximum_filter
    return np.asarray(choose(np.where(np.isfinite(z), z, missing), width, mode="nearest"))


def _check_smooth(low: Floats, name: str) -> None:
    steps = np.concatenate([np.abs(np.diff(low, axis=k)).ravel() for k in (0, 1)])
    steps = steps[np.isfinite(steps)]
    if not steps.size:
        raise InputError(
            name, "has too few points along the path for a ground: fewer than 3 in a cell of 0.5 m"
        )
    if np.median(steps) > _ROUGH:
        raise InputError(
            name,
            "has no ground along the path: its lowest points differ by "
            f"{np.median(steps):.2f} m from one cell to the next (filtered away, or up is another axis: --axes)",
        )


def _without_trend(low: Floats, size: float) -> tuple[Floats, Floats]:
    """Heights over the running median of the cross sections, and that median (nu,): an opening wants level ground."""
    filled = _filled(low)
    row = np.median(filled, axis=1)
    window = max(3, round(15.0 / size) | 1)
    reach = min(window // 2, row.size - 1)
    # Straight on at both ends, by point reflection.
    padded = np.concatenate([2 * row[0] - row[reach:0:-1], row, 2 * row[-1] - row[-2 : -2 - reach : -1]])
    middle = ndimage.median_filter(padded, window, mode="nearest")[reach : reach + row.size]
    trend: Floats = ndimage.uniform_filter1d(middle, max(3, window // 3), mode="nearest")
    return low - trend[:, None], trend


def _steep_sided(flat: Floats, objects: NDArray[np.bool_], high: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """High cells, in connected pieces, that jump up from the cells around them: a hill does not."""
    around = np.where(objects | high, np.nan, flat)
    if not high.any() or not np.isfinite(around).any():
        return high
    jump = flat - _filled(around)
    # Beside ground that was seen; a piece with none beside it is taken for an object.
    border = high & ndimage.binary_dilation(np.isfinite(around), np.ones((3, 3), dtype=np.bool_))
    labels, number = ndimage.label(high, structure=np.ones((3, 3)))
    each = np.arange(1, number + 1)
    sides = ndimage.sum_labels(border, labels, each)
    jumps = ndimage.median(np.where(border, jump, 0.0), np.where(border, labels, 0), each)
    found = (np.asarray(jumps) > _SIDE) | (np.asarray(sides) == 0)
    steep: NDArray[np.bool_] = np.concatenate([[False], found])[labels]
    return steep


def _filled(z: Floats) -> Floats:
    """Heights with missing ones interpolated by normalised convolutions, ever wider."""
    out = np.array(z)
    known = np.isfinite(z)
    if not known.any():
        return np.zeros_like(z)
    held, weight = np.where(known, z, 0.0), known.astype(np.float64)
    sigma = 1.0
    while np.isnan(out).any():
        w = ndimage.gaussian_filter(weight, sigma, mode="nearest")
        mean = ndimage.gaussian_filter(held, sigma, mode="nearest") / np.maximum(w, 1e-300)
        out = np.where(np.isnan(out) & (w > 0.02), mean, out)
        sigma *= 2.0
        if sigma > 4.0 * max(z.shape):
            out = np.where(np.isnan(out), float(np.median(z[known])), out)
    return out


@compiled
def _lowest_surface(
    z: NDArray[np.float32], first: NDArray[np.int32], order: NDArray[np.int32],
    least: int, share: float, layer: float, high: float, obstacle: float,
    out: Floats, above: Floats, next_layer: Floats, rise: Floats,
) -> None:  # fmt: skip
    """Of each cell the height ``out`` of the lowest layer of points, and the share ``above`` it up to ``high`` m.

    A layer is ``layer`` m thick and holds ``least`` points and ``share`` of the cell's at least; NaN without one.
    ``next_layer``: points within two layers above it for each one within a layer of its middle. Where there are points
    enough and no layer, all of them stand. ``rise``: how far, m, points go on upwards from it without a gap of a
    layer's thickness, to the top of a kerb or an obstacle; 0 where they go on beyond ``obstacle`` m.
    """
    out[:] = np.nan
    above[:] = next_layer[:] = rise[:] = 0.0
    for k in range(out.size):
        n = first[k + 1] - first[k]
        need = max(least, int(share * n))
        if n < need:
            continue
        h = np.sort(z[order[first[k] : first[k + 1]]])
        begin = -1
        for i in range(n - need + 1):
            if h[i + need - 1] - h[i] <= layer:
                begin = i
                break
        if begin < 0:
            above[k] = 1.0
            next_layer[k] = np.inf
            continue
        # Its middle: the layer starts in the tail of the surface's own spread.
        level = float(h[begin + need // 2])
        for _ in range(3):
            low = np.searchsorted(h, level - layer)
            top = np.searchsorted(h, level + layer)
            level = float(h[(low + top) // 2])
        out[k] = level
        count = 0
        for i in range(n):
            if 0.1 < h[i] - level < high:
                count += 1
        above[k] = count / n
        low = np.searchsorted(h, level - layer)
        top = np.searchsorted(h, level + layer)
        over = np.searchsorted(h, level + 3.0 * layer)
        next_layer[k] = float(over - top) / float(top - low)
        while top < n and h[top] - h[top - 1] <= layer:
            top += 1
        reach = float(h[top - 1]) - level
        rise[k] = reach if reach <= obstacle else 0.0
