# SPDX-License-Identifier: Apache-2.0
"""Loops over the points of a scan, compiled: the lowest surface of each cell, and the equations of a bilinear surface.

A point at (u, v) observes the bilinear interpolation of the four nodes around it. Nodes are numbered i * nv + j; a
matrix over them is banded, stored as LAPACK's lower form: band[k, j] = A[j + k, j].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = ["accumulate", "by_cell", "in_band", "lowest_surface", "residuals"]

Singles = NDArray[np.float32]
Ints = NDArray[np.int32]


@compiled
def by_cell(
    u: Singles, v: Singles, size: float, v0: float, nu: int, nv: int, first: Ints, order: Ints
) -> None:
    """Points (n,) by their square cells of ``size`` m: ``order`` (n,), and where each cell begins, (nu nv + 1,)."""
    for p in range(u.size):
        i = min(max(int(u[p] / size), 0), nu - 1)
        j = min(max(int((v[p] - v0) / size), 0), nv - 1)
        first[i * nv + j + 1] += 1
    for k in range(nu * nv):
        first[k + 1] += first[k]
    place = first.copy()
    for p in range(u.size):
        i = min(max(int(u[p] / size), 0), nu - 1)
        j = min(max(int((v[p] - v0) / size), 0), nv - 1)
        order[place[i * nv + j]] = p
        place[i * nv + j] += 1


@compiled
def lowest_surface(
    z: Singles, first: Ints, order: Ints, least: int, share: float, layer: float, high: float,
    obstacle: float,
    out: Floats, above: Floats, next_layer: Floats, rise: Floats,
) -> None:  # fmt: skip
    """Of each cell the height ``out`` of the lowest layer of points, and the share ``above`` it up to ``high`` m.

    A layer is ``layer`` m thick and holds ``least`` points and ``share`` of the cell's at least; NaN without one.
    ``next_layer``: points within two layers above it for each one within a layer of its middle. Where there are points
    enough and no layer, all of them stand. ``rise``: how far, m, points go on upwards from it without a gap of a
    layer's thickness, to the top of a kerb or an obstacle; 0 where they go on beyond ``obstacle`` m.
    """
    for k in range(out.size):
        n = first[k + 1] - first[k]
        out[k] = np.nan
        above[k] = 0.0
        next_layer[k] = 0.0
        rise[k] = 0.0
        need = max(least, int(share * n))
        if n < need:
            continue
        h = np.sort(z[order[first[k] : first[k + 1]]])
        begin = -1
        for i in range(n - need + 1):
            if h[i + need - 1] - h[i] <= layer:
                begin = i
                break
        if begin < 0:
            above[k] = 1.0
            next_layer[k] = np.inf
            continue
        # Its middle: the layer starts in the tail of the surface's own spread.
        level = float(h[begin + need // 2])
        for _ in range(3):
            low = np.searchsorted(h, level - layer)
            top = np.searchsorted(h, level + layer)
            level = float(h[(low + top) // 2])
        out[k] = level
        count = 0
        for i in range(n):
            if 0.1 < h[i] - level < high:
                count += 1
        above[k] = count / n
        low = np.searchsorted(h, level - layer)
        top = np.searchsorted(h, level + layer)
        over = np.searchsorted(h, level + 3.0 * layer)
        next_layer[k] = float(over - top) / float(top - low)
        while top < n and h[top] - h[top - 1] <= layer:
            top += 1
        reach = float(h[top - 1]) - level
        rise[k] = reach if reach <= obstacle else 0.0


@compiled
def in_band(
    u: Singles,
    v: Singles,
    z: Singles,
    size: float,
    v0: float,
    low: Floats,
    high: Floats,
    keep: NDArray[np.bool_],
) -> None:
    """Points (n,) between the bounds (nu, nv) of their cells; NaN keeps none."""
    nu, nv = low.shape
    for p in range(u.size):
        i = min(max(int(u[p] / size), 0), nu - 1)
        j = min(max(int((v[p] - v0) / size), 0), nv - 1)
        keep[p] = low[i, j] <= z[p] <= high[i, j]


@compiled
def accumulate(
    u: Singles, v: Singles, z: Singles, w: Floats, u0: float, v0: float, du: float, dv: float, nu: int, nv: int,
    band: Floats, right: Floats,
) -> None:  # fmt: skip
    """Add weighted points (n,) to the normal equations of the nodes."""
    for p in range(u.size):
        fu, fv = (u[p] - u0) / du, (v[p] - v0) / dv
        i, j = min(max(int(fu), 0), nu - 2), min(max(int(fv), 0), nv - 2)
        a, c = fu - i, fv - j
        k = i * nv + j
        w00, w01, w10, w11 = (1.0 - a) * (1.0 - c), (1.0 - a) * c, a * (1.0 - c), a * c
        weight = w[p]
        band[0, k] += weight * w00 * w00
        band[1, k] += weight * w00 * w01
        band[nv, k] += weight * w00 * w10
        band[nv + 1, k] += weight * w00 * w11
        band[0, k + 1] += weight * w01 * w01
        band[nv - 1, k + 1] += weight * w01 * w10
        band[nv, k + 1] += weight * w01 * w11
        band[0, k + nv] += weight * w10 * w10
        band[1, k + nv] += weight * w10 * w11
        band[0, k + nv + 1] += weight * w11 * w11
        r = weight * z[p]
        right[k] += r * w00
        right[k + 1] += r * w01
        right[k + nv] += r * w10
        right[k + nv + 1] += r * w11


@compiled
def residuals(
    u: Singles, v: Singles, z: Singles, u0: float, v0: float, du: float, dv: float, x: Floats, out: Floats
) -> None:
    """Heights (n,) of points above the surface of nodes ``x`` (nu, nv)."""
    nu, nv = x.shape
    for p in range(u.size):
        fu, fv = (u[p] - u0) / du, (v[p] - v0) / dv
        i, j = min(max(int(fu), 0), nu - 2), min(max(int(fv), 0), nv - 2)
        a, c = fu - i, fv - j
        low = x[i, j] + c * (x[i, j + 1] - x[i, j])
        top = x[i + 1, j] + c * (x[i + 1, j + 1] - x[i + 1, j])
        out[p] = z[p] - (low + a * (top - low))
