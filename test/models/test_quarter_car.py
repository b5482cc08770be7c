# SPDX-License-Identifier: Apache-2.0
"""The quarter car against LSODA, closed forms and energy, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.runs import rig_run
from suspension_twin.models.parameters import lanes, pack
from suspension_twin.models.quarter_car import CHANNELS
from suspension_twin.models.simulate import simulate_lanes, simulate_twin
from suspension_twin.vehicle.twin import Twin, load_twin, parse_twin, save_twin

G = 9.80665
TWIN = Path(__file__).resolve().parents[2] / "config" / "twins" / "quarter_car.yaml"
K, C = 25000.0, 1800.0


@pytest.fixture(scope="module")
def twin() -> Twin:
    return load_twin(TWIN)


def linear(twin: Twin, damping: float = C) -> Twin:
    damper = {"velocity": (1.0,), "force": (damping,)}
    return twin.with_changes(
        {
            "vehicle.spring": {"compression": (1.0,), "force": (K,)},
            "vehicle.damper_push": damper,
            "vehicle.damper_pull": damper,
        }
    )


def force_of(points: tuple[Any, Any]) -> Callable[[float], float]:
    """A characteristic written down anew: through (0, 0), its points, and on with the last slope."""
    x, f = np.r_[0.0, points[0]], np.r_[0.0, points[1]]

    def force(value: float) -> float:
        if value <= 0.0:
            return float(value * f[1] / x[1])
        if value >= x[-1]:
            return float(f[-1] + (value - x[-1]) * (f[-1] - f[-2]) / (x[-1] - x[-2]))
        return float(np.interp(value, x, f))

    return force


def integrated(twin: Twin, t: Any, road: Any, pushed: Any = None) -> Any:
    """Accelerations of body and wheel (n, 2) and compression (n,) by scipy, from the equations alone."""
    actuator = np.zeros(t.size) if pushed is None else pushed
    v = twin.vehicle
    spring, push, pull = (force_of(c.points) for c in (v.spring, v.damper_push, v.damper_pull))
    static = brentq(lambda c: spring(c) - v.sprung_mass * G, 0.0, 5.0)
    load, curve = (v.sprung_mass + v.unsprung_mass) * G, CubicSpline(t, road)

    def acceleration(at: float, s: Any) -> tuple[float, float]:
        rate = s[3] - s[2]
        strut = spring(static + s[1] - s[0]) + (push(rate) if rate > 0 else -pull(-rate))
        strut += float(np.interp(at, t, actuator))
        tyre = max(0.0, load + v.tyre.vertical_stiffness * (float(curve(at)) - s[1]))
        return strut / v.sprung_mass - G, (tyre - strut) / v.unsprung_mass - G

    def slope(at: float, s: Any) -> list[float]:
        return [s[2], s[3], *acceleration(at, s)]

    run = solve_ivp(
        slope,
        (t[0], t[-1]),
        [road[0], road[0], 0.0, 0.0],
        method="LSODA",
        rtol=1e-9,
        atol=1e-11,
        t_eval=t,
        max_step=2e-3,
    )
    found = np.array([acceleration(at, s) for at, s in zip(t, run.y.T, strict=True)])
    return found, static + run.y[1] - run.y[0]


def test_against_lsoda_with_a_wheel_that_leaves_the_road(twin: Twin) -> None:
    """Stiffening spring, digressive dampers, a road that drops faster than the wheel can follow."""
    corner = twin.with_changes(
        {
            "vehicle.spring": {"compression": (0.1, 0.2, 0.3), "force": (1800.0, 4600.0, 9000.0)},
            "vehicle.damper_push": {"velocity": (0.1, 0.4), "force": (300.0, 600.0)},
            "vehicle.damper_pull": {"velocity": (0.1, 0.4), "force": (700.0, 1400.0)},
        }
    )
    t = np.arange(601) / 200
    road = 0.03 * np.sin(2 * np.pi * 1.4 * t) * np.minimum(t, 1.0) + 0.012 * np.sin(2 * np.pi * 10.0 * t)
    road -= 0.012 * 2 * np.pi * 10.0 * t * np.exp(-40.0 * t)  # from rest
    answer = simulate_twin(corner, rig_run(t, road))
    exact, compression = integrated(corner, t, road)
    assert (answer.tyre_force == 0.0).any() and answer.tyre_force.min() >= 0.0
    error = np.std(answer.acceleration - exact, axis=0) / np.std(exact, axis=0)
    assert (error < 0.005).all()
    assert np.std(answer.deflection[:, 0] - compression) < 0.002 * np.std(compression)


def test_an_actuator_pushes_body_and_wheel_apart(twin: Twin) -> None:
    """From rest against LSODA; held from the start, the spring carries what the actuator leaves."""
    t = np.arange(501) / 250
    road, pushed = 0.004 * np.sin(2 * np.pi * 9.0 * t) * t, 800.0 * np.sin(2 * np.pi * 3.0 * t)
    answer = simulate_twin(twin, rig_run(t, road, force=pushed))
    exact, compression = integrated(twin, t, road, pushed)
    assert (np.std(answer.acceleration - exact, axis=0) < 0.005 * np.std(exact, axis=0)).all()
    assert np.std(answer.deflection[:, 0] - compression) < 0.002 * np.std(compression)
    held = simulate_twin(twin, rig_run(t, 0 * t, force=0 * t + 500.0))
    assert held.deflection[:, 0] == pytest.approx((twin.vehicle.sprung_mass * G - 500.0) / 23000.0)
    assert np.abs(held.acceleration).max() < 1e-6


@pytest.mark.parametrize("frequency", [0.8, 1.3, 4.0, 11.0, 18.0])
def test_transmissibility_is_the_transfer_function(twin: Twin, frequency: float) -> None:
    corner, rate, omega = linear(twin), 400, 2 * np.pi * frequency
    v = corner.vehicle
    t = np.arange(12 * rate) / rate
    read = simulate_lanes(corner, lanes(corner, [], np.zeros((1, 0))), rig_run(t, 0.001 * np.sin(omega * t)))
    assert read.names == CHANNELS and not read.failed.any()
    m, u, kt, s = v.sprung_mass, v.unsprung_mass, v.tyre.vertical_stiffness, 1j * omega
    matrix = np.array([[m * s**2 + C * s + K, -(C * s + K)], [-(C * s + K), u * s**2 + C * s + K + kt]])
    body, wheel = np.linalg.solve(matrix, [0.0, kt])
    last = slice(-6 * rate, None)
    basis = np.c_[np.sin(omega * t[last]), np.cos(omega * t[last]), np.ones(6 * rate)]
    for name, expected in zip(
        CHANNELS, (s**2 * body, s**2 * wheel, wheel - body, kt * (1.0 - wheel)), strict=True
    ):
        a, b, _ = np.linalg.lstsq(basis, read.channel(name)[last, 0], rcond=None)[0]
        assert complex(a, b) / 0.001 == pytest.approx(expected, rel=0.005)


def test_free_motion_has_the_two_natural_frequencies(twin: Twin) -> None:
    """Without damping, after the road has come to rest: nothing but the two modes of the linear system."""
    corner = linear(twin, damping=0.0)
    v = corner.vehicle
    mass, kt = np.diag([v.sprung_mass, v.unsprung_mass]), v.tyre.vertical_stiffness
    squares = np.linalg.eigvals(np.linalg.solve(mass, [[K, -K], [-K, K + kt]])).real
    t = np.arange(2401) / 400
    answer = simulate_twin(
        corner, rig_run(t, 0.01 * np.sin(2 * np.pi * np.minimum(t, 0.25)) ** 2, max_step=2.5e-4)
    )
    free = t > 0.3
    phase = np.sqrt(np.sort(squares)) * t[free, None]
    basis = np.c_[np.sin(phase), np.cos(phase)]
    for motion in answer.acceleration[free].T:
        left = motion - basis @ np.linalg.lstsq(basis, motion, rcond=None)[0]
        assert np.std(left) < 0.01 * np.std(motion)
    assert np.sqrt(squares.min()) / (2 * np.pi) == pytest.approx(1.2, abs=0.1)
    assert np.sqrt(squares.max()) / (2 * np.pi) == pytest.approx(12.2, abs=0.2)


def test_standing_on_a_raised_road_by_hand(twin: Twin) -> None:
    v = twin.vehicle
    answer = simulate_twin(twin, rig_run(np.arange(100) / 100, np.full(100, 0.05)))
    assert answer.deflection[:, 0] == pytest.approx(
        v.sprung_mass * G / 23000.0
    )  # the preset's spring is linear
    assert answer.tyre_force[:, 0] == pytest.approx((v.sprung_mass + v.unsprung_mass) * G)
    assert answer.heave == pytest.approx(0.05) and np.abs(answer.acceleration).max() < 1e-9


@pytest.mark.parametrize("damping", [0.0, 1800.0])
def test_energy_never_grows_by_itself(twin: Twin, damping: float) -> None:
    corner, rate = linear(twin, damping), 2000
    v = corner.vehicle
    t = np.arange(6 * rate) / rate
    answer = simulate_twin(corner, rig_run(t, -0.04 * np.clip(t / 0.02, 0.0, 1.0)))
    assert (answer.tyre_force == 0.0).any()  # the drop leaves the wheel in the air
    wheel = answer.wheel_z[:, 0]
    speed = np.gradient(np.c_[answer.heave, wheel], t, axis=0)
    stored = (
        0.5 * speed**2 @ [v.sprung_mass, v.unsprung_mass]
        + G * (v.sprung_mass * answer.heave + v.unsprung_mass * wheel)
        + 0.5 * K * answer.deflection[:, 0] ** 2
        + 0.5 * answer.tyre_force[:, 0] ** 2 / v.tyre.vertical_stiffness
    )
    at_rest = stored[0] - 0.04 * G * (v.sprung_mass + v.unsprung_mass)  # where the road has gone to
    excess = (stored - at_rest)[(t > 0.05) & (t < t[-2])]  # the last speeds are one-sided differences
    assert (excess - np.minimum.accumulate(excess)).max() < 0.002 * excess[0]
    assert excess[-1] > 0.998 * excess[0] if damping == 0.0 else excess[-1] < 1e-6 * excess[0]


def test_velocity_is_integrated_and_a_pause_starts_again_from_rest(twin: Twin) -> None:
    t = np.arange(1200) / 300
    t[600:] += 5.0
    omega = 2 * np.pi * 3.0
    by_height = rig_run(t, 0.01 * (1 - np.cos(omega * t)))
    by_speed = rig_run(t[:600], velocity=0.01 * omega * np.sin(omega * t[:600]))
    assert by_speed.road == pytest.approx(by_height.road[: len(by_speed.road)], abs=1e-5)
    answer = simulate_twin(twin, by_height)
    assert np.flatnonzero(by_height.substeps == 0).tolist() == [0, 600]
    assert answer.acceleration[600] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_candidate_is_what_a_twin_of_its_own_is(twin: Twin) -> None:
    t = np.arange(500) / 250
    run = rig_run(t, 0.01 * np.sin(2 * np.pi * 6 * t) + 0.02 * np.minimum(t, 0.1))
    keys = ["vehicle.sprung_mass", "vehicle.damper_pull.force.1", "vehicle.tyre.vertical_stiffness"]
    values = np.array([[390.0, 900.0, 2.1e5], [450.0, 800.0, 1.8e5], [-5.0, 800.0, 1.8e5]])
    many = simulate_lanes(twin, lanes(twin, keys, values), run)
    assert many.failed.tolist() == [False, False, True] and np.isfinite(many.signals).all()
    for i in range(2):
        alone = simulate_twin(twin.with_changes(dict(zip(keys, values[i].tolist(), strict=True))), run)
        assert np.array_equal(many.signals[:, 0, i], alone.vertical_acceleration)
        assert np.array_equal(many.signals[:, 1, i], alone.acceleration[:, 1])
        assert many.signals[:, 2, i] == pytest.approx(
            alone.deflection[:, 0] - alone.deflection[0, 0], abs=1e-12
        )


def test_what_cannot_be_simulated_is_named(twin: Twin) -> None:
    t = np.arange(50) / 100
    with pytest.raises(InputError, match="vehicle.spring.force: the spring never carries its static load"):
        weak = {"vehicle.spring": {"compression": (0.1, 0.2), "force": (1000.0, 1000.0)}}
        simulate_twin(twin.with_changes(weak), rig_run(t, 0.0 * t))
    with pytest.raises(WorkError, match="diverges"):
        simulate_twin(twin, rig_run(t, 1e3 * t))
    with pytest.raises(InputError, match="rig run: needs displacement or velocity"):
        rig_run(t)
    with pytest.raises(
        InputError, match="rig run: stamps, road and force must be finite, and stamps must rise"
    ):
        rig_run(t[::-1], 0.0 * t)
    with pytest.raises(InputError, match="vehicle.mass: is not a number of this twin"):
        lanes(twin, ["vehicle.mass"], np.ones((1, 1)))


def test_the_twin_file(twin: Twin, tmp_path: Path) -> None:
    save_twin(twin, tmp_path / "twin.yaml")
    assert load_twin(tmp_path / "twin.yaml") == twin and twin.joint_names == ("suspension",)
    data = twin.model_dump(mode="python")
    for key, value, message in (
        (
            "sprung_mass",
            0.39,
            r"sprung_mass: 0.39 kg would bounce on this spring at 39 Hz, .* \(is it in t\?\)",
        ),
        ("wheelbase", 2.8, "vehicle.wheelbase: is not a key of a twin file"),
        ("tyre", {"radius": 0.3}, "vehicle.tyre.vertical_stiffness: is missing"),
        ("spring", {"compression": [0.1], "force": [1.0, 2.0]}, "force: has 2 points for 1 of compression"),
    ):
        with pytest.raises(InputError, match=message):
            parse_twin({**data, "vehicle": {**data["vehicle"], key: value}})


def test_the_latency_is_that_of_every_response(twin: Twin) -> None:
    t = np.arange(0.0, 4.0, 0.004)
    run = rig_run(t, 0.02 * np.sin(2 * np.pi * 2.0 * t) * np.clip(t, 0.0, 1.0))
    late = twin.with_changes({"imu.latency": 0.02})
    plain, delayed = (simulate_lanes(one, pack(one)[:, None], run).signals[:, :, 0] for one in (twin, late))
    for channel in range(plain.shape[1]):
        there = np.interp(t - 0.02, t, plain[:, channel])
        assert np.std((delayed[:, channel] - there)[50:]) < 0.01 * np.std(there)


def test_tyre_damping_of_the_file_is_the_effect(twin: Twin) -> None:
    t = np.arange(0.0, 2.0, 0.004)
    run = rig_run(t, 0.01 * np.sin(2 * np.pi * 9.0 * t))
    part = twin.with_changes({"vehicle.tyre.damping": 600.0})
    effect = twin.with_changes({"effects": [{"id": "tyre_damping", "parameters": {"damping": 600.0}}]})
    one, other, plain = (simulate_lanes(x, pack(x)[:, None], run).signals for x in (part, effect, twin))
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    assert np.abs(one - plain).max() > 0.1
