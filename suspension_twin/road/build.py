# SPDX-License-Identifier: Apache-2.0
"""Roads made of numbers: from a grid of heights, flat, over a line, curved, and with bumps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.road import ReferenceLine, Road, single_precision

__all__ = [
    "Bump",
    "Centreline",
    "add_bump",
    "bump_road",
    "circular",
    "curved_road",
    "flat_road",
    "grid_road",
    "half_sine",
    "lateral_grid",
    "road_over",
    "trapezoid",
]


def grid_road(
    z: ArrayLike,
    u_step: float,
    v: ArrayLike,
    *,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    name: str = "road",
) -> Road:
    """Make a straight road from a grid of heights.

    Parameters
    ----------
    z : (nu, nv) array
        Heights in m, rounded to single precision, the precision of OpenCRG files.
    u_step : float
        Distance of the cross sections in m.
    v : (nv,) array
        Lateral positions in m, rising.
    x, y : float
        Start in ``map`` in m.
    heading : float
        Direction in rad from east, counter-clockwise.
    name : str
        Name of the road.

    Returns
    -------
    Road
        The road.

    Raises
    ------
    InputError
        The heights do not fit the positions.

    Examples
    --------
    >>> import numpy as np
    >>> grid_road(np.zeros((101, 3)), 0.1, [-2.0, 0.0, 2.0]).length
    10.0
    """
    heights = single_precision(np.atleast_2d(np.asarray(z, dtype=np.float64)))
    s = u_step * np.arange(heights.shape[0], dtype=np.float64)
    along = x + s * math.cos(heading), y + s * math.sin(heading)
    line = ReferenceLine.level(*along, float(u_step), (heading, heading))
    return Road(name, heights, np.asarray(v, dtype=np.float64), line)


def lateral_grid(width: float, step: float) -> Floats:
    """Long sections ``step`` m apart or a little less, over ``width`` m about the middle; one at v = 0."""
    if not (math.isfinite(width) and width > 0.0 and math.isfinite(step) and step > 0.0):
        raise InputError("road", "width and lateral step must be above 0 m")
    half = max(1, math.ceil(0.5 * width / step - 1e-9))
    return np.linspace(-0.5 * width, 0.5 * width, 2 * half + 1)


def flat_road(
    length: float = 20000.0,
    width: float = 20000.0,
    *,
    x: float = -10000.0,
    y: float = 0.0,
    heading: float = 0.0,
    name: str = "flat",
) -> Road:
    """Make a level plane at height 0, by default 20 km by 20 km about the origin of ``map``.

    Parameters
    ----------
    length, width : float
        m.
    x, y : float
        Start of its reference line in ``map`` in m.
    heading : float
        Direction in rad.
    name : str
        Name of the road.

    Returns
    -------
    Road
        The plane.

    Raises
    ------
    InputError
        A length or width that is not positive.

    Examples
    --------
    >>> float(flat_road().heights(100.0, -50.0))
    0.0
    """
    if not (math.isfinite(length) and length > 0.0):
        raise InputError(name, "length", f"must be above 0 m, is {length}")
    v = lateral_grid(width, width)
    return grid_road(np.zeros((2, v.size)), length, v, x=x, y=y, heading=heading, name=name)


def curved_road(road: Road, curvature: ArrayLike, *, name: str | None = None) -> Road:
    """The road bent along its length: ``curvature`` 1/m, positive to the left, a number or one a segment.

    Heights stay where they are in (u, v). Raises InputError where the line would turn so sharply
    that the inner border runs backwards.
    """
    segments = road.z.shape[0] - 1
    k = np.broadcast_to(np.asarray(curvature, dtype=np.float64), (segments,))
    if not np.isfinite(k).all() or np.abs(k).max() * max(-road.v[0], road.v[-1]) >= 1.0:
        raise InputError(road.name, "curvature", "the centre of a bend must lie off the road")
    # Half a turn before the first segment keeps the line on the circle, not beside it.
    turns = k * road.u_step
    headings = road.headings[0] + np.cumsum(turns) - 0.5 * turns
    x = road.x[0] + np.concatenate([[0.0], np.cumsum(road.u_step * np.cos(headings))])
    y = road.y[0] + np.concatenate([[0.0], np.cumsum(road.u_step * np.sin(headings))])
    ends = float(headings[0]), float(headings[-1])
    return replace(road, name=name or road.name).with_line(x=x, y=y, headings=ends)


class Centreline:
    """A polyline in ``map`` with points ``step`` m of arc apart.

    Parameters
    ----------
    x, y : (n,) array
        Points in m, in the order in which they are passed.
    step : float
        Distance of the resulting points in m.

    Raises
    ------
    InputError
        Fewer than two points, or none a step from the first.

    Examples
    --------
    >>> line = Centreline([0.0, 3.0, 3.0], [0.0, 0.0, 4.0], 0.5)
    >>> float(line.length)
    7.0
    """

    def __init__(self, x: ArrayLike, y: ArrayLike, step: float) -> None:
        px, py = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        if px.ndim != 1 or px.shape != py.shape or px.size < 2 or not np.isfinite([px, py]).all():
            raise InputError("centreline", "needs two points or more, all finite")
        moved = np.concatenate([[True], np.hypot(np.diff(px), np.diff(py)) > 1e-9])
        px, py = px[moved], py[moved]
        s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(px), np.diff(py)))])
        count = math.floor(s[-1] / step + 1e-9)
        if count < 1:
            raise InputError("centreline", f"is {s[-1]:.3g} m long, shorter than its step of {step:g} m")
        self.step = step
        at = step * np.arange(count + 1)
        self.x: Floats = np.interp(at, s, px)
        self.y: Floats = np.interp(at, s, py)

    @property
    def length(self) -> float:
        """m from the first point to the last."""
        return self.step * (self.x.size - 1)

    @property
    def headings(self) -> tuple[float, float]:
        """Direction of the first and of the last segment, rad."""
        first, last = (
            math.atan2(self.y[i + 1] - self.y[i], self.x[i + 1] - self.x[i]) for i in (0, self.x.size - 2)
        )
        return first, last


def road_over(line: Centreline, z: ArrayLike, v: ArrayLike, name: str) -> Road:
    """A road of heights ``z`` (nu, nv) m over a centreline, one cross section a point, at ``v`` (nv,) m."""
    reference = ReferenceLine.level(line.x, line.y, line.step, line.headings)
    return Road(name, single_precision(z), np.asarray(v, dtype=np.float64), reference)


# Speed bumps: the usual shapes, and roads with them


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
    return road.with_heights(z)


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
