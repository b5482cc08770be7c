# SPDX-License-Identifier: Apache-2.0
"""How a vehicle leans by what effects put on it, and where its wheels are if its place is that of an antenna."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from suspension_twin.models.constants import Conditions, constants
from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import lanes, layout, pack
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.pose.types import Trajectory
from suspension_twin.vehicle.twin import EffectSpec, Twin

Drive = Callable[..., Trajectory]
HEIGHT = 1.5


def given_to(twin: Twin, effect: str, **parameters: float) -> Twin:
    return twin.model_copy(update={"effects": (EffectSpec(id=effect, parameters=parameters),)})


def static_angles(twin: Twin) -> tuple[float, float]:
    """Pitch and roll in rad that move the road under an antenna ``HEIGHT`` up."""
    road = constants(pack(twin)[:, None], layout(twin), Conditions(1e-3, antenna=HEIGHT)).road
    assert road is not None
    return float(-road.ahead[0] / HEIGHT), float(road.left[0] / HEIGHT)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(mass=st.floats(20, 400), x=st.floats(-0.8, 2.5), y=st.floats(-0.6, 0.6))
def test_a_payload_leans_the_vehicle_as_far_as_it_stands_leaning(
    mondeo: Twin, flat: Any, drive: Drive, mass: float, x: float, y: float
) -> None:
    twin = given_to(mondeo, "payload", mass=mass, x=x, y=y)
    standing = simulate_twin(twin, excitation(drive(0.1, speed=0.0), twin.vehicle, flat))
    assert_allclose(static_angles(twin), (standing.pitch[0], standing.roll[0]), rtol=0.1, atol=2e-4)


@pytest.mark.parametrize(("corner", "change"), [(0.0, -0.2), (1.0, 0.3), (3.0, -0.3)])
def test_a_sagged_corner_does_so_too(
    mondeo: Twin, flat: Any, drive: Drive, corner: float, change: float
) -> None:
    twin = given_to(mondeo, "corner_spring", corner=corner, change=change)
    standing = simulate_twin(twin, excitation(drive(0.1, speed=0.0), twin.vehicle, flat))
    assert_allclose(static_angles(twin), (standing.pitch[0], standing.roll[0]), rtol=0.15, atol=2e-4)


@pytest.mark.parametrize("effect", ["payload", "sensor_offset", "strut_friction", "sensor_tilt"])
def test_without_lean_the_antenna_changes_no_bit(mondeo: Twin, rough: Any, drive: Drive, effect: str) -> None:
    values = {
        "sensor_offset": {"x": 0.3},
        "strut_friction": {"front_force": 80.0},
        "sensor_tilt": {"pitch": 0.02},
    }
    twin = given_to(mondeo, effect, **values.get(effect, {}))
    plain = excitation(drive(1.0), twin.vehicle, rough)
    candidates = lanes(twin, ("vehicle.cog.2",), np.full((3, 1), 0.55))
    raised = replace(plain, path=replace(plain.path, antenna=HEIGHT))
    for fused in (False, True):
        found = [simulate_lanes(twin, candidates, e, fused=fused) for e in (plain, raised)]
        assert_array_equal(found[0].vertical_acceleration, found[1].vertical_acceleration)


def test_the_wheels_are_where_they_are_and_not_under_the_antenna(
    mondeo: Twin, rough: Any, drive: Drive
) -> None:
    """The path of the antenna of a leaning vehicle, taken for its own, and the same with the antenna's height given."""
    twin = given_to(mondeo, "payload", mass=300.0, x=0.0, y=0.4)
    path = drive(3.0, yaw_rate=0.05)
    pitch, roll = static_angles(twin)
    cos, sin = np.cos(path.yaw), np.sin(path.yaw)
    ahead, left = HEIGHT * pitch, -HEIGHT * roll
    above = replace(path, x=path.x + cos * ahead - sin * left, y=path.y + sin * ahead + cos * left)
    true = simulate_twin(twin, excitation(path, twin.vehicle, rough)).vertical_acceleration
    seen, right = (
        simulate_twin(twin, excitation(above, twin.vehicle, rough, antenna=h)).vertical_acceleration
        for h in (0.0, HEIGHT)
    )
    assert np.std(seen - true) > 0.02 * np.std(true)
    assert np.std(right - true) < 0.1 * np.std(seen - true)
