# SPDX-License-Identifier: Apache-2.0
"""Rotations against scipy's, gravity against published values, the vertical against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from suspension_twin.signals.attitude import (
    level_rpy,
    matrix_rpy,
    normal_gravity,
    quaternion,
    rpy_matrix,
    smooth_up,
    tilt_of,
    up_step,
)

ANGLE = st.floats(-math.pi, math.pi)


@given(ANGLE, st.floats(-1.57, 1.57), ANGLE)
@settings(max_examples=200, deadline=None)
def test_rpy_is_fixed_axis_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> None:
    matrix = rpy_matrix((roll, pitch, yaw))
    assert matrix == pytest.approx(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), abs=1e-12)
    assert rpy_matrix(matrix_rpy(matrix)) == pytest.approx(matrix, abs=1e-7)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_rpy_looking_straight_up_or_down(pitch: float) -> None:
    matrix = Rotation.from_euler("xyz", [0.3, pitch, -0.5]).as_matrix()
    assert rpy_matrix(matrix_rpy(matrix)) == pytest.approx(matrix, abs=1e-6)


@given(ANGLE, st.floats(-1.5, 1.5))
@settings(max_examples=100, deadline=None)
def test_levelling_turns_any_reading_upright(roll: float, pitch: float) -> None:
    reading = rpy_matrix((roll, pitch, 0.0)).T @ [0.0, 0.0, 9.8]
    level = level_rpy(reading)
    assert rpy_matrix(level) @ reading == pytest.approx([0.0, 0.0, 9.8], abs=1e-9)
    assert level[2] == 0.0


def test_upside_down_levels_by_a_roll() -> None:
    assert level_rpy(np.array([0.0, 0.0, -9.8])) == pytest.approx((math.pi, 0.0, 0.0))
    assert tilt_of(np.array([0.0, 0.0, -9.8])) == pytest.approx(math.pi)
    assert tilt_of(np.array([1.0, 0.0, 1.0])) == pytest.approx(math.pi / 4)


@pytest.mark.parametrize(
    ("latitude", "gravity"), [(0.0, 9.7803253), (45.0, 9.8061977), (90.0, 9.8321849), (-45.0, 9.8061977)]
)
def test_normal_gravity(latitude: float, gravity: float) -> None:
    assert normal_gravity(latitude) == pytest.approx(gravity, abs=2e-7)  # WGS 84, published
    assert normal_gravity(latitude, 1000.0) == pytest.approx(gravity - 0.003086, abs=1e-6)


def test_gravity_without_a_latitude_is_the_standard_one() -> None:
    assert normal_gravity(None) == 9.80665


@pytest.mark.parametrize("step", [0.001, 0.01, 0.3])
def test_the_gyro_alone_carries_the_vertical_as_a_rotation_does(step: float) -> None:
    rate = np.array([0.4, -0.9, 0.7])
    up = np.array([0.1, -0.2, math.sqrt(1 - 0.05)])
    expected = Rotation.from_rotvec(-rate * step * 100).apply(up)
    for _ in range(100):
        up_step(up, np.zeros(3), np.array([0.0, 0.0, 9.8]), rate, step, 9.8, 0.0, 0.0)
    assert up == pytest.approx(expected, abs=1e-5)
    assert np.linalg.norm(up) == pytest.approx(1.0, abs=1e-12)


def test_the_accelerometer_pulls_with_its_time_constant() -> None:
    tilt, seconds, dt = 0.02, 8.0, 0.01
    up = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    for _ in range(int(seconds / dt)):
        up_step(up, np.zeros(3), np.array([0.0, 0.0, 9.8]), np.zeros(3), dt, 9.8, 1.0 / seconds, 0.0)
    assert math.asin(up[0]) == pytest.approx(tilt * math.exp(-1), rel=0.05)


def test_a_constant_gyro_bias_is_learnt() -> None:
    up, bias = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    for _ in range(60_000):
        up_step(up, bias, np.array([0.0, 0.0, 9.8]), np.array([0.004, -0.003, 0.0]), 0.01, 9.8, 0.125, 0.02)
    assert bias[:2] == pytest.approx([0.004, -0.003], abs=2e-4)
    assert up == pytest.approx([0, 0, 1], abs=1e-3)


def test_smoothed_over_a_braking_car_on_a_slope() -> None:
    """With the vehicle's own acceleration known, neither it nor the slope tilts the vertical wrongly."""
    t = np.arange(6000) / 100
    pitch = np.radians(4) * np.sin(2 * np.pi * t / 30) + np.radians(1) * np.sin(2 * np.pi * 1.3 * t)
    rate = np.column_stack([0 * t, np.gradient(pitch, t), 0 * t])
    planar = np.column_stack([2.5 * np.sign(np.sin(0.7 * t)), 0 * t, 0 * t])
    up = np.column_stack([-np.sin(pitch), 0 * t, np.cos(pitch)])
    force = 9.8 * up + planar + np.random.default_rng(0).normal(0, 0.5, (t.size, 3))
    found = smooth_up(t, force - planar, rate, 9.8, np.full(t.size, 8.0))
    assert np.degrees(np.abs(found - up).max()) < 0.6
    assert smooth_up(t[:1], force[:1], rate[:1], 9.8, np.ones(1)) == pytest.approx(np.array([[0, 0, 1]]))


@pytest.mark.parametrize("rpy", [(0.3, -0.5, 2.0), (-1.2, 0.7, -0.4), (0.0, 0.0, 3.0)])
def test_a_quaternion_is_that_of_fixed_axes(rpy: tuple[float, float, float]) -> None:
    wanted = Rotation.from_euler("xyz", rpy).as_quat(canonical=False)
    assert quaternion(*rpy) == pytest.approx(wanted * np.sign(wanted[3] * quaternion(*rpy)[3]))
