# SPDX-License-Identifier: Apache-2.0
"""Speed bumps: the usual shapes, measured ones, and roads with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.build import grid_road, lateral_grid
from suspension_twin.road.road import Road

__all__ = ["Bump", "add_bump", "bump_road", "circular", "half_sine", "measured", "trapezoid"]


@dataclass(frozen=True, eq=False)
class Bump:
    """A bump's cross section: ``profile`` gives heights in m at distances from its start in m.

    It is asked only within 0 to ``length``; outside a bump is 0 high.
    """

    name: str
    length: float
    height: float
    profile: Callable[[Floats], Floats]

    def __call__(self, s: ArrayLike) -> Floats:
        """Heights at distances ``s`` from the start, of the shape of ``s``."""
        s = np.asarray(s, dtype=np.float64)
        on = (s >= 0.0) & (s <= self.length)
        return np.where(on, self.profile(np.clip(s, 0.0, self.length)), 0.0)


def half_sine(length: float, height: float) -> Bump:
    """A bump of the shape of half a sine wave.

    Parameters
    ----------
    length : float
        m along the road.
    height : float
        m; a negative height makes a dip.

    Returns
    -------
    Bump
        The cross section, for :func:`bump_road` and :func:`add_bump`.

    Raises
    ------
    InputError
        For a length that is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> half_sine(0.9, 0.05).profile(np.array([0.45])).round(3).tolist()
    [0.05]
    """
    _check(length, height)
    return Bump("half sine", length, height, lambda s: height * np.sin(math.pi * s / length))


def trapezoid(length: float, height: float, top: float) -> Bump:
    """Ramps up and down of equal length with a level ``top`` (m) between them."""
    _check(length, height)
    if not 0.0 <= top < length:
        raise InputError("bump", "top", f"must be at least 0 and less than the length {length} m, is {top} m")
    ramp = 0.5 * (length - top)
    return Bump(
        "trapezoid", length, height, lambda s: height * np.clip(np.minimum(s, length - s) / ramp, 0.0, 1.0)
    )


def circular(length: float, height: float) -> Bump:
    """A segment of a circle (a round-top hump); a height of half the length is a half round."""
    _check(length, height)
    h = abs(height)
    if h > 0.5 * length:
        raise InputError(
            "bump", "height", f"a circular bump {length} m long is at most {0.5 * length} m high"
        )
    radius = (0.25 * length**2 + h**2) / (2.0 * h)

    def profile(s: Floats) -> Floats:
        z = np.sqrt(np.maximum(radius**2 - (s - 0.5 * length) ** 2, 0.0)) - (radius - h)
        return math.copysign(1.0, height) * np.maximum(z, 0.0)

    return Bump("circular", length, height, profile)


def measured(s: ArrayLike, z: ArrayLike) -> Bump:
    """A bump through measured points: distances ``s`` (n,) m rising, heights ``z`` (n,) m; linear between."""
    along, up = np.asarray(s, dtype=np.float64), np.asarray(z, dtype=np.float64)
    if along.ndim != 1 or along.shape != up.shape or along.size < 2:
        raise InputError("bump", "points", f"need 2 or more pairs, got {along.size} and {up.size} values")
    if not (np.isfinite(along).all() and np.isfinite(up).all()):
        raise InputError("bump", "points", "must be finite")
    if not (np.diff(along) > 0.0).all():
        raise InputError("bump", "points", "distances must rise from point to point")
    along = along - along[0]
    peak = float(up[np.abs(up).argmax()])
    return Bump("measured", float(along[-1]), peak, lambda at: np.interp(at, along, up))


def add_bump(
    road: Road,
    bump: Bump,
    at: float,
    *,
    v_low: float = -math.inf,
    v_high: float = math.inf,
    angle: float = 0.0,
) -> Road:
    """Put a bump on a road.

    Parameters
    ----------
    road : Road
        The road without it.
    bump : Bump
        The cross section.
    at : float
        u in m at which it starts.
    v_low, v_high : float
        Its extent across in m, as for one wheel path only.
    angle : float
        rad by which it lies askew, positive with the left side farther on.

    Returns
    -------
    Road
        The road with it.

    Raises
    ------
    InputError
        It does not lie on the road, or the grid is too coarse for its shape.

    Examples
    --------
    >>> road = add_bump(bump_road(half_sine(0.9, 0.05)), half_sine(0.5, -0.03), 40.0, v_low=0.1)
    >>> bool(road.z.min() < -0.029)
    True
    """
    if not (road.u_first <= at and at + bump.length <= road.u_last + 1e-9):
        raise InputError(
            road.name,
            "bump",
            f"{at} to {at + bump.length} m is off the road ({road.u_first} to {road.u_last} m)",
        )
    if bump.length < 4.0 * road.u_step:
        raise InputError(
            road.name,
            "u_step",
            f"{road.u_step} m is too coarse for a bump of {bump.length} m; use a quarter or less",
        )
    if not abs(angle) < 0.5 * math.pi:
        raise InputError(road.name, "angle", f"must be less than a right angle, is {angle} rad")
    across = (road.v >= v_low) & (road.v <= v_high)
    if not across.any():
        raise InputError(road.name, "bump", f"no long section lies between v {v_low} and {v_high} m")
    s = road.u[:, None] - at - road.v[None, :] * math.tan(angle)
    z = road.z + np.where(across, bump(s), 0.0)
    return replace(road, z=z.astype(np.float32).astype(np.float64))


def bump_road(
    bump: Bump,
    at: float | Sequence[float] = 20.0,
    *,
    length: float = 60.0,
    width: float = 6.0,
    step: float = 0.01,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    name: str | None = None,
) -> Road:
    """Make a level straight road with a bump at one or several places.

    Parameters
    ----------
    bump : Bump
        The cross section.
    at : float or sequence of float
        Distance of each bump's start from the start of the road in m.
    length, width : float
        Of the road in m.
    step : float
        Distance of the cross sections in m.
    x, y : float
        Start in ``map`` in m.
    heading : float
        Direction in rad.
    name : str, optional
        Name of the road.

    Returns
    -------
    Road
        The road.

    Raises
    ------
    InputError
        The bump does not lie on the road, or the grid is too coarse for its shape.

    Examples
    --------
    >>> road = bump_road(half_sine(0.9, 0.05), at=[10.0, 30.0], length=50.0)
    >>> round(float(road.z.max()), 3)
    0.05
    """
    v = lateral_grid(width, 0.5)
    count = round(length / step) + 1
    title = name or f"{bump.name} bump"
    road = grid_road(np.zeros((count, v.size)), step, v, x=x, y=y, heading=heading, name=title)
    for place in [at] if isinstance(at, (int, float)) else at:
        road = add_bump(road, bump, float(place))
    return road


def _check(length: float, height: float) -> None:
    if not (math.isfinite(length) and length > 0.0):
        raise InputError("bump", "length", f"must be above 0 m, is {length}")
    if not (math.isfinite(height) and height != 0.0):
        raise InputError("bump", "height", f"must be a height in m other than 0, is {height}")
