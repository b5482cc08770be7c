# SPDX-License-Identifier: Apache-2.0
"""A measured road made fit for a simulation: Gaussian smoothing (the car paper, section 5), and spikes removed.

A spike is a single measured point that stands out of a road as no road does. A laser scan leaves them, and a wheel
that touches the ground at one point takes every one as a blow. The peak finder of the OpenCRG tools compares absolute
heights in a square of seven by seven points, so it sees nothing on a road of three long sections, nor on one
that lies off z = 0. Here a point is held against the running median of its own long section, and
across the road too where the long sections are close enough for that to mean something.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import fftconvolve

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.road import Road, single_precision

__all__ = ["Spike", "Spikes", "find_spikes", "remove_spikes", "smooth"]

_REACH = 5.0  # standard deviations; beyond it the weight is below a millionth

#: Points wider than this many are a feature of the road, not a spike.
_WIDEST = 3
#: On a coarse grid a hill is a few points wide; a spike's side is at least this steep, m/m.
_STEEP = 0.25
#: How far around a point its road's own unevenness counts, m.
_AROUND = 20.0
#: A spike stands out this many times as far as the points around it.
_FACTOR = 7.0
#: Long sections farther apart than this say nothing of each other, m.
_NEAR_ACROSS = 0.25


def smooth(road: Road, along: float, across: float | None = None) -> Road:
    """Smooth a road with a Gaussian window.

    A wave of n cycles/m keeps exp(-2 (pi n sigma)²) of its height. Missing heights stay missing; slopes are
    kept.

    Parameters
    ----------
    road : Road
        The road.
    along : float
        Standard deviation along it in m.
    across : float, optional
        Standard deviation across it in m: None as along, 0 not at all.

    Returns
    -------
    Road
        The smoothed road.

    Raises
    ------
    InputError
        For a negative standard deviation.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> road = bump_road(half_sine(0.9, 0.05), width=2.0)
    >>> bool(smooth(road, 0.2).z.max() < 0.045)
    True
    """
    sigma_v = along if across is None else across
    for direction, sigma in (("along", along), ("across", sigma_v)):
        if not (math.isfinite(sigma) and sigma >= 0.0):
            raise InputError("road smoothing", f"sigma {direction}", f"must be 0 m or more, is {sigma}")
    z, missing = road.z, np.isnan(road.z)
    ref_z, bank = road.ref_z, road.bank
    sigma_u = along / road.u_step
    if sigma_u > 0.0:
        z = np.where(missing, np.nan, _along(z, sigma_u))
        # The reference line's own height and the banking are part of the surface.
        ref_z, bank = (_along(c[:, None], sigma_u)[:, 0] for c in (ref_z, bank))
    if sigma_v > 0.0:
        z = np.where(missing, np.nan, _across(z, road.v, sigma_v))
    smoothed = replace(road.reference, z=ref_z, bank=bank)
    return replace(road, z=single_precision(z), reference=smoothed)


def _along(z: Floats, sigma: float) -> Floats:
    """Each column (nu, m) under the window of ``sigma`` steps; NaN weigh nothing."""
    reach = min(math.ceil(_REACH * sigma), z.shape[0])
    offset = np.arange(-reach, reach + 1, dtype=np.float64)
    window = np.exp(-0.5 * (offset / sigma) ** 2)
    known = ~np.isnan(z)

    def moment(values: Floats, power: int) -> Floats:
        # Correlation, not convolution: the kernel is turned round.
        kernel = (window * offset**power)[::-1, None]
        full: Floats = fftconvolve(values, kernel, mode="full", axes=0)
        return full[reach : reach + values.shape[0]]

    weight = known.astype(np.float64) if not known.all() else np.ones((z.shape[0], 1))
    filled = np.where(known, z, 0.0)
    weights = [moment(weight, p) for p in range(3)]
    return _local_line(weights, [moment(filled, p) for p in range(2)], sigma)


def _across(z: Floats, v: Floats, sigma: float) -> Floats:
    """Each cross section (nu, nv) under the window over its positions ``v``, however spaced."""
    known = ~np.isnan(z)
    offset = v[None, :] - v[:, None]  # (to, from)
    window = np.exp(-0.5 * (offset / sigma) ** 2) * np.gradient(v)[None, :]
    window[np.abs(offset) > _REACH * sigma] = 0.0
    weight = known.astype(np.float64) if not known.all() else np.ones((1, v.size))
    filled = np.where(known, z, 0.0)
    weights = [weight @ (window * offset**p).T for p in range(3)]
    return _local_line(weights, [filled @ (window * offset**p).T for p in range(2)], sigma)


def _local_line(weights: list[Floats], heights: list[Floats], sigma: float) -> Floats:
    """Height at the window's middle of the straight line through the heights under it.

    Where the window lies whole within the road that is its mean; at a border the line lets a slope
    through. ``weights`` and ``heights`` are the moments of the window about its middle.
    """
    spread = weights[0] * weights[2] - weights[1] ** 2
    enough = spread > 1e-6 * (weights[0] * sigma) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        line = (weights[2] * heights[0] - weights[1] * heights[1]) / spread
        mean = heights[0] / weights[0]
    return np.where(enough, line, mean)


# Spikes


@dataclass(frozen=True)
class Spike:
    """One spike: ``u``, ``v`` m of its tip, ``height`` m it stands out (negative: a pit).

    ``step`` m is the largest jump to the next point along the road, ``nodes`` the number of grid
    points, ``v_low`` and ``v_high`` m how far it goes across.
    """

    u: float
    v: float
    height: float
    step: float
    nodes: int
    v_low: float
    v_high: float


@dataclass(frozen=True, eq=False)
class Spikes:
    """All spikes of a road, the largest step first, and ``mask`` (nu, nv) True at their points."""

    found: tuple[Spike, ...]
    mask: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.found)


def find_spikes(road: Road, min_height: float = 0.02) -> Spikes:
    """Spikes that stand out by ``min_height`` m at least and far beyond the road around them."""
    z = road.grid[0]
    missing = np.isnan(road.z)
    out = _standing_out(z, 0)
    window = max(2 * round(_AROUND / road.u_step) + 1, 31)
    mask = np.abs(out) > np.maximum(min_height, _FACTOR * _local_scale(out, window))
    if z.shape[1] >= 2 * _WIDEST + 1 and float(np.diff(road.v).max()) <= _NEAR_ACROSS:
        across = _standing_out(z, 1)
        mask &= (np.sign(across) == np.sign(out)) & (np.abs(across) > min_height)
    mask &= ~missing
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    jumps = np.abs(np.diff(z, axis=0, prepend=z[:1], append=z[-1:]))
    step = np.maximum(jumps[:-1], jumps[1:])
    found = []
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        inner = np.nonzero(labels[box] == label)
        rows, columns = (part + edge.start for part, edge in zip(inner, box, strict=True))
        if step[rows, columns].max() < _STEEP * road.u_step:
            mask[rows, columns] = False
            continue
        tip = int(np.abs(out[rows, columns]).argmax())
        found.append(
            Spike(
                u=float(road.u[rows[tip]]),
                v=float(road.v[columns[tip]]),
                height=float(out[rows[tip], columns[tip]]),
                step=float(step[rows, columns].max()),
                nodes=int(rows.size),
                v_low=float(road.v[columns.min()]),
                v_high=float(road.v[columns.max()]),
            )
        )
    return Spikes(tuple(sorted(found, key=lambda s: -s.step)), mask)


def remove_spikes(road: Road, spikes: Spikes | None = None) -> Road:
    """The road with its spikes (all that :func:`find_spikes` finds, or those given) bridged along u.

    Each of their points gets the height between the sound points before and after it.
    """
    mask = (spikes or find_spikes(road)).mask
    z = np.array(road.z)
    sound = ~mask & ~np.isnan(z)
    for j in np.flatnonzero(mask.any(axis=0)):
        if sound[:, j].any():
            bad = np.flatnonzero(mask[:, j])
            good = np.flatnonzero(sound[:, j])
            z[bad, j] = np.interp(bad, good, z[good, j])
    return road.with_heights(z)


def _standing_out(z: Floats, axis: int) -> Floats:
    """How far each point stands out of the median of its neighbours along an axis."""
    size = [1, 1]
    size[axis] = 2 * _WIDEST + 1
    median: Floats = ndimage.median_filter(z, size=tuple(size), mode="nearest")
    return z - median


def _local_scale(out: Floats, window: int) -> Floats:
    """How far points stand out around each point of its long section: a standard deviation by a quantile.

    The ninth decile, as on a smooth road more than half of the points are their own median.
    Segments of half a window, the largest of the three that overlap a point's window, stand for a
    running quantile, which would take minutes on a fine grid.
    """
    half = max(window // 2, 1)
    count = -(-out.shape[0] // half)
    padded = np.full((count * half, out.shape[1]), np.nan)
    padded[: out.shape[0]] = np.abs(out)
    deciles = np.nanquantile(padded.reshape(count, half, -1), 0.9, axis=1)
    around = ndimage.maximum_filter1d(deciles, 3, axis=0, mode="nearest")
    return np.repeat(around, half, axis=0)[: out.shape[0]] / 1.645
