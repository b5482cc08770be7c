# SPDX-License-Identifier: Apache-2.0
"""A soft tyre: the car of linear parts with another stiffness under one wheel, standing and on waves."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import given, respond, way
from linear_car import linear, matrices, tone

from suspension_twin.effects.tyre_pressure import EXPONENT
from suspension_twin.vehicle.twin import Twin

PLACES = {0: (0,), 3: (3,), 4: (0, 1), 5: (2, 3), 6: (0, 1, 2, 3)}


def factors(corner: int, change: float) -> tuple[float, float, float, float]:
    a, b, c, d = ((1.0 + change * (i in PLACES[corner])) ** EXPONENT for i in range(4))
    return a, b, c, d


@pytest.mark.parametrize("corner", PLACES)
def test_the_car_stands_lower_there(twin: Twin, corner: int) -> None:
    """Compression of each tyre is its load over its stiffness, and the loads are as before."""
    car, soft = linear(twin), factors(corner, -0.4)
    m = matrices(car, soft)
    off = given(car, tyre_pressure={"corner": float(corner), "change": -0.4})
    still = way(0.1, speed=0.0)
    plain, low = (respond(each, lambda x, y: 0.0 * x + 0.0 * y, still) for each in (car, off))
    # in the standing car, the softened tyres lack what they are softer by
    missing = np.zeros(7)
    missing[3:] = m.load * (np.array(soft) - 1.0)
    moved = np.linalg.solve(m.stiffness, missing)
    found = [low.heave[0], low.roll[0], low.pitch[0], *(low.wheel_z[0] - plain.wheel_z[0])]
    np.testing.assert_allclose(found, moved, atol=1e-9)
    assert moved[3 + PLACES[corner][0]] < -0.005
    np.testing.assert_allclose(low.tyre_force[0].sum(), plain.tyre_force[0].sum(), rtol=1e-9)


@pytest.mark.parametrize(("corner", "change"), [(0, -0.4), (3, -0.6), (4, 0.3), (6, -0.3)])
def test_it_rides_as_its_stiffness_says(twin: Twin, corner: int, change: float) -> None:
    """On waves of 5 Hz and 11 Hz, in step under all wheels, by the matrices of the car."""
    car, soft = linear(twin), factors(corner, change)
    m = matrices(car, soft)
    off = given(car, tyre_pressure={"corner": float(corner), "change": change})
    for cycles, height in ((1, 0.004), (2, 0.0015)):
        length, speed = twin.vehicle.wheelbase / cycles, 5.0 * twin.vehicle.wheelbase
        omega = 2 * np.pi * speed / length
        road = lambda x, y, a=height, k=2 * np.pi / length: a * np.sin(k * x) + 0.0 * y  # noqa: E731
        run = respond(off, road, way(6.0, rate=200.0, speed=speed))
        late = run.t > run.t[0] + 3.0
        force = np.zeros(7, dtype=complex)
        force[3:] = -1j * height * car.vehicle.tyre.vertical_stiffness * np.array(soft)
        wanted = -(omega**2) * m.amplitude(omega, force)
        found = tone(run.t[late] - run.t[0], run.acceleration[late], omega)
        np.testing.assert_allclose(found, wanted, atol=0.01 * np.abs(wanted).max())
