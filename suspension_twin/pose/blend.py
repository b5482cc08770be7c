# SPDX-License-Identifier: Apache-2.0
"""Gradual output of the filter's corrections, without steps."""

from __future__ import annotations

import math

from suspension_twin.arrays import Floats
from suspension_twin.pose.ekf import SPEED, YAW, X, Y

__all__ = ["Blend"]


class Blend:
    """Offsets between the output and the filter's state: x, y, yaw and speed.

    Each dies away like a critically damped second-order system of ``time`` s, so the output has no
    step in position and, from a correction of the speed, none in velocity. A correction of the
    position alone moves it at ``speed`` m/s at most; one beyond ``snap`` m is jumped at once.
    """

    def __init__(self, time: float, speed: float, snap: float) -> None:
        self._time = time
        self._speed = speed
        self._snap = snap
        self.clear()

    def clear(self) -> None:
        """The output is the filter's state."""
        self._offset = [0.0, 0.0, 0.0, 0.0]
        self._rate = [0.0, 0.0, 0.0]
        self._slow = self._time  # s, of the position
        self._t = math.nan

    def correct(self, before: Floats, after: Floats) -> None:
        """The filter's newest state was ``before`` (8,) and is now ``after`` (8,)."""
        offset = self._offset
        offset[0] += float(before[X] - after[X])
        offset[1] += float(before[Y] - after[Y])
        offset[2] += float(before[YAW] - after[YAW])
        offset[3] += float(before[SPEED] - after[SPEED])
        c0, s0 = math.cos(before[YAW]), math.sin(before[YAW])
        c1, s1 = math.cos(after[YAW]), math.sin(after[YAW])
        self._rate[0] += float(before[SPEED] * c0 - after[SPEED] * c1)
        self._rate[1] += float(before[SPEED] * s0 - after[SPEED] * s1)
        length = math.hypot(offset[0], offset[1])
        # The largest speed of the decay is offset / time / e.
        self._slow = max(self._time, length / (math.e * self._speed))
        if length > self._snap or abs(offset[2]) > 0.5:
            self.clear()

    def step(self, t: float) -> tuple[float, float, float, float]:
        """Offsets of x m, y m, yaw rad and speed m/s to add at ``t`` s."""
        dt = min(t - self._t, 0.2) if math.isfinite(self._t) else 0.0
        self._t = t
        if dt > 0.0:
            for k in range(3):
                w = 1.0 / (self._slow if k < 2 else self._time)
                x, v = self._offset[k], self._rate[k]
                fade = math.exp(-w * dt)
                linear = v + w * x
                self._offset[k] = (x + linear * dt) * fade
                self._rate[k] = (v - w * linear * dt) * fade
            self._offset[3] *= math.exp(-dt / self._time)
        x, y, yaw, v = self._offset
        return x, y, yaw, v
