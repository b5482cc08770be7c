# SPDX-License-Identifier: Apache-2.0
"""How good a receiver's velocities are, as the live filter sees them: no message says so."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

from suspension_twin.arrays import Floats
from suspension_twin.pose import ekf
from suspension_twin.pose.history import Measurement
from suspension_twin.pose.settings import VELOCITY_SHARE

__all__ = ["VelocityNoise"]

#: Velocities that an estimate rests on, at least and at most; the standard deviations of the least that it may be; and
#: m/s off the filter's, beyond which it is the filter that is wrong (tolerances, by hand).
_FEWEST, _MOST, _LARGEST, _WRONG = 10, 60, 10.0, 2.0


class VelocityNoise:
    """Innovation-based estimate of a velocity's standard deviation.

    Ahead, a velocity differs from the filter's by the noise of both: ``median |r| / 0.6745`` squared less the variance
    of the filter's speed is the receiver's variance. Across, slip would count as noise.

    Parameters
    ----------
    least : float
        m/s that a receiver is not better than.
    """

    def __init__(self, least: float) -> None:
        self._given = self._least = least
        self._off: deque[float] = deque(maxlen=_MOST)
        self._spread: deque[float] = deque(maxlen=_MOST)
        self.sigma = least

    def by_fixes(self, sigma: float) -> None:
        """The receiver's fixes have a standard deviation of ``sigma`` m: its velocities are not much better."""
        self._least = max(self._given, VELOCITY_SHARE * sigma)
        self.sigma = max(self.sigma, self._least)

    def see(self, state: Floats, covariance: Floats, row: Floats, z: Measurement) -> None:
        """A velocity ``z``, the filter's ``state`` (8,) and ``covariance`` (8, 8) before it, and its inputs ``row``."""
        yaw = float(state[ekf.YAW])
        expected = float(state[ekf.SPEED] + row[ekf.ANTENNA_VX])
        off = abs(z[0] * math.cos(yaw) + z[1] * math.sin(yaw) - expected)
        if off > _WRONG:
            return
        self._off.append(off)
        self._spread.append(float(covariance[ekf.SPEED, ekf.SPEED]))
        if len(self._off) >= _FEWEST:
            variance = (median(self._off) / 0.6745) ** 2 - median(self._spread)
            sigma = math.sqrt(max(variance, 0.0))
            self.sigma = min(max(sigma, self._least), _LARGEST * self._least)
