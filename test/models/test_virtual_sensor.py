# SPDX-License-Identifier: Apache-2.0
"""The virtual sensor against differentiated positions and rotations, at finite angles and any place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from suspension_twin.compiled import inlined
from suspension_twin.models import rows
from suspension_twin.models.excitation import excitation
from suspension_twin.models.sensor import rotation, sense, to_sensor_axes
from suspension_twin.models.simulate import simulate_twin

G = 9.80665
WIDTH = rows.WIDTH


def attitude(yaw: Any, pitch: Any, roll: Any) -> Any:
    return Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1)).as_matrix()


def read(
    position: Any, velocity: Any, acceleration: Any, place: Any, sprung: Any, height: float, planar: Any
) -> Any:
    """What one lane's sensor reads for heave, roll, pitch and their derivatives."""
    w = np.zeros((rows.CURVES) * WIDTH)

    def put(first: int, values: Any) -> None:
        for j, value in enumerate(values):
            w[(first + j) * WIDTH] = value

    put(rows.POSITION, position)
    put(rows.VELOCITY, velocity)
    put(rows.ACCELERATION, acceleration)
    put(rows.SENSOR, place)
    put(rows.SPRUNG, sprung)
    put(rows.HEIGHT, [height])
    sense(w, 0, *planar)
    return w.reshape(-1, WIDTH)[rows.SIGNAL : rows.SIGNAL + 7, 0]


small = st.floats(-0.6, 0.6)
place = st.tuples(st.floats(-3, 3), st.floats(-1, 1), st.floats(-0.5, 2.5))


@settings(max_examples=60, deadline=None)
@given(
    a0=small,
    a1=small,
    b0=small,
    b1=small,
    f0=st.floats(0.5, 6),
    f1=st.floats(0.5, 6),
    place=place,
    sprung=place,
    height=st.floats(0.0, 1.5),
    speed=st.floats(-5, 25),
    turn=st.floats(-0.8, 0.8),
    turning=st.floats(-0.5, 0.5),
)
def test_reads_what_a_moving_rigid_body_has(
    a0: float,
    a1: float,
    b0: float,
    b1: float,
    f0: float,
    f1: float,
    place: Any,
    sprung: Any,
    height: float,
    speed: float,
    turn: float,
    turning: float,
) -> None:
    """Angles of up to 34 degrees, swinging; the place circles, the heave oscillates."""
    h = 1e-3
    t = h * np.arange(-3, 4)
    roll, pitch = (
        a0 * np.cos(f0 * t) + a1 * np.sin(f0 * t) / f0,
        b0 * np.cos(f1 * t) + b1 * np.sin(f1 * t) / f1,
    )
    heave = 0.1 * np.sin(9 * t) + 0.3 * t
    yaw = turn * t + 0.5 * turning * t**2
    # the point at the height of the centre of gravity, in the plane: from its speed along x; fine steps around 0
    fine = np.linspace(t[0], t[-1], 12001)
    angle = turn * fine + 0.5 * turning * fine**2

    def path(rate: Any) -> Any:
        steps = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(fine))])
        return np.interp(t, fine, steps)

    body = attitude(yaw, pitch, roll)
    centre, sensor = np.array(sprung), np.array(place)
    origin = np.stack([path(speed * np.cos(angle)), path(speed * np.sin(angle)), np.zeros(7)], axis=1)
    origin[:, :2] -= (body @ [0.0, 0.0, height])[:, :2]
    origin[:, 2] = heave + centre[2] - (body @ centre)[:, 2]
    p = origin + body @ sensor
    # sixth-order central differences
    second = np.array([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90]) / h**2
    first = np.array([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60]) / h
    force = body[3].T @ (second @ p + [0, 0, G])
    skew = body[3].T @ np.einsum("t,tij->ij", first, body)
    rate = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    state = np.stack([heave, roll, pitch])
    planar = (0.0, speed * turn, turn, turning)
    got = read(state[:, 3], state @ first, state @ second, place, sprung, height, planar)
    np.testing.assert_allclose(got[:3], force, atol=2e-4)
    np.testing.assert_allclose(got[3:6], rate, atol=1e-8)
    assert got[6] == pytest.approx(got[2] - G * np.cos(pitch[3]) * np.cos(roll[3]), abs=1e-12)


def test_signs_at_rest() -> None:
    """Nose down: gravity shows along -x; left side up: along +y."""
    still = (0.0, 0.0, 0.0, 0.0)
    nose_down = read((0, 0, 0.1), (0, 0, 0), (0, 0, 0), (1, 0, 1), (1.4, 0, 0.5), 0.5, still)
    np.testing.assert_allclose(nose_down[:3], [-G * np.sin(0.1), 0, G * np.cos(0.1)], atol=1e-12)
    left_up = read((0, 0.1, 0), (0, 0, 0), (0, 0, 0), (1, 0, 1), (1.4, 0, 0.5), 0.5, still)
    np.testing.assert_allclose(left_up[:3], [0, G * np.sin(0.1), G * np.cos(0.1)], atol=1e-12)


@pytest.mark.parametrize("where", [(2.2, 0.05, 1.25), (-0.5, -0.6, 0.3), (0.0, 0.0, 0.0)])
def test_the_whole_model_agrees_with_its_own_pose(mondeo: Any, drive: Any, rough: Any, where: Any) -> None:
    """What the sensor reads is what the pose, differentiated, says of a body that turns about its centre of gravity."""
    twin = mondeo.with_changes({"imu.position": where})
    h = 5e-4
    way = drive(seconds=2, rate=1 / h, speed=9, yaw_rate=0.3, t0=0.0)
    run = simulate_twin(twin, excitation(way, twin.vehicle, rough, max_step=h))
    body = attitude(way.yaw, run.pitch, run.roll)
    origin = np.stack([way.x, way.y, run.z], axis=1)
    origin[:, :2] -= (body @ [0.0, 0.0, twin.vehicle.cog[2]])[:, :2]
    p = origin + body @ np.array(where)
    acceleration = np.gradient(np.gradient(p, h, axis=0), h, axis=0)
    force = np.einsum("tji,tj->ti", body, acceleration + np.array([0, 0, G]))
    inner = slice(200, -10)
    np.testing.assert_allclose(run.force[inner], force[inner], atol=0.06)
    spread = np.std(run.force[inner], axis=0)
    assert (np.std((run.force - force)[inner], axis=0) < 0.01 * spread).all()


def test_sensor_axes_follow_rpy() -> None:
    rpy = (0.2, -0.4, 2.5)
    matrix = Rotation.from_euler("ZYX", rpy[::-1]).as_matrix()
    np.testing.assert_allclose(rotation(rpy), matrix, atol=1e-15)
    v = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(to_sensor_axes(v, rpy), v @ matrix, atol=1e-14)
    # a sensor on its side, turned by 90 degrees about x: its y axis points up
    np.testing.assert_allclose(to_sensor_axes(np.array([0, 0, G]), (np.pi / 2, 0, 0)), [0, G, 0], atol=1e-12)


def test_sine_and_cosine() -> None:
    from numba import njit

    from suspension_twin.models.rows import sin_cos

    @njit
    def both(x: float) -> tuple[float, float]:
        return sin_cos(x)

    x = np.linspace(-1, 1, 4001)
    got = np.array([both(v) for v in x])
    near = np.abs(x) < 0.8
    np.testing.assert_allclose(got[near], np.stack([np.sin(x), np.cos(x)], axis=1)[near], atol=1e-15)
    np.testing.assert_allclose(got, np.stack([np.sin(x), np.cos(x)], axis=1), atol=1e-13)
    assert inlined  # the helper that the kernels use, compiled here on its own
