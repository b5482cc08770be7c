# SPDX-License-Identifier: Apache-2.0
"""Gaussian smoothing of a road, as the car paper cleans its laser-scanned surface (section 5)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.signal import fftconvolve

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.road import Road

__all__ = ["smooth"]

_REACH = 5.0  # standard deviations; what lies beyond is below a millionth of the weight


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
    for what, sigma in (("along", along), ("across", sigma_v)):
        if not (math.isfinite(sigma) and sigma >= 0.0):
            raise InputError("road smoothing", f"sigma {what}", f"must be 0 m or more, is {sigma}")
    z, missing = road.z, np.isnan(road.z)
    ref_z, bank = road.ref_z, road.bank
    sigma_u = along / road.u_step
    if sigma_u > 0.0:
        z = np.where(missing, np.nan, _along(z, sigma_u))
        # The reference line's own height and the banking are part of the surface.
        ref_z, bank = (_along(c[:, None], sigma_u)[:, 0] for c in (ref_z, bank))
    if sigma_v > 0.0:
        z = np.where(missing, np.nan, _across(z, road.v, sigma_v))
    return replace(road, z=z.astype(np.float32).astype(np.float64), ref_z=ref_z, bank=bank)


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
    """Height at the window's middle of the straight line through what lies under it.

    Where the window lies whole within the road that is its mean; at a border the line lets a slope
    through. ``weights`` and ``heights`` are the moments of the window about its middle.
    """
    spread = weights[0] * weights[2] - weights[1] ** 2
    enough = spread > 1e-6 * (weights[0] * sigma) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        line = (weights[2] * heights[0] - weights[1] * heights[1]) / spread
        mean = heights[0] / weights[0]
    result: Floats = np.where(enough, line, mean)
    return result
