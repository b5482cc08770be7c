# SPDX-License-Identifier: Apache-2.0
"""Sky-hook and ground-hook against the equations of a car that heaves alone, by ``solve_ivp``."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases import given, respond, way
from linear_car import DAMPER, SPRING, WHEEL, linear
from scipy.integrate import solve_ivp

from suspension_twin.effects.semi_active_damper import HIGH_PASS, SWITCHING
from suspension_twin.vehicle.twin import Twin


@pytest.fixture(scope="module")
def heaving(twin: Twin) -> Twin:
    """Alike in front and rear, so that waves as long as its wheelbase make it heave alone."""
    half = twin.vehicle.wheelbase / 2
    return (
        linear(twin)
        .with_changes({"vehicle.cog": [half, 0.0, 0.5], "vehicle.rear_track": 1.5})
        .with_changes({"vehicle.front_track": 1.5})
    )


@pytest.mark.parametrize(("law", "force"), [(0, 2500.0), (1, 900.0)], ids=["sky", "ground"])
def test_the_equations(heaving: Twin, law: int, force: float) -> None:
    length, sprung = heaving.vehicle.wheelbase, heaving.vehicle.mass / 4 - WHEEL
    tyre = heaving.vehicle.tyre.vertical_stiffness

    def road(x: np.ndarray | float, y: np.ndarray | float = 0.0) -> np.ndarray:
        return np.asarray(0.02 * (1 - np.cos(2 * np.pi * np.asarray(x) / length)) + 0.0 * np.asarray(y))

    def rates(t: float, q: np.ndarray) -> list[float]:
        z, dz, u, du, slow = q
        seen = (dz, du)[law] - slow
        power = seen * (du - dz) * (-1.0, 1.0)[law]
        gate = max(power, 0.0) / (max(power, 0.0) + SWITCHING**2)
        strut = SPRING * (u - z) + DAMPER * (du - dz) + (-force, force)[law] * seen * gate
        return [
            dz,
            strut / sprung,
            du,
            (tyre * (float(road(8.0 * t)) - u) - strut) / WHEEL,
            2 * np.pi * HIGH_PASS * seen,
        ]

    hooked = given(heaving, semi_active_damper={"law": float(law), "front": force, "rear": force})
    plain, run = (respond(each, road, way(3.0, speed=8.0)) for each in (heaving, hooked))
    t = run.t - run.t[0]
    exact = solve_ivp(rates, (0, t[-1]), np.zeros(5), t_eval=t, rtol=1e-8, atol=1e-10, max_step=1e-3).y[0]
    assert np.abs(run.pitch).max() < 1e-6
    assert np.abs(run.heave - exact).max() < 0.01 * np.abs(exact).max()
    assert np.abs(plain.heave - exact).max() > 0.1 * np.abs(exact).max()


def test_one_axle_alone(twin: Twin) -> None:
    """Over a bump that the front wheels alone have met, the rear dampers' controller has nothing to do."""
    bump = lambda x, y: 0.03 * np.exp(-(((x - 6.0) / 0.3) ** 2)) + 0.0 * y  # noqa: E731
    still = way(1.0, speed=0.0)
    runs = [
        respond(given(twin, semi_active_damper={axle: 2000.0}), bump, still) for axle in ("front", "rear")
    ]
    np.testing.assert_allclose(runs[0].force, runs[1].force, atol=1e-9)  # at rest neither acts
    short = way(0.6, speed=8.0)
    front, rear, plain = (
        respond(each, bump, short)
        for each in (
            given(twin, semi_active_damper={"front": 2000.0}),
            given(twin, semi_active_damper={"rear": 2000.0}),
            twin,
        )
    )
    change = [np.std(one.deflection - plain.deflection, axis=0) for one in (front, rear)]
    assert change[0][:2].min() > 3 * change[0][2:].max()
    assert change[0][:2].min() > 3 * change[1][:2].max()


def test_a_climb_is_no_bounce(twin: Twin) -> None:
    """On a steady climb the controller lets go: the wheels' loads come back to those of the sound car."""
    climb = lambda x, y: 0.05 * np.maximum(x - 4.0, 0.0) + 0.0 * y  # noqa: E731
    hooked = given(twin, semi_active_damper={"front": 2000.0, "rear": 2000.0})
    plain, run = (respond(each, climb, way(14.0)) for each in (twin, hooked))
    np.testing.assert_allclose(run.deflection[-1], plain.deflection[-1], atol=1e-4)
