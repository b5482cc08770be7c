# SPDX-License-Identifier: Apache-2.0
"""Compiled evaluation of a road: heights, and the change between map and road coordinates.

The rules are those of ASAM OpenCRG 2.0 (bilinear grid, slope, banking, border modes, smoothing zones; the reference
line is a chain of straight segments, the cross sections lie in the planes that bisect it), so that the values are
those of the OpenCRG library. Where on the line to look is the caller's to say
(:class:`~suspension_twin.road.road.Road` asks a k-d tree of its reference points), so that an answer depends on the
position alone and not, as in the OpenCRG library, on the queries before it.

A road is handed in as plain tuples of arrays and numbers, SI units. Plain, because numba's cache remembers the types
of a kernel's arguments: a class among them, and a cache left by another version of this package could no longer be
read.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = [
    "INSIDE",
    "NOT_FINITE",
    "OUTSIDE",
    "REFUSED",
    "VOID",
    "Grid",
    "Line",
    "heights_uv",
    "uv_to_xy",
    "xy_to_uv",
]

#: The reference line: its points x and y (nu,); cos and sin of the heading before the start, then
#: after the end (4,); u of the first and the last point and the step between them; whether the line
#: is straight; whether it could be closed into a track.
Line = tuple[Floats, Floats, Floats, float, float, float, bool, bool]

#: The heights over the line: z (nu, nv) without a NaN; True (nu-1, nv-1) where a corner of the cell
#: had no data, or (0, 0) if there is none; v (nv,) and its step, 0 where it is uneven; height and
#: banking of the line (nu,); length of the smoothing zone and base height at the start, then at the
#: end (4,), a negative length for no zone; u of the first and the last cross section and their step.
Grid = tuple[Floats, NDArray[np.bool_], Floats, float, Floats, Floats, Floats, float, float, float]

# Bits of a position.
INSIDE, OUTSIDE, VOID, REFUSED, NOT_FINITE = 0, 1, 2, 4, 8

# OpenCRG border modes.
_NONE, _ZERO, _KEEP, _REPEAT, _REFLECT = 0, 1, 2, 3, 4

_SNAP = 1e-8  # m, OpenCRG's tolerance at the border of unevenly spaced long sections


@compiled
def _repeat(f: float, count: float) -> float:
    f = np.fmod(f, count)
    return f + count if f < 0.0 else f


@compiled
def _reflect(f: float, count: float) -> float:
    f = abs(f)
    turns = math.floor(f / count)
    f -= turns * count
    return count - f if turns % 2.0 != 0.0 else f


@compiled
def _cell(f: float, cells: int) -> tuple[int, float]:
    """Cell and place within it (0 to 1), held at both borders."""
    if f < 0.0:
        return 0, 0.0
    if f >= cells:
        return cells - 1, 1.0
    i = int(f)
    return i, f - i


@compiled
def _any_height(
    grid: Grid, u: float, v: float, mode_u: int, mode_v: int, offset_u: float, offset_v: float
) -> tuple[float, int]:
    """Height and bits of a position (u, v) by all of OpenCRG's rules, where the plain case does not hold."""
    zs, void, vs, v_step, ref_z, bank, smooth, u_first, u_last, u_step = grid
    nu, nv = zs.shape
    seen = INSIDE
    offset = 0.0
    core_u, core_v, value, banked = True, True, True, True
    fu = (u - u_first) / u_step
    if u < u_first or u > u_last:
        seen |= OUTSIDE
        if mode_u == _NONE:
            return math.nan, seen | REFUSED
        core_u = mode_u == _REPEAT or mode_u == _REFLECT
        cells = (u_last - u_first) / u_step
        if mode_u == _ZERO:
            value, banked = False, False
        elif core_u:
            fu = _repeat(fu, cells) if mode_u == _REPEAT else _reflect(fu, cells)
            u = u_first + fu * u_step
        offset += offset_u
    iu, fu = _cell(fu, nu - 1)

    v_low, v_high = vs[0], vs[nv - 1]
    vg = v
    if v < v_low or v > v_high:
        snapped = v_step == 0.0 and (abs(v - v_low) < _SNAP or abs(v - v_high) < _SNAP)
        if snapped:
            core_v, mode_v = False, _KEEP
        else:
            seen |= OUTSIDE
            if mode_v == _NONE:
                return math.nan, seen | REFUSED
            core_v = mode_v == _REPEAT or mode_v == _REFLECT
            value = value and mode_v != _ZERO
            if core_v:
                span = v_high - v_low
                if mode_v == _REPEAT:
                    vg = v_low + _repeat(v - v_low, span)
                else:
                    vg = v_low + _reflect(v - v_low, span)
        offset += offset_v
    if v_step > 0.0:
        jv, fv = _cell((vg - v_low) / v_step, nv - 1)
        v = vg
    else:
        jv = min(max(np.searchsorted(vs, vg, side="right") - 1, 0), nv - 2)
        fv = min(max((vg - vs[jv]) / (vs[jv + 1] - vs[jv]), 0.0), 1.0)
    if void.size > 0 and value and void[iu, jv]:
        seen |= VOID

    z = 0.0
    if value:
        z00, z10 = zs[iu, jv], zs[iu + 1, jv]
        z01, z11 = zs[iu, jv + 1], zs[iu + 1, jv + 1]
        z = z00 + (z10 - z00) * fu + ((z01 - z00) + (z11 - z10 - z01 + z00) * fu) * fv
    z += ref_z[iu] + fu * (ref_z[iu + 1] - ref_z[iu])
    if banked:
        z += (bank[iu] + fu * (bank[iu + 1] - bank[iu])) * min(max(v, v_low), v_high)
    if not core_u:
        z = offset if mode_u == _ZERO else z + offset
    elif not core_v:
        z = offset if mode_v == _ZERO else z + offset

    scale, base = -1.0, 0.0
    if smooth[0] >= 0.0 and u - u_first <= smooth[0]:
        scale, base = max(u - u_first, 0.0) / smooth[0], smooth[1]
    if smooth[2] >= 0.0 and u_last - u <= smooth[2]:
        scale, base = max(u_last - u, 0.0) / smooth[2], smooth[3]
    if scale >= 0.0:
        z = base + (z - base) * scale
    return z, seen


@compiled
def heights_uv(
    grid: Grid,
    u: Floats,
    v: Floats,
    modes: tuple[int, int],
    offsets: tuple[float, float],
    out: Floats,
    seen: NDArray[np.uint8],
) -> int:
    """Heights (n,) at road coordinates (n,) into ``out``, bits into ``seen``; returns all bits or-ed."""
    met = 0
    z, void, vs, v_step, ref_z, bank, smooth, u_first, u_last, u_step = grid
    nu, nv = z.shape
    v_low, v_high = vs[0], vs[nv - 1]
    plain = v_step > 0.0 and smooth[0] < 0.0 and smooth[2] < 0.0
    holes = void.size > 0
    for i in range(u.size):
        at, across = u[i], v[i]
        if plain and u_first <= at <= u_last and v_low <= across <= v_high:
            fu, fv = (at - u_first) / u_step, (across - v_low) / v_step
            iu, jv = min(int(fu), nu - 2), min(int(fv), nv - 2)
            fu, fv = min(fu - iu, 1.0), min(fv - jv, 1.0)
            z00, z10, z01, z11 = z[iu, jv], z[iu + 1, jv], z[iu, jv + 1], z[iu + 1, jv + 1]
            height = z00 + (z10 - z00) * fu + ((z01 - z00) + (z11 - z10 - z01 + z00) * fu) * fv
            height += ref_z[iu] + fu * (ref_z[iu + 1] - ref_z[iu])
            out[i] = height + (bank[iu] + fu * (bank[iu + 1] - bank[iu])) * across
            code = VOID if holes and void[iu, jv] else INSIDE
        elif math.isfinite(at) and math.isfinite(across):
            out[i], code = _any_height(grid, at, across, modes[0], modes[1], offsets[0], offsets[1])
        else:
            out[i], code = math.nan, NOT_FINITE
        seen[i] = code
        met |= code
    return met


@compiled
def _beside(
    px: float, py: float, cos: float, sin: float, u: float, x: float, y: float
) -> tuple[float, float]:
    """(u, v) of a position (x, y) at a straight line through (px, py), where it has this u."""
    dx, dy = x - px, y - py
    return u + dx * cos + dy * sin, dy * cos - dx * sin


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
        u, v = _beside(px[0], py[0], ends[0], ends[1], u_first, x, y)
    elif u > u_last:
        u, v = _beside(px[last], py[last], ends[2], ends[3], u_last, x, y)
    return u, v, i


@compiled
def xy_to_uv(line: Line, at: NDArray[np.int64], x: Floats, y: Floats, u: Floats, v: Floats) -> None:
    """Road coordinates (n,) of map positions (n,); NaN where one is not finite.

    The interval of each is looked for from the reference point ``at`` (n,), which must lie on the same
    part of the line, and is left there.
    """
    px, py, ends, u_first, u_last, u_step, straight, closes = line
    for i in range(x.size):
        if not (math.isfinite(x[i]) and math.isfinite(y[i])):
            u[i], v[i] = math.nan, math.nan
        elif straight:
            u[i], v[i] = _beside(px[0], py[0], ends[0], ends[1], u_first, x[i], y[i])
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
        i = min(int(max(f, 0.0)), last - 1)
        along = f - i
        if straight or along < 0.0 or along > 1.0:
            # a straight line: the road's own, or the one that goes on beyond an end
            end = along > 1.0 and not straight
            p, d = (last, (along - 1.0) * u_step) if end else (0, f * u_step)
            cos, sin = (ends[2], ends[3]) if end else (ends[0], ends[1])
            x[k] = px[p] + d * cos - v[k] * sin
            y[k] = py[p] + d * sin + v[k] * cos
        else:
            ax, ay = _corner(px, py, i, i, v[k])
            bx, by = _corner(px, py, i, i + 1, v[k])
            x[k], y[k] = ax + along * (bx - ax), ay + along * (by - ay)
