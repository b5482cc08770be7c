# SPDX-License-Identifier: Apache-2.0
"""The pose filter's steps against numerical derivatives, textbook formulas written with numpy, and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from suspension_twin.pose import ekf
from suspension_twin.pose.ekf import smooth
from suspension_twin.pose.types import PoseSettings

NOISE = PoseSettings().noise()
GATE, HUBER = NOISE[ekf.GATE], NOISE[ekf.HUBER]
STATE = arrays(np.float64, 8, elements=st.floats(-3.0, 3.0))
INPUT = arrays(np.float64, 8, elements=st.floats(-1.5, 1.5))


def covariance(seed: int, scale: float = 0.3) -> np.ndarray:
    """(8, 8) of any shape, positive definite."""
    a = np.random.default_rng(seed).normal(size=(8, 8))
    return scale**2 * (a @ a.T / 8.0 + 0.2 * np.eye(8))


def moved(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """The state ``dt`` s later."""
    after = x.copy()
    ekf.predict_state(after, u, dt, np.empty((8, 8)))
    return after


def added(x: np.ndarray, u: np.ndarray, dt: float, noise: np.ndarray = NOISE) -> np.ndarray:
    """(8, 8) process noise of ``dt`` s."""
    q = np.zeros((8, 8))
    ekf.add_process_noise(q, noise, x, u, dt)
    return q


def derivative(function: object, x: np.ndarray) -> np.ndarray:
    """Central differences, a column for each of the states."""
    h = 1e-6
    columns = [(function(x + h * e) - function(x - h * e)) / (2.0 * h) for e in np.eye(8)]  # type: ignore[operator]
    return np.stack(columns, axis=-1)


@given(STATE, INPUT, st.floats(1e-3, 0.1), st.booleans())
@settings(max_examples=20, deadline=None)
def test_the_jacobian_is_the_derivative(x: np.ndarray, u: np.ndarray, dt: float, standing: bool) -> None:
    u[ekf.STANDING] = float(standing)
    f = np.full((8, 8), np.nan)
    ekf.predict_state(x.copy(), u, dt, f)
    assert f == pytest.approx(derivative(lambda y: moved(y, u, dt), x), abs=1e-7)


def test_a_circle_is_driven_round() -> None:
    """Constant speed and yaw rate, a biased gyro: after a whole turn it is back, and half way across."""
    v, w, n = 8.0, 0.5, 1000
    x = np.array([3.0, -2.0, 0.4, v, 0.0, 0.0, 0.02, 0.0])
    u = np.zeros(8)
    u[ekf.YAW_RATE] = w + 0.02
    dt = 2.0 * math.pi / w / n
    for k in range(n):
        x = moved(x, u, dt)
        if k == n // 2 - 1:
            across = 2.0 * v / w
            middle = [3.0 - across * math.sin(0.4), -2.0 + across * math.cos(0.4)]
            assert x[:2] == pytest.approx(middle, abs=1e-3)
    assert x[:3] == pytest.approx([3.0, -2.0, 0.4 + 2.0 * math.pi], abs=1e-3)
    assert x[3:] == pytest.approx([v, 0.0, 0.0, 0.02, 0.0], abs=1e-12)


def test_straight_on_it_speeds_up_and_slips_less_and_less() -> None:
    x = np.array([0.0, 0.0, 0.3, 5.0, 2.0, 0.4, 0.0, 0.1])
    after = moved(x, np.zeros(8), 0.2)
    ahead, left = 5.0 * 0.2 + 0.5 * 2.0 * 0.2**2, 0.4 * 0.2
    c, s = math.cos(0.3), math.sin(0.3)
    assert after[:4] == pytest.approx([ahead * c - left * s, ahead * s + left * c, 0.3, 5.4])
    assert after[4:] == pytest.approx([2.0, 0.4 * math.exp(-0.2 / ekf.LATERAL_SPEED_TIME), 0.0, 0.1])


def test_who_stands_stays() -> None:
    x = np.array([1.0, 2.0, 0.3, 0.01, 0.0, 0.02, 0.05, 0.1])
    u = np.array([0.3, 0.2, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    after = moved(x, u, 0.5)
    assert after[:4] == pytest.approx(x[:4])


@given(STATE, INPUT, st.floats(0.01, 0.5))
@settings(max_examples=15, deadline=None)
def test_noise_of_two_halves_is_that_of_the_whole(x: np.ndarray, u: np.ndarray, dt: float) -> None:
    """Jerk on the acceleration, walks of biases, yaw, and a lateral speed that forgets: one density each."""
    u[ekf.YAW_RATE] = x[ekf.GYRO_BIAS]  # straight ahead the model is linear
    u[ekf.STANDING] = 0.0
    half = added(x, u, 0.5 * dt)
    f = np.eye(8)
    f[ekf.SPEED, ekf.ACCELERATION] = 0.5 * dt
    f[ekf.LATERAL_SPEED, ekf.LATERAL_SPEED] = math.exp(-0.5 * dt / ekf.LATERAL_SPEED_TIME)
    assert f @ half @ f.T + half == pytest.approx(added(x, u, dt), rel=1e-9, abs=1e-15)


def test_noise_is_of_the_densities_that_the_settings_name() -> None:
    x = np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0, 0.1, 0.0])
    u = np.array([0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    given_ = PoseSettings()
    q = added(x, u, 0.02)
    assert np.array_equal(q, q.T)
    assert q[ekf.ACCELERATION, ekf.ACCELERATION] == pytest.approx(given_.jerk_density * 0.02)
    turning = given_.gyro_density + (given_.gyro_scale * 0.4) ** 2
    assert q[ekf.YAW, ekf.YAW] == pytest.approx(turning * 0.02)
    assert q[ekf.GYRO_BIAS, ekf.GYRO_BIAS] == pytest.approx(given_.gyro_bias_walk * 0.02)
    assert q[ekf.ACCELEROMETER_BIAS, ekf.ACCELEROMETER_BIAS] == pytest.approx(given_.force_bias_walk * 0.02)
    # for ever in a bend the lateral speed is as uncertain as the slip: rear axle, lateral acceleration, speed
    slip = added(x, u, 1e3)[ekf.LATERAL_SPEED, ekf.LATERAL_SPEED]
    straight = added(x, u * 0.0 + [0.1, 0, 0, 1, 0, 0, 0, 0], 1e3)[ekf.LATERAL_SPEED, ekf.LATERAL_SPEED]
    assert math.sqrt(slip) - math.sqrt(straight) == pytest.approx(given_.slip * 10.0 * 0.4 * 10.0)
    assert math.sqrt(straight) < 0.05
    for sign in (-1.0, 1.0):
        y = x.copy()
        y[ekf.SPEED] *= sign
        assert added(y, u, 0.02) == pytest.approx(q)
    # where samples are missing the gyro is worse so many times; a factor below one helps nobody
    for factor, worse in ((1000.0, 1000.0), (0.1, 1.0)):
        u[ekf.GYRO_LOOSENESS] = factor
        assert added(x, u, 0.02)[ekf.YAW, ekf.YAW] == pytest.approx(worse * turning * 0.02)
    u[ekf.STANDING] = 1.0
    stands = added(x, u, 0.02)
    assert stands[ekf.YAW, ekf.YAW] == 0.0
    # a car that stands may settle, one that drives is led by its speed
    assert 0.0 < q[ekf.X, ekf.X] < stands[ekf.X, ekf.X] < 0.01**2
    assert stands[ekf.X, ekf.X] == stands[ekf.Y, ekf.Y]
    assert q[ekf.X, ekf.X] == q[ekf.Y, ekf.Y]


def textbook(
    x: np.ndarray, p: np.ndarray, h: np.ndarray, r: np.ndarray, variance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's update by all rows at once."""
    s = h @ p @ h.T + variance * np.eye(len(h))
    gain = np.linalg.solve(s, h @ p).T
    return x + gain @ r, p - gain @ h @ p


def expected_of(x: np.ndarray, u: np.ndarray, kind: int) -> np.ndarray:
    """What a measurement shows, if all is as the state says: place or velocity of the antenna, or the yaw."""
    yaw = x[ekf.YAW]
    if kind == ekf.HEADING:
        return np.array([yaw])
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    if kind == ekf.VELOCITY:
        return turn @ (x[[ekf.SPEED, ekf.LATERAL_SPEED]] + u[[ekf.ANTENNA_VX, ekf.ANTENNA_VY]])
    return x[[ekf.X, ekf.Y]] + turn @ u[[ekf.ANTENNA_X, ekf.ANTENNA_Y]]


@given(
    STATE,
    INPUT,
    st.integers(0, 1000),
    st.sampled_from([ekf.FIX, ekf.VELOCITY, ekf.HEADING]),
    st.floats(0.05, 1.0),
    st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
)
@settings(max_examples=30, deadline=None)
def test_a_measurement_is_used_as_kalman_says(
    x: np.ndarray, u: np.ndarray, seed: int, kind: int, sigma: float, off: tuple[float, float]
) -> None:
    u[ekf.STANDING] = 0.0
    stack = np.stack([covariance(seed + k) for k in range(3)])
    p = stack[1].copy()
    h = derivative(lambda y: expected_of(y, u, kind), x)
    r = np.array(off)[: len(h)]
    z = np.array([*(expected_of(x, u, kind) + r), 0.0, 0.0])[:2]
    x_after, others = x.copy(), stack[[0, 2]].copy()
    weight = ekf.measurement_update(x_after, stack[1], kind, np.array([*z, sigma]), u, NOISE)
    s = h @ p @ h.T + sigma**2 * np.eye(len(h))
    distance = math.sqrt(r @ np.linalg.solve(s, r))
    if distance < 0.99 * HUBER:
        assert weight == 1.0
        wanted = textbook(x, p, h, r, sigma**2)
        assert x_after == pytest.approx(wanted[0], abs=1e-6)
        assert stack[1] == pytest.approx(wanted[1], abs=1e-6)
    assert np.array_equal(stack[[0, 2]], others)


@pytest.mark.parametrize("kind", [ekf.FIX, ekf.VELOCITY, ekf.HEADING])
def test_the_further_off_the_less_it_weighs_until_it_is_refused(kind: int) -> None:
    """Huber: beyond the distance from which it weighs less, as if its variance grew by the weight squared."""
    x, u, sigma = np.array([1.0, 2.0, 0.5, 4.0, 0.1, 0.2, 0.0, 0.0]), np.zeros(8), 0.4
    u[4:] = [0.8, -0.4, 0.1, 0.3]
    h = derivative(lambda y: expected_of(y, u, kind), x)
    direction = np.array([0.8, -0.6])[: len(h)]
    p = covariance(5, 0.2)
    s = h @ p @ h.T + sigma**2 * np.eye(len(h))
    unit = math.sqrt(direction @ np.linalg.solve(s, direction))
    for distance in (0.5 * HUBER, 0.9 * HUBER, 1.2 * HUBER, 0.5 * (HUBER + GATE), 0.98 * GATE):
        r = direction * distance / unit
        z = np.array([*(expected_of(x, u, kind) + r), 0.0])[:2]
        after, spread = x.copy(), p.copy()
        weight = ekf.measurement_update(after, spread, kind, np.array([*z, sigma]), u, NOISE)
        assert weight == pytest.approx(min(1.0, HUBER / distance), rel=1e-6)
        wanted = textbook(x, p, h, r, (sigma / weight) ** 2)
        assert after == pytest.approx(wanted[0], abs=1e-7)
        assert spread == pytest.approx(wanted[1], abs=1e-7)
    for distance in (1.02 * GATE, 10.0 * GATE):
        z = np.array([*(expected_of(x, u, kind) + direction * distance / unit), 0.0])[:2]
        if kind == ekf.HEADING and distance / unit > math.pi:
            continue
        after, spread = x.copy(), p.copy()
        assert ekf.measurement_update(after, spread, kind, np.array([*z, sigma]), u, NOISE) == 0.0
        assert np.array_equal(after, x)
        assert np.array_equal(spread, p)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
@pytest.mark.parametrize("yaw", [3.1, -3.1, 0.0])
def test_whole_turns_of_a_heading_do_not_count(turns: int, yaw: float) -> None:
    x, p = np.zeros(8), np.eye(8) * 0.01
    x[ekf.YAW] = yaw + 2.0 * math.pi * turns
    z = np.array([yaw + 0.1, 0.0, 0.1])
    ekf.measurement_update(x, p, ekf.HEADING, z, np.zeros(8), NOISE)
    assert x[ekf.YAW] == pytest.approx(yaw + 2.0 * math.pi * turns + 0.05)


def test_a_reset_moves_the_place_alone() -> None:
    """However far off: the antenna is at the fix, and nothing but the place has changed."""
    u = np.zeros(8)
    u[4:6] = 0.8, -0.4
    x = np.array([1.0, 2.0, 0.5, 4.0, 0.1, 0.2, 0.01, 0.02])
    stack = np.stack([covariance(k) for k in range(3)])
    before, p = x.copy(), stack.copy()
    weight = ekf.measurement_update(x, stack[1], ekf.RESET, np.array([500.0, -300.0, 0.3]), u, NOISE)
    assert weight == 1.0
    assert expected_of(x, u, ekf.FIX) == pytest.approx([500.0, -300.0], abs=1e-3)
    assert x[2:] == pytest.approx(before[2:], abs=1e-3)
    assert stack[1][2:, 2:] == pytest.approx(p[1][2:, 2:], abs=1e-4)
    # as uncertain as the fix, and as the yaw makes the antenna's arm
    arm = derivative(lambda y: expected_of(y, u, ekf.FIX), before)[:, ekf.YAW]
    wanted = 0.3**2 * np.eye(2) + np.outer(arm, arm) * p[1][2, 2]
    assert stack[1][:2, :2] == pytest.approx(wanted, abs=1e-3)
    assert np.array_equal(stack[[0, 2]], p[[0, 2]])


@pytest.mark.parametrize("kind", [ekf.FIX, ekf.VELOCITY])
def test_of_a_car_that_stands_a_wandering_fix_turns_nothing(kind: int) -> None:
    """Schmidt: the yaw's own uncertainty stays, and what hangs together with it is kept in step."""
    x, p = np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.01, 0.02]), covariance(3)
    u = np.zeros(8)
    u[ekf.STANDING], u[ekf.ANTENNA_X] = 1.0, 1.0
    h = derivative(lambda y: expected_of(y, u, kind), x)
    z = np.array([*(expected_of(x, u, kind) + np.array([0.3, -0.2])), 0.5])
    gain = np.linalg.solve(h @ p @ h.T + 0.25 * np.eye(2), h @ p).T
    held = gain.copy()
    held[ekf.YAW] = 0.0
    after, spread = x.copy(), p.copy()
    ekf.measurement_update(after, spread, kind, z, u, NOISE)
    assert after[ekf.YAW] == x[ekf.YAW]
    assert spread[ekf.YAW, ekf.YAW] == p[ekf.YAW, ekf.YAW]
    assert spread == pytest.approx(spread.T)
    assert np.linalg.eigvalsh(spread).min() > 0.0
    # two numbers one after the other are not the two at once where one state is held; for one number they are
    z_one, h_one = np.array([0.2]), np.zeros(8)
    h_one[ekf.X], h_one[ekf.YAW] = 1.0, -0.4
    one, p_one = x.copy(), p.copy()
    ekf.scalar_update(one, p_one, h_one, float(z_one[0]), 0.09, True)
    k = p @ h_one / (h_one @ p @ h_one + 0.09)
    k[ekf.YAW] = 0.0
    rest = np.eye(8) - np.outer(k, h_one)
    assert one == pytest.approx(x + k * z_one[0])
    assert p_one == pytest.approx(rest @ p @ rest.T + 0.09 * np.outer(k, k))
    # a heading still turns it
    ekf.measurement_update(one, p_one, ekf.HEADING, np.array([0.6, 0.0, 0.1]), u, NOISE)
    assert one[ekf.YAW] > 0.51


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_the_accelerometer_measures_acceleration_and_bias(dt: float) -> None:
    x, p = np.array([1.0, 2.0, 0.5, 4.0, 0.3, 0.1, 0.01, 0.05]), covariance(4)
    u = np.array([0.2, 0.9, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    h = np.zeros((1, 8))
    h[0, [ekf.ACCELERATION, ekf.ACCELEROMETER_BIAS]] = 1.0
    wanted = textbook(x, p, h, np.array([0.9 - 0.35]), NOISE[ekf.FORCE_DENSITY] / dt)
    after, spread = x.copy(), p.copy()
    ekf.imu_measurement_update(after, spread, NOISE, u, dt)
    assert after == pytest.approx(wanted[0])
    assert spread == pytest.approx(wanted[1])
    # where samples are missing there is none to be had
    u[ekf.GYRO_LOOSENESS] = 1000.0
    after, spread = x.copy(), p.copy()
    ekf.imu_measurement_update(after, spread, NOISE, u, dt)
    assert np.array_equal(after, x)
    assert np.array_equal(spread, p)


def test_standing_still_shows_the_biases() -> None:
    """What the sensors read then is their bias; the yaw is left alone, and the place too."""
    x, p = (
        np.array([1.0, 2.0, 0.5, 0.2, 0.3, 0.1, 0.0, 0.0]),
        np.diag([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 1e-2, 0.1]),
    )
    u = np.array([0.03, 0.15, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(300):
        ekf.imu_measurement_update(x, p, NOISE, u, 0.01)
    assert x[:3] == pytest.approx([1.0, 2.0, 0.5])
    assert x[3:] == pytest.approx([0.0, 0.0, 0.0, 0.03, 0.15], abs=2e-3)
    assert np.sqrt(np.diag(p))[3:7].max() < 0.02
    assert np.diag(p)[:3] == pytest.approx([1.0, 1.0, 0.1])
    # looked at ten times as often it is not ten times as sure: of one second there is one second's worth
    often, spread = x.copy(), np.eye(8)
    seldom, wide = x.copy(), np.eye(8)
    for _ in range(100):
        ekf.imu_measurement_update(often, spread, NOISE, u, 0.01)
    for _ in range(10):
        ekf.imu_measurement_update(seldom, wide, NOISE, u, 0.1)
    assert spread == pytest.approx(wide, rel=1e-6, abs=1e-12)


def step_on(x: np.ndarray, p: np.ndarray, u: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """The textbook's prediction."""
    f = np.empty((8, 8))
    y = x.copy()
    ekf.predict_state(y, u, dt, f)
    return y, f @ p @ f.T + added(y, u, dt)


def ring(n: int, size: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and inputs of ``n`` samples of a lively drive, of which a ring of ``size`` holds the last."""
    random = np.random.default_rng(seed)
    t = np.cumsum(random.uniform(0.008, 0.012, n))
    u = random.normal(0.0, 0.3, (n, 8))
    u[:, ekf.STANDING], u[:, ekf.GYRO_LOOSENESS] = 0.0, 1.0
    held, inputs = np.zeros(size), np.zeros((size, 8))
    for k in range(n):
        held[k % size], inputs[k % size] = t[k], u[k]
    return held, inputs


@pytest.mark.parametrize("first", [30, 47])
@pytest.mark.parametrize("spare", [0, 5])
def test_advance_takes_each_measurement_at_its_own_stamp(first: int, spare: int) -> None:
    """Two between two samples, one on a sample, one before the first, which counts no more."""
    size, last = 32, 58
    t, inputs = ring(59, size)
    start = np.array([5.0, -3.0, 0.2, 6.0, 0.1, 0.0, 0.0, 0.0])
    states, spreads = np.full((size, 8), np.nan), np.full((size, 8, 8), np.nan)
    states[first % size], spreads[first % size] = start, covariance(1)

    def stamp(index: int, share: float = 0.0) -> float:
        return float(t[index % size] + share * (t[(index + 1) % size] - t[index % size]))

    times = [stamp(first), stamp(first, 0.4), stamp(first, 0.7), stamp(first + 3), stamp(first + 6, 0.5)]
    kinds = [ekf.FIX, ekf.VELOCITY, ekf.FIX, ekf.HEADING, ekf.FIX]
    values = [[90, 90, 0.1], [5.9, 1.2, 0.1], [5.5, -3.2, 0.2], [0.25, 0.0, 0.05], [999, 0, 0.1]]
    count = len(times)
    padded = np.array([*times, *[0.0] * spare])
    weights = np.full(count + spare, np.nan)
    ekf.advance(
        t, inputs, states, spreads, first, last, np.array([*kinds, *[0.0] * spare]), padded,
        np.array([*values, *[[0.0, 0.0, 1.0]] * spare], dtype=float), weights, count, NOISE,
    )  # fmt: skip
    x, p, now, m = start, covariance(1), stamp(first), 1
    wanted = []
    for k in range(first + 1, last + 1):
        u, begin = inputs[k % size], now
        while m < count and times[m] <= stamp(k):
            x, p = step_on(x, p, u, times[m] - now)
            x, p = x.copy(), p.copy()
            wanted.append(ekf.measurement_update(x, p, kinds[m], np.array(values[m], dtype=float), u, NOISE))
            now, m = times[m], m + 1
        if stamp(k) > now:
            x, p = step_on(x, p, u, stamp(k) - now)
        now = stamp(k)
        ekf.imu_measurement_update(x, p, NOISE, u, now - begin)
        assert states[k % size] == pytest.approx(x, abs=1e-9)
        assert spreads[k % size] == pytest.approx(p, abs=1e-9)
    assert wanted[-1] == 0.0  # far off
    assert weights[1:count] == pytest.approx(wanted)
    assert np.array_equal(states[first % size], start)


def nodes(n: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, inputs, kinds and values of a short straight drive to the east at 5 m/s; a fix shares a stamp."""
    random = np.random.default_rng(7)
    t = 0.05 * np.arange(n)
    kinds = np.full(n, -1.0)
    kinds[4::6], kinds[7::12] = ekf.FIX, ekf.VELOCITY
    t = np.insert(t, 21, t[20])
    kinds = np.insert(kinds, 21, ekf.FIX)
    values = np.column_stack([5.0 * t, 0.0 * t, np.full(n + 1, 0.2)])
    values[kinds == ekf.VELOCITY] = [5.0, 0.0, 0.1]
    values[:, :2] += random.normal(0.0, 0.05, (n + 1, 2))
    inputs = np.zeros((n + 1, 8))
    inputs[:, ekf.FORWARD_FORCE] = random.normal(0.1, 0.1, n + 1)
    inputs[:, ekf.GYRO_LOOSENESS] = 1.0
    return t, inputs, kinds, values


def smoothed(
    start: np.ndarray, spread: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Filtered and smoothed states and covariances of :func:`nodes`."""
    t, inputs, kinds, values = nodes()
    states, spreads = np.full((t.size, 8), np.nan), np.full((t.size, 8, 8), np.nan)
    weights = np.full(t.size, np.nan)
    ekf.forward(t, inputs, kinds, values, start, spread, noise, states, spreads, weights)
    assert np.isfinite(weights[kinds >= 0]).all()
    filtered = states.copy(), spreads.copy()
    smooth(t, inputs, noise, states, spreads)
    return *filtered, states, spreads


def test_smoothing_is_least_squares_over_all_nodes_at_once() -> None:
    """Straight ahead with a known yaw all is linear: the drive as one Gaussian, given what was measured."""
    t, inputs, kinds, values = nodes()
    noise = PoseSettings(gate=1e3, gyro_density=1e-18, gyro_scale=1e-9, gyro_bias_walk=1e-18).noise(
        hard=False
    )
    start = np.array([0.1, -0.1, 0.0, 4.8, 0.0, 0.0, 0.0, 0.0])
    spread = np.diag(np.array([0.5, 0.5, 1e-7, 0.5, 0.5, 0.1, 1e-8, 0.2]) ** 2)
    f_states, f_spreads, states, spreads = smoothed(start, spread, noise)
    n = t.size
    mean, joint = np.zeros((n, 8)), np.zeros((n, 8, n, 8))
    mean[0], joint[0, :, 0] = start, spread
    rows, seen, variances = [], [], []
    for i in range(n):
        dt = t[i] - t[i - 1] if i else 0.0
        if dt > 0.0:
            f = np.empty((8, 8))
            mean[i] = mean[i - 1]
            ekf.predict_state(mean[i], inputs[i], dt, f)
            joint[i, :, :i] = np.einsum("ab,bjc->ajc", f, joint[i - 1, :, :i])
            joint[:i, :, i] = np.transpose(joint[i, :, :i], (1, 2, 0))
            joint[i, :, i] = f @ joint[i - 1, :, i - 1] @ f.T + added(f_states[i - 1], inputs[i], dt, noise)
            rows.append((i, [ekf.ACCELERATION, ekf.ACCELEROMETER_BIAS]))
            seen.append(inputs[i, ekf.FORWARD_FORCE])
            variances.append(noise[ekf.FORCE_DENSITY] / dt)
        elif i:
            mean[i], joint[i, :, :i] = mean[i - 1], joint[i - 1, :, :i]
            joint[:i, :, i] = np.transpose(joint[i, :, :i], (1, 2, 0))
            joint[i, :, i] = joint[i - 1, :, i - 1]
        if kinds[i] >= 0:
            pair = (ekf.X, ekf.Y) if kinds[i] == ekf.FIX else (ekf.SPEED, ekf.LATERAL_SPEED)
            for state, number in zip(pair, values[i, :2], strict=True):
                rows.append((i, [state]))
                seen.append(number)
                variances.append(values[i, 2] ** 2)
    h = np.zeros((len(rows), n, 8))
    for k, (i, which) in enumerate(rows):
        h[k, i, which] = 1.0
    h, whole = h.reshape(len(rows), -1), joint.reshape(8 * n, 8 * n)
    gain = np.linalg.solve(h @ whole @ h.T + np.diag(variances), h @ whole).T
    best = (mean.reshape(-1) + gain @ (np.array(seen) - h @ mean.reshape(-1))).reshape(n, 8)
    left = (whole - gain @ h @ whole).reshape(n, 8, n, 8)
    assert states == pytest.approx(best, abs=2e-6)
    own = np.stack([left[i, :, i] for i in range(n)])
    assert spreads == pytest.approx(own, rel=1e-4, abs=1e-7)
    assert np.array_equal(states[-1], f_states[-1])
    # the future helps: nowhere is it less sure than filtered, and in the middle a good deal surer
    assert (np.einsum("ikk->ik", spreads) <= np.einsum("ikk->ik", f_spreads) + 1e-12).all()
    assert spreads[30, 0, 0] < 0.7 * f_spreads[30, 0, 0]


def test_smoothing_in_a_bend_is_that_of_rauch_tung_and_striebel() -> None:
    """With the gain P F' (F P F' + Q)^-1, node by node from the end; nodes that share a stamp share the state."""
    t, inputs, kinds, values = nodes()
    inputs[:, ekf.YAW_RATE] = 0.3 * np.sin(t)
    inputs[40:50, ekf.GYRO_LOOSENESS] = 1000.0
    inputs[50:, ekf.STANDING] = 1.0
    inputs[:, 4:6] = 0.8, -0.4
    states, spreads = np.empty((t.size, 8)), np.empty((t.size, 8, 8))
    start = np.array([0.1, -0.1, 0.1, 4.8, 0.0, 0.0, 0.0, 0.0])
    spread = np.diag(np.array([0.5, 0.5, 0.2, 0.5, 0.5, 0.1, 1e-2, 0.2]) ** 2)
    soft = PoseSettings().noise(hard=False)
    ekf.forward(t, inputs, kinds, values, start, spread, soft, states, spreads, np.zeros(t.size))
    wanted, shape = states.copy(), spreads.copy()
    for i in range(t.size - 2, -1, -1):
        dt = t[i + 1] - t[i]
        if dt == 0.0:
            wanted[i], shape[i] = wanted[i + 1], shape[i + 1]
            continue
        f, ahead = np.empty((8, 8)), states[i].copy()
        ekf.predict_state(ahead, inputs[i + 1], dt, f)
        predicted = f @ spreads[i] @ f.T + added(ahead, inputs[i + 1], dt, soft)
        gain = np.linalg.solve(predicted, f @ spreads[i]).T
        wanted[i] = states[i] + gain @ (wanted[i + 1] - ahead)
        shape[i] = spreads[i] + gain @ (shape[i + 1] - predicted) @ gain.T
    smooth(t, inputs, soft, states, spreads)
    assert states == pytest.approx(wanted, abs=1e-7)
    assert spreads == pytest.approx(shape, abs=1e-7)
    assert np.array_equal(spreads[20], spreads[21])
    assert np.array_equal(states[20], states[21])


def test_forward_is_predict_then_imu_then_what_was_measured() -> None:
    t, inputs, kinds, values = nodes()
    inputs[:, ekf.YAW_RATE] = 0.2 * np.cos(t)
    values[10, 0] += 1e3  # refused
    start, spread = np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0]), covariance(2)
    states, spreads, weights = np.empty((t.size, 8)), np.empty((t.size, 8, 8)), np.full(t.size, np.nan)
    ekf.forward(t, inputs, kinds, values, start, spread, NOISE, states, spreads, weights)
    x, p = start, spread
    for i in range(t.size):
        if i and t[i] > t[i - 1]:
            x, p = step_on(x, p, inputs[i], t[i] - t[i - 1])
            ekf.imu_measurement_update(x, p, NOISE, inputs[i], t[i] - t[i - 1])
        x, p = x.copy(), p.copy()
        if kinds[i] >= 0:
            weight = ekf.measurement_update(x, p, int(kinds[i]), values[i], inputs[i], NOISE)
            assert weights[i] == pytest.approx(weight)
        else:
            assert math.isnan(weights[i])
        assert states[i] == pytest.approx(x, abs=1e-9)
        assert spreads[i] == pytest.approx(p, abs=1e-9)
    assert kinds[10] == ekf.FIX
    assert weights[10] == 0.0
