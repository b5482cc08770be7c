# SPDX-License-Identifier: Apache-2.0
"""The vertical of a vehicle that already moves when its first sample comes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from suspension_twin.pose import ekf
from suspension_twin.pose.alignment import GRAVITY, LEVEL_PULL, MOVING_PULL, LiveInputs, MovingLevel
from suspension_twin.pose.history import History
from suspension_twin.pose.types import PoseSettings
from suspension_twin.vehicle.twin import Place

STEP = 0.01


def drive_on(
    level: MovingLevel,
    seconds: float,
    *,
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
    speed: float = 9.0,
    pull: float = 0.0,
    turn: float = 0.0,
    sigma: float = 0.03,
    gravity: float = GRAVITY,
    after: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
) -> tuple[list[tuple[float, np.ndarray]], np.ndarray]:
    """A body that leans by a fixed roll and pitch, at a speed that changes by ``pull`` m/s², in a bend; velocities at
    10 Hz that come ``after`` s late. What was found and when, and the true vertical in body axes."""
    lean = Rotation.from_euler(
        "YX", [pitch, roll]
    ).as_matrix()  # from body axes to level ones ahead, left and up
    up = lean[2]
    random = np.random.default_rng(seed)
    found = []
    waiting: list[tuple[float, float, float]] = []
    for k in range(1, round(seconds / STEP) + 1):
        t = k * STEP
        v = speed + pull * t
        force = lean.T @ (pull, v * turn, gravity)
        level.add(t, np.concatenate([force, lean.T @ (0.0, 0.0, turn)]), STEP)
        if k % 10 == 0:
            course = yaw + turn * t
            off = noise * random.standard_normal(2)
            waiting.append((t, v * math.cos(course) + off[0], v * math.sin(course) + off[1]))
        while waiting and waiting[0][0] + after <= t:
            now = level.velocity(*waiting.pop(0), sigma, GRAVITY)
            if now is not None:
                found.append((t, now))
    return found, up


@given(
    roll=st.floats(-0.15, 0.15),
    pitch=st.floats(-0.15, 0.15),
    yaw=st.floats(-3.0, 3.0),
    pull=st.floats(-3.0, 3.0),
    turn=st.floats(-0.5, 0.5),
    after=st.sampled_from([0.0, 0.2, 0.5]),
)
@settings(max_examples=60, deadline=None)
def test_whatever_it_does_the_vertical_is_found_within_two_seconds(
    roll: float, pitch: float, yaw: float, pull: float, turn: float, after: float
) -> None:
    found, up = drive_on(
        MovingLevel(np.zeros(3)), 2.0, roll=roll, pitch=pitch, yaw=yaw, pull=pull, turn=turn, after=after
    )
    when, first = found[0]
    assert when == pytest.approx(1.1 + after, abs=1e-9)
    assert np.linalg.norm(first) == pytest.approx(1.0)
    assert math.acos(min(1.0, float(first @ up))) < 0.004


def least_time(sigma: float) -> float:
    """s that velocities of ``sigma`` m/s at 10 Hz need for a slope good to half of what an alignment may leave."""
    for n in range(11, 200):
        t = 0.1 * np.arange(n)
        if sigma / math.sqrt(np.sum((t - t.mean()) ** 2)) <= 0.5 * LEVEL_PULL:
            return float(t[-1])
    return math.inf


@pytest.mark.parametrize("sigma", [0.1, 0.5, 2.0, 5.0])
def test_a_receiver_that_is_less_sure_needs_longer(sigma: float) -> None:
    found, _ = drive_on(MovingLevel(np.zeros(3)), 25.0, speed=30.0, pull=-0.5, sigma=sigma)
    assert (found[0][0] if found else math.inf) == pytest.approx(0.1 + least_time(sigma), abs=0.01)


def test_what_is_off_the_line_says_how_good_the_velocities_are() -> None:
    """Velocities of 0.5 m/s that claim 0.01 take as long as those that say so, and find the vertical as well."""
    errors = []
    for seed in range(10):
        found, up = drive_on(
            MovingLevel(np.zeros(3)), 10.0, roll=0.1, turn=0.2, noise=0.5, sigma=0.01, seed=seed
        )
        assert 0.7 * least_time(0.5) < found[0][0] < 1.4 * least_time(0.5)
        errors.append(math.acos(min(1.0, float(found[0][1] @ up))))
    assert np.sqrt(np.mean(np.square(errors))) < 1.5 * math.sqrt(2.0) * 0.5 * LEVEL_PULL / GRAVITY


def test_one_that_stands_needs_no_course() -> None:
    found, up = drive_on(MovingLevel(np.zeros(3)), 1.5, speed=0.0, roll=0.05, pitch=-0.1)
    assert math.acos(min(1.0, float(found[0][1] @ up))) < 1e-6


def test_where_gravity_is_missing_nothing_is_found() -> None:
    level = MovingLevel(np.zeros(3))
    assert drive_on(level, 3.0, gravity=0.7 * GRAVITY)[0] == []
    level.begin()
    assert len(drive_on(level, 3.0)[0]) > 5


def test_velocities_from_before_the_samples_and_out_of_order_are_passed_over() -> None:
    level = MovingLevel(np.zeros(3))
    still = np.array([0.0, 0.0, GRAVITY, 0.0, 0.0, 0.0])
    assert level.velocity(0.5, 9.0, 0.0, 0.03, GRAVITY) is None
    for k in range(201):
        level.add(5.0 + k * STEP, still, STEP)
    said = [(0.5, -9.0), (5.2, 9.0), (5.5, 9.0), (5.5, -9.0), (5.4, -9.0), (6.0, 9.0)]
    assert all(level.velocity(t, v, 0.0, 0.03, GRAVITY) is None for t, v in said)
    assert level.velocity(6.5, 9.0, 0.0, 0.03, GRAVITY) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def history(force: float, bias: float, ahead: float, x: float) -> History:
    """Three seconds at 10 m/s, yaw 0.6 rad, with one forward specific force and one antenna."""
    found = History(2.0, PoseSettings().noise())
    for k in range(300):
        row = found.append(k * STEP)
        row[:] = 0.0
        row[[ekf.GYRO_LOOSENESS, ekf.FORWARD_FORCE, ekf.ANTENNA_X, ekf.ANTENNA_Y]] = 1.0, force, ahead, -0.2
        if k == 0:
            shift = np.array([math.cos(0.6), math.sin(0.6)]) * x
            found.state(0)[:] = [*shift, 0.6, 10.0, 0.5, 0.0, 0.0, bias]
            found.covariance(0)[:] = np.diag([0.1, 0.1, 0.0, 0.25, 1.0, 0.01, 0.0, 9.0])
        else:
            found.step()
    return found


def test_states_that_move_with_their_inputs_are_those_of_the_right_vertical() -> None:
    """Both histories are of one drive: in one of them the vertical is off so that 1.2 m/s² are missing ahead and the
    antenna stands 0.3 m too far back. As sure as before (an endless sigma) they are the same afterwards."""
    wrong, right = history(-0.7, -1.2, 0.5, 0.3), history(0.5, 0.0, 0.8, 0.0)
    wrong.relevel(1.2, 0.3, 0.0, 1e9)
    east, north = 10.0 * 2.9 * math.cos(0.6) + 0.7, 10.0 * 2.9 * math.sin(0.6) + 0.3
    for where in (wrong, right):
        assert where.take(where.before(2.9), 2.9, ekf.FIX, (east, north, 0.02)) > 0.0
    for k in (wrong.before(2.9), wrong.head):
        assert wrong.state(k) == pytest.approx(right.state(k), abs=1e-6)
        assert wrong.covariance(k) == pytest.approx(right.covariance(k), abs=1e-6)


def test_a_confirmed_vertical_says_that_there_is_no_bias() -> None:
    """Kalman's update by a bias of 0 with a standard deviation of 0.2 m/s², in numpy."""
    seen = history(0.5, 0.4, 0.8, 0.0)
    x, p = seen.state(seen.head).copy(), seen.covariance(seen.head).copy()
    h = np.eye(ekf.STATES)[ekf.ACCELEROMETER_BIAS]
    gain = p @ h / (h @ p @ h + 0.04)
    seen.relevel(0.0, 0.0, 0.0, 0.2)
    assert seen.state(seen.head) == pytest.approx(x - gain * x[ekf.ACCELEROMETER_BIAS], abs=1e-9)
    assert seen.covariance(seen.head) == pytest.approx(p - np.outer(gain, h @ p), abs=1e-9)


def test_a_forgotten_bias_is_independent_of_all_else() -> None:
    seen = history(0.5, 0.4, 0.8, 0.0)
    before = seen.head - 1
    kept = seen.covariance(before).copy()
    seen.forget_bias(3.0)
    b = ekf.ACCELEROMETER_BIAS
    assert seen.state(before)[b] == 0.0
    assert seen.covariance(before)[b].tolist() == seen.covariance(before)[:, b].tolist() == [0.0] * b + [9.0]
    assert np.array_equal(seen.covariance(before)[:b, :b], kept[:b, :b])


def test_who_comes_to_rest_with_a_wrong_vertical_stands_and_sees_it() -> None:
    """The first sample is of a bend at 3 m/s², then the car stands and its receiver says so."""
    live, out = LiveInputs(Place(), Place(position=(0.0, 0.0, 1.5))), np.zeros(11)
    live.row(0.0, (2.0, 3.0, GRAVITY), (0.0, 0.0, 0.0), None, out)
    assert live.pull == MOVING_PULL and not live.levelled
    reached = math.nan
    for k in range(1, 600):
        if k % 10 == 0:
            live.note_velocity(k * STEP, 0.01, 0.0)
        live.row(k * STEP, (0.0, 0.0, GRAVITY), (0.0, 0.0, 0.0), None, out)
        if live.standing and math.isnan(reached):
            reached = k * STEP
            change = live.take_change()
            assert change is not None and live.take_change() is None
            # most of the 2 m/s² is still in the vertical, which the accelerometer corrects slowly
            assert 1.0 < change[0] < 2.0 and change[1] > 0.0 and change[2] > 0.0
    assert reached < 4.5 and live.levelled and live.pull == LEVEL_PULL
    assert out[ekf.FORWARD_FORCE] == pytest.approx(0.0, abs=0.01)


def test_without_a_velocity_a_force_off_the_vertical_is_still_a_pull() -> None:
    live, out = LiveInputs(Place(), Place()), np.zeros(11)
    live.row(0.0, (2.0, 3.0, GRAVITY), (0.0, 0.0, 0.0), None, out)
    for k in range(1, 500):
        live.row(k * STEP, (0.0, 0.0, GRAVITY), (0.0, 0.0, 0.0), None, out)
        assert not live.standing
