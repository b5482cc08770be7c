# SPDX-License-Identifier: Apache-2.0
"""Speed, course and planar acceleration by the receiver alone, on motions in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.signals.offline import NO_FIX, GnssMotion, gnss_motion

T0 = 1.7e9
PLACE = (1.9, -0.6, 1.1)
METRES = 111_200.0  # of a degree


def ground(
    s: np.ndarray, speed: np.ndarray, course: np.ndarray | float = 0.0, noise: float = 0.0
) -> GnssMotion:
    """Velocities at ``s`` from T0."""
    return GnssMotion(T0 + s, speed * np.cos(course), speed * np.sin(course), noise)


def drive(fix: FixData | None = None, velocity: VelocityData | None = None) -> Drive:
    """One without an IMU."""
    imu = ImuData(np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    return Drive("drive", imu, fix or FixData.empty(), velocity or VelocityData.empty())


def test_four_messages_are_something_to_go_by() -> None:
    s = np.arange(4.0)
    assert ground(s, 0.0 * s).known
    assert not ground(s[:3], s[:3]).known


def test_the_least_speed_is_between_the_messages_and_nowhere_far_from_them() -> None:
    s = np.array([0.0, 1.0, 2.0, 3.0, 10.0, 11.0])
    motion = ground(
        s, np.array([3.0, 5.0, 5.0, 0.1, 4.0, 4.0]), np.array([0.3, 2.0, -2.0, 1.0, 0.0, 1.0]), 0.5
    )
    asked = np.array([-2.0, -1.0, 0.0, 0.5, 1.7, 3.0, 4.4, 4.6, 6.5, 8.4, 8.6, 11.0, 12.4, 12.6])
    wanted = np.interp(asked, s, [2.5, 4.5, 4.5, 0.0, 3.5, 3.5])  # less the noise, and never below zero
    wanted[[0, 7, 8, 9, 13]] = np.nan
    assert motion.least_speed(T0 + asked) == pytest.approx(wanted, nan_ok=True, rel=1e-6)


def test_acceleration_at_the_sensor_is_that_of_a_rigid_body() -> None:
    """A car that speeds up evenly in a bend that tightens evenly; the sensor ahead and to the right."""
    s = np.arange(0.0, 20.0, 0.1)
    t = np.arange(0.0, 19.9, 0.01)
    pull, faster = 0.8, 0.05
    rate = 0.1 + faster * t
    found = ground(s, 2.0 + pull * s, 0.05 * s**2).acceleration(T0 + t, rate, PLACE)
    ahead = pull - rate**2 * PLACE[0] - faster * PLACE[1]
    left = (2.0 + pull * t) * rate + faster * PLACE[0] - rate**2 * PLACE[1]
    inner = slice(100, -100)
    assert found[inner, 0] == pytest.approx(ahead[inner], abs=1e-3)
    assert found[inner, 1] == pytest.approx(left[inner], abs=1e-3)
    assert not found[:, 2].any()


def test_braking_is_seen_and_noise_is_not() -> None:
    """From 15 m/s to rest within five seconds, the velocities noisy by 5 cm/s."""
    s = np.arange(0.0, 30.0, 0.1)
    speed = 15.0 - np.clip(3.0 * (s - 10.0), 0.0, 15.0)
    noisy = np.abs(speed + np.random.default_rng(0).normal(0.0, 0.05, s.size))
    found = ground(s, noisy).acceleration(T0 + s, np.zeros_like(s), (0.0, 0.0, 0.0))
    assert found[(s > 11.0) & (s < 14.0), 0] == pytest.approx(-3.0, abs=0.25)
    assert np.abs(found[(s < 8.5) | (s > 16.5), 0]).max() < 0.25
    assert found[np.searchsorted(s, 9.95), 0] == pytest.approx(-1.5, abs=0.4)  # smooth, and not late
    assert not found[:, 1:].any()


def test_a_change_of_the_yaw_rate_is_smoothed_as_little_as_it_needs() -> None:
    """Rolling into a bend within a second and out again: the sensor ahead is thrown aside."""
    s, t = np.arange(0.0, 20.0, 0.1), np.arange(0.0, 19.9, 0.01)
    rate = 0.3 * np.sin(1.2 * t)
    found = ground(s, np.full_like(s, 6.0)).acceleration(T0 + t, rate, PLACE)
    faster = 0.36 * np.cos(1.2 * t)
    assert found[100:-100, 1] == pytest.approx(
        (6.0 * rate + faster * PLACE[0] - rate**2 * PLACE[1])[100:-100], abs=0.02
    )
    assert found[100:-100, 0] == pytest.approx(
        (-(rate**2) * PLACE[0] - faster * PLACE[1])[100:-100], abs=0.02
    )


def test_where_nothing_is_known_there_is_no_acceleration() -> None:
    s = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(20.0, 30.0, 0.1)])
    t = np.arange(-5.0, 35.0, 0.05) + 0.013
    rate = np.full_like(t, 0.2)
    found = ground(s, 5.0 + 0.3 * s).acceleration(T0 + t, rate, PLACE)
    near = (np.abs(t[:, None] - s).min(axis=1)) < 1.5
    assert not found[~near].any()
    assert found[near, 1].all()
    vague = ground(s, 5.0 + 0.3 * s, noise=0.6)
    assert not vague.acceleration(T0 + t, rate, PLACE).any()


@given(st.floats(-0.05, 0.05), st.floats(-0.4, 0.4), st.floats(-3.0, 3.0))
@settings(max_examples=12, deadline=None)
def test_the_gyro_s_bias_is_what_it_turns_more_than_the_course(
    bias: float, turn: float, course: float
) -> None:
    """However often the course goes round."""
    s, t = np.arange(0.0, 60.0, 0.2), np.arange(0.0, 60.0, 0.01)
    rate = turn + 0.2 * np.cos(0.7 * t)
    way = course + turn * s + 0.2 / 0.7 * np.sin(0.7 * s)
    found = ground(s, np.full_like(s, 8.0), way).yaw_rate_bias(T0 + t, rate + bias)
    assert found == pytest.approx(bias, abs=1e-4)


def test_a_bias_needs_ten_seconds_fast_enough_within_the_imu_s_time() -> None:
    s, t = np.arange(0.0, 60.0, 0.25), np.arange(0.0, 60.0, 0.01)
    rate = np.full_like(t, 0.01)

    def found(until: float, speed: float = 8.0, noise: float = 0.0, pause: float = 0.0) -> float | None:
        own = np.where(s < until, speed, 1.0)
        way = np.where(s < until, 0.0, 3.0 * np.sin(5.0 * s))  # below that a course is none
        at = s + pause * (s >= 6.0)
        return ground(at, own, way, noise).yaw_rate_bias(T0 + t, rate)

    assert found(9.8) is None
    assert found(10.6) == pytest.approx(0.01)
    assert found(60.0, speed=2.9) is None
    assert found(60.0, speed=3.3) == pytest.approx(0.01)
    assert found(60.0, speed=3.3, noise=0.5) is None
    # a pause of the receiver counts as nothing, neither as time nor as turning
    assert found(10.2, pause=4.0) is None
    assert found(10.9, pause=4.0) == pytest.approx(0.01)
    # nor does what lies outside of the IMU's time
    long = ground(s, np.full_like(s, 8.0))
    assert long.yaw_rate_bias(T0 + t[2000:2900], rate[2000:2900]) is None
    assert long.yaw_rate_bias(T0 + t[2000:3200], rate[2000:3200]) == pytest.approx(0.01)


def test_velocities_are_taken_as_they_are() -> None:
    s = np.array([0.0, 0.2, 0.2, 0.4, np.nan, 0.6, 0.8, 1.0])
    enu = np.column_stack([np.arange(8.0), -np.arange(8.0), np.full(8, np.nan)])
    enu[5, 1] = np.nan
    fix = some_fixes(np.arange(0.0, 5.0), np.arange(5.0), np.zeros(5))
    found = gnss_motion(drive(fix, VelocityData(T0 + s, enu)))
    assert found.t == pytest.approx(T0 + np.array([0.0, 0.2, 0.4, 0.8, 1.0]))
    assert found.east == pytest.approx([0.0, 1.0, 3.0, 6.0, 7.0])
    assert found.north == pytest.approx([0.0, -1.0, -3.0, -6.0, -7.0])
    assert found.noise == 0.0
    # of three there is not enough to go by: the fixes have it
    few = gnss_motion(drive(fix, VelocityData(T0 + s[[0, 1, 3]], enu[[0, 1, 3]])))
    assert few.east == pytest.approx(1.0)
    four = gnss_motion(drive(fix, VelocityData(T0 + s[[0, 1, 3, 7]], enu[[0, 1, 3, 7]])))
    assert four.east == pytest.approx([0.0, 1.0, 3.0, 7.0])


def some_fixes(s: np.ndarray, east: np.ndarray, north: np.ndarray, sigma: float = math.nan) -> FixData:
    """Fixes about 60° north on a sphere that a degree of has METRES."""
    latitude = 60.0 + north / METRES
    longitude = 10.0 + east / METRES / math.cos(math.radians(60.0 + north[0] / METRES))
    told = np.full((s.size, 3), sigma)
    return FixData(T0 + s, latitude, longitude, 0.0 * s, np.zeros(s.size, np.int8), told)


@pytest.mark.parametrize(("sigma", "apart"), [(0.01, 0.2), (0.028, 0.4), (0.5, 1.0), (math.nan, 1.0)])
def test_between_fixes_lies_the_velocity(sigma: float, apart: float) -> None:
    """As far apart as their noise demands for 0.1 m/s, and within a second; the stamps half way."""
    s = np.arange(0.0, 10.0, 0.2)
    found = gnss_motion(drive(some_fixes(s, 3.0 * s + 0.2 * s**2, -2.0 * s, sigma)))
    ends = np.minimum(s + apart, s[-1])[:-1]
    assert found.t - T0 == pytest.approx(0.5 * (s[:-1] + ends), abs=1e-6)
    assert found.north == pytest.approx(-2.0, rel=1e-5)
    # of a parabola a chord has the slope in its middle
    assert found.east == pytest.approx(3.0 + 0.4 * (found.t - T0), rel=1e-5)
    known = 2.5 if math.isnan(sigma) else sigma
    assert found.noise == pytest.approx(4.0 * known / apart, rel=1e-6)


def test_useless_fixes_are_left_out() -> None:
    s = np.arange(0.0, 10.0)
    good = some_fixes(s, 4.0 * s, 0.0 * s, 0.01)
    spoilt = {name: getattr(good, name).copy() for name in ("t", "latitude", "longitude", "status", "sigma")}
    spoilt["latitude"][2] = spoilt["longitude"][4] = spoilt["t"][5] = np.nan
    spoilt["status"][7], spoilt["latitude"][7] = NO_FIX, 0.0
    spoilt["sigma"][:4] = np.nan
    fix = FixData(altitude=good.altitude, **spoilt)
    again = np.concatenate([np.arange(10), [3, 3]])
    found = gnss_motion(drive(fix.select(again)))
    assert found.t - T0 == pytest.approx([0.5, 2.0, 4.5, 7.0, 8.5], abs=1e-6)
    assert found.east == pytest.approx(4.0, rel=1e-5)
    assert found.north == pytest.approx(0.0, abs=1e-6)
    none = gnss_motion(drive(fix.select(np.arange(4))))
    assert not none.known
    assert none.t.size == none.east.size == none.north.size == 0
    assert not gnss_motion(drive()).known
    assert gnss_motion(drive(good.select(np.arange(4)))).t.size == 3


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([3.0, 5.0, 10.0]))
def test_altitudes_that_are_off_by_metres_are_no_slope(seed: int, sigma: float) -> None:
    """A phone's altitude error changes by more within five seconds than roads of 15 km/h rise."""
    s = np.arange(0.0, 70.0, 1.0)
    draw = np.random.default_rng(seed).standard_normal(s.size)
    error = np.zeros_like(s)
    for k in range(1, s.size):
        error[k] = 0.983 * error[k - 1] + 0.18 * sigma * draw[k]
    motion = ground(s, np.full_like(s, 15.0 / 3.6))
    columns = {
        "latitude": 0.0 * s,
        "longitude": 0.0 * s,
        "altitude": error,
        "status": np.zeros(s.size, np.int8),
    }
    accuracy = np.tile([sigma, sigma, sigma], (s.size, 1))
    assert motion.slope(T0 + s, FixData(T0 + s, **columns, sigma=accuracy)) is None
    # of an accurate receiver they are
    exact = FixData(T0 + s, **{**columns, "altitude": 0.03 * 15.0 / 3.6 * s}, sigma=0.004 * accuracy)
    found = motion.slope(T0 + s, exact)
    assert found is not None and found == pytest.approx(np.full(s.size, math.atan(0.03)), abs=1e-6)
