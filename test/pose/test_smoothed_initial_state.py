# SPDX-License-Identifier: Apache-2.0
"""The filter's first state of a recorded drive, on paths of which every moment is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.pose import ekf
from suspension_twin.pose.smoothed import Measurements, first_state
from suspension_twin.pose.types import REVERSE_SPEED, REVERSE_TIME

T0 = 1.7e9
ARM = (0.8, -0.4)  # the antenna ahead and to the left of base_link
Curve = Callable[[np.ndarray], np.ndarray]
Seen = tuple[np.ndarray, np.ndarray, np.ndarray]


class Path:
    """A vehicle that starts at ``place`` with ``yaw`` and goes on with ``speed(s)`` and ``turn(s)``; ``s`` from T0."""

    def __init__(
        self,
        speed: Curve,
        turn: Curve = np.zeros_like,
        yaw: float = 0.7,
        place: tuple[float, float] = (30.0, -20.0),
        seconds: float = 20.0,
    ) -> None:
        self._s = np.arange(-5.0, seconds + 1e-9, 1e-3)
        self._speed = speed(self._s)
        self._turn = turn(self._s)

        def integral(values: np.ndarray) -> np.ndarray:
            whole = np.concatenate([[0.0], np.cumsum(5e-4 * (values[1:] + values[:-1]))])
            return whole - np.interp(0.0, self._s, whole)

        self._yaw = yaw + integral(self._turn)
        self._x = place[0] + integral(self._speed * np.cos(self._yaw))
        self._y = place[1] + integral(self._speed * np.sin(self._yaw))
        self.stamps = T0 + np.arange(0.0, seconds, 0.01)
        self.rows = np.zeros((self.stamps.size, 8))
        self.rows[:, 0] = np.interp(self.stamps - T0, self._s, self._turn)
        self.rows[:, 1] = np.interp(self.stamps - T0, self._s, np.gradient(self._speed, self._s))
        self.rows[:, 4:6] = ARM + np.outer(np.sin(self.stamps - T0), [0.2, -0.1])  # later the body leans

    def _at(self, s: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.interp(s, self._s, values)

    def fixes(self, s: np.ndarray, sigma: float = 0.01) -> Seen:
        """Fixes of the antenna."""
        c, n = np.cos(self._at(s, self._yaw)), np.sin(self._at(s, self._yaw))
        east = self._at(s, self._x) + ARM[0] * c - ARM[1] * n
        north = self._at(s, self._y) + ARM[0] * n + ARM[1] * c
        return T0 + s, np.full(s.size, ekf.FIX), np.column_stack([east, north, np.full(s.size, sigma)])

    def velocities(self, s: np.ndarray, sigma: float = 0.05) -> Seen:
        """Velocities of base_link, as an antenna above it has them."""
        v, yaw = self._at(s, self._speed), self._at(s, self._yaw)
        z = np.column_stack([v * np.cos(yaw), v * np.sin(yaw), np.full(s.size, sigma)])
        return T0 + s, np.full(s.size, ekf.VELOCITY), z

    def headings(self, s: np.ndarray) -> Seen:
        """Headings."""
        z = np.column_stack([self._at(s, self._yaw), np.zeros(s.size), np.full(s.size, 0.02)])
        return T0 + s, np.full(s.size, ekf.HEADING), z


def together(*seen: Seen) -> Measurements:
    """What was measured, in the order of time."""
    t, kind, z = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    order = np.argsort(t, kind="stable")
    return Measurements(t[order], kind[order].astype(float), z[order])


def off(x: np.ndarray, yaw: float = 0.7, place: tuple[float, float] = (30.0, -20.0)) -> tuple[float, float]:
    """Distance in m and angle in rad from where the vehicle truly was at T0."""
    turned = math.remainder(float(x[ekf.YAW]) - yaw, 2.0 * math.pi)
    return math.hypot(x[ekf.X] - place[0], x[ekf.Y] - place[1]), abs(turned)


def steady(level: float) -> Curve:
    """The same all the time."""
    return lambda s: np.full_like(s, level)


EVERY = np.arange(0.0, 19.95, 0.1)


@given(
    yaw=st.floats(-3.1, 3.1),
    turn=st.floats(-0.3, 0.3),
    speed=st.floats(2.0, 20.0),
    late=st.floats(0.0, 0.2),
    wait=st.floats(0.0, 0.3),
)
@settings(max_examples=12, deadline=None)
def test_on_a_circle_with_velocities(yaw: float, turn: float, speed: float, late: float, wait: float) -> None:
    """The first course is ``late`` s late, the first fix waits ``wait`` s: both are carried back."""
    path = Path(steady(speed), steady(turn), yaw, seconds=3.0)
    s = np.arange(0.0, 2.5, 0.1)
    measured = together(path.fixes(s + wait), path.velocities(s + late))
    x, p = first_state(measured, path.stamps, path.rows)
    distance, turned = off(x, yaw)
    assert turned < 1e-5
    # a straight way back for an arc, and an antenna that turned on meanwhile
    most = (speed * wait + math.hypot(*ARM)) * abs(turn) * wait + speed * wait * (turn * late) ** 2
    assert distance < most + 1e-5
    assert x[ekf.SPEED] == pytest.approx(speed * math.cos(turn * late), rel=1e-6)
    assert not x[[ekf.ACCELERATION, ekf.LATERAL_SPEED, ekf.GYRO_BIAS, ekf.ACCELEROMETER_BIAS]].any()
    assert np.array_equal(p, np.diag(np.diag(p))) and (np.diag(p) > 0.0).all()


def test_the_way_back_goes_by_the_gyro_however_it_turned() -> None:
    """At rest for eight seconds on a turntable that stops and turns back, then it drives off."""

    def turn(s: np.ndarray) -> np.ndarray:
        return 0.4 * np.sin(1.1 * s) + 0.05 * s

    path = Path(lambda s: np.where(s < 8.0, 0.0, 1.5 * (s - 8.0)), turn, yaw=-2.0)
    x, _ = first_state(together(path.fixes(EVERY), path.velocities(EVERY)), path.stamps, path.rows)
    distance, turned = off(x, -2.0)
    assert turned < 1e-3
    assert distance < 1e-3
    assert x[ekf.SPEED] == pytest.approx(0.0, abs=1e-6)


def test_a_course_at_a_crawl_does_not_count_where_a_faster_one_follows() -> None:
    """The antenna of a car at walking pace swings aside: that is no course of the car."""
    path = Path(lambda s: np.where(s < 6.0, 0.7, 0.7 + 2.0 * (s - 6.0)))
    velocity = path.velocities(EVERY, 0.05)
    aside = EVERY < 5.0
    velocity[2][aside, :2] = 0.8 * np.array([math.cos(0.7 + 1.5), math.sin(0.7 + 1.5)])
    x, _ = first_state(together(path.fixes(EVERY), velocity), path.stamps, path.rows)
    assert off(x)[1] < 1e-6
    # where nothing is faster, it is all that there is
    crawl = Path(steady(0.7))
    x, _ = first_state(together(crawl.fixes(EVERY), crawl.velocities(EVERY)), crawl.stamps, crawl.rows)
    assert off(x)[1] < 1e-6
    assert x[ekf.SPEED] == pytest.approx(0.7)


def test_a_drive_that_begins_in_reverse_has_the_yaw_of_what_follows() -> None:
    path = Path(lambda s: np.clip(-1.2 + 1.5 * np.maximum(s - 4.0, 0.0), -1.2, 9.0), steady(0.1), yaw=2.9)
    x, _ = first_state(together(path.fixes(EVERY), path.velocities(EVERY)), path.stamps, path.rows)
    assert off(x, 2.9)[1] < 1e-3
    assert off(x, 2.9)[0] < 1e-3
    assert x[ekf.SPEED] == pytest.approx(-1.2, abs=1e-3)


@pytest.mark.parametrize("every", [0.1, 0.25, 1.0, 2.0])
@pytest.mark.parametrize("turn", [0.0, 0.15])
def test_without_velocities_the_way_between_fixes_gives_course_and_speed(every: float, turn: float) -> None:
    path = Path(steady(6.0), steady(turn))
    path.rows[:, 4:6] = 0.0
    s = np.arange(0.0, 19.95, every)
    t, kind, z = path.fixes(s)
    z[:, :2] -= path.fixes(s)[2][:, :2] - np.column_stack([path._at(s, path._x), path._at(s, path._y)])
    x, _ = first_state(together((t, kind, z)), path.stamps, path.rows)
    distance, turned = off(x)
    assert turned < 1e-3
    assert distance < 1e-3
    chord = max(every, 1.0) * turn / 2.0  # a chord is shorter than its arc, and it lies half way on
    along = 6.0 * (math.sin(chord) / chord * math.cos(chord) if turn else 1.0)
    # fixes two seconds apart: the first displacement is no longer one of the first second
    assert x[ekf.SPEED] == pytest.approx(along if every < 2.0 else 0.0, abs=0.01)


@pytest.mark.parametrize("bend", [2.0, 8.0])
def test_a_pause_of_the_receiver_gives_no_course(bend: float) -> None:
    """Round a bend or most of a circle while it saw nothing: where it came back lies to the side."""
    path = Path(steady(5.0), lambda s: np.where(s < bend, 0.6, 0.0))
    s = np.concatenate([[0.0], np.arange(9.0, 19.9, 0.5)])
    x, p = first_state(together(path.fixes(s)), path.stamps, path.rows)
    distance, turned = off(x)
    assert turned < 5e-3  # of a radian and more that it turned
    assert distance < 5e-3
    assert x[ekf.SPEED] == 0.0  # nobody knows
    assert p[ekf.SPEED, ekf.SPEED] > 5.0**2


def test_a_heading_comes_before_any_course() -> None:
    """Of a car that drifts sideways down a ramp of ice."""
    path = Path(steady(3.0), steady(0.2))
    velocity = path.velocities(EVERY)
    velocity[2][:, :2] = velocity[2][:, :2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    heading = path.headings(np.arange(0.5, 19.0, 1.0))
    x, _ = first_state(together(path.fixes(EVERY), velocity, heading), path.stamps, path.rows)
    assert off(x)[1] < 1e-6
    assert x[ekf.SPEED] == pytest.approx(0.0, abs=1e-9)  # none of it is ahead
    parked = Path(steady(0.0))
    x, p = first_state(
        together(parked.fixes(EVERY), parked.headings(EVERY + 0.3)), parked.stamps, parked.rows
    )
    assert off(x) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert math.sqrt(p[ekf.YAW, ekf.YAW]) < 0.1


@pytest.mark.parametrize("heading", [False, True])
def test_what_was_measured_before_the_imu_began_does_not_count(heading: bool) -> None:
    """It was carried there on another lorry, sideways: only the IMU's own time tells."""
    path = Path(steady(7.0))
    before = -np.arange(4.0, 0.05, -0.1)
    fix, velocity, known = path.fixes(before), path.velocities(before), path.headings(before)
    fix[2][:, :2] += 500.0
    velocity[2][:, :2] = [0.0, -30.0]
    known[2][:, 0] = -1.0
    seen = [fix, velocity, path.fixes(EVERY + 0.02), path.velocities(EVERY + 0.02)]
    seen += [known, path.headings(EVERY + 0.04)] if heading else []
    x, p = first_state(together(*seen), path.stamps, path.rows)
    distance, turned = off(x)
    assert turned < 1e-6
    assert distance < 1e-4
    assert x[ekf.SPEED] == pytest.approx(7.0)
    assert math.sqrt(p[ekf.X, ekf.X]) < 1.0
    # nor what came after its end
    t = path.stamps[:500]
    late = together(path.fixes(EVERY), path.velocities(EVERY[EVERY > 6.0]))
    with pytest.raises(InputError, match="never moves fast enough"):
        first_state(late, t, path.rows[:500])


def slow_reverse(s: np.ndarray) -> np.ndarray:
    """Never faster than one can reverse, and never the same speed for long."""
    return -(2.0 + 0.9 * np.sin(1.3 * s))


@pytest.mark.parametrize("how", ["velocities", "fixes"])
def test_a_car_that_reverses_all_the_way_is_seen_by_its_pull(how: str) -> None:
    path = Path(slow_reverse, steady(0.05))
    seen = [path.fixes(EVERY)] + ([path.velocities(EVERY)] if how == "velocities" else [])
    x, _ = first_state(together(*seen), path.stamps, path.rows)
    distance, turned = off(x)
    assert turned < (1e-5 if how == "velocities" else 0.07)  # the antenna itself goes round
    assert distance < 0.05
    assert x[ekf.SPEED] == pytest.approx(-2.0, abs=0.02 if how == "velocities" else 0.6)


@pytest.mark.parametrize(
    ("speed", "seconds"),
    [
        (lambda s: slow_reverse(s) - 5.0, 20.0),  # too fast for that: the sensor faces backwards
        (lambda s: -(3.2 + 1.8 * np.sin(0.5 * s)), 20.0),  # now and then too fast, seven seconds in all
        (steady(-2.0), 20.0),  # no change of speed that a pull could be compared with
        (slow_reverse, 2.4),  # too short to tell
    ],
)
def test_a_course_is_turned_round_for_good_reasons_only(speed: Curve, seconds: float) -> None:
    path = Path(speed, seconds=seconds)
    s = np.arange(0.0, seconds - 0.05, 0.1)
    x, _ = first_state(together(path.fixes(s), path.velocities(s)), path.stamps, path.rows)
    assert off(x)[1] == pytest.approx(math.pi, abs=1e-6)
    assert x[ekf.SPEED] == pytest.approx(-float(speed(np.zeros(1))[0]), rel=1e-6)


def test_a_short_sprint_backwards_is_still_reversing() -> None:
    """Faster than REVERSE_SPEED, but not for REVERSE_TIME."""

    def speed(s: np.ndarray) -> np.ndarray:
        return -(2.0 + 0.9 * np.sin(1.3 * s) + 3.0 * np.exp(-(((s - 10.8) / 1.3) ** 2)))

    time = 1e-3 * np.count_nonzero(-speed(np.arange(0.0, 20.0, 1e-3)) > REVERSE_SPEED)
    assert 0.5 * REVERSE_TIME < time < 0.9 * REVERSE_TIME
    path = Path(speed)
    x, _ = first_state(together(path.fixes(EVERY), path.velocities(EVERY)), path.stamps, path.rows)
    assert off(x)[1] < 1e-6


def test_a_pull_that_says_nothing_turns_nothing_round() -> None:
    """An accelerometer that shows but noise, or that faces aside."""
    path = Path(lambda s: -slow_reverse(s))
    measured = together(path.fixes(EVERY), path.velocities(EVERY))
    for pull in (
        np.random.default_rng(2).normal(0.0, 1.0, path.stamps.size),
        np.cos(1.3 * (path.stamps - T0) + math.pi / 2),
    ):
        rows = path.rows.copy()
        rows[:, 1] = pull
        assert off(first_state(measured, path.stamps, rows)[0])[1] < 1e-6
    # loud shaking on top of an honest pull does not hide that a car reverses
    back = Path(slow_reverse)
    back.rows[:, 1] += 4.0 * np.sin(2.0 * np.pi * 11.0 * (back.stamps - T0))
    x, _ = first_state(together(back.fixes(EVERY), back.velocities(EVERY)), back.stamps, back.rows)
    assert off(x)[1] < 1e-6


@pytest.mark.parametrize(("speed", "sigma"), [(0.4, 0.02), (1.5, 0.3)])
def test_too_slow_for_a_course_is_refused(speed: float, sigma: float) -> None:
    path = Path(steady(speed))
    with pytest.raises(InputError, match="^vel: the vehicle never moves fast enough"):
        first_state(together(path.fixes(EVERY), path.velocities(EVERY, sigma)), path.stamps, path.rows)
    with pytest.raises(InputError, match="^fix: .* record the receiver's velocities"):
        first_state(together(path.fixes(EVERY[:2])), path.stamps, path.rows)


@pytest.mark.parametrize("sigma", [0.05, 0.2])
@pytest.mark.parametrize("speed", [2.0, 15.0])
def test_the_yaw_is_as_sure_as_its_course(speed: float, sigma: float) -> None:
    """A course has the noise of a velocity across by its length."""
    path = Path(steady(speed))
    _, p = first_state(together(path.fixes(EVERY), path.velocities(EVERY, sigma)), path.stamps, path.rows)
    own = sigma / speed
    assert own < math.sqrt(p[ekf.YAW, ekf.YAW]) < own + 0.05


def test_the_course_between_fixes_is_as_sure_as_they_are() -> None:
    path = Path(steady(8.0))
    for sigma in (0.01, 0.3, 0.6):
        _, p = first_state(together(path.fixes(EVERY, sigma)), path.stamps, path.rows)
        own = math.sqrt(2.0) * sigma / 8.0  # two of them, a second apart
        assert own < math.sqrt(p[ekf.YAW, ekf.YAW]) < 1.1 * own + 0.05, sigma


def test_how_sure_the_state_is_covers_what_is_not_known() -> None:
    """A fix of 2 m that comes two seconds late on a car at 6 m/s, whose speed is known five seconds later only."""
    path = Path(lambda s: np.clip(6.0 + 0.0 * s, 0.0, 6.0), yaw=1.0)
    late = together(path.fixes(EVERY[20:], 2.0), path.velocities(EVERY[50:]))
    x, p = first_state(late, path.stamps, path.rows)
    sure = np.sqrt(np.diag(p))
    distance, _ = off(x, 1.0)
    assert distance == pytest.approx(12.0, abs=0.01)  # it is taken to stand there, as nothing says otherwise
    assert x[ekf.SPEED] == 0.0
    assert distance < 3.0 * math.hypot(sure[ekf.X], sure[ekf.Y])
    assert 6.0 < sure[ekf.SPEED] < 60.0
    assert sure[ekf.X] == sure[ekf.Y]
    at_once = together(path.fixes(EVERY, 2.0), path.velocities(EVERY))
    near = np.sqrt(np.diag(first_state(at_once, path.stamps, path.rows)[1]))
    assert 2.0 <= near[ekf.X] < sure[ekf.X]
    assert near[ekf.SPEED] < 0.2 * sure[ekf.SPEED]
    exact = replace(at_once, z=at_once.z * [1.0, 1.0, 0.1])
    finer = np.sqrt(np.diag(first_state(exact, path.stamps, path.rows)[1]))
    assert 0.2 <= finer[ekf.X] < 0.3 * near[ekf.X] + 0.2


def test_a_yaw_carried_far_by_the_gyro_is_less_sure() -> None:
    sure = []
    for begins in (1.0, 15.0):
        path = Path(lambda s, begins=begins: np.where(s < begins, 0.0, 8.0))
        measured = together(path.fixes(EVERY), path.velocities(EVERY))
        sure.append(math.sqrt(first_state(measured, path.stamps, path.rows)[1][ekf.YAW, ekf.YAW]))
    assert sure[0] + 0.02 < sure[1] < 0.3
