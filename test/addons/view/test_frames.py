# SPDX-License-Identifier: Apache-2.0
"""Poses at the moments of an engine's frames: carried on from messages that came before."""

from __future__ import annotations

import doctest
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from suspension_twin.addons.view import frames
from suspension_twin.addons.view.frames import FramePoses

T0 = 1.7e9


def truth(t: float) -> tuple[np.ndarray, Rotation]:
    """A car at 15 m/s in a bend of 30 m, whose body heaves 3 cm at 1.3 Hz and pitches."""
    yaw, w = 0.5 * (t - T0), 2 * math.pi * 1.3
    place = np.array([30 * math.sin(yaw), 30 * (1 - math.cos(yaw)), 0.03 * math.sin(w * t)])
    return place, Rotation.from_euler("ZYX", [yaw, 0.02 * math.cos(w * t), 0.03])


def pushed(poses: FramePoses, rate: float, until: float) -> float:
    """Push the truth at ``rate`` Hz up to ``until``; the last stamp."""
    for t in (stamp := np.arange(T0, until, 1 / rate)):
        place, turn = truth(t)
        poses.push(t, place, turn.as_quat())
    return float(stamp[-1])


@given(rate=st.floats(30.0, 100.0), ahead=st.floats(0.0, 0.05))
def test_the_car_is_drawn_where_it_is_and_not_where_it_was(rate, ahead):
    poses = FramePoses()
    last = pushed(poses, rate, T0 + 1.0)
    found = poses.at(last + ahead)
    place, turn = truth(last + ahead)
    assert found.stamp == last and found.ahead == pytest.approx(ahead, abs=1e-6)
    # a = v²/r = 7.5 m/s² over the time ahead and the half interval that the speeds are old
    most = 0.5 * 7.6 * ahead * (ahead + 1 / rate) + 1e-5
    assert np.linalg.norm(np.subtract(found.place, place)[:2]) < most
    assert (
        abs(found.place[2] - place[2]) < 0.03 * (2 * math.pi * 1.3) ** 2 * ahead * (ahead + 1 / rate) + 1e-5
    )
    assert (Rotation.from_quat(found.turn) * turn.inv()).magnitude() < 2.0 * ahead * (ahead + 1 / rate) + 1e-6


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_between_two_messages_it_lies_between_them(share):
    poses = FramePoses()
    last = pushed(poses, 60.0, T0 + 1.0)
    at = last - (1 - share) / 60.0
    found = poses.at(at)
    place, _ = truth(at)
    assert found.t == pytest.approx(at) and np.linalg.norm(np.subtract(found.place, place)) < 1e-3


def test_the_origin_of_the_engines_vehicle_turns_with_the_body():
    poses = FramePoses(origin=(1.4, 0.0, 0.2))
    last = pushed(poses, 60.0, T0 + 1.0)
    place, turn = truth(last)
    np.testing.assert_allclose(poses.at(last).place, place + turn.apply([1.4, 0.0, 0.2]), atol=1e-12)


def test_a_twin_that_sends_no_more_stands():
    poses = FramePoses()
    last = pushed(poses, 60.0, T0 + 1.0)
    assert poses.at(last + 60.0).place == poses.at(last + frames.FARTHEST).place
    assert poses.at(last + 60.0).ahead == pytest.approx(frames.FARTHEST)


def test_nothing_is_carried_on_over_a_pause_or_a_jump_back():
    poses = FramePoses()
    assert poses.at(T0) is None
    level = (0.0, 0.0, 0.0, 1.0)
    for t in (T0, T0 + 5.0, T0 + 1.0):  # a pause, and a replay that begins anew
        poses.push(t, (t - T0, 0.0, 0.0), level)
        assert poses.at(t + 0.05).place == (t - T0, 0.0, 0.0)
        assert poses.at(t + 0.05).stamp == t


def test_the_example_runs():
    assert doctest.testmod(frames).failed == 0
