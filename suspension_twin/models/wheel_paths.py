# SPDX-License-Identifier: Apache-2.0
"""Where the wheels are at every step: compiled, and the same code for batch and live."""

from __future__ import annotations

import math

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models.types import Ints

__all__ = ["YAW_TIME", "next_yaw_acceleration", "walk", "yaw_accelerations"]

#: Time constant in s of the filtered difference that gives the yaw acceleration. It delays the
#: lever-arm term a little and keeps gyro noise over a jittered interval from blowing it up.
YAW_TIME = 0.03


@compiled
def walk(
    x: Floats,
    y: Floats,
    yaw: Floats,
    count: Ints,
    first: Ints,
    begin: int,
    end: int,
    wheels: Floats,
    wheel_x: Floats,
    wheel_y: Floats,
) -> None:
    """Fill (rows, 4) ``map`` positions of the wheel centres for the stamps begin..end-1.

    ``count`` and ``first`` as in Excitation; poses run linearly between stamps. ``wheels`` (4, 2)
    in base_link.
    """
    origin = first[begin]
    for k in range(begin, end):
        n = max(1, count[k])
        for j in range(n):
            px, py, angle = x[k], y[k], yaw[k]
            if j < n - 1:
                share = (j + 1) / n
                px = x[k - 1] + share * (px - x[k - 1])
                py = y[k - 1] + share * (py - y[k - 1])
                angle = yaw[k - 1] + share * (angle - yaw[k - 1])
            c, s = math.cos(angle), math.sin(angle)
            row = first[k] + j - origin
            for i in range(4):
                wheel_x[row, i] = px + c * wheels[i, 0] - s * wheels[i, 1]
                wheel_y[row, i] = py + s * wheels[i, 0] + c * wheels[i, 1]


def next_yaw_acceleration(value: float, change: float, interval: float) -> float:
    """One step of the filtered difference: ``change`` rad/s of the yaw rate in ``interval`` s."""
    return value + (change - value * interval) / (interval + YAW_TIME)


_next = compiled(next_yaw_acceleration)


@compiled
def yaw_accelerations(t: Floats, yaw_rate: Floats, count: Ints, out: Floats) -> None:
    """Fill (n,) rad/s² the filtered difference of the yaw rate; zero at every fresh start."""
    value = 0.0
    for k in range(t.size):
        value = _next(value, yaw_rate[k] - yaw_rate[k - 1], t[k] - t[k - 1]) if count[k] > 0 else 0.0
        out[k] = value
