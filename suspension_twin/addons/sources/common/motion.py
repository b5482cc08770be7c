# SPDX-License-Identifier: Apache-2.0
"""By how much the stamps of an IMU are later than those of a receiver, from what both see of the vehicle's motion.

The lag is that of the largest correlation of their motion (:mod:`suspension_twin.drive.motion`). Its standard deviation
is that of a least-squares fit: residual over slope, of as many independent values as there are separate intervals.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.motion import LEAST_CORRELATION, CommonMotion
from suspension_twin.drive.types import ImuData, VelocityData

__all__ = ["MotionLag", "MotionShift"]

#: s of motion that are looked at, and over which IMU samples are averaged.
_WINDOW, _BIN = 90.0, 0.05
#: Largest lag that is looked for, and the step of the search, in s.
_REACH, _STEP = 1.5, 0.05
#: Velocities and bins of the IMU before anything is looked for.
_LEAST = 20


@dataclass(frozen=True)
class MotionShift:
    """``lag`` s of the IMU's stamps (positive: later), its standard deviation ``sigma`` s, and the correlation."""

    lag: float
    sigma: float
    correlation: float


class MotionLag:
    """Takes the samples as they come; :meth:`estimate` looks at the last minute and a half."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        bins = round(_WINDOW / _BIN)
        self._t: deque[float] = deque(maxlen=bins)
        self._force: deque[Floats] = deque(maxlen=bins)
        self._velocity: deque[tuple[float, complex]] = deque(maxlen=round(_WINDOW * 10))
        self._sum, self._count, self._began = np.zeros(3), 0, -math.inf

    def imu(self, samples: ImuData) -> None:
        """Specific forces, in about the order of their stamps."""
        edges = np.floor(samples.t / _BIN)
        for start, end in _runs(edges):
            if edges[start] != self._began:
                if self._count and (not self._t or self._began * _BIN > self._t[-1]):
                    self._t.append((self._began + 1.0) * _BIN)  # the end of the bin
                    self._force.append(self._sum / self._count)
                self._sum, self._count, self._began = np.zeros(3), 0, float(edges[start])
            self._sum = self._sum + samples.specific_force[start:end].sum(axis=0)
            self._count += end - start

    def velocity(self, samples: VelocityData) -> None:
        """Velocities east, north, in the order of their stamps."""
        for t, (east, north, _) in zip(samples.t.tolist(), samples.enu.tolist(), strict=True):
            if not self._velocity or t > self._velocity[-1][0]:
                self._velocity.append((t, complex(east, north)))

    def estimate(self) -> MotionShift | None:
        """The lag; None where the motion does not tell it."""
        if len(self._velocity) < _LEAST or len(self._t) < 2 * _LEAST:
            return None
        t, v = np.array([p[0] for p in self._velocity]), np.array([p[1] for p in self._velocity])
        motion = CommonMotion.of(np.array(self._t), np.array(self._force), t, v).within(0.0, _REACH)
        if not motion.enough:
            return None
        lags = np.arange(-_REACH, _REACH + 0.5 * _STEP, _STEP)
        found = motion.correlations(lags.tolist())
        best = int(np.argmax(found))
        if not 0 < best < lags.size - 1 or found[best] < LEAST_CORRELATION:
            return None
        left, top, right = found[best - 1 : best + 2]
        lag = float(
            lags[best]
            + _STEP * np.clip(0.5 * (right - left) / max(2.0 * top - left - right, 1e-9), -1.0, 1.0)
        )
        f, slope = motion.force(lag), (motion.force(lag + 0.02) - motion.force(lag - 0.02)) / 0.04
        gain = np.vdot(motion.acceleration, f) / np.vdot(motion.acceleration, motion.acceleration)
        residual = f - gain * motion.acceleration
        # Each velocity is in two intervals: half of them are independent.
        independent = max(0.5 * f.size - 4.0, 1.0)
        spread = float(np.sqrt(np.sum(np.abs(residual) ** 2) / independent))
        sigma = spread / max(float(np.sqrt(0.5 * np.sum(np.abs(slope) ** 2))), 1e-12)
        return MotionShift(lag, sigma, float(top))


def _runs(edges: Floats) -> list[tuple[int, int]]:
    """First and last index of each run of equal values."""
    if edges.size == 1:
        return [(0, 1)]
    cuts = np.flatnonzero(np.diff(edges)) + 1
    bounds = [0, *cuts.tolist(), edges.size]
    return list(zip(bounds, bounds[1:], strict=False)) if edges.size else []
