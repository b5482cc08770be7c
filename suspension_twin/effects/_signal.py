# SPDX-License-Identifier: Apache-2.0
"""A second-order stage of the sensor's chain, compiled."""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.effects.base import Bools, Floats, compiled

__all__ = ["STATES", "second_order"]

STATES = 6  # of one axis


@compiled
def second_order(
    signals: Floats,
    t: Floats,
    fresh: Bools,
    axis: int,
    axes: int,
    lane: int,
    omega: float,
    zeta: float,
    feed: float,
    gain: float,
    state: Floats,
) -> None:
    """``axes`` of one lane from ``axis`` on through q'' + 2 zeta omega q' + omega² q = x, in place.

    What is read is x + gain (omega² q + feed q' - x): with ``feed`` 2 zeta omega a mass shaken at
    its foot, with 0 a low-pass. Exact for x that is a parabola through three stamps, however these
    jitter: a line between two takes a twentieth off a wheel's hop at 12 of 100 Hz. At rest under x at
    a fresh start. ``state`` keeps ``STATES`` rows of every axis: q, q', x, the stamp, x's last slope and
    the time it held for. ``zeta`` < 1.
    """
    damped = omega * math.sqrt(1.0 - zeta * zeta)
    square = omega * omega
    own = np.empty((axes, STATES))  # by loops: assignments to slices take the compiler two seconds
    for i in range(axes):
        for j in range(STATES):
            own[i, j] = state[STATES * i + j, lane]
    for k in range(t.size):
        known, decay, c, s = -1.0, 0.0, 0.0, 0.0  # axes mostly have a step in common
        for i in range(axes):
            q, v, before, last, earlier, held = (
                own[i, 0],
                own[i, 1],
                own[i, 2],
                own[i, 3],
                own[i, 4],
                own[i, 5],
            )
            x = signals[k, axis + i, lane]
            h = t[k] - last
            if fresh[k]:
                q, v, held = x / square, 0.0, 0.0
            elif h > 0.0:
                if h != known:
                    decay, c, s = (
                        math.exp(-zeta * omega * h),
                        math.cos(damped * h),
                        math.sin(damped * h) / damped,
                    )
                    known = h
                slope = (x - before) / h
                bend = (slope - earlier) / (h + held) if held > 0.0 else 0.0
                # x = before + (slope - bend h) s + bend s², answered by q = level + rise s + curve s² and a free swing
                curve = bend / square
                rise = (slope - bend * h) / square - 4.0 * zeta / omega * curve
                level = before / square - 2.0 * zeta / omega * rise - 2.0 * curve / square
                p0, v0 = q - level, v - rise
                q = decay * (p0 * (c + zeta * omega * s) + v0 * s) + level + (rise + curve * h) * h
                v = decay * (v0 * (c - zeta * omega * s) - p0 * square * s) + rise + 2.0 * curve * h
                earlier, held = slope, h
            own[i, 0], own[i, 1], own[i, 2], own[i, 3], own[i, 4], own[i, 5] = q, v, x, t[k], earlier, held
            more = gain * (square * q + feed * v - x)
            signals[k, axis + i, lane] = x + more
            if axis + i == 2:
                signals[k, 6, lane] += more
    for i in range(axes):
        for j in range(STATES):
            state[STATES * i + j, lane] = own[i, j]
