# SPDX-License-Identifier: Apache-2.0
"""Static equilibrium of a lane, through piecewise linear springs, tyres and the elastic elements of effects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, compiled_later, inlined, linked, specialised
from suspension_twin.models import rows
from suspension_twin.models.curves import spring_force, spring_slope
from suspension_twin.models.rows import WIDTH, fma
from suspension_twin.units import STANDARD_GRAVITY as G

__all__ = ["stand", "stand_with"]

#: Steps of Newton's method, and after how many of them they are halved: a cycle between segments ends so.
_ROUNDS, _CYCLE = 100, 30
_SOFT = 1.0  # N/m, N m: stiffness of what has none (airborne, flat spring), far below any car's


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


@inlined
def _nothing(w: Floats, lane: int) -> None:
    """A lane without effects has no states to set to zero."""


@inlined
def _no_force(w: Floats, lane: int, travel: Floats, force: Floats, stiffness: Floats) -> None:
    """A lane without effects has no further elastic elements."""


_RESTART, _ELASTIC = _nothing, _no_force


@compiled_later
def _stand(
    w: Floats,
    lane: int,
    mx: float,
    my: float,
    forward: float,
    sideways: float,
    c0: int,
    c1: int,
    c2: int,
    c3: int,
    hinges: int,
) -> None:
    """Put one lane of a block in equilibrium on the road heights in its rows ROAD.

    ``mx``, ``my`` N m are the moments of the planar accelerations, ``c0``.. the first rows of the curves of the
    corners. The vehicle moves with ``forward`` and ``sideways`` m/s along the plane through its four contact points,
    so that a drive that begins on a slope begins without a jolt. Newton's method over heave, roll, pitch and four
    wheels, from that plane; elastic elements act on the compression of the four corners and on its difference at the
    two axles. A lane without an equilibrium is marked failed.
    """
    _RESTART(w, lane)
    curves = (c0, c1, c2, c3)
    weight = G / w[rows.INV_MASS * WIDTH + lane]
    tyre = w[rows.TYRE * WIDTH + lane]
    q, rest, k = np.empty(7), np.empty(7), np.empty((7, 7))
    travel, force, stiffness = np.empty(6), np.empty(6), np.empty(6)
    g = np.zeros((6, 7))  # decrease of compression: of the corners, then of left less right of the axles
    for c in range(4):
        q[3 + c] = w[(rows.ROAD + c) * WIDTH + lane]
        g[c, 0] = 1.0
        g[c, 1] = w[(rows.ARM_Y + c) * WIDTH + lane]
        g[c, 2] = -w[(rows.ARM_X + c // 2) * WIDTH + lane]
        g[c, 3 + c] = -1.0
    for a in range(2):
        for j in range(7):
            g[4 + a, j] = g[2 * a, j] - g[2 * a + 1, j]
    rear = 0.5 * (q[5] + q[6])
    q[1] = 0.5 * ((q[3] - q[4]) / g[4, 1] + (q[5] - q[6]) / g[5, 1])
    q[2] = (rear - 0.5 * (q[3] + q[4])) / (g[2, 2] - g[0, 2])
    q[0] = rear - g[2, 2] * q[2]
    climb = -q[2] * forward + q[1] * sideways
    small = 1e-11 * weight
    error = 2.0 * small
    for attempt in range(_ROUNDS):
        for c in range(4):
            x = -(g[c, 0] * q[0] + g[c, 1] * q[1] + g[c, 2] * q[2] + g[c, 3 + c] * q[3 + c])
            free = w[(rows.STATIC + c) * WIDTH + lane] + x
            travel[c] = x
            force[c] = spring_force(w, curves[c], hinges, lane, free) + w[rows.ACTUATOR * WIDTH + lane]
            stiffness[c] = max(spring_slope(w, curves[c], hinges, lane, free), 0.0)
        for a in range(2):
            travel[4 + a] = travel[2 * a] - travel[2 * a + 1]
            force[4 + a] = stiffness[4 + a] = 0.0
        _ELASTIC(w, lane, travel, force, stiffness)
        rest[:] = 0.0
        rest[0], rest[1], rest[2] = -weight, mx, my
        k[:] = 0.0
        for j in range(7):
            k[j, j] = _SOFT
        for c in range(4):
            share = 1.0 + w[(rows.TYRE_CHANGE + c) * WIDTH + lane]
            pull = w[(rows.LOAD + c) * WIDTH + lane] + tyre * (w[(rows.ROAD + c) * WIDTH + lane] - q[3 + c])
            pull *= share
            if pull > 0.0:
                rest[3 + c] += pull
                k[3 + c, 3 + c] += share * tyre
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
        _solve(k, rest)
        q += (0.5 if attempt > _CYCLE else 1.0) * rest
        if error <= small:  # after one more step: to rounding
            break
    if not error <= 1e3 * small:
        w[rows.FAILED * WIDTH + lane] = 1.0
    for j in range(7):
        static = w[(rows.STATIC + j - 3) * WIDTH + lane] if j > 2 else 0.0
        w[(rows.POSITION + j) * WIDTH + lane] = q[j] + static
        w[(rows.VELOCITY + j) * WIDTH + lane] = 0.0 if j == 1 or j == 2 else climb
        w[(rows.ACCELERATION + j) * WIDTH + lane] = 0.0
    for c in range(4):
        w[(rows.DAMPER + c) * WIDTH + lane] = 0.0
        above = w[(rows.ROAD + c) * WIDTH + lane] - w[(rows.WHEEL + c) * WIDTH + lane]
        share = 1.0 + w[(rows.TYRE_CHANGE + c) * WIDTH + lane]
        w[(rows.GROUND + c) * WIDTH + lane] = share * fma(tyre, above, w[(rows.TOUCH + c) * WIDTH + lane])


#: ``_stand`` of lanes without effects.
stand = compiled(_stand)


def stand_with(restart: Callable[..., None], elastic: Callable[..., None]) -> Callable[..., None]:
    """``_stand`` with effects: ``restart(w, lane)`` sets their states to zero, ``elastic(w, lane, travel, force,
    stiffness)`` adds their forces in N and stiffnesses in N/m of four corners and two axles."""
    standing: Callable[..., None] = linked(specialised(_stand, "stand", _RESTART=restart, _ELASTIC=elastic))
    return standing
