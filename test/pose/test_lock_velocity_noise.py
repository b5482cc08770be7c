# SPDX-License-Identifier: Apache-2.0
"""The noise of a receiver's velocities, which no message tells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.pose import ekf
from suspension_twin.pose.lock import VelocityNoise
from suspension_twin.pose.types import VELOCITY_SHARE

YAW = 0.7


def seen(
    least: float, true: float, spread: float, n: int = 60, seed: int = 0, swing: float = 0.0
) -> VelocityNoise:
    """``n`` velocities of noise ``true`` m/s, against a filter whose speed is off by ``spread``; slip of 1 m/s."""
    random = np.random.default_rng(seed)
    noise = VelocityNoise(least)
    covariance = np.zeros((ekf.STATES, ekf.STATES))
    covariance[ekf.SPEED, ekf.SPEED] = spread**2
    row = np.zeros(11)
    row[ekf.ANTENNA_VX] = swing
    for _ in range(n):
        state = np.zeros(ekf.STATES)
        state[ekf.YAW], state[ekf.SPEED] = YAW, 8.0 + spread * random.standard_normal()
        ahead, left = 8.0 + swing + true * random.standard_normal(), 1.0
        c, s = math.cos(YAW), math.sin(YAW)
        noise.see(state, covariance, row, (ahead * c - left * s, ahead * s + left * c, math.nan))
    return noise


@pytest.mark.parametrize("spread", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("true", [0.1, 0.3])
def test_it_is_what_the_filter_does_not_explain(true: float, spread: float) -> None:
    found = [seen(0.05, true, spread, seed=seed, swing=0.5).sigma for seed in range(40)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(true, rel=0.3, abs=0.05)


def test_it_is_never_less_than_set_nor_ten_times_as_much_nor_changed_by_a_few() -> None:
    assert seen(0.05, 0.001, 0.0).sigma == 0.05
    assert seen(0.05, 1.0, 0.0).sigma == pytest.approx(0.5)
    assert seen(0.05, 1.0, 0.0, n=9).sigma == 0.05


def test_a_speed_that_is_wrong_is_no_noise() -> None:
    noise = VelocityNoise(0.05)
    state = np.zeros(ekf.STATES)
    for _ in range(60):
        noise.see(state, np.zeros((8, 8)), np.zeros(11), (10.0, 0.0, 0.05))
    assert noise.sigma == 0.05


def test_velocities_are_not_much_better_than_the_fixes() -> None:
    noise = VelocityNoise(0.05)
    for fix, expected in ((0.02, 0.05), (3.0, 3.0 * VELOCITY_SHARE)):
        noise.by_fixes(fix)
        assert noise.sigma == pytest.approx(expected)
