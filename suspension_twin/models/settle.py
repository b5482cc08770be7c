# SPDX-License-Identifier: Apache-2.0
"""Static equilibrium of a lane with effects, from the equilibrium without them."""

from __future__ import annotations

from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models import rows
from suspension_twin.models.curves import spring_force, spring_slope
from suspension_twin.models.numerics import fma
from suspension_twin.models.rows import WIDTH
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = ["settle"]

_ROUNDS = 100


@compiled
def _solve(k: Floats, rest: Floats) -> None:
    """Solve ``k x = rest`` in place for a positive definite ``k`` (7, 7).

    Never raises: a lane whose stiffness is not finite gets an answer that is not finite, and fails alone.
    """
    for j in range(7):
        for a in range(j + 1, 7):
            share = k[a, j] / k[j, j]
            for b in range(j + 1, 7):
                k[a, b] -= share * k[j, b]
            rest[a] -= share * rest[j]
    for j in range(6, -1, -1):
        for b in range(j + 1, 7):
            rest[j] -= k[j, b] * rest[b]
        rest[j] /= k[j, j]


#: Of each assembly of the kernel: forces of elastic elements of effects, and rows that are zero after a fresh start.
_ELASTIC: Any = None
_RESTARTED: tuple[int, ...] = ()


def settle(w: Floats, lane: int, mx: float, my: float, curves: int, hinges: int) -> None:
    """Static equilibrium of one lane of a block with effects, from where ``stand`` put it.

    Springs of every corner's own and elastic elements of effects; the other terms carry nothing at first. A lane that
    is in equilibrium already is not touched at all. ``mx``, ``my`` N m are the moments of the planar accelerations,
    ``curves`` the first row of the axles' curves. Newton's method over heave, roll, pitch and four wheels; elastic
    elements act on the compression of the four corners and on its difference at the two axles.
    """
    for row in _RESTARTED:
        w[row * WIDTH + lane] = 0.0
    stride = 5 + 6 * hinges
    weight = G / w[rows.INV_MASS * WIDTH + lane]
    tyre = w[rows.TYRE * WIDTH + lane]
    q = np.empty(7)
    for j in range(7):
        q[j] = w[(rows.POSITION + j) * WIDTH + lane] - (
            w[(rows.STATIC + j - 3) * WIDTH + lane] if j > 2 else 0.0
        )
    rest, k = np.empty(7), np.empty((7, 7))
    travel, force, stiffness = np.empty(6), np.empty(6), np.empty(6)
    g = np.zeros((6, 7))  # what takes compression away: corners, then left less right of the axles
    for c in range(4):
        g[c, 0] = 1.0
        g[c, 1] = w[(rows.ARM_Y + c) * WIDTH + lane]
        g[c, 2] = -w[(rows.ARM_X + c // 2) * WIDTH + lane]
        g[c, 3 + c] = -1.0
    for a in range(2):
        for j in range(7):
            g[4 + a, j] = g[2 * a, j] - g[2 * a + 1, j]
    small = 1e-10 * weight
    error = 2 * small
    for attempt in range(_ROUNDS):
        for c in range(4):
            x = -(g[c, 0] * q[0] + g[c, 1] * q[1] + g[c, 2] * q[2] + g[c, 3 + c] * q[3 + c])
            first = curves + (2 + c) * stride
            free = w[(rows.STATIC + c) * WIDTH + lane] + x
            travel[c] = x
            force[c] = spring_force(w, first, hinges, lane, free)
            stiffness[c] = max(spring_slope(w, first, hinges, lane, free), 0.0)
        for a in range(2):
            travel[4 + a] = travel[2 * a] - travel[2 * a + 1]
            force[4 + a] = stiffness[4 + a] = 0.0
        _ELASTIC(w, lane, travel, force, stiffness)
        rest[:] = 0.0
        rest[0], rest[1], rest[2] = -weight, mx, my
        k[:] = 0.0
        for j in range(7):
            k[j, j] = 1.0
        for c in range(4):
            pull = w[(rows.LOAD + c) * WIDTH + lane] + tyre * (w[(rows.ROAD + c) * WIDTH + lane] - q[3 + c])
            if pull > 0.0:
                rest[3 + c] += pull
                k[3 + c, 3 + c] += tyre
            rest[3 + c] -= G / w[(rows.INV_WHEEL + c // 2) * WIDTH + lane]
        for c in range(6):
            stiff = max(stiffness[c], 0.0)
            for a in range(7):
                rest[a] += force[c] * g[c, a]
                for b in range(7):
                    k[a, b] += stiff * g[c, a] * g[c, b]
        error = 0.0
        for j in range(7):
            error = error if error >= abs(rest[j]) else abs(rest[j])  # what is not finite goes in and stays
        if error <= small:
            break
        _solve(k, rest)
        q += (0.5 if attempt > 30 else 1.0) * rest
    if not error <= 1e3 * small:
        w[rows.FAILED * WIDTH + lane] = 1.0
    if attempt > 0:
        for j in range(7):
            w[(rows.POSITION + j) * WIDTH + lane] = q[j] + (
                w[(rows.STATIC + j - 3) * WIDTH + lane] if j > 2 else 0.0
            )
    for c in range(4):
        above = w[(rows.ROAD + c) * WIDTH + lane] - w[(rows.WHEEL + c) * WIDTH + lane]
        w[(rows.GROUND + c) * WIDTH + lane] = fma(tyre, above, w[(rows.TOUCH + c) * WIDTH + lane])
