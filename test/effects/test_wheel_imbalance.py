# SPDX-License-Identifier: Apache-2.0
"""A wheel out of balance shakes the car of linear parts as a harmonic force on that wheel does."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import given, respond, way
from linear_car import linear, matrices, tone

from suspension_twin.vehicle.twin import Twin


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.0 * x + 0.0 * y


@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("speed", [10.0, 22.0])
def test_the_response_of_every_degree_of_freedom(twin: Twin, corner: int, speed: float) -> None:
    car, m = linear(twin), matrices(linear(twin))
    moment, radius, phase = 0.15, 0.31, 0.7
    values = {"corner": float(corner), "moment": moment, "rolling_radius": radius, "phase": phase}
    run = respond(given(car, wheel_imbalance=values), flat, way(6.0, rate=200.0, speed=speed))
    omega = speed / radius
    force = np.zeros(7, dtype=complex)
    force[3 + corner] = moment * omega**2 * np.exp(1j * phase)
    # along the road at the hub, less what the load transfer makes of the acceleration: a quarter of a turn later
    force[2] = -1j * radius * force[3 + corner]
    wanted = -(omega**2) * m.amplitude(omega, force)
    t = run.t - run.t[0]
    found = tone(t[t > 3.0], run.acceleration[t > 3.0], omega)
    np.testing.assert_allclose(found, wanted, atol=0.01 * np.abs(wanted).max())
    # what the tyre carries is the road's alone
    height = car.vehicle.tyre.vertical_stiffness * (run.wheel_z[0, corner] - run.wheel_z[:, corner])
    np.testing.assert_allclose(run.tyre_force[:, corner] - run.tyre_force[0, corner], height, atol=1e-6)


def test_the_angle_follows_the_way(twin: Twin) -> None:
    """While the car speeds up, the wheel's acceleration is in step with the way over the radius: against the phase
    of the same force at each moment's speed."""
    car = linear(twin)
    moment, radius = 0.2, 0.3
    run = respond(
        given(car, wheel_imbalance={"moment": moment, "rolling_radius": radius}),
        flat,
        way(8.0, rate=400.0, speed=6.0, ax=0.25),
    )
    t = run.t - run.t[0]
    speed, angle = 6.0 + 0.25 * t, (6.0 * t + 0.125 * t**2) / radius
    m = matrices(car)
    unit = np.zeros(7, dtype=complex)
    unit[3], unit[2] = 1.0, -1j * radius
    wanted = np.array(
        [
            (
                -((v / radius) ** 2)
                * m.amplitude(v / radius, moment * (v / radius) ** 2 * unit)[3]
                * np.exp(1j * a)
            ).real
            for v, a in zip(speed, angle, strict=True)
        ]
    )
    late = t > 2.0
    assert np.abs(run.acceleration[late, 3] - wanted[late]).max() < 0.03 * np.abs(wanted).max()


def test_a_tyre_never_pulls(twin: Twin) -> None:
    values = {"moment": 3.0, "rolling_radius": 0.3}
    run = respond(given(linear(twin), wheel_imbalance=values), flat, way(3.0, rate=400.0, speed=14.0))
    assert run.tyre_force.min() == 0.0 and (run.tyre_force[:, 0] == 0.0).mean() > 0.05


def test_in_a_bend_each_wheel_turns_as_fast_as_its_own_way_is_long(twin: Twin) -> None:
    """On a circle the outer wheel shakes at a higher frequency than the inner one."""
    car = linear(twin)
    speed, radius, rolling = 9.0, 18.0, 0.3
    left = car.vehicle.wheel_positions[:2, 1]
    for corner, y in enumerate(left):
        run = respond(
            given(car, wheel_imbalance={"corner": float(corner), "moment": 0.2, "rolling_radius": rolling}),
            flat,
            way(8.0, rate=400.0, speed=speed, yaw_rate=speed / radius),
        )
        t = run.t - run.t[0]
        late = t > 3.0
        powers = {
            y_of: abs(
                tone(t[late], run.acceleration[late, 3 + corner], speed * (1.0 - y_of / radius) / rolling)
            )
            for y_of in (-y, 0.0, y)
        }
        assert powers[y] > 3.0 * max(powers[0.0], powers[-y])
