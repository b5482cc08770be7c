# SPDX-License-Identifier: Apache-2.0
"""What several stages of the sensor's chain are made of, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from suspension_twin.compiled import compiled
from suspension_twin.drive.types import Floats

__all__ = ["STATES", "second_order"]

STATES = 6  # of one axis


@compiled
def second_order(
    signals: Floats, t: Floats, fresh: NDArray[np.bool_], axis: int, lane: int, omega: float, zeta: float,
    feed: float, gain: float, state: Floats, first: int,
) -> None:  # fmt: skip
    """One axis of one lane through q'' + 2 zeta omega q' + omega² q = x, in place.

    What is read is x + gain (omega² q + feed q' - x): with ``feed`` 2 zeta omega a mass shaken at
    its foot, with 0 a low-pass. Exact for x that is a parabola through three stamps, however these
    jitter: a line between two takes a twentieth off a wheel's hop at 12 of 100 Hz. At rest under x at
    a fresh start. ``state`` rows ``first``.. keep ``STATES``: q, q', x, the stamp, x's last slope and
    the time it held for. ``zeta`` < 1.
    """
    damped = omega * math.sqrt(1.0 - zeta * zeta)
    square = omega * omega
    q, v = state[first, lane], state[first + 1, lane]
    before, last = state[first + 2, lane], state[first + 3, lane]
    earlier, held = state[first + 4, lane], state[first + 5, lane]
    for k in range(t.size):
        x = signals[k, axis, lane]
        h = t[k] - last
        if fresh[k]:
            q, v, held = x / square, 0.0, 0.0
        elif h > 0.0:
            slope = (x - before) / h
            bend = (slope - earlier) / (h + held) if held > 0.0 else 0.0
            # x = before + (slope - bend h) s + bend s², which q = level + rise s + curve s² answers, and a free swing
            curve = bend / square
            rise = (slope - bend * h) / square - 4.0 * zeta / omega * curve
            level = before / square - 2.0 * zeta / omega * rise - 2.0 * curve / square
            p0, v0 = q - level, v - rise
            decay, c, s = math.exp(-zeta * omega * h), math.cos(damped * h), math.sin(damped * h) / damped
            q = decay * (p0 * (c + zeta * omega * s) + v0 * s) + level + (rise + curve * h) * h
            v = decay * (v0 * (c - zeta * omega * s) - p0 * square * s) + rise + 2.0 * curve * h
            earlier, held = slope, h
        before, last = x, t[k]
        more = gain * (square * q + feed * v - x)
        signals[k, axis, lane] = x + more
        if axis == 2:
            signals[k, 6, lane] += more
    state[first, lane], state[first + 1, lane] = q, v
    state[first + 2, lane], state[first + 3, lane] = before, last
    state[first + 4, lane], state[first + 5, lane] = earlier, held
