# SPDX-License-Identifier: Apache-2.0
"""The ground under a wheel for ``newton``: cubic convolution (Keys 1981), averaged over a patch."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from reality.surface import Surface

from blind.world import Floats


class Ground(NamedTuple):
    """Heights (nu, nv) over a reference line; ``last`` (5,) m keeps where each wheel and the driver were;
    ``reach`` and ``weight`` the points of the contact patch; ``sink`` (4,) m of the tyres at rest."""

    du: float
    dv: float
    v0: float
    z: Floats
    heading: Floats
    x: Floats
    y: Floats
    last: Floats
    reach: Floats
    weight: Floats
    sink: Floats


def ground_of(surface: Surface, u: Floats, patch: float, sink: Floats) -> Ground:
    """``patch`` m long, weighted like a parabola; ``u`` (5,) m where the probes are at first."""
    count = 1 if patch <= 0 else max(3, 2 * round(patch / 0.06) + 1)
    reach = np.linspace(-0.5, 0.5, count) * patch if count > 1 else np.zeros(1)
    weight = 1.0 - 0.8 * (2 * reach / patch) ** 2 if count > 1 else np.ones(1)
    return Ground(
        surface.du,
        surface.dv,
        surface.v0,
        np.ascontiguousarray(surface.z),
        surface.heading,
        surface.line[:, 0].copy(),
        surface.line[:, 1].copy(),
        np.array(u, dtype=float),
        reach,
        weight / weight.sum(),
        sink,
    )


@njit(cache=True)
def locate(g, i, x, y):  # type: ignore[no-untyped-def]
    """Place (u, v) of a point, and the cell it was found from; probe i starts from where it was."""
    u = g.last[i]
    cell = 0
    c = s = 0.0
    n = g.heading.size
    for _ in range(5):
        cell = min(max(int(u / g.du), 0), n - 2)
        c, s = math.cos(g.heading[cell]), math.sin(g.heading[cell])
        new = cell * g.du + (x - g.x[cell]) * c + (y - g.y[cell]) * s
        done = abs(new - u) < 1e-5
        u = new
        if done:
            break
    g.last[i] = u
    return u, -(x - g.x[cell]) * s + (y - g.y[cell]) * c, g.heading[cell]


@njit(cache=True)
def _keys(a, w, d):  # type: ignore[no-untyped-def]
    """Weights and slopes of the four neighbours at part a of a cell."""
    b = a * a
    e = b * a
    w[0], w[1], w[2], w[3] = (
        -0.5 * e + b - 0.5 * a,
        1.5 * e - 2.5 * b + 1,
        -1.5 * e + 2 * b + 0.5 * a,
        0.5 * (e - b),
    )
    d[0], d[1], d[2], d[3] = -1.5 * b + 2 * a - 0.5, 4.5 * b - 5 * a, -4.5 * b + 4 * a + 0.5, 1.5 * b - a


@njit(cache=True)
def probe(g, i, x, y, ca, sa, seen, w):  # type: ignore[no-untyped-def]
    """``seen`` := height and its slopes along map's x and y under the patch at (x, y), heading (ca, sa).

    ``w`` (4, 4) is room to work in.
    """
    u, v, heading = locate(g, i, x, y)
    ch, sh = math.cos(heading), math.sin(heading)
    du, dv = ca * ch + sa * sh, -ca * sh + sa * ch
    nu, nv = g.z.shape
    height = along = across = 0.0
    for k in range(g.reach.size):
        a = min(max((u + g.reach[k] * du) / g.du, 1.0), nu - 3.000001)
        b = min(max((v + g.reach[k] * dv - g.v0) / g.dv, 1.0), nv - 3.000001)
        p, q = int(a), int(b)
        _keys(a - p, w[0], w[1])
        _keys(b - q, w[2], w[3])
        h = hu = hv = 0.0
        for m in range(4):
            row = slope = 0.0
            for n in range(4):
                z = g.z[p - 1 + m, q - 1 + n]
                row += w[2, n] * z
                slope += w[3, n] * z
            h += w[0, m] * row
            hu += w[1, m] * row
            hv += w[0, m] * slope
        height += g.weight[k] * h
        along += g.weight[k] * hu / g.du
        across += g.weight[k] * hv / g.dv
    seen[0] = height
    seen[1], seen[2] = along * ch - across * sh, along * sh + across * ch
