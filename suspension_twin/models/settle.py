# SPDX-License-Identifier: Apache-2.0
"""Where a lane with effects stands: on from where it stands without them."""

from __future__ import annotations

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

    Never raises: a lane whose stiffness is not finite gets an answer that is not, and fails alone.
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


@compiled
def settle(w: Floats, lane: int, mx: float, my: float, hinges: int) -> None:
    """Static equilibrium of one lane of a block with effects, from where ``stand`` put it.

    Springs of every corner's own, however progressive, stops and anti-roll bars; friction, engine mounts and body
    bending carry nothing at first. A lane that already stands is not touched at all. ``mx``,
    ``my`` N m are the moments of the planar accelerations.
    """
    for c in range(4):
        w[(rows.FRICTION + c) * WIDTH + lane] = 0.0
        w[(rows.SLACK + c) * WIDTH + lane] = 0.0
    for j in range(3):
        w[(rows.ENGINE + j) * WIDTH + lane] = 0.0
        w[(rows.BEND + j) * WIDTH + lane] = 0.0
    curves = rows.CURVES + 2 * (5 + 6 * hinges)
    weight = G / w[rows.INV_MASS * WIDTH + lane]
    tyre = w[rows.TYRE * WIDTH + lane]
    q = np.empty(7)
    for j in range(7):
        q[j] = w[j * WIDTH + lane] - (w[(rows.STATIC + j - 3) * WIDTH + lane] if j > 2 else 0.0)
    rest, k, g, pull = np.empty(7), np.empty((7, 7)), np.zeros((4, 7)), np.empty(4)
    travel, force, stiffness = np.empty(4), np.empty(4), np.empty(4)
    for c in range(4):
        g[c, 0] = 1.0
        g[c, 1] = w[(rows.ARM_Y + c) * WIDTH + lane]
        g[c, 2] = -w[(rows.ARM_X + c // 2) * WIDTH + lane]
        g[c, 3 + c] = -1.0
    small = 1e-10 * weight
    error = 2 * small
    for attempt in range(_ROUNDS):
        for c in range(4):
            x = -(g[c, 0] * q[0] + g[c, 1] * q[1] + g[c, 2] * q[2] + g[c, 3 + c] * q[3 + c])
            travel[c] = x
            first = curves + c * (5 + 6 * hinges)
            free = w[(rows.STATIC + c) * WIDTH + lane] + x
            force[c] = spring_force(w, first, hinges, lane, free)
            stiffness[c] = max(spring_slope(w, first, hinges, lane, free), 0.0)
            bump = x - w[(rows.BUMP_GAP + c) * WIDTH + lane]
            if bump > 0.0:
                rate, rise = w[(rows.BUMP_RATE + c) * WIDTH + lane], w[(rows.BUMP_RISE + c) * WIDTH + lane]
                force[c] += bump * (rate + rise * bump)
                stiffness[c] += rate + 2 * rise * bump
            droop = -x - w[(rows.REBOUND_GAP + c) * WIDTH + lane]
            if droop > 0.0:
                rate, rise = (
                    w[(rows.REBOUND_RATE + c) * WIDTH + lane],
                    w[(rows.REBOUND_RISE + c) * WIDTH + lane],
                )
                force[c] -= droop * (rate + rise * droop)
                stiffness[c] += rate + 2 * rise * droop
            rise, square = w[(rows.RATE_RISE + c) * WIDTH + lane], w[(rows.RATE_SQUARE + c) * WIDTH + lane]
            force[c] += x * x * (0.5 * rise + square * x / 3.0)
            stiffness[c] += max(x * (rise + square * x), -stiffness[c])
        for a in range(2):
            bar = w[(rows.BAR + a) * WIDTH + lane] * (travel[2 * a] - travel[2 * a + 1])
            force[2 * a] += bar
            force[2 * a + 1] -= bar
        rest[:] = 0.0
        rest[0], rest[1], rest[2] = -weight, mx, my
        k[:] = 0.0
        for j in range(7):
            k[j, j] = 1.0
        for c in range(4):
            pull[c] = w[(rows.LOAD + c) * WIDTH + lane] + tyre * (
                w[(rows.ROAD + c) * WIDTH + lane] - q[3 + c]
            )
            if pull[c] > 0.0:
                rest[3 + c] += pull[c]
                k[3 + c, 3 + c] += tyre
            rest[3 + c] -= G / w[(rows.INV_WHEEL + c // 2) * WIDTH + lane]
            for a in range(7):
                rest[a] += force[c] * g[c, a]
                for b in range(7):
                    k[a, b] += stiffness[c] * g[c, a] * g[c, b]
        for axle in range(2):
            for a in range(7):
                for b in range(7):
                    left = g[2 * axle, a] - g[2 * axle + 1, a]
                    right = g[2 * axle, b] - g[2 * axle + 1, b]
                    k[a, b] += w[(rows.BAR + axle) * WIDTH + lane] * left * right
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
            w[j * WIDTH + lane] = q[j] + (w[(rows.STATIC + j - 3) * WIDTH + lane] if j > 2 else 0.0)
    for c in range(4):
        above = w[(rows.ROAD + c) * WIDTH + lane] - w[(3 + c) * WIDTH + lane]
        w[(rows.GROUND + c) * WIDTH + lane] = fma(tyre, above, w[(rows.TOUCH + c) * WIDTH + lane])
