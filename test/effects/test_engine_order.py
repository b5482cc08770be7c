# SPDX-License-Identifier: Apache-2.0
"""A tone of the engine is a harmonic force above the front axle."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import given, respond, way
from linear_car import linear, matrices, tone

from suspension_twin.vehicle.twin import Twin


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.0 * x + 0.0 * y


@pytest.mark.parametrize(
    ("speed", "frequency", "per_metre"), [(0.0, 7.5, 0.4), (9.0, 11.0, 0.0), (12.0, 4.0, 0.6)]
)
def test_the_response_of_every_degree_of_freedom(
    twin: Twin, speed: float, frequency: float, per_metre: float
) -> None:
    car, m = linear(twin), matrices(linear(twin))
    size, phase = 250.0, -0.4
    values = {"force": size, "frequency": frequency, "per_metre": per_metre, "phase": phase}
    run = respond(given(car, engine_order=values), flat, way(6.0, rate=200.0, speed=speed))
    omega = 2 * np.pi * (frequency + per_metre * speed)
    force = np.zeros(7, dtype=complex)
    sine = size * np.exp(1j * (phase - np.pi / 2))
    front_left, front_right = m.reach[0], m.reach[1]
    force[0] = sine
    force[2] = -0.5 * (front_left[2] + front_right[2]) * sine
    wanted = -(omega**2) * m.amplitude(omega, force)
    t = run.t - run.t[0]
    found = tone(t[t > 3.0], run.acceleration[t > 3.0], omega)
    np.testing.assert_allclose(found, wanted, atol=0.01 * np.abs(wanted).max())
    read = tone(t[t > 3.0], run.vertical_acceleration[t > 3.0, None], omega)
    assert abs(read[0] - m.sensor @ wanted) < 0.02 * abs(m.sensor @ wanted)


def test_the_frequency_rises_with_the_speed(twin: Twin) -> None:
    """Zero crossings of what the sensor reads come at the half turns of the integrated frequency."""
    run = respond(
        given(linear(twin), engine_order={"force": 300.0, "frequency": 6.0, "per_metre": 0.5}),
        flat,
        way(8.0, rate=400.0, speed=4.0, ax=1.0),
    )
    t = run.t - run.t[0]
    late = t > 2.0
    turns = 6.0 * t + 0.5 * (4.0 * t + 0.5 * t**2)
    crossings = np.count_nonzero(np.diff(np.sign(run.vertical_acceleration[late])))
    assert crossings == pytest.approx(2 * np.ptp(turns[late]), abs=1.5)


def test_the_engine_idles_below_a_speed(twin: Twin) -> None:
    run = respond(
        given(linear(twin), engine_order={"force": 300.0, "per_metre": 1.0, "floor": 7.0}),
        flat,
        way(10.0, rate=400.0, speed=3.0, ax=1.0),
    )
    t = run.t - run.t[0]
    late = t > 2.0
    above = np.maximum(t - 4.0, 0.0)  # 7 m/s after 4 s
    turns = 7.0 * t + 0.5 * above**2
    crossings = np.count_nonzero(np.diff(np.sign(run.vertical_acceleration[late])))
    assert crossings == pytest.approx(2 * np.ptp(turns[late]), abs=1.5)
