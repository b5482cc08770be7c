# SPDX-License-Identifier: Apache-2.0
"""By how much the stamps of an IMU are later than those of a receiver, from what both see of the vehicle's motion.

Between two velocities the receiver says what the mean planar acceleration a was, as a complex number forward + 1j left;
the IMU's mean horizontal specific force f over the same time, its stamps moved by a lag, is the same number but for the
yaw of the sensor, which is a phase. The lag is that of the largest magnitude of the correlation

    c = Σ f conj(a) / (|f| |a|).

Its standard deviation is that of a least-squares fit: residual over slope, of as many independent values as there are
separate intervals.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import ImuData, VelocityData

__all__ = ["MotionLag", "MotionShift"]

#: s of motion that are looked at, and over which IMU samples are averaged.
_WINDOW, _BIN = 90.0, 0.05
#: Largest lag that is looked for, and the step of the search, in s.
_REACH, _STEP = 1.5, 0.05
#: What is needed for an answer: velocities, rms of their acceleration in m/s², speed in m/s, correlation.
_LEAST, _EXCITED, _MOVING, _CORRELATED = 20, 0.2, 1.0, 0.75
#: Beyond this interval in s between velocities nothing is averaged.
_APART = 2.5


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
        first, middle, last = t[:-2], v[1:-1], t[2:]
        used = (np.abs(middle) > _MOVING) & (last - first < _APART)
        with np.errstate(invalid="ignore", divide="ignore"):
            turned = (v[2:] - v[:-2]) / (last - first) * np.abs(middle) / middle
        path, total = self._integral()
        used &= (first - _REACH > path[0]) & (last + _REACH < path[-1])
        if np.count_nonzero(used) < _LEAST:
            return None
        first, last, reference = first[used], last[used], turned[used]
        reference = reference - reference.mean()
        if float(np.sqrt(np.mean(np.abs(reference) ** 2))) < _EXCITED:
            return None

        def force(lag: float) -> NDArray[np.complex128]:
            mean = (_at(last + lag, path, total) - _at(first + lag, path, total)) / (last - first)
            return np.asarray(mean - mean.mean())

        def correlation(lag: float) -> float:
            f = force(lag)
            size = float(np.linalg.norm(f) * np.linalg.norm(reference))
            return abs(complex(np.vdot(reference, f))) / max(size, 1e-12)

        lags = np.arange(-_REACH, _REACH + 0.5 * _STEP, _STEP)
        found = np.array([correlation(lag) for lag in lags.tolist()])
        best = int(np.argmax(found))
        if not 0 < best < lags.size - 1 or found[best] < _CORRELATED:
            return None
        left, top, right = found[best - 1 : best + 2]
        lag = float(
            lags[best]
            + _STEP * np.clip(0.5 * (right - left) / max(2.0 * top - left - right, 1e-9), -1.0, 1.0)
        )
        f, slope = force(lag), (force(lag + 0.02) - force(lag - 0.02)) / 0.04
        gain = np.vdot(reference, f) / np.vdot(reference, reference)
        residual = f - gain * reference
        # Each velocity is in two intervals: half of them are independent.
        independent = max(0.5 * f.size - 4.0, 1.0)
        spread = float(np.sqrt(np.sum(np.abs(residual) ** 2) / independent))
        sigma = spread / max(float(np.sqrt(0.5 * np.sum(np.abs(slope) ** 2))), 1e-12)
        return MotionShift(lag, sigma, float(top))

    def _integral(self) -> tuple[Floats, NDArray[np.complex128]]:
        """Stamps (n,) s and the integral of the horizontal force up to them, in axes of which nobody knows the yaw."""
        t, force = np.array(self._t), np.array(self._force)
        up = force.mean(axis=0)
        up /= max(float(np.linalg.norm(up)), 1e-12)
        ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
        ahead = ahead - (ahead @ up) * up
        ahead /= float(np.linalg.norm(ahead))
        flat = force @ ahead + 1j * (force @ np.cross(up, ahead))
        step = np.diff(t, prepend=t[0] - _BIN)
        step = np.where(step > 5.0 * _BIN, 0.0, step)  # nothing is known of a gap
        return t, np.cumsum(flat * step)


def _runs(edges: Floats) -> list[tuple[int, int]]:
    """First and last index of each run of equal values."""
    if edges.size == 1:
        return [(0, 1)]
    cuts = np.flatnonzero(np.diff(edges)) + 1
    bounds = [0, *cuts.tolist(), edges.size]
    return list(zip(bounds, bounds[1:], strict=False)) if edges.size else []


def _at(t: Floats, path: Floats, total: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.asarray(np.interp(t, path, total.real) + 1j * np.interp(t, path, total.imag))
