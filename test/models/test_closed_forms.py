# SPDX-License-Identifier: Apache-2.0
"""The full car against what can be written down: frequency response, free modes, energy, statics, order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from suspension_twin.models.excitation import excitation
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes, simulate_twin

G = 9.80665


def with_linear(twin: Any, k: float = 25000.0, c: float = 1800.0, **more: Any) -> Any:
    changes: dict[str, Any] = dict(more)
    for axle in ("front", "rear"):
        changes[f"vehicle.{axle}.spring"] = {"compression": (1.0,), "force": (k,)}
        for part in ("damper_push", "damper_pull"):
            changes[f"vehicle.{axle}.{part}"] = {"velocity": (1.0,), "force": (c,)}
    return twin.with_changes(changes)


@pytest.fixture(scope="module")
def symmetric(mondeo: Any) -> Any:
    """Centre of gravity amid the wheels and axles alike: heave, pitch and roll are apart."""
    half = mondeo.vehicle.wheelbase / 2
    return with_linear(
        mondeo,
        **{
            "vehicle.cog": (half, 0.0, 0.55),
            "vehicle.rear_track": mondeo.vehicle.front_track,
            "vehicle.rear.unsprung_mass": mondeo.vehicle.front.unsprung_mass,
        },
    )


def sprung_mass(twin: Any) -> float:
    v = twin.vehicle
    return float(v.mass - 2 * (v.front.unsprung_mass + v.rear.unsprung_mass))


@pytest.mark.parametrize("frequency", [0.8, 1.4, 3.0, 8.0, 12.0, 18.0])
def test_frequency_response_of_a_quarter_car(
    symmetric: Any, drive: Any, ground: Any, frequency: float
) -> None:
    """All wheels alike in time: a quarter car on a wave, as complex gain of body and wheel acceleration."""
    way = drive(seconds=16.0, rate=400, speed=0.0, t0=0.0)
    twin, omega, height = symmetric, 2 * np.pi * frequency, 0.001
    e = excitation(way, twin.vehicle, ground(lambda x, y: 0 * x), 5e-4)
    # the same height under all wheels: the road itself moves, as on a shaker
    fine = np.repeat(way.t[1:], e.substeps[1:]) - np.concatenate(
        [np.arange(n - 1, -1, -1) * h for n, h in zip(e.substeps[1:], e.step[1:], strict=True)]
    )
    e.road[1:] = height * np.sin(omega * fine)[:, None]
    r = simulate_twin(twin, e)
    m, mw = sprung_mass(twin) / 4, twin.vehicle.front.unsprung_mass
    k, c, kt = 25000.0, 1800.0, twin.vehicle.tyre.vertical_stiffness
    s = 1j * omega
    matrix = np.array([[m * s**2 + c * s + k, -(c * s + k)], [-(c * s + k), mw * s**2 + c * s + k + kt]])
    gain = np.linalg.solve(matrix, [0, kt]) * s**2
    last = slice(-3200, None)
    basis = np.c_[np.sin(omega * way.t[last]), np.cos(omega * way.t[last]), np.ones(3200)]
    for column, expected in ((0, gain[0]), (3, gain[1])):
        a, b, _ = np.linalg.lstsq(basis, r.acceleration[last, column], rcond=None)[0]
        assert complex(a, b) / height == pytest.approx(expected, rel=0.005)


def linear_matrices(twin: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass, damping and stiffness matrix (7, 7), put together from energies."""
    v = twin.vehicle
    mw = np.array([v.front.unsprung_mass] * 2 + [v.rear.unsprung_mass] * 2)
    ms = v.mass - mw.sum()
    arm = v.wheel_positions - (v.mass * np.array(v.cog[:2]) - v.wheel_positions.T @ mw) / ms
    m = np.diag([ms, v.sprung_inertia.roll, v.sprung_inertia.pitch, *mw])
    c, k = np.zeros((7, 7)), np.zeros((7, 7))
    for i, axle in enumerate([v.front] * 2 + [v.rear] * 2):
        row = np.r_[-1, -arm[i, 1], arm[i, 0], np.eye(4)[i]]
        k += axle.spring.force[0] / axle.spring.compression[0] * np.outer(row, row)
        c += axle.damper_push.force[0] / axle.damper_push.velocity[0] * np.outer(row, row)
        k[3 + i, 3 + i] += v.tyre.vertical_stiffness
    return m, c, k


def test_free_motion_is_the_matrix_exponential(mondeo: Any, drive: Any, ground: Any) -> None:
    """Off a ramp onto the level: what follows is exp(A t) of the state, all seven modes in it."""
    from scipy.linalg import expm

    twin = with_linear(mondeo, c=900.0)
    way = drive(seconds=2.5, rate=200, speed=10.0, t0=0.0)
    ramp = lambda x, y: 0.02 * np.clip((x - 3.0) / 1.5, 0, 1) * (1 + 0.5 * y)  # noqa: E731
    r = simulate_twin(twin, excitation(way, twin.vehicle, ground(ramp), 2.5e-4))
    begin = int(np.argmax(way.x > 4.6))
    m, c, k = linear_matrices(twin)
    a = np.block([[np.zeros((7, 7)), np.eye(7)], [-np.linalg.solve(m, k), -np.linalg.solve(m, c)]])
    end = 0.02 * (1 + 0.5 * twin.vehicle.wheel_positions[:, 1])
    place = np.linalg.solve(k, np.r_[0, 0, 0, twin.vehicle.tyre.vertical_stiffness * end])
    q = np.c_[r.heave, r.roll, r.pitch, r.wheel_z - twin.vehicle.tyre.radius] - place
    velocity = np.gradient(
        q, way.t, axis=0, edge_order=2
    )  # only to start from: corrected by the accelerations
    rate = velocity[begin]
    step = expm(a / 200)
    state = np.r_[q[begin], rate]
    # velocities that fit position and acceleration best at the start
    fit = np.linalg.lstsq(
        np.linalg.solve(m, c), -np.linalg.solve(m, k) @ q[begin] - r.acceleration[begin], rcond=None
    )[0]
    struts = c @ (fit - rate)
    assert np.abs(struts).max() < 0.05 * np.abs(c @ rate).max() + 1.0
    for _ in range(begin + 1, way.t.size):
        state = step @ state
    tolerance = 0.03 * np.abs(q[begin:]).max(axis=0)
    assert (np.abs(q[-1] - state[:7]) < tolerance).all()


def test_energy_goes_where_it_can(mondeo: Any, drive: Any, rough: Any) -> None:
    """Work of the road on the tyres = energy stored in masses, springs and tyres + burnt in dampers."""
    twin = with_linear(mondeo)
    v, rate = twin.vehicle, 4000
    way = drive(seconds=3.0, rate=rate, speed=8.0, t0=0.0)
    e = excitation(way, v, rough, 2.5e-4)
    r = simulate_twin(twin, e)
    mw = np.array([v.front.unsprung_mass] * 2 + [v.rear.unsprung_mass] * 2)
    road = e.road[e.first[1:] - 1]
    q = np.c_[r.heave, r.roll, r.pitch, r.wheel_z]
    speed = np.gradient(q, way.t, axis=0)
    mass = np.r_[sprung_mass(twin), v.sprung_inertia.roll, v.sprung_inertia.pitch, mw]
    stored = (
        0.5 * (mass * speed**2).sum(axis=1)
        + G * (sprung_mass(twin) * r.heave + r.wheel_z @ mw)
        + 0.5 * 25000.0 * (r.deflection**2).sum(axis=1)
        + 0.5 * (r.tyre_force**2).sum(axis=1) / v.tyre.vertical_stiffness
    )
    burnt = np.cumsum(1800.0 * (r.deflection_rate**2).sum(axis=1)) / rate
    work = np.cumsum((r.tyre_force * np.gradient(road, way.t, axis=0)).sum(axis=1)) / rate
    part = slice(20, -20)
    balance = (stored + burnt - work)[part]
    assert r.tyre_force.min() > 0
    assert np.ptp(balance) < 0.01 * burnt[-1]


def test_order_of_convergence_is_two(mondeo: Any, drive: Any, ground: Any) -> None:
    """Linear car, smooth road: halving the step quarters the error."""
    twin = with_linear(mondeo)
    way = drive(seconds=2.0, rate=50, speed=8.0, t0=0.0)
    smooth = ground(lambda x, y: 0.02 * np.clip(x / 4, 0, 1) ** 3 * np.sin(2 * np.pi * x / 5 + 0.3 * y))
    runs = [
        simulate_twin(twin, excitation(way, twin.vehicle, smooth, h)).acceleration
        for h in (2e-3, 1e-3, 5e-4, 3.125e-5)
    ]
    errors = [np.sqrt(np.mean((run - runs[-1]) ** 2)) for run in runs[:-1]]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (orders > 1.8).all() and (orders < 2.3).all()


def test_standing_by_hand(mondeo: Any, drive: Any, flat: Any) -> None:
    r = simulate_twin(mondeo, excitation(drive(seconds=1.0, speed=0.0), mondeo.vehicle, flat))
    v = mondeo.vehicle
    assert np.abs(r.acceleration).max() < 1e-9 and np.ptp(r.deflection, axis=0).max() < 1e-12
    front = v.mass * G * v.cog[0] / v.wheelbase
    assert r.tyre_force[0, :2].sum() == pytest.approx(front, rel=1e-9)
    assert r.tyre_force[0].sum() == pytest.approx(v.mass * G, rel=1e-9)
    # the front spring stands where its characteristic carries its share of the sprung weight
    load = (front - 2 * v.front.unsprung_mass * G) / 2
    assert np.interp(
        r.deflection[0, 0], (0, *v.front.spring.compression), (0, *v.front.spring.force)
    ) == pytest.approx(load)
    assert r.force[0] == pytest.approx([0, 0, G], abs=1e-12)


@pytest.mark.parametrize(("ax", "yaw_rate"), [(-3.0, 0.0), (0.0, 0.35)])
def test_load_transfer_by_hand(mondeo: Any, drive: Any, flat: Any, ax: float, yaw_rate: float) -> None:
    """In steady braking and cornering the tyre loads balance the moments of the whole car about the ground."""
    v = mondeo.vehicle
    way = drive(seconds=8.0, speed=30.0 if ax else 9.0, ax=ax, yaw_rate=yaw_rate)
    r = simulate_twin(mondeo, excitation(way, v, flat))
    lateral, longitudinal = way.speed[-1] * yaw_rate, ax - yaw_rate**2 * v.cog[0]
    load = r.tyre_force[-1]
    moved = -v.mass * longitudinal * v.cog[2] / v.wheelbase
    assert load[:2].sum() == pytest.approx(v.mass * G * v.cog[0] / v.wheelbase + moved, rel=2e-3)
    sides = np.array([v.front_track, -v.front_track, v.rear_track, -v.rear_track]) / 2
    assert load @ sides == pytest.approx(v.mass * (G * v.cog[1] - lateral * v.cog[2]), abs=3.0)
    if ax < 0:
        assert r.pitch[-1] > 0.003  # nose down
    if yaw_rate:
        assert r.roll[-1] > 0.003  # a bend to the left: left side up


def test_a_tyre_off_the_road_falls_freely(mondeo: Any, drive: Any, ground: Any) -> None:
    """Over a drop deeper than the tyre's squeeze the tyre's force is zero, never negative."""
    drop = ground(lambda x, y: np.where(x > 4.0, -0.4, 0.0) + 0 * y)
    way = drive(seconds=0.7, rate=1000, speed=10.0, t0=0.0)
    r = simulate_twin(mondeo, excitation(way, mondeo.vehicle, drop, 5e-4))
    v, off = mondeo.vehicle, r.tyre_force[:, 0] == 0
    assert off.any() and r.tyre_force.min() == 0
    at = int(np.flatnonzero(off)[5])
    strut = v.front.unsprung_mass * (-r.acceleration[at, 3] - G)  # what the spring adds to gravity
    assert strut > 0


def test_stiffest_dampers_at_a_millisecond(stiff: Any, drive: Any, rough: Any) -> None:
    """100 kN s/m on 40 kg wheels: finite, and close to ten times smaller steps."""
    way = drive(seconds=3.0, speed=10.0)
    coarse, fine = (simulate_twin(stiff, excitation(way, stiff.vehicle, rough, h)) for h in (1e-3, 1e-4))
    error = np.std(coarse.vertical_acceleration - fine.vertical_acceleration)
    assert error < 0.02 * np.std(fine.vertical_acceleration)


def test_a_lane_does_not_know_its_neighbours(
    mondeo: Any, drive: Any, rough: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any number of lanes and threads: the same bits; a lane that diverges or cannot stand is alone in that."""
    keys = ["vehicle.front.spring.force.1", "vehicle.tyre.vertical_stiffness", "vehicle.mass"]
    rng = np.random.default_rng(3)
    base = np.array([6900.0, 2.1e5, mondeo.vehicle.mass])
    values = base * rng.uniform(0.95, 1.05, (101, 3))
    values[40, 2] = 100.0  # lighter than its wheels
    e = excitation(drive(seconds=1.5), mondeo.vehicle, rough)
    whole = simulate_lanes(mondeo, lanes(mondeo, keys, values), e)
    assert np.flatnonzero(whole.failed).tolist() == [40]
    assert np.isfinite(whole.force).all() and not whole.force[..., 40].any()
    monkeypatch.setattr("suspension_twin.models.simulate.cores", lambda: 1, raising=False)
    for picked in ([7], [7, 40, 99], list(range(33))):
        part = simulate_lanes(mondeo, lanes(mondeo, keys, values[picked]), e)
        assert np.array_equal(part.force, whole.force[..., picked])
        assert np.array_equal(part.vertical_acceleration, whole.vertical_acceleration[..., picked])
