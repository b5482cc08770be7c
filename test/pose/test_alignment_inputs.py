# SPDX-License-Identifier: Apache-2.0
"""What the live lock knows of standing, of the first yaw and of the antenna's sway."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from suspension_twin.pose import ekf
from suspension_twin.pose.alignment import GRAVITY, UP_TIME, LiveInputs
from suspension_twin.pose.types import SWAY_SIGMA
from suspension_twin.signals.imu import STANDSTILL_FILTER_DELAY, StillLimits
from suspension_twin.vehicle.twin import Place

UP = np.array([0.0, 0.0, GRAVITY])
LIMITS = StillLimits()


def run(
    live: LiveInputs,
    t: np.ndarray,
    force: np.ndarray | None = None,
    rate: np.ndarray | None = None,
    speed: float = 0.0,
    known: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 11) rows and (n,) whether it stands, of a level car unless told otherwise."""
    force = np.tile(UP, (t.size, 1)) if force is None else force
    rate = np.zeros((t.size, 3)) if rate is None else rate
    rows, stands = np.zeros((t.size, 11)), np.zeros(t.size, dtype=bool)
    for k in range(t.size):
        live.row(float(t[k]), force[k].tolist(), rate[k].tolist(), (speed, 0.0) if known else None, rows[k])
        stands[k] = live.standing
    return rows, stands


def clock(seconds: float, start: float = 0.0, rate: float = 100.0) -> np.ndarray:
    """Even stamps."""
    return start + np.arange(round(seconds * rate)) / rate


def parked(place: Place | None = None) -> LiveInputs:
    """A car that has stood for five seconds, up to 0 s."""
    live = LiveInputs(Place(), place or Place())
    run(live, clock(5.0, -5.0))
    assert live.standing
    return live


def test_quiet_for_half_a_second_it_stands_and_one_loud_sample_ends_it() -> None:
    live = LiveInputs(Place(), Place())
    t = clock(6.0)
    force = np.tile(UP, (t.size, 1))
    force[500] += 3.0
    rows, stands = run(live, t, force)
    begins = int(np.argmax(stands))
    assert LIMITS.window <= t[begins] < 4.0
    assert stands[begins:500].all()
    assert not stands[501]
    assert np.array_equal(rows[:, ekf.STANDING], stands)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize(("share", "expected"), [(0.5, True), (2.5, False)])
def test_each_axis_can_say_that_it_moves(axis: int, share: float, expected: bool) -> None:
    t = clock(6.0)
    signal = np.zeros((t.size, 6))
    limit = LIMITS.force if axis < 3 else LIMITS.rate
    signal[:, axis] = share * limit * math.sqrt(2.0) * np.sin(2.0 * np.pi * 3.0 * t)
    _, stands = run(LiveInputs(Place(), Place()), t, UP + signal[:, :3], signal[:, 3:])
    assert stands[-100:].all() == stands[-100:].any() == expected


@pytest.mark.parametrize("axis", range(3))
def test_a_steady_turn_is_no_standstill(axis: int) -> None:
    for turn, expected in ((0.6 * LIMITS.turn, axis == 2), (-1.4 * LIMITS.turn, False)):
        rate = np.zeros((500, 3))
        rate[:, axis] = turn
        _, stands = run(LiveInputs(Place(), Place()), clock(5.0), None, rate)
        assert stands[-1] == expected or (axis < 2 and abs(turn) < LIMITS.turn)


@pytest.mark.parametrize(("axis", "sign"), [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)])
def test_a_force_off_the_vertical_that_the_gyro_carries_is_a_pull(axis: int, sign: float) -> None:
    """Constant as it is: it drives off evenly, or leans into an endless bend."""
    live = parked()
    t = clock(3.0, 0.01)
    force = np.tile(UP, (t.size, 1))
    force[:, axis] += 0.8 * sign
    rows, stands = run(live, t, force, speed=0.0)
    assert not stands[5:200].any()
    assert rows[100, ekf.FORWARD_FORCE] == pytest.approx(0.8 * sign if axis == 0 else 0.0, abs=0.08)


def test_a_step_off_is_seen_at_once_whatever_pulled_before() -> None:
    """On a slope, too, where the sensor shows more than the step: what counts is the change."""
    for slope in (0.0, 0.1, -0.1):
        lean = GRAVITY * np.array([math.sin(slope), 0.0, math.cos(slope)])
        live = LiveInputs(Place(), Place())
        t = clock(6.0)
        force = np.tile(lean, (t.size, 1))
        force[500:, 0] += 0.5 * np.minimum((t[500:] - t[500]) / 0.1, 1.0)
        _, stands = run(live, t, force)
        assert stands[450:500].all()
        assert not stands[520:].any()
    # and a turn, before its mean is one
    rate = np.zeros((600, 3))
    rate[500:, 2] = 0.04
    _, stands = run(LiveInputs(Place(), Place()), clock(6.0), None, rate)
    assert stands[450:500].all()
    assert not stands[510:540].any()


def test_what_is_known_of_the_speed_overrules_the_quiet() -> None:
    """A smooth road at a constant speed is as quiet as a parking place."""
    t = clock(5.0)
    for speed, known, expected in (
        (0.0, True, True),
        (-0.5, True, False),
        (5.0, True, False),
        (5.0, False, True),
    ):
        assert run(LiveInputs(Place(), Place()), t, speed=speed, known=known)[1][-1] == expected
    for east, north, age, expected in (
        (3.0, 0.0, 0.5, False),
        (0.0, -3.0, 0.5, False),
        (0.1, 0.1, 0.5, True),
        (3.0, 0.0, 3.0, True),  # long ago
    ):
        live = parked()
        live.note_velocity(-age, east, north)
        assert run(live, clock(0.3, 0.01))[1][-1] == expected
    live.note_velocity(0.3, 3.0, 0.0)
    live.forget_course()
    assert run(live, clock(1.0, 0.31))[1][-1]


def test_the_yaw_rate_is_the_mean_over_the_interval_and_the_raw_one_about_the_vertical() -> None:
    """The antenna goes round with it, but for the part of its own sway."""
    place = Place(position=(0.8, -0.4, 1.5))
    t = clock(4.0)
    rate = np.column_stack([0.2 * np.sin(3.0 * t), 0.1 * np.cos(2.0 * t), 0.1 * t])
    force = np.tile(UP, (t.size, 1))
    rows, _ = run(LiveInputs(Place(), place), t, force, rate)
    # two poles at 10 Hz make a ramp late by their delay, and the mean of two samples by half a step
    late = STANDSTILL_FILTER_DELAY + 0.005
    assert rows[-1, ekf.YAW_RATE] == pytest.approx(0.1 * (t[-1] - late), abs=0.01)
    assert rows[-1, 10] == pytest.approx(0.1 * t[-1], abs=0.012)
    assert rows[-1, 10] - rows[-1, ekf.YAW_RATE] == pytest.approx(0.1 * late, abs=3e-3)
    pitching, rolling = (np.interp(t[300:] - STANDSTILL_FILTER_DELAY, t, rate[:, k]) for k in (1, 0))
    assert np.abs(rows[300:, 8] - 1.5 * pitching).max() < 0.01
    assert np.abs(rows[300:, 9] + 1.5 * rolling).max() < 0.01


def test_a_gap_starts_over_and_a_long_one_finds_the_vertical_anew() -> None:
    live = LiveInputs(Place(), Place(position=(0.0, 0.0, 2.0)))
    out = np.zeros(11)
    assert live.row(0.0, UP, (0.0, 0.0, 0.1), None, out)
    assert out[ekf.GYRO_LOOSENESS] > 1.0
    assert out[ekf.YAW_RATE] == pytest.approx(0.1)
    assert not live.row(0.01, UP, (0.0, 0.0, 0.1), None, out)
    assert out[ekf.GYRO_LOOSENESS] == 1.0
    for pause, found in ((0.2, False), (0.5, False), (3.0, True)):
        live = parked(Place(position=(0.0, 0.0, 2.0)))
        lean = 0.3
        force = GRAVITY * np.array([-math.sin(lean), 0.0, math.cos(lean)])
        gap = live.row(pause - 0.01, force, (0.0, 0.0, 0.2), None, out)
        assert gap == (pause > 0.25)
        # nose down by so much, the antenna is as much ahead as it is high times that
        assert (out[ekf.ANTENNA_X] > 0.9 * 2.0 * math.sin(lean)) == found
        if gap:
            assert out[ekf.YAW_RATE] == pytest.approx(0.2, abs=1e-2)
            assert not live.standing


@pytest.mark.parametrize("lean", [(0.0, 0.0), (0.2, 0.0), (0.0, -0.3), (-0.9, 0.4)])
def test_the_first_sample_gives_the_vertical_whatever_its_length(lean: tuple[float, float]) -> None:
    roll, pitch = lean
    up = np.array([-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)])
    for gravity in (0.8 * GRAVITY, GRAVITY):
        out = np.zeros(11)
        live = LiveInputs(Place(), Place(position=(0.0, 0.0, 1.0)))
        live.row(0.0, gravity * up, (0.0, 0.0, 0.0), None, out)
        # all of the vertical arm leans with it, on level ground ahead and to the right
        reach = math.hypot(out[4], out[5])
        assert reach == pytest.approx(math.sqrt(1.0 - up[2] ** 2), abs=1e-9)
        assert out[10] == 0.0
    # in free fall there is none to be had: it is taken to be level
    live.row(10.0, (0.0, 0.0, 0.5), (0.0, 0.0, 0.0), None, out)
    fresh = LiveInputs(Place(), Place(position=(0.0, 0.0, 1.0)))
    fresh.row(0.0, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), None, out)
    assert out[4:6] == pytest.approx([0.0, 0.0])


def test_the_accelerometer_corrects_the_vertical_with_its_time_constant() -> None:
    """Tilted wrongly by 0.02 rad, while it drives (known to) at a constant speed."""
    live = LiveInputs(Place(), Place())
    out = np.zeros(11)
    lean = 0.02
    live.row(0.0, GRAVITY * np.array([math.sin(lean), 0.0, math.cos(lean)]), (0.0,) * 3, (5.0, 0.0), out)
    for t in np.arange(0.01, UP_TIME, 0.01):
        live.row(float(t), UP, (0.0, 0.0, 0.0), (5.0, 0.0), out)
    assert -out[ekf.FORWARD_FORCE] / GRAVITY == pytest.approx(lean * math.exp(-1.0), rel=0.15)


# -- the first yaw ---------------------------------------------------------------------------


def test_nothing_is_known_before_it_is_measured() -> None:
    live = LiveInputs(Place(), Place())
    assert live.course(1.0) is None
    live.note_velocity(0.0, 0.3, -0.4)
    assert live.course(1.0) is None
    yaw, sigma, speed, _ = live.course(0.4) or (0.0,) * 4
    assert (yaw, speed) == pytest.approx((math.atan2(-0.4, 0.3), 0.5))
    live.note_velocity(0.1, -3.0, 4.0)
    faster = live.course(1.0)
    assert faster is not None
    assert (faster[0], faster[2]) == pytest.approx((math.atan2(4.0, -3.0), 5.0))
    assert faster[1] < sigma  # the faster the surer
    live.forget_course()
    assert live.course(0.0) is None


def test_a_heading_is_the_yaw_and_the_velocity_s_part_ahead_the_speed() -> None:
    live = LiveInputs(Place(), Place())
    live.note_heading(0.0, 0.5)
    assert live.course(1.0) is None  # how fast it goes is not known
    live.note_velocity(0.1, -3.0, 4.0)
    found = live.course(10.0)
    assert found is not None
    assert found[0] == 0.5
    assert found[2] == pytest.approx(-3.0 * math.cos(0.5) + 4.0 * math.sin(0.5))
    live.forget_course()
    assert live.course(0.0) is None


def test_two_fixes_far_enough_apart_give_the_course_where_no_velocities_come() -> None:
    def found(t: float, east: float, north: float, sigma: float = 0.1, last: float = 0.1) -> object:
        live = LiveInputs(Place(), Place())
        live.note_fix(10.0, 100.0, -50.0, last)
        live.note_fix(t, east, north, sigma)
        return live.course(1.0)

    yaw, sigma, speed, doubt = found(10.5, 97.0, -46.0)  # type: ignore[misc]
    assert (yaw, speed) == pytest.approx((math.atan2(4.0, -3.0), 10.0))
    assert math.hypot(0.1, 0.1) / 5.0 < sigma < math.hypot(0.1, 0.1) / 5.0 + 0.1
    assert math.hypot(0.1, 0.1) / 0.5 < doubt < math.hypot(0.1, 0.1) / 0.5 + 1.0
    wide = found(10.5, 97.0, -46.0, 0.5, 0.4)  # type: ignore[misc]
    assert wide[1] - sigma == pytest.approx((math.hypot(0.5, 0.4) - math.hypot(0.1, 0.1)) / 5.0)  # type: ignore[index]
    assert found(10.5, 97.0, -46.0, 0.6, 0.6) is None  # within the noise
    assert found(10.5, 100.7, -50.6, 0.01, 0.01) is None  # less than a metre
    assert found(10.5, 100.9, -50.6, 0.01, 0.01) is not None
    assert found(19.9, 97.0, -46.0) is not None
    assert found(20.1, 97.0, -46.0) is None  # too long ago
    assert found(10.0, 97.0, -46.0) is None
    assert found(9.5, 97.0, -46.0) is None
    live = LiveInputs(Place(), Place())
    live.note_fix(10.0, 100.0, -50.0, 0.1)
    assert live.course(1.0) is None
    live.note_velocity(10.0, 0.1, 0.0)
    live.note_fix(10.5, 97.0, -46.0, 0.1)
    assert live.course(1.0) is None  # velocities know better: it creeps


@pytest.mark.parametrize(
    ("hertz", "sigma", "speed"), [(10, 0.02, 2.0), (5, 0.3, 4.0), (1, 2.5, 4.0), (1, 2.5, 15.0)]
)
def test_fixes_add_up_until_they_are_far_enough_apart(hertz: int, sigma: float, speed: float) -> None:
    """However often they come, a slow vehicle is found within ten seconds, and is never found while it stands."""
    live = LiveInputs(Place(), Place())
    t = clock(9.99)
    run(live, t)
    random = np.random.default_rng(3)
    for when in np.arange(0.0, 10.0, 1.0 / hertz):
        live.note_fix(when, *random.normal(0.0, sigma, 2), sigma)
    assert live.standing and live.course(0.0) is None
    wobble = np.tile(UP, (1000, 1)) + random.normal(0.0, 1.0, (1000, 3))
    for k, when in enumerate(np.arange(10.0, 20.0, 0.01)):
        run(live, np.array([when]), wobble[k : k + 1])
        if k % round(100 / hertz) == 0:
            east = speed * (when - 10.0) + random.normal(0.0, sigma)
            live.note_fix(when, east, random.normal(0.0, sigma), sigma)
    found = live.course(0.0)
    assert found is not None
    assert abs(found[0]) < 4.0 * found[1]
    assert found[2] == pytest.approx(speed, abs=4.0 * found[3])


@pytest.mark.parametrize("turn", [0.2, -0.4])
def test_in_a_bend_the_course_is_that_of_the_newest_fix(turn: float) -> None:
    """The chord of an arc lies by half of its angle behind, and is shorter than it."""
    live = LiveInputs(Place(), Place())
    speed = 8.0
    radius = speed / turn
    for seconds in (0.0, 1.0):
        t = clock(2.0 if seconds == 0.0 else 1.0, -2.0 if seconds == 0.0 else 0.0)
        force = np.tile([0.0, speed * turn, UP[2]], (t.size, 1))
        run(live, t, force, np.tile([0.0, 0.0, turn], (t.size, 1)), speed, True)
        angle = turn * seconds
        live.note_fix(seconds, radius * math.sin(angle), radius * (1.0 - math.cos(angle)), 0.5)
    yaw, _, found, _ = live.course(1.0) or (0.0,) * 4
    assert yaw == pytest.approx(turn, abs=0.01)
    assert found == pytest.approx(speed, rel=0.005)


def test_fixes_on_either_side_of_a_gap_give_no_course() -> None:
    """How far the car turned meanwhile is not known."""
    live = LiveInputs(Place(), Place())
    rough = np.tile(UP, (100, 1)) + np.random.default_rng(5).normal(0.0, 1.0, (100, 3))
    run(live, clock(1.0), rough)
    live.note_fix(0.9, 0.0, 0.0, 0.1)
    run(live, clock(1.0, 3.0), rough)
    live.note_fix(3.9, 30.0, 0.0, 0.1)
    assert live.course(1.0) is None
    live.note_fix(4.0, 31.0, 1.0, 0.1)
    assert live.course(1.0) is not None


def test_a_heading_waits_for_fixes_to_say_how_fast() -> None:
    live = LiveInputs(Place(), Place())
    live.note_heading(0.0, 0.5)
    live.note_fix(0.0, 10.0, 5.0, 2.0)
    assert live.course(1.0) is None
    live.note_fix(0.5, 10.0 + 4.0 * math.cos(0.5), 5.0 + 4.0 * math.sin(0.5), 2.0)  # far within the noise
    yaw, sigma, speed, doubt = live.course(1.0) or (0.0,) * 4
    assert (yaw, speed) == pytest.approx((0.5, 8.0)) and sigma < 0.1
    assert doubt > math.hypot(2.0, 2.0) / 0.5
    live.note_fix(10.0, 10.0 + 76.0 * math.cos(0.5), 5.0 + 76.0 * math.sin(0.5), 2.0)
    yaw, _, speed, closer = live.course(1.0) or (0.0,) * 4
    assert (yaw, speed) == pytest.approx((0.5, 8.0), rel=0.1) and closer < 1.0
    parked_with_heading = parked()
    parked_with_heading.note_heading(5.0, 0.5)
    assert (parked_with_heading.course(1.0) or ())[::2] == (0.5, 0.0)


def driven_off(pull: float, seconds: float = 2.0) -> Iterator[LiveInputs]:
    """From rest, at so many m/s²; with a velocity, and with fixes instead; its course is to the north."""
    for how in ("velocity", "fixes"):
        live = parked()
        t = clock(seconds, 0.01)
        force = np.tile(UP, (t.size, 1))
        force[:, 0] += pull
        run(live, t, force)
        assert not live.standing
        if how == "velocity":
            live.note_velocity(float(t[-1]), 0.0, abs(pull) * seconds)
        else:
            live.note_fix(float(t[-1]) - 1.0, 0.0, 0.0, 0.01)
            live.note_fix(float(t[-1]), 0.0, abs(pull) * seconds, 0.01)
        yield live


@pytest.mark.parametrize("pull", [1.5, -1.5])
def test_who_drives_off_backwards_faces_against_the_course(pull: float) -> None:
    for live in driven_off(pull):
        found = live.course(1.0)
        assert found is not None
        assert found[0] == pytest.approx(math.pi / 2 if pull > 0 else 1.5 * math.pi)
        assert found[2] == pytest.approx(2.0 * pull)
        # too long after the standstill the integral says nothing
        run(live, clock(8.5, 2.01))
        late = live.course(1.0)
        assert late is not None
        assert late[::2] == pytest.approx((math.pi / 2, 3.0))
    for live in driven_off(pull):
        live.forget_course()  # nor once it was said to be wrong
        live.note_velocity(2.0, 0.0, 3.0)
        assert (live.course(1.0) or ())[::2] == pytest.approx((math.pi / 2, 3.0))


def test_a_little_pull_back_is_not_enough_to_reverse() -> None:
    for live in driven_off(-0.6):
        live.note_velocity(2.0, 0.0, 4.0)
        assert (live.course(1.0) or ())[::2] == pytest.approx((math.pi / 2, 4.0))


# -- the antenna's sway ------------------------------------------------------------------------


def shown(live: LiveInputs, place: Place) -> float:
    """The share of the sway that counts in the next rows: a body that pitches at 1 rad/s."""
    out = np.zeros(11)
    live.row(0.0, UP, (0.0, 1.0, 0.0), None, out)
    return float(out[ekf.ANTENNA_VX]) / place.position[2]


Noise = Callable[[], float]


@pytest.mark.parametrize(("true", "expected"), [(1.0, 1.0), (0.4, 0.4), (0.0, 0.0), (-0.5, 0.0), (1.7, 1.2)])
def test_the_share_of_the_sway_is_learnt_by_least_squares(true: float, expected: float) -> None:
    """A receiver shows so much of it, under way in a bend; none and a fifth too much are the ends."""
    place = Place(position=(0.8, -0.4, 1.5))
    live = LiveInputs(Place(), place)
    random = np.random.default_rng(0)
    for _ in range(400):
        state, row = np.zeros(8), np.zeros(11)
        state[ekf.YAW], state[ekf.SPEED], state[ekf.LATERAL_SPEED] = random.uniform(-3, 3), 9.0, 0.1
        sway, turning = random.uniform(-0.4, 0.4, 2), random.uniform(-0.2, 0.2, 2)
        row[8:10] = sway
        row[6:8] = turning + shown_share(live, place) * sway  # as the rows have it by now
        ahead, left = np.array([9.0, 0.1]) + turning + true * sway
        c, s = math.cos(state[ekf.YAW]), math.sin(state[ekf.YAW])
        live.learn_sway(state, row, (ahead * c - left * s, ahead * s + left * c, 0.05))
    assert shown(live, place) == pytest.approx(expected, abs=0.02)


def shown_share(live: LiveInputs, place: Place) -> float:
    """The same without touching it: of a copy of what it has learnt."""
    import copy

    return shown(copy.deepcopy(live), place)


def test_one_velocity_weighs_against_the_prior_by_its_noise() -> None:
    place = Place(position=(0.0, 0.0, 1.5))
    for sigma in (0.05, 0.5):
        live, row = LiveInputs(Place(), place), np.zeros(11)
        row[6:10] = 0.3, 0.2, 0.3, 0.2
        live.learn_sway(np.zeros(8), row, (0.0, 0.0, sigma))  # it shows none at all
        prior, own = 1.0 / SWAY_SIGMA**2, (0.3**2 + 0.2**2) / (sigma**2 + 0.05**2)
        assert shown(live, place) == pytest.approx(prior / (prior + own), rel=1e-6)


def test_what_says_nothing_of_the_sway_teaches_nothing() -> None:
    place = Place(position=(0.0, 0.0, 1.5))
    live, row = LiveInputs(Place(), place), np.zeros(11)
    row[6:10] = 0.03, 0.03, 0.03, 0.03
    live.learn_sway(np.zeros(8), row, (0.4, 0.0, 0.05))  # it hardly swings
    assert shown(live, place) == 1.0
    for east, north in ((3.0, 0.0), (0.0, -3.0)):  # and that is another fault
        live, row = LiveInputs(Place(), place), np.zeros(11)
        row[6:10] = 0.3, 0.2, 0.3, 0.2
        live.learn_sway(np.zeros(8), row, (east, north, 0.05))
        assert shown(live, place) == 1.0
