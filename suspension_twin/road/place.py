# SPDX-License-Identifier: Apache-2.0
"""Compiled change between map and road coordinates.

The rules are those of ASAM OpenCRG 2.0: the reference line is a chain of straight segments, the
cross sections lie in the planes that bisect it. What differs from the OpenCRG library is the
search for the place on a curved line: every query finds the nearest point of the whole line
through boxes around its stretches, so the answer depends on the position alone, not on the
queries before it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, inlined
from suspension_twin.road.surface import Line

__all__ = ["FOLLOW", "FOLLOW_STEPS", "box_tree", "sure_reach", "uv_to_xy", "xy_to_uv", "xy_to_uv_from"]

#: Segments in a box of :func:`box_tree`, and boxes in a box of the level above.
FAN = 16
#: A place is followed from the one before where it is nearer than this many steps, or metres (as in OpenCRG).
FOLLOW_STEPS, FOLLOW = 20.0, 1.5


def box_tree(x: Floats, y: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Boxes (m, 4) x min, x max, y min, y max around the stretches of a line, and where each level starts.

    Level 0 holds the boxes of ``FAN`` segments each, every level above those of ``FAN`` boxes each, the
    last no more than ``FAN``; ``levels`` ends with m.
    """
    low_x, high_x = np.minimum(x[:-1], x[1:]), np.maximum(x[:-1], x[1:])
    low_y, high_y = np.minimum(y[:-1], y[1:]), np.maximum(y[:-1], y[1:])
    level = np.column_stack([low_x, high_x, low_y, high_y])
    found, starts = [], [0]
    while True:
        at = np.arange(0, len(level), FAN)
        low, high = np.minimum.reduceat(level, at, axis=0), np.maximum.reduceat(level, at, axis=0)
        level = np.column_stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]])
        found.append(level)
        starts.append(starts[-1] + len(level))
        if len(level) <= FAN:
            return np.vstack(found), np.array(starts, dtype=np.int64)


@inlined
def _box_distance2(boxes: Floats, i: int, x: float, y: float) -> float:
    dx: float = max(boxes[i, 0] - x, 0.0, x - boxes[i, 1])
    dy: float = max(boxes[i, 2] - y, 0.0, y - boxes[i, 3])
    return dx * dx + dy * dy


@inlined
def _next(level: int, i: int, levels: NDArray[np.int64]) -> tuple[int, int]:
    """The box after box i of a level in the order of the line, children of one box before the next."""
    i += 1
    while level < levels.size - 2 and (i % FAN == 0 or i >= levels[level + 1] - levels[level]):
        i = (i - 1) // FAN + 1
        level += 1
    return level, i


@inlined
def _segment_distance2(px: Floats, py: Floats, i: int, x: float, y: float) -> float:
    tx: float = px[i + 1] - px[i]
    ty: float = py[i + 1] - py[i]
    dx: float = x - px[i]
    dy: float = y - py[i]
    f: float = min(max((dx * tx + dy * ty) / (tx * tx + ty * ty), 0.0), 1.0)
    dx, dy = dx - f * tx, dy - f * ty
    return dx * dx + dy * dy


@compiled
def _near(px: Floats, py: Floats, boxes: Floats, levels: NDArray[np.int64], x: float, y: float) -> int:
    """A segment near (x, y), by the nearest box of each level down the tree; mostly the nearest."""
    top = levels.size - 2
    near = 0
    for level in range(top, -1, -1):
        first = near * FAN if level < top else 0
        near, near_d2 = first, math.inf
        for i in range(first, min(first + FAN, levels[level + 1] - levels[level])):
            d2 = _box_distance2(boxes, levels[level] + i, x, y)
            if d2 < near_d2:
                near, near_d2 = i, d2
    best, best_d2 = 0, math.inf
    for i in range(near * FAN, min((near + 1) * FAN, px.size - 1)):
        d2 = _segment_distance2(px, py, i, x, y)
        if d2 < best_d2:
            best, best_d2 = i, d2
    return best + 1


@compiled
def _nearest(
    px: Floats, py: Floats, boxes: Floats, levels: NDArray[np.int64], x: float, y: float, near: int
) -> int:
    """Number of the segment nearest to (x, y), the first of equals; it ends at the point of that index.

    ``near`` is a segment to begin with.
    """
    top = levels.size - 2
    segments = px.size - 1
    best = near - 1
    best_d2 = _segment_distance2(px, py, best, x, y)
    level, i = top, 0
    while i < levels[level + 1] - levels[level]:
        if _box_distance2(boxes, levels[level] + i, x, y) > best_d2:
            level, i = _next(level, i, levels)
        elif level > 0:
            level, i = level - 1, i * FAN
        else:
            for k in range(i * FAN, min((i + 1) * FAN, segments)):
                d2 = _segment_distance2(px, py, k, x, y)
                if d2 < best_d2 or (d2 == best_d2 and k < best):
                    best_d2, best = d2, k
            level, i = _next(level, i, levels)
    return best + 1


@compiled
def sure_reach(px: Floats, py: Floats, boxes: Floats, levels: NDArray[np.int64], cap: float) -> Floats:
    """How far to the right and to the left (n, 2) of a segment a place is surely nearest to it.

    Segment i ends at point i. A point of the line is the nearest to all places on its normal up to
    where a circle through it, with its centre there, meets the line again: the radius
    |d|² / (2 d.n) over all other points at d, n the normal (Federer, Trans. AMS 93 (1959) 418).
    Beyond ``cap`` m nobody asks. Of the smaller radius of a segment's two ends four fifths are
    taken, less a step, as the places lie between the ends; none where another part of the line
    comes within two steps, where it may cross.
    """
    n = px.size
    top = levels.size - 2
    reach = np.full((n, 2), cap)
    for k in range(n):
        a, b = max(k - 1, 0), min(k + 1, n - 1)
        tx, ty = px[b] - px[a], py[b] - py[a]
        length = math.sqrt(tx * tx + ty * ty)
        if length == 0.0:
            reach[k, :] = 0.0
            continue
        nx, ny = -ty / length, tx / length
        crossing2 = (2.0 * length / (b - a)) ** 2
        left, right = cap, cap
        level, i = top, 0
        while i < levels[level + 1] - levels[level]:
            box = levels[level] + i
            # The least radius that a point of the box could give: nearest corner, farthest aside.
            d2 = _box_distance2(boxes, box, px[k], py[k])
            x0, x1, y0, y1 = (
                boxes[box, 0] - px[k],
                boxes[box, 1] - px[k],
                boxes[box, 2] - py[k],
                boxes[box, 3] - py[k],
            )
            up = max(x0 * nx, x1 * nx) + max(y0 * ny, y1 * ny)
            down = -min(x0 * nx, x1 * nx) - min(y0 * ny, y1 * ny)
            if d2 > crossing2 and d2 >= 2.0 * max(up, 0.0) * left and d2 >= 2.0 * max(down, 0.0) * right:
                level, i = _next(level, i, levels)
            elif level > 0:
                level, i = level - 1, i * FAN
            else:
                # The box's segments begin at these points; the last ends at the one after.
                for j in range(i * FAN, min((i + 1) * FAN, n - 1) + 1):
                    dx, dy = px[j] - px[k], py[j] - py[k]
                    aside = dx * nx + dy * ny
                    d2 = dx * dx + dy * dy
                    if abs(j - k) > 2 and d2 <= crossing2:
                        left = right = 0.0
                    elif aside > 0.0 and d2 < 2.0 * aside * left:
                        left = 0.5 * d2 / aside
                    elif aside < 0.0 and d2 < -2.0 * aside * right:
                        right = -0.5 * d2 / aside
                level, i = _next(level, i, levels)
        reach[k, 0], reach[k, 1] = right, left
    sure = np.full((n, 2), -1.0)
    for i in range(1, n):
        step = math.sqrt((px[i] - px[i - 1]) ** 2 + (py[i] - py[i - 1]) ** 2)
        for side in range(2):
            sure[i, side] = 0.8 * min(reach[i - 1, side], reach[i, side]) - step
    return sure


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


@inlined
def _sure(sure: Floats, u_first: float, u_step: float, u: float, v: float, at: int) -> bool:
    """True if no other part of the line can be nearer to (u, v), found in interval ``at``."""
    inner = (u - u_first) / u_step - at
    return inner >= -1.0 and inner <= 0.0 and -sure[at, 0] <= v and v <= sure[at, 1]


@compiled
def xy_to_uv(line: Line, x: Floats, y: Floats, u: Floats, v: Floats) -> None:
    """Road coordinates (n,) of map positions (n,); what is not finite gives NaN."""
    px, py, boxes, levels, sure, ends, u_first, u_last, u_step, straight, closes = line
    if straight:
        x0, y0, cos, sin = px[0], py[0], ends[0], ends[1]
        for i in range(x.size):
            dx, dy = x[i] - x0, y[i] - y0
            u[i], v[i] = u_first + dx * cos + dy * sin, dy * cos - dx * sin
        return
    follow2 = max(FOLLOW, FOLLOW_STEPS * u_step) ** 2
    at = 0
    for i in range(x.size):
        if not (math.isfinite(x[i]) and math.isfinite(y[i])):
            u[i], v[i] = math.nan, math.nan
            continue
        if at > 0 and (x[i] - px[at]) ** 2 + (y[i] - py[at]) ** 2 < follow2:
            # From the place before; kept where no other part of the line can be nearer.
            u[i], v[i], at = _uv_from(px, py, ends, u_first, u_last, u_step, closes, x[i], y[i], at)
            if _sure(sure, u_first, u_step, u[i], v[i], at):
                continue
        near = _near(px, py, boxes, levels, x[i], y[i])
        u[i], v[i], at = _uv_from(px, py, ends, u_first, u_last, u_step, closes, x[i], y[i], near)
        if not _sure(sure, u_first, u_step, u[i], v[i], at):
            start = _nearest(px, py, boxes, levels, x[i], y[i], near)
            u[i], v[i], at = _uv_from(px, py, ends, u_first, u_last, u_step, closes, x[i], y[i], start)


@compiled
def xy_to_uv_from(
    line: Line, x: Floats, y: Floats, reach2: float, at: NDArray[np.int64], u: Floats, v: Floats
) -> None:
    """As :func:`xy_to_uv`, each position followed from the interval ``at`` (n,) where it was last.

    A position farther than the root of ``reach2`` from there, or with ``at`` below 1, is searched
    afresh. ``at`` is brought up to date.
    """
    px, py, boxes, levels, _, ends, u_first, u_last, u_step, straight, closes = line
    if straight:
        xy_to_uv(line, x, y, u, v)
        return
    for i in range(x.size):
        if not (math.isfinite(x[i]) and math.isfinite(y[i])):
            u[i], v[i] = math.nan, math.nan
            continue
        k = at[i]
        if k < 1 or (x[i] - px[k]) ** 2 + (y[i] - py[k]) ** 2 > reach2:
            near = _near(px, py, boxes, levels, x[i], y[i])
            k = _nearest(px, py, boxes, levels, x[i], y[i], near)
        u[i], v[i], at[i] = _uv_from(px, py, ends, u_first, u_last, u_step, closes, x[i], y[i], k)


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
    px, py, _, _, _, ends, u_first, _, u_step, straight, _ = line
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
