# SPDX-License-Identifier: Apache-2.0
"""Sagged springs: how the car of linear parts stands with them, and that it rides with their rate."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import given, respond, rough, way
from linear_car import SPRING, WHEEL, linear, matrices

from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.twin import Twin


@pytest.mark.parametrize(("front", "rear", "rate"), [(0.03, 0.0, 0.0), (0.0, 0.05, 0.0), (0.02, 0.04, 3.0)])
def test_the_axle_stands_lower(twin: Twin, front: float, rear: float, rate: float) -> None:
    """Every spring carries its load at (1 + rate sag) times its stiffness and ``sag`` later."""
    car = linear(twin)
    sag = np.array([front, front, rear, rear])
    load = matrices(car).load - WHEEL * G
    run = respond(
        given(car, spring_sag={"front": front, "rear": rear, "rate": rate}),
        lambda x, y: 0.0 * x + 0.0 * y,
        way(0.1, speed=0.0),
    )
    np.testing.assert_allclose(run.deflection[0], sag + load / (SPRING * (1.0 + rate * sag)), atol=1e-9)
    dive = (
        run.deflection[0, 0] - run.deflection[0, 2] - (load[0] - load[2]) / SPRING
    ) / car.vehicle.wheelbase
    assert run.pitch[0] == pytest.approx(dive, abs=1e-6)


def test_it_rides_with_the_rate_alone(twin: Twin) -> None:
    """Of straight springs: shorter ones ride alike, stiffer ones as stiffer ones of a file do."""
    car = linear(twin)
    stiffer = {"compression": (0.5,), "force": (0.5 * SPRING * 1.09,)}
    by_hand = car.with_changes({f"vehicle.front.spring.{key}": value for key, value in stiffer.items()})
    for rate, other in ((0.0, car), (3.0, by_hand)):
        a = respond(given(car, spring_sag={"front": 0.03, "rate": rate}))
        b = respond(other)
        np.testing.assert_allclose(a.acceleration, b.acceleration, atol=2e-3 * np.abs(b.acceleration).max())


def test_a_curved_spring_works_further_up(twin: Twin) -> None:
    """At one compression it has the force that it had ``sag`` earlier: from the wheel's motion of a car without damping
    to speak of."""
    points = {"compression": (0.1, 0.2, 0.3, 0.5), "force": (1500.0, 4000.0, 8000.0, 20000.0)}
    soft = {"velocity": (1.0,), "force": (1.0,)}
    axle = {"unsprung_mass": WHEEL, "spring": points, "damper_push": soft, "damper_pull": soft}
    car = twin.with_changes({"vehicle.front": axle, "vehicle.rear": axle})
    run = respond(given(car, spring_sag={"front": 0.04}), rough, way(1.0))
    force = run.tyre_force[:, 0] - WHEEL * (run.acceleration[:, 3] + G)
    at, wanted = np.array((0.0, *points["compression"])), np.array((0.0, *points["force"]))
    assert np.ptp(run.deflection[:, 0]) > 0.02
    np.testing.assert_allclose(force, np.interp(run.deflection[:, 0] - 0.04, at, wanted), atol=8.0)
