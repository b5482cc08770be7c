# SPDX-License-Identifier: Apache-2.0
"""Compiled change between map and road coordinates.

The rules are those of ASAM OpenCRG 2.0: the reference line is a chain of straight segments, the
cross sections lie in the planes that bisect it. Where on the line to look is the caller's to say
(:class:`~suspension_twin.road.road.Road` asks a k-d tree of its reference points), so that an answer
depends on the position alone and not, as in the OpenCRG library, on the queries before it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.road.surface import Line

__all__ = ["uv_to_xy", "xy_to_uv"]


@compiled
def _uv_from(
    px: Floats,
    py: Floats,
    ends: Floats,
    u_first: float,
    u_last: float,
    u_step: float,
    closes: bool,
    x: float,
    y: float,
    start: int,
) -> tuple[float, float, int]:
    """(u, v, interval) of a position, walking along the reference line from a point of it.

    Interval i lies between reference points i - 1 and i; its borders are the planes that
    bisect the line at these points. Same rules as OpenCRG's own search.
    """
    last = px.size - 1
    i = min(max(start, 1), last)
    # Which end of a track that closes was looked at already: each end is looked at once.
    end_seen = False
    while True:
        n = min(i + 1, last)
        ahead = (x - px[i]) * (px[n] - px[i - 1]) + (y - py[i]) * (py[n] - py[i - 1])
        if ahead <= 0.0:
            break
        if i < last:
            i += 1
        elif closes:
            start_d = (x - px[0]) * (px[1] - px[0]) + (y - py[0]) * (py[1] - py[0])
            end_seen = start_d != 0.0
            if start_d <= 0.0:
                break
            i = 1
        else:
            break
    while True:
        b = max(i - 2, 0)
        behind = (x - px[i - 1]) * (px[i] - px[b]) + (y - py[i - 1]) * (py[i] - py[b])
        if behind >= 0.0:
            break
        if i > 1:
            i -= 1
        elif closes and not end_seen:
            end_d = (x - px[last]) * (px[last] - px[last - 1]) + (y - py[last]) * (py[last] - py[last - 1])
            end_seen = end_d != 0.0
            if end_d >= 0.0:
                break
            i = last
        else:
            break
    n = min(i + 1, last)
    tx, ty = px[i] - px[i - 1], py[i] - py[i - 1]
    v = (tx * (y - py[i - 1]) - ty * (x - px[i - 1])) / math.sqrt(tx * tx + ty * ty)
    ta = behind / ((px[i] - px[b]) * tx + (py[i] - py[b]) * ty)
    nx, ny = px[n] - px[i - 1], py[n] - py[i - 1]
    tb = (nx * (px[i] - x) + ny * (py[i] - y)) / (nx * tx + ny * ty)
    u = (i - 1) * u_step + ta / (ta + tb) * u_step + u_first
    if u < u_first:
        dx, dy = x - px[0], y - py[0]
        u = u_first + dx * ends[0] + dy * ends[1]
        v = dy * ends[0] - dx * ends[1]
    elif u > u_last:
        dx, dy = x - px[last], y - py[last]
        u = u_last + dx * ends[2] + dy * ends[3]
        v = dy * ends[2] - dx * ends[3]
    return u, v, i


@compiled
def xy_to_uv(line: Line, at: NDArray[np.int64], x: Floats, y: Floats, u: Floats, v: Floats) -> None:
    """Road coordinates (n,) of map positions (n,); what is not finite gives NaN.

    The interval of each is looked for from the reference point ``at`` (n,), which must lie on the same
    part of the line, and is left there.
    """
    px, py, ends, u_first, u_last, u_step, straight, closes = line
    for i in range(x.size):
        if not (math.isfinite(x[i]) and math.isfinite(y[i])):
            u[i], v[i] = math.nan, math.nan
        elif straight:
            dx, dy = x[i] - px[0], y[i] - py[0]
            u[i], v[i] = u_first + dx * ends[0] + dy * ends[1], dy * ends[0] - dx * ends[1]
        else:
            u[i], v[i], at[i] = _uv_from(px, py, ends, u_first, u_last, u_step, closes, x[i], y[i], at[i])


@compiled
def _corner(px: Floats, py: Floats, i: int, n: int, v: float) -> tuple[float, float]:
    """Point at distance v from the segment i to i + 1, in the plane that bisects the line at point n."""
    last = px.size - 1
    tx, ty = px[i + 1] - px[i], py[i + 1] - py[i]
    length = math.sqrt(tx * tx + ty * ty)
    before, after = max(n - 1, 0), min(n + 1, last)
    if before == n or after == n:
        before, after = i, i + 1
    bx, by = px[after] - px[before], py[after] - py[before]
    along = (bx * tx + by * ty) / length
    return px[n] - v * by / along, py[n] + v * bx / along


@compiled
def uv_to_xy(line: Line, u: Floats, v: Floats, x: Floats, y: Floats) -> None:
    """Map positions (n,) of road coordinates (n,); NaN gives NaN."""
    px, py, ends, u_first, _, u_step, straight, _ = line
    last = px.size - 1
    for k in range(u.size):
        if not (math.isfinite(u[k]) and math.isfinite(v[k])):
            x[k], y[k] = math.nan, math.nan
            continue
        f = (u[k] - u_first) / u_step
        if straight:
            f *= u_step
            x[k] = px[0] + f * ends[0] - v[k] * ends[1]
            y[k] = py[0] + f * ends[1] + v[k] * ends[0]
            continue
        i = min(int(max(f, 0.0)), last - 1)
        f -= i
        if f < 0.0:
            d = f * u_step
            x[k] = px[0] + d * ends[0] - v[k] * ends[1]
            y[k] = py[0] + d * ends[1] + v[k] * ends[0]
        elif f > 1.0:
            d = (f - 1.0) * u_step
            x[k] = px[last] + d * ends[2] - v[k] * ends[3]
            y[k] = py[last] + d * ends[3] + v[k] * ends[2]
        else:
            ax, ay = _corner(px, py, i, i, v[k])
            bx, by = _corner(px, py, i, i + 1, v[k])
            x[k], y[k] = ax + f * (bx - ax), ay + f * (by - ay)
