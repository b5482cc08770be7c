# SPDX-License-Identifier: Apache-2.0
"""``msd``, the car paper's game-engine model: what is odd in its equations, and what it is as read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import Vehicle

G = 9.80665


def printed(vehicle: Vehicle, ax: float, ay: float, xdd: float) -> tuple[float, float]:
    """F_rear and F_front of eqs (3) and (4) to the letter, N; accelerations in m/s²."""
    m, wheelbase, (l2, _, h) = vehicle.mass, vehicle.wheelbase, vehicle.cog
    l1 = wheelbase - l2

    def load(length: float, track: float) -> float:
        share = length / wheelbase - (ax + G) * h / ((xdd + G) * wheelbase)
        return m / 2 * share * (xdd + G) - m * share * (ay + G) * h / track

    return load(l2, vehicle.front_track), load(l1, vehicle.rear_track)


@pytest.fixture(scope="module")
def msd(mondeo: Any) -> Any:
    changes: dict[str, Any] = {}
    for axle, k, c in (("front", 26000.0, 2100.0), ("rear", 23000.0, 1700.0)):
        changes[f"vehicle.{axle}.spring"] = {"compression": (1.0,), "force": (k,)}
        for part in ("damper_push", "damper_pull"):
            changes[f"vehicle.{axle}.{part}"] = {"velocity": (1.0,), "force": (c,)}
    return mondeo.with_changes(changes).model_copy(update={"model": "msd"})


def test_printed_loads_do_not_carry_a_standing_car(mondeo: Any) -> None:
    """Oddity 1: with g beside the horizontal accelerations the loads at rest are a tenth of the weight."""
    rear, front = printed(mondeo.vehicle, 0.0, 0.0, 0.0)
    assert 0 < rear + front < 0.2 * mondeo.vehicle.mass * G


def test_printed_axles_are_exchanged(mondeo: Any) -> None:
    """Oddity 2: a car with its weight in front has the larger printed load named rear."""
    nose = mondeo.with_changes({"vehicle.cog.0": 0.7 * mondeo.vehicle.wheelbase})
    rear, front = printed(nose.vehicle, -G, -G, 0.0)  # g taken back out of the horizontal accelerations
    assert rear == pytest.approx(nose.vehicle.mass * G / 2 * 0.7)
    assert front == pytest.approx(nose.vehicle.mass * G / 2 * 0.3)


def test_printed_lateral_term_lacks_a_g_and_a_side(mondeo: Any) -> None:
    """Oddity 3: the lateral term has the unit of a load times m/s², and relieves an axle as a whole."""
    bare = printed(mondeo.vehicle, -G, -G, 0.0)
    turning = printed(mondeo.vehicle, -G, 2.0 - G, 0.0)
    h, v = mondeo.vehicle.cog[2], mondeo.vehicle
    share = v.cog[0] / v.wheelbase
    assert bare[0] - turning[0] == pytest.approx(v.mass * share * 2.0 * h / v.front_track)


def test_printed_loads_take_half_of_the_inertia(mondeo: Any) -> None:
    """Oddity 4: the loads grow by m/2 per m/s² of x'', on the side of (5) that should be without it."""
    sums = [sum(printed(mondeo.vehicle, -G, -G, xdd)) for xdd in (0.0, 1.0)]
    assert sums[1] - sums[0] == pytest.approx(mondeo.vehicle.mass / 2)


def test_printed_loads_have_no_answer_in_a_jump(mondeo: Any) -> None:
    """Oddity 6: x'' = -g, free fall, divides by zero."""
    with pytest.raises(ZeroDivisionError):
        printed(mondeo.vehicle, 0.0, 0.0, -G)


def test_it_stands_and_climbs_without_being_held_back(msd: Any, drive: Any, flat: Any, ground: Any) -> None:
    """Oddity 5: with dampers between body and road, a steady climb costs no damper force."""
    standing = simulate_twin(msd, excitation(drive(seconds=1.0, speed=0.0), msd.vehicle, flat))
    assert np.abs(standing.acceleration[:, :3]).max() < 1e-9
    assert standing.force[0] == pytest.approx([0, 0, G], abs=1e-9)
    loads = standing.deflection[0] * np.array([26000.0, 26000.0, 23000.0, 23000.0])
    assert loads.sum() == pytest.approx(msd.vehicle.mass * G)
    assert loads[:2].sum() == pytest.approx(msd.vehicle.mass * G * msd.vehicle.cog[0] / msd.vehicle.wheelbase)
    slope = ground(lambda x, y: 0.05 * x + 0 * y)
    climbing = simulate_twin(msd, excitation(drive(seconds=6.0, speed=10.0), msd.vehicle, slope))
    assert climbing.deflection[-1] == pytest.approx(standing.deflection[-1], abs=1e-4)


def test_each_corner_is_its_own_oscillator(msd: Any, drive: Any, rough: Any) -> None:
    """As read: m/4 x_i'' = k (y_i - x_i) + c (y_i' - x_i') about standing, four times, against RK45."""
    way = drive(seconds=3.0, rate=400, speed=8.0, t0=0.0)
    answer = simulate_twin(msd, excitation(way, msd.vehicle, rough, 2.5e-4))
    v = msd.vehicle
    fine = np.linspace(0, 3.0, 24001)
    x = np.interp(fine, way.t, way.x)
    corners = []
    for (wx, wy), k, c in zip(
        v.wheel_positions, (26e3, 26e3, 23e3, 23e3), (2100.0, 2100.0, 1700.0, 1700.0), strict=True
    ):
        y = rough.heights(x + wx, 0 * x + wy)
        dy = np.gradient(y, fine)

        def f(t: float, s: Any, y: Any = y, dy: Any = dy, k: float = k, c: float = c) -> list[float]:
            ground, climb = np.interp(t, fine, y), np.interp(t, fine, dy)
            return [s[1], 4 / v.mass * (k * (ground - s[0]) + c * (climb - s[1]))]

        run = solve_ivp(f, (0, 3.0), [y[0], dy[0]], t_eval=way.t, max_step=2e-3, rtol=1e-8)
        corners.append(run.y[0])
    front, rear = (corners[0] + corners[1]) / 2, (corners[2] + corners[3]) / 2
    late = slice(800, None)  # what the start was has died away
    pitch = (rear - front) / v.wheelbase
    assert np.std(answer.pitch[late] - pitch[late]) < 0.02 * np.std(pitch[late])
    assert np.std((answer.heave - (front + rear) / 2)[late]) < 0.02 * np.std(((front + rear) / 2)[late])


def test_load_transfer_leans_it_out_of_a_bend_and_onto_its_nose(msd: Any, drive: Any, flat: Any) -> None:
    turning = simulate_twin(msd, excitation(drive(seconds=5.0, speed=9.0, yaw_rate=0.3), msd.vehicle, flat))
    braking = simulate_twin(msd, excitation(drive(seconds=5.0, speed=30.0, ax=-3.0), msd.vehicle, flat))
    assert turning.roll[-1] > 0.003 and abs(turning.pitch[-1]) < 0.003
    assert braking.pitch[-1] > 0.003 and abs(braking.roll[-1]) < 1e-9
