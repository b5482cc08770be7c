# SPDX-License-Identifier: Apache-2.0
"""The ground among the points of a scan: without cars, people, plants and what hangs over the road.

1. In every cell of some decimetres the lowest layer that enough points lie in.
2. What stands on the ground is higher than an opening of these heights (the lowest within a window, then the
   highest of those) with windows from a foot's length to a car's (Zhang et al., IEEE Trans. Geosci. Remote Sens. 41
   (2003) 872), and has steep sides.
3. Where many points lie above the layer, something stood. Without a gap above the layer it is a part of that thing,
   such as a leg. About all these cells heights must agree with what the cells around them let expect: the tread of a
   tyre and the sole of a shoe do not.
4. Points near the heights of their cell and its neighbours are ground; a wall of a pothole lies between those.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from suspension_twin.addons.roads.scan.kernels import by_cell, in_band, lowest_surface
from suspension_twin.addons.roads.scan.surface import Points
from suspension_twin.arrays import Floats
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
#: m by which a thing jumps up from what is around it.
_SIDE = 0.1
#: More than this share of a cell's points above its layer, up to a person's height: something stood there.
_STANDING, _PERSON = 0.15, 2.2
#: Where something stood, ground is denser than what is right above it; a leg is not.
_CONTINUED = 0.5
#: Cells nearer to such a thing than this, m, have to agree with those around within so many m.
_NEAR, _AGREE = 0.45, 0.02
#: Beyond the heights of a cell and its neighbours, m.
_MARGIN = 0.03
#: Ground is smooth: the median step between neighbouring cells of plants and roofs is larger than this, m.
_ROUGH = 0.06
#: Share of the cells that hold points at least.
_PRESENT = 0.25


@dataclass(frozen=True, eq=False)
class Cells:
    """Heights ``z`` (nu, nv) m of the ground in square cells of ``size`` m from v = ``v0`` on; NaN where there is none.

    ``rise`` (nu, nv) m: how far the ground goes up within a cell. ``things`` (nu, nv): cells left out because something
    stood on them.
    """

    size: float
    v0: float
    z: Floats
    rise: Floats
    things: NDArray[np.bool_]


def ground_cells(points: Points, length: float, half: float, name: str) -> Cells:
    """The ground in cells over ``length`` m by ``half`` m to both sides; raises InputError where there is none."""
    u, v, z = points.u, points.v, points.z
    size = _cell_size(points, length, half)
    nu, nv = math.ceil(length / size), math.ceil(2.0 * half / size)
    first = np.zeros(nu * nv + 1, dtype=np.int32)
    order = np.empty(u.size, dtype=np.int32)
    by_cell(u, v, size, -half, nu, nv, first, order)
    level, above, next_layer, rise = np.empty((4, nu * nv))
    lowest_surface(
        z, first, order, _LEAST, _SHARE, _LAYER, _PERSON, _OPENINGS[0][1], level, above, next_layer, rise
    )
    low, standing = level.reshape(nu, nv), above.reshape(nu, nv) > _STANDING
    if np.isfinite(low).mean() < _PRESENT:
        raise InputError(
            name,
            f"has ground in {100 * np.isfinite(low).mean():.0f} % of the road's width alone: too narrow a scan "
            "(--width), or up is another axis (--axes)",
        )
    _check_smooth(low, name)
    flat, trend = _without_trend(low, size)
    things = standing & (next_layer.reshape(nu, nv) > _CONTINUED)
    for window, allowed in _OPENINGS:
        width = max(3, round(window / size) | 1)
        with np.errstate(invalid="ignore"):
            high = flat - _opened(np.where(things, np.nan, flat), width) > allowed
        things |= _steep_sided(flat, things, high & ~things)
    kept = np.where(things, np.nan, flat)
    near = _grown(things | standing, _NEAR / size) & np.isfinite(kept)
    if near.any() and np.isfinite(np.where(near, np.nan, kept)).any():
        expected = _filled(np.where(near, np.nan, kept))
        wrong = near & (np.abs(kept - expected) > _AGREE)
        things |= wrong
        kept = np.where(wrong, np.nan, kept)
    # Beside a thing what goes up without a gap is a part of it, such as a shoe.
    return Cells(size, -half, kept + trend[:, None], np.where(near, 0.0, rise.reshape(nu, nv)), things)


def _cell_size(points: Points, length: float, half: float) -> float:
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
    with np.errstate(invalid="ignore"):
        low = (
            ndimage.minimum_filter(np.where(np.isnan(cells.z), np.inf, cells.z), 3, mode="nearest") - _MARGIN
        )
        top = cells.z + cells.rise
        high = ndimage.maximum_filter(np.where(np.isnan(top), -np.inf, top), 3, mode="nearest") + _MARGIN
    # A cell on which something stood has no ground of its own.
    low, high = (np.where(cells.things, np.nan, b) for b in (low, high))
    keep = np.zeros(points.u.size, dtype=np.bool_)
    in_band(points.u, points.v, points.z, cells.size, cells.v0, low, high, keep)
    return Points(points.u[keep], points.v[keep], points.z[keep])


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


def _opened(z: Floats, width: int) -> Floats:
    lowest = ndimage.minimum_filter(np.where(np.isnan(z), np.inf, z), width, mode="nearest")
    opened: Floats = ndimage.maximum_filter(
        np.where(np.isinf(lowest), -np.inf, lowest), width, mode="nearest"
    )
    return opened


def _steep_sided(flat: Floats, things: NDArray[np.bool_], high: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What of the high cells, in pieces that hang together, jumps up from the cells around it: a hill does not."""
    around = np.where(things | high, np.nan, flat)
    if not high.any() or not np.isfinite(around).any():
        return high
    jump = flat - _filled(around)
    # Beside ground that was seen; what has none beside it is taken for a thing.
    border = high & ndimage.binary_dilation(np.isfinite(around), np.ones((3, 3), dtype=np.bool_))
    labels, number = ndimage.label(high, structure=np.ones((3, 3)))
    each = np.arange(1, number + 1)
    sides = ndimage.sum_labels(border, labels, each)
    jumps = ndimage.median(np.where(border, jump, 0.0), np.where(border, labels, 0), each)
    found = (np.asarray(jumps) > _SIDE) | (np.asarray(sides) == 0)
    steep: NDArray[np.bool_] = np.concatenate([[False], found])[labels]
    return steep


def _grown(flags: NDArray[np.bool_], cells: float) -> NDArray[np.bool_]:
    grown: NDArray[np.bool_] = ndimage.distance_transform_edt(~flags) <= cells
    return grown if flags.any() else flags


def _filled(z: Floats) -> Floats:
    """Heights with the missing ones from those around them: normalised convolutions, ever wider."""
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
