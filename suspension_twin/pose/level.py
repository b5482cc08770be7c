# SPDX-License-Identifier: Apache-2.0
"""The vertical of a vehicle that moves: a coarse alignment by the change of its velocity."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation

from suspension_twin.arrays import Floats

__all__ = ["LEVEL_PULL", "MOVING_PULL", "MOVING_WALK", "MovingLevel"]

#: m/s²: what braking and bends add to gravity where the specific force of a moving vehicle is taken for the vertical,
#: and what an alignment leaves of it (0.02 rad).
MOVING_PULL, LEVEL_PULL = 3.0, 0.2
#: (m/s²)²/s by which that wanders in body axes: a vertical that is off stays behind while the vehicle turns, here by
#: 0.4 rad/s.
MOVING_WALK = (0.4 * MOVING_PULL) ** 2
#: s that an alignment takes: bumps average out, and the gyro's bias does not show yet.
_SHORTEST, _LONGEST = 1.0, 20.0
_STEP = 0.01  # s between the stamps at which the integrals are kept
_LENGTH = 0.2  # of gravity by which the result may miss it


class MovingLevel:
    """The vertical in body axes, from the specific force, the gyro and two velocities over ground.

    The mean specific force between two velocities, in the axes that the body had at the first of them, is gravity's
    reaction and their change: ``mean(R f) = Δv / T + g up``. The first course says where ahead and left lie.

    Parameters
    ----------
    arm : (3,) array
        From the IMU to the antenna in body axes, m.
    """

    def __init__(self, arm: Floats) -> None:
        self._arm = arm
        self.begin()

    def begin(self) -> None:
        """Forget everything."""
        self._turn = np.eye(3)  # from body axes to those when it began
        self._pull = np.zeros(3)  # integral of the IMU's specific force in these, m/s
        self._kept: deque[tuple[float, Floats, Floats]] = deque()
        self._first: tuple[float, float, float, float, Floats, Floats] | None = None

    def add(self, t: float, sample: Floats, dt: float) -> None:
        """A sample (6,), specific force m/s² and angular rate rad/s in body axes, ``dt`` s after the last."""
        self._turn = self._turn @ Rotation.from_rotvec(sample[3:] * dt).as_matrix()
        self._pull = self._pull + self._turn @ sample[:3] * dt
        if not self._kept or t - self._kept[-1][0] >= _STEP:
            # turning, the antenna moves against the IMU
            swing = self._turn @ np.cross(sample[3:], self._arm)
            self._kept.append((t, self._pull + swing, self._turn))
            while t - self._kept[0][0] > _LONGEST:
                self._kept.popleft()

    def velocity(self, t: float, east: float, north: float, sigma: float, gravity: float) -> Floats | None:
        """A velocity in m/s of a vehicle that moves, ``sigma`` m/s its standard deviation. Up (3,) in the body axes of
        the newest sample once it is known, else None. Velocities come in the order of their stamps."""
        here = self._at(t)
        if here is None:
            return None
        first = self._first
        if first is None or t - first[0] > _LONGEST:
            self._first = (t, east, north, sigma, *here)
            return None
        time = t - first[0]
        if time < _SHORTEST or math.hypot(sigma, first[3]) / time > 0.5 * LEVEL_PULL:
            return None
        _, east0, north0, _, pull0, turn0 = first
        gained = np.array([east - east0, north - north0]) / time
        ahead, left = np.array([[east0, north0], [-north0, east0]]) @ gained / math.hypot(east0, north0)
        mean = turn0.T @ (here[0] - pull0) / time
        level = mean
        for _ in range(3):  # where ahead and left lie depends on up a little
            up = level / np.linalg.norm(level)
            x = np.array([1.0, 0.0, 0.0]) - up[0] * up
            x /= np.linalg.norm(x)
            level = mean - ahead * x - left * np.cross(up, x)
        length = float(np.linalg.norm(level))
        if not abs(length / gravity - 1.0) < _LENGTH:
            self._first = (t, east, north, sigma, *here)
            return None
        found: Floats = self._turn.T @ turn0 @ level / length
        return found

    def _at(self, t: float) -> tuple[Floats, Floats] | None:
        """The integral and the turn at ``t`` s, None before the first sample."""
        if not self._kept or t < self._kept[0][0] - _STEP:
            return None
        after = next((k for k, kept in enumerate(self._kept) if kept[0] >= t), None)
        if after is None or after == 0:
            _, pull, turn = self._kept[-1 if after is None else 0]
            return pull, turn
        (t0, pull0, turn0), (t1, pull1, _) = self._kept[after - 1], self._kept[after]
        return pull0 + (t - t0) / (t1 - t0) * (pull1 - pull0), turn0
