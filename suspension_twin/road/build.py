# SPDX-License-Identifier: Apache-2.0
"""Roads made of numbers: from a grid of heights, flat, and of several parts one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.road import Borders, Road

__all__ = ["curved_road", "flat_road", "grid_road", "join", "lateral_grid"]


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
        Heights in m, rounded to single precision, which is what an OpenCRG file can hold.
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
    heights = np.atleast_2d(np.asarray(z, dtype=np.float64)).astype(np.float32).astype(np.float64)
    nu = heights.shape[0]
    s = u_step * np.arange(nu, dtype=np.float64)
    return Road(
        name=name,
        z=heights,
        v=np.asarray(v, dtype=np.float64),
        u_step=float(u_step),
        x=x + s * math.cos(heading),
        y=y + s * math.sin(heading),
        ref_z=np.zeros(nu),
        bank=np.zeros(nu),
        headings=(heading, heading),
    )


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
    return replace(road, name=name or road.name, x=x, y=y, headings=ends)


def join(parts: Sequence[Road], *, level: bool = True, name: str | None = None) -> Road:
    """One road of several, each starting where and in the direction in which the one before ends.

    The first part gives the place and the long sections, the finest the step along the road;
    lengths are rounded to whole steps. With ``level`` each part is raised so that its mean height at
    the seam is that of the part before; without, heights stay, and the seam is a ramp of one step.
    Raises InputError for no parts, and for a curved part of another step.
    """
    if not parts:
        raise InputError("road", "join", "needs one part or more")
    step = min(p.u_step for p in parts)
    done = _resampled(parts[0], step, parts[0].v)
    for part in parts[1:]:
        done = _append(done, _resampled(part, step, parts[0].v), level)
    # Border options of one part mean nothing for the whole.
    return replace(done, name=name or " + ".join(p.name for p in parts), borders=Borders())


def _append(road: Road, part: Road, level: bool) -> Road:
    part = part.placed(float(road.x[-1]), float(road.y[-1]), road.headings[1])
    lift = 0.0
    if level:
        end, start = road.heights_grid[-1], part.heights_grid[0]
        both = np.isfinite(end) & np.isfinite(start)
        lift = float((end[both] - start[both]).mean()) if both.any() else 0.0
    return replace(
        road,
        z=np.concatenate([road.z, part.z[1:]]),
        x=np.concatenate([road.x, part.x[1:]]),
        y=np.concatenate([road.y, part.y[1:]]),
        ref_z=np.concatenate([road.ref_z, part.ref_z[1:] + lift]),
        bank=np.concatenate([road.bank, part.bank[1:]]),
        headings=(road.headings[0], part.headings[1]),
    )


def _resampled(road: Road, step: float, v: Floats) -> Road:
    """The road on another grid; missing heights stay missing, beyond its own width it is held."""
    same_v = v.shape == road.v.shape and np.allclose(v, road.v, rtol=0.0, atol=1e-9)
    same_u = math.isclose(step, road.u_step, rel_tol=1e-9)
    if same_u and same_v:
        return road
    if not same_u and not road.straight:
        raise InputError(
            road.name, "u_step", f"{road.u_step} m differs from {step} m: a curved part is not resampled"
        )
    count = round(road.length / step) if not same_u else road.z.shape[0] - 1
    u = road.u_first + step * np.arange(max(count, 1) + 1)
    # The grid alone, within its borders: what is added to it is resampled on its own.
    zero = np.zeros(road.z.shape[0])
    grid = replace(road, ref_z=zero, bank=zero, borders=Borders())
    within = np.clip(u, road.u_first, road.u_last)[:, None], np.clip(v, road.v[0], road.v[-1])[None, :]
    samples = grid.sample_uv(*within, "hold")
    heights = np.where(samples.inside, samples.z, np.nan)
    if same_u:
        x_line, y_line, ref_z, bank = road.x, road.y, road.ref_z, road.bank
    else:
        s = u - road.u_first
        x_line = road.x[0] + s * math.cos(road.headings[0])
        y_line = road.y[0] + s * math.sin(road.headings[0])
        ref_z, bank = np.interp(u, road.u, road.ref_z), np.interp(u, road.u, road.bank)
    z = heights.astype(np.float32).astype(np.float64)
    return replace(road, z=z, v=v, u_step=step, x=x_line, y=y_line, ref_z=ref_z, bank=bank)
