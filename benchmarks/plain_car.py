# SPDX-License-Identifier: Apache-2.0
"""The textbook car as one would first write it: NumPy in a right-hand side, ``scipy.integrate.solve_ivp``.

The peer that ``calibration.py`` measures itself by: seven degrees of freedom, piecewise linear
characteristics by ``np.interp``, tyres that cannot pull, one candidate at a time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.twin import Twin, Vehicle

Floats = NDArray[np.float64]
G = 9.80665


def characteristic(points: tuple[Floats, Floats]) -> Callable[[Floats], Floats]:
    """Force over an abscissa: through (0, 0), linear between the points, going on with the last slope."""
    x, f = np.concatenate([[0.0], points[0]]), np.concatenate([[0.0], points[1]])
    first, last = f[1] / x[1], (f[-1] - f[-2]) / (x[-1] - x[-2])

    def force(value: Floats) -> Floats:
        inside = np.interp(value, x, f)
        above = f[-1] + last * (value - x[-1])
        return np.asarray(np.where(value < 0, first * value, np.where(value > x[-1], above, inside)))

    return force


class PlainCar:
    """Vertical acceleration at the IMU's place over one excitation, candidate by candidate."""

    def __init__(self, twin: Twin, excitation: Excitation) -> None:
        v = self.vehicle = twin.vehicle
        wheels = v.wheel_positions
        self.wheel_mass = np.repeat([v.front.unsprung_mass, v.rear.unsprung_mass], 2)
        self.sprung_mass = v.mass - self.wheel_mass.sum()
        centre = np.concatenate([wheels.T @ self.wheel_mass, [v.tyre.radius * self.wheel_mass.sum()]])
        sprung = (v.mass * np.array(v.cog) - centre) / self.sprung_mass
        self.x, self.y = (wheels - sprung[:2]).T
        self.arm = np.array(twin.imu.position) - sprung
        share = np.repeat([sprung[0], v.wheelbase - sprung[0]], 2) / v.wheelbase
        self.weight = self.sprung_mass * G * share / 2
        self.t = excitation.t - excitation.t[0]
        ends = excitation.first[1:] - 1
        self.road = excitation.road[ends]
        self.pull = excitation.ax - excitation.yaw_rate**2 * v.cog[0]

    def simulate(self, vehicle: Vehicle) -> Floats:
        """(n,) vertical acceleration of the candidate at the stamps."""
        axles = (vehicle.front, vehicle.rear)
        springs = [characteristic(a.spring.points) for a in axles]
        push = [characteristic(a.damper_push.points) for a in axles]
        pull = [characteristic(a.damper_pull.points) for a in axles]
        static = np.array([_standing(springs[i // 2], w) for i, w in enumerate(self.weight)])
        stiffness = vehicle.tyre.vertical_stiffness
        height = vehicle.cog[2] * vehicle.mass

        def forces(s: Floats) -> Floats:
            body = s[0] + self.y * s[1] - self.x * s[2]
            rate = s[10:14] - (s[7] + self.y * s[8] - self.x * s[9])
            travel = static + s[3:7] - body
            out = np.empty(4)
            for axle, cut in enumerate((slice(0, 2), slice(2, 4))):
                damping = np.where(rate[cut] > 0, push[axle](rate[cut]), -pull[axle](-rate[cut]))
                out[cut] = springs[axle](travel[cut]) + damping
            return out

        def rhs(t: float, s: Floats) -> Floats:
            i = min(int(np.searchsorted(self.t, t)), self.t.size - 1)
            j = max(i - 1, 0)
            share = (t - self.t[j]) / (self.t[i] - self.t[j]) if i > j else 0.0
            road = self.road[j] + share * (self.road[i] - self.road[j])
            force = forces(s)
            tyre = np.maximum(0.0, self.weight + self.wheel_mass * G + stiffness * (road - s[3:7]))
            moment = -height * np.interp(t, self.t, self.pull)
            return np.concatenate(
                [
                    s[7:],
                    [
                        force.sum() / self.sprung_mass - G,
                        float(self.y @ force) / vehicle.sprung_inertia.roll,
                        (float(-self.x @ force) + moment) / vehicle.sprung_inertia.pitch,
                    ],
                    (tyre - force) / self.wheel_mass - G,
                ]
            )

        run = solve_ivp(
            rhs,
            (self.t[0], self.t[-1]),
            np.zeros(14),
            t_eval=self.t,
            method="LSODA",
            rtol=1e-4,
            atol=1e-6,
            max_step=0.02,
        )
        if not run.success:
            return np.full(self.t.size, np.nan)
        out = np.empty(self.t.size)
        for k in range(self.t.size):
            derivative = rhs(self.t[k], run.y[:, k])
            out[k] = derivative[7] + self.arm[1] * derivative[8] - self.arm[0] * derivative[9]
        return out


def _standing(spring: Callable[[Floats], Floats], weight: float) -> float:
    """Compression that bears ``weight``: by bisection, a spring rises."""
    low, high = 0.0, 3.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if spring(np.array(middle)) < weight:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
