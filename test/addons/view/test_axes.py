# SPDX-License-Identifier: Apache-2.0
"""Poses in left-handed axes, against rotation matrices and against Unreal's published definition of its rotator."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.addons.view import axes

#: Rows: the engine's axes in ROS's.
UNITY = np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]])
UNREAL = np.diag([1, -1, 1])
TURNS = [
    Rotation.from_euler("ZYX", angles) for angles in np.random.default_rng(0).uniform(-1.4, 1.4, (40, 3))
]


@pytest.mark.parametrize(("convert", "matrix"), [(axes.to_unity, UNITY), (axes.to_unreal, UNREAL)])
def test_a_point_of_the_body_lies_where_it_lay(convert, matrix):
    """Turned and moved in ROS and then converted, or converted first and turned by the engine: the same place."""
    assert np.linalg.det(matrix) == pytest.approx(-1.0), "left-handed"
    point, place = np.array([1.9, 0.4, 1.2]), np.array([10.0, -3.0, 0.2])
    for turn in TURNS:
        where, quaternion = convert(place, turn.as_quat())
        in_ros = matrix @ (turn.apply(point) + place)
        # a quaternion rotates by the same formula whatever the hand of its axes
        in_engine = Rotation.from_quat(quaternion).apply(matrix @ point) + np.array(where)
        np.testing.assert_allclose(in_engine, in_ros, atol=1e-12)


def test_the_rotator_is_unreals():
    """Axes of the body by FRotationMatrix: forward, right and up from pitch, yaw and roll."""
    for turn in TURNS:
        roll, pitch, yaw = np.radians(axes.unreal_rotator(turn.as_quat()))
        (sr, cr), (sp, cp), (sy, cy) = ((np.sin(v), np.cos(v)) for v in (roll, pitch, yaw))
        forward = [cp * cy, cp * sy, sp]
        right = [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp]
        up = [-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp]
        ours = UNREAL @ turn.as_matrix() @ UNREAL  # columns: the body's axes
        np.testing.assert_allclose(np.column_stack([forward, right, up]), ours, atol=1e-12)


def test_nose_down_and_left_turn_have_the_right_sign():
    roll, pitch, yaw = axes.unreal_rotator(Rotation.from_euler("ZYX", [0.3, 0.1, 0.05]).as_quat())
    assert pitch == pytest.approx(-np.degrees(0.1)), "nose down is negative there"
    assert yaw == pytest.approx(-np.degrees(0.3)), "left is negative there"
    assert roll == pytest.approx(np.degrees(0.05)), "right side down is positive in both"


def test_the_examples_run():
    assert doctest.testmod(axes).failed == 0
