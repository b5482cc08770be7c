# SPDX-License-Identifier: Apache-2.0
"""Compiled heights of a road.

The rules are those of ASAM OpenCRG 2.0 (bilinear grid, slope, banking, border modes, smoothing
zones), so that the values are those of the OpenCRG library.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.road.surface import Grid

__all__ = [
    "INSIDE",
    "NOT_FINITE",
    "OUTSIDE",
    "REFUSED",
    "VOID",
    "heights_uv",
]

# What a query met, as bits.
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
    """Height and what was met at (u, v) by all of OpenCRG's rules, where the plain case does not hold."""
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
    """Heights (n,) at road coordinates (n,) into ``out``, what was met into ``seen``; all bits or-ed."""
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
