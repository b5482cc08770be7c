# SPDX-License-Identifier: Apache-2.0
"""What several stages of the sensor's chain are made of, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from suspension_twin.compiled import compiled
from suspension_twin.drive.types import Floats

__all__ = ["second_order"]


@compiled
def second_order(
    signals: Floats, t: Floats, fresh: NDArray[np.bool_], axis: int, lane: int, omega: float, zeta: float,
    feed: float, gain: float, state: Floats, first: int,
) -> None:  # fmt: skip
    """One axis of one lane through q'' + 2 zeta omega q' + omega² q = x, in place.

    What is read is x + gain (omega² q + feed q' - x): with ``feed`` 2 zeta omega a mass shaken at
    its foot, with 0 a low-pass. Exact for x linear between stamps, however these jitter; at rest
    under x at a fresh start. ``state`` rows ``first``.. keep q, q', x and the stamp. ``zeta`` < 1.
    """
    damped = omega * math.sqrt(1.0 - zeta * zeta)
    q, v, before, last = (
        state[first, lane],
        state[first + 1, lane],
        state[first + 2, lane],
        state[first + 3, lane],
    )
    for k in range(t.size):
        x = signals[k, axis, lane]
        h = t[k] - last
        if fresh[k]:
            q, v = x / (omega * omega), 0.0
        elif h > 0.0:
            slope = (x - before) / h / (omega * omega)
            level = before / (omega * omega) - 2.0 * zeta / omega * slope
            p0, v0 = q - level, v - slope
            decay, c, s = math.exp(-zeta * omega * h), math.cos(damped * h), math.sin(damped * h) / damped
            q = decay * (p0 * (c + zeta * omega * s) + v0 * s) + level + slope * h
            v = decay * (v0 * (c - zeta * omega * s) - p0 * omega * omega * s) + slope
        before, last = x, t[k]
        more = gain * (omega * omega * q + feed * v - x)
        signals[k, axis, lane] = x + more
        if axis == 2:
            signals[k, 6, lane] += more
    state[first, lane], state[first + 1, lane], state[first + 2, lane], state[first + 3, lane] = (
        q,
        v,
        before,
        last,
    )
