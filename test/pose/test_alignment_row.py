# SPDX-License-Identifier: Apache-2.0
"""The inputs of the live pose, against motions whose specific force is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.pose.alignment import GRAVITY, LiveInputs
from suspension_twin.pose.types import SLOPE_TIME
from suspension_twin.vehicle.twin import Place


def test_what_turning_adds_beside_the_middle_is_no_tilt() -> None:
    """A level car drives off in a bend that tightens; the sensor sits ahead and far to the left."""
    (x, y, z), dt = (1.9, 0.9, 0.1), 0.01
    live, out = LiveInputs(Place(position=(x, y, z)), Place(position=(1.0, 0.5, 1.5))), np.zeros(11)
    for t in np.arange(-1.0, 5.0, dt):
        moves = float(t > 0.0)
        pull, faster = 0.5 * moves, 0.2 * moves
        speed, turn = pull * t, faster * t
        force = (pull - turn**2 * x - faster * y, speed * turn + faster * x - turn**2 * y, GRAVITY)
        live.row(float(t), force, (0.0, 0.0, turn), (speed, pull), out)
    assert out[0] == pytest.approx(turn, abs=0.01)
    assert out[1] == pytest.approx(pull, abs=0.02)
    assert out[4:6] == pytest.approx([1.0, 0.5], abs=3e-3)  # the antenna of a level car


def test_of_a_receiver_that_hides_the_sway_the_antenna_leans_with_the_slope_alone() -> None:
    """The body nods, and the receiver shows nothing of it; then the car pitches within a second. The slope that
    it stands on shows over SLOPE_TIME."""
    high, dt = 1.5, 0.01
    live, out = LiveInputs(Place(), Place(position=(0.0, 0.0, high))), np.zeros(11)
    seen: dict[int, float] = {}
    pitch = 0.0
    for k in range(2000):
        nodding = k < 800
        rate = 0.7 * math.cos(2.0 * math.pi * k * dt) if nodding else 0.1 if 1000 <= k < 1100 else 0.0
        pitch += rate * dt
        force = (-GRAVITY * math.sin(pitch), 0.0, GRAVITY * math.cos(pitch))
        live.row(k * dt, force, (0.0, rate, 0.0), None, out)
        if nodding:
            live.learn_sway(np.zeros(8), out, (0.0, 0.0, 0.05))
        seen[k] = float(out[4])
    for at in (1200, 1500, 1999):
        slow = 0.1 * (1.0 - math.exp(-(at - 1050) * dt / SLOPE_TIME))
        assert seen[at] == pytest.approx(high * math.sin(slow), abs=0.013), at
