# SPDX-License-Identifier: Apache-2.0
"""The full nonlinear car against a model written here, straight from the equations, and LSODA."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin

G = 9.80665


def curve(points: tuple[Any, Any]) -> Any:
    x, f = np.r_[0.0, points[0]], np.r_[0.0, points[1]]
    left, right = (f[1] - f[0]) / (x[1] - x[0]), (f[-1] - f[-2]) / (x[-1] - x[-2])

    def force(value: Any) -> Any:
        inside = np.interp(value, x, f)
        return np.where(
            value < 0, left * value, np.where(value > x[-1], f[-1] + right * (value - x[-1]), inside)
        )

    return force


class Car:
    """The textbook seven degrees of freedom, with loops and np.interp where the kernel has tables."""

    def __init__(self, twin: Any) -> None:
        v = twin.vehicle
        self.v = v
        self.axle = [v.front, v.front, v.rear, v.rear]
        self.mw = np.array([a.unsprung_mass for a in self.axle])
        self.ms = v.mass - self.mw.sum()
        wheels = v.wheel_positions
        self.cog = np.array(v.cog)
        centre = np.r_[wheels.T @ self.mw, v.tyre.radius * self.mw.sum()]
        self.sprung = (v.mass * self.cog - centre) / self.ms
        self.x, self.y = (wheels - self.sprung[:2]).T
        span = np.r_[[wheels[0, 1] * 2] * 2, [wheels[2, 1] * 2] * 2]
        share = np.r_[[self.sprung[0]] * 2, [v.wheelbase - self.sprung[0]] * 2] / v.wheelbase
        side = np.array([1, -1, 1, -1])
        self.weight = self.ms * G * share * (0.5 + side * self.sprung[1] / span)
        self.springs = [curve(a.spring.points) for a in self.axle]
        self.push = [curve(a.damper_push.points) for a in self.axle]
        self.pull = [curve(a.damper_pull.points) for a in self.axle]
        self.static = np.array(
            [
                brentq(lambda c, f=f, w=w: f(c) - w, 0, 5)
                for f, w in zip(self.springs, self.weight, strict=True)
            ]
        )

    def accelerations(self, q: Any, v: Any, road: Any, ax: float, ay: float) -> Any:
        """``ax``, ``ay`` at the whole car's centre of gravity."""
        compression = self.static + q[3:] - (q[0] + self.y * q[1] - self.x * q[2])
        rate = v[3:] - (v[0] + self.y * v[1] - self.x * v[2])
        force = np.array(
            [
                self.springs[i](compression[i])
                + (self.push[i](rate[i]) if rate[i] > 0 else -self.pull[i](-rate[i]))
                for i in range(4)
            ]
        )
        tyre = np.maximum(0, self.weight + self.mw * G + self.v.tyre.vertical_stiffness * (road - q[3:]))
        moment = self.v.mass * self.cog[2]
        return np.r_[
            force.sum() / self.ms - G,
            (self.y @ force + moment * ay) / self.v.sprung_inertia.roll,
            (-self.x @ force - moment * ax) / self.v.sprung_inertia.pitch,
            (tyre - force) / self.mw - G,
        ]


def reference(twin: Any, way: Any, ground: Any, start: Any) -> Any:
    """Accelerations (n, 7) at the stamps, by LSODA with tight tolerances."""
    car = Car(twin)
    wheels = twin.vehicle.wheel_positions

    def inputs(t: float) -> Any:
        x, y, yaw, ax, ay, w = (
            np.interp(t, way.t, c) for c in (way.x, way.y, way.yaw, *way.acceleration.T, way.yaw_rate)
        )
        c, s = np.cos(yaw), np.sin(yaw)
        road = ground.heights(
            x + c * wheels[:, 0] - s * wheels[:, 1], y + s * wheels[:, 0] + c * wheels[:, 1]
        )
        return road, ax - w**2 * car.cog[0], ay - w**2 * car.cog[1]

    def f(t: float, s: Any) -> Any:
        return np.r_[s[7:], car.accelerations(s[:7], s[7:], *inputs(t))]

    states = [start]
    for a, b in zip(way.t[:-1], way.t[1:], strict=True):  # the inputs have a kink at every stamp
        run = solve_ivp(f, (a, b), states[-1], method="LSODA", rtol=1e-8, atol=1e-10)
        states.append(run.y[:, -1])
    return np.array([car.accelerations(s[:7], s[7:], *inputs(t)) for t, s in zip(way.t, states, strict=True)])


def rms(x: Any) -> Any:
    return np.sqrt(np.mean(np.square(x), axis=0))


@pytest.mark.parametrize(
    ("car", "speed", "yaw_rate", "ax"),
    [
        ("mondeo", 8.0, 0.0, 0.0),
        ("mondeo", 6.0, 0.4, 0.0),
        ("stiff", 8.0, 0.0, -2.0),
    ],
)
@pytest.mark.long
def test_every_acceleration_within_half_a_per_cent(
    request: Any, drive: Any, rough: Any, car: str, speed: float, yaw_rate: float, ax: float
) -> None:
    twin = request.getfixturevalue(car)
    way = drive(seconds=1.5, rate=100, speed=speed, yaw_rate=yaw_rate, ax=ax, t0=0.0)
    answer = simulate_twin(twin, excitation(way, twin.vehicle, rough))
    wheels = answer.wheel_z[0] - twin.vehicle.tyre.radius
    # it starts in equilibrium and moves along the plane through its contact points
    at = twin.vehicle.wheel_positions + np.array([way.x[0], way.y[0]])
    z = rough.heights(at[:, 0], at[:, 1])
    climb = speed * (z[0] + z[1] - z[2] - z[3]) / 2 / twin.vehicle.wheelbase
    start = np.r_[answer.heave[0], answer.roll[0], answer.pitch[0], wheels, climb, 0, 0, [climb] * 4]
    exact = reference(twin, way, rough, start)
    error = rms(answer.acceleration[20:] - exact[20:]) / rms(exact[20:])
    assert (error < 0.005).all()
