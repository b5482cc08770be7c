# SPDX-License-Identifier: Apache-2.0
"""The vertical of a vehicle that moves: a coarse alignment by the change of its velocity."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from suspension_twin.arrays import Floats

__all__ = ["LEVEL_PULL", "MOVING_PULL", "MOVING_WALK", "MovingLevel"]

#: m/s²: what braking and bends add to gravity where the specific force of a moving vehicle is taken for the vertical,
#: and what an alignment leaves of it (0.02 rad). Priors, by hand: ordinary driving; the bias that was assumed before.
MOVING_PULL, LEVEL_PULL = 3.0, 0.2
#: (m/s²)²/s by which that wanders in body axes: a vertical that is off stays behind while the vehicle turns, here by
#: 0.4 rad/s.
MOVING_WALK = (0.4 * MOVING_PULL) ** 2
#: s that an alignment takes: bumps average out, and the gyro's bias does not show yet; and its velocities at least.
#: Tolerances, by hand.
_SHORTEST, _LONGEST = 1.0, 20.0
_FEWEST = 4
_STEP = 0.005  # s between the stamps at which the integrals are kept (tolerance, by hand)
_LENGTH = 0.2  # of gravity by which the result may miss it (tolerance, by hand)


class MovingLevel:
    """The vertical in body axes, from the specific force, the gyro and velocities over ground.

    In the axes that the body had when it began, the integral of the specific force is the gain of velocity and
    gravity's reaction: ``∫ R f dt = v(t) - v(0) + g up t``. A straight line through its difference from the measured
    velocities has the slope ``g up``; what is off the line says how good the velocities are.

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
        self._seen: deque[_Velocity] = deque()

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
        """A velocity in m/s, ``sigma`` m/s its standard deviation at least. Up (3,) in the body
        axes of the newest sample once it is known, else None. Velocities come in the order of their stamps."""
        here = self._at(t)
        if here is None or (self._seen and t <= self._seen[-1].t):
            return None
        self._seen.append(_Velocity(t, east, north, sigma, *here))
        while t - self._seen[0].t > _LONGEST:
            self._seen.popleft()
        if len(self._seen) < _FEWEST or t - self._seen[0].t < _SHORTEST:
            return None
        level, spread = _line(self._seen)
        length = float(np.linalg.norm(level))
        if spread > 0.5 * LEVEL_PULL or not abs(length / gravity - 1.0) < _LENGTH:
            return None
        found: Floats = self._turn.T @ level / length
        return found

    def _at(self, t: float) -> tuple[Floats, Floats] | None:
        """The integral and the turn at ``t`` s, None before the first sample."""
        if not self._kept or t < self._kept[0][0] - _STEP:
            return None
        after = next((k for k, kept in enumerate(self._kept) if kept[0] >= t), None)
        if after is None or after == 0:
            _, pull, turn = self._kept[-1 if after is None else 0]
            return pull, turn
        (t0, pull0, turn0), (t1, pull1, turn1) = self._kept[after - 1], self._kept[after]
        share = (t - t0) / (t1 - t0)
        return pull0 + share * (pull1 - pull0), turn0 if share < 0.5 else turn1


class _Velocity(NamedTuple):
    """A velocity over ground, m/s, with the integral (3,) and the turn (3, 3) of its time."""

    t: float
    east: float
    north: float
    sigma: float
    pull: Floats
    turn: Floats


def _line(seen: Sequence[_Velocity]) -> tuple[Floats, float]:
    """Slope (3,) of the line, m/s², and the standard deviation of its horizontal parts."""
    t = np.array([v.t for v in seen])
    over_ground = np.array([complex(v.east, v.north) for v in seen])
    pull, nose = np.array([v.pull for v in seen]), np.array([v.turn[:, 0] for v in seen])
    t = t - t.mean()
    level = t @ pull / (t @ t)
    for _ in range(3):  # where ahead and left lie depends on up a little
        up = level / np.linalg.norm(level)
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x /= np.linalg.norm(x)
        y = np.cross(up, x)
        turned = nose @ x + 1j * (nose @ y)
        yaw = np.sum(over_ground * turned.conj())
        ahead = over_ground * (yaw.conj() / max(abs(yaw), 1e-9))  # in the axes when it began
        rest = pull - np.outer(ahead.real, x) - np.outer(ahead.imag, y)
        level = t @ rest / (t @ t)
    off = (rest - rest.mean(axis=0) - np.outer(t, level)) @ np.array([x, y]).T
    sigma = max(math.sqrt(np.sum(off**2) / (2 * len(seen) - 4)), *(v.sigma for v in seen))
    return level, sigma / math.sqrt(t @ t)
