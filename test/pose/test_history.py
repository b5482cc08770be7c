# SPDX-License-Identifier: Apache-2.0
"""The ring of the last seconds: what it remembers, and that the order of arrival makes no difference."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.pose import ekf
from suspension_twin.pose.history import History, Measurement
from suspension_twin.pose.lock import Blend
from suspension_twin.pose.types import PoseSettings

NOISE = PoseSettings().noise()
FASTEST = 1600.0  # Hz of an IMU
Seen = tuple[float, int, Measurement]


def filled(n: int, seconds: float = 1.0, dt: float = 0.01) -> History:
    """A car at 5 m/s to the east, ``n`` samples filtered without a measurement; the first at ``dt``."""
    history = History(seconds, NOISE)
    for k in range(n):
        row = history.append((k + 1) * dt)
        row[:] = 0.0
        row[ekf.GYRO_LOOSENESS] = 1.0
        row[ekf.YAW_RATE] = 0.1 * math.sin(0.3 * k)
        if k == 0:
            history.state(0)[:] = [0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0]
            history.covariance(0)[:] = np.diag([1.0, 1.0, 0.01, 0.25, 1.0, 0.01, 1e-4, 0.04])
        else:
            history.step()
    return history


@given(st.integers(1, 120), st.floats(0.0, 1.3), st.sampled_from([0.01, 0.03]))
@settings(max_examples=80, deadline=None)
def test_the_sample_before_a_stamp(n: int, t: float, seconds: float) -> None:
    """The newest that is before, however often the ring has gone round; none where it does not reach back."""
    history = History(seconds, NOISE)
    assert history.before(t) == -1
    for k in range(n):
        history.append(0.01 * (k + 1))
    assert history.head == n - 1
    found = history.before(t)
    true = math.ceil(round(t / 0.01, 9)) - 2 if t <= 0.01 * n else n - 1
    if found == -1:
        kept = int(seconds * FASTEST)
        assert true < 0 or history.head - true >= kept
    else:
        assert history.stamp(found) < t
        assert found == history.head or history.stamp(found + 1) >= t
        assert history.stamp(found) == pytest.approx(0.01 * (found + 1))


@pytest.mark.parametrize("n", [30, 500])
def test_all_of_its_seconds_are_there_at_the_fastest_rate(n: int) -> None:
    history = History(0.05, NOISE)
    for k in range(n):
        history.append(k / FASTEST)[:] = k
    now, oldest = history.stamp(history.head), max(0.0, (n - 1) / FASTEST - 0.05)
    for t in np.linspace(oldest + 1e-6, now + 1e-6, 50):
        k = history.before(float(t))
        assert k == math.ceil(t * FASTEST) - 1
        assert history.inputs(k)[0] == k
    assert history.before(-1.0) == -1
    history.clear()
    assert history.head == -1
    assert history.before(now + 1.0) == -1


def measured() -> list[Seen]:
    """A dozen fixes, velocities and headings of that car, all of them a little off, and one outlier."""
    random = np.random.default_rng(3)
    out: list[Seen] = []
    for t in random.uniform(0.05, 0.79, 12):
        kind = int(random.choice([ekf.FIX, ekf.VELOCITY, ekf.HEADING]))
        z = {ekf.FIX: (5.0 * t, 0.0), ekf.VELOCITY: (5.0, 0.0), ekf.HEADING: (0.0, 0.0)}[kind]
        x, y = np.array(z) + random.normal(0.0, 0.05, 2)
        out.append((float(t), kind, (float(x), float(y), 0.1)))
    return [*out, (0.33, ekf.FIX, (70.0, -40.0, 0.1))]


@pytest.mark.parametrize("seed", range(4))
def test_in_whatever_order_measurements_arrive_the_end_is_the_same(seed: int) -> None:
    orderly = sorted(measured())
    mixed = [orderly[k] for k in np.random.default_rng(seed).permutation(len(orderly))]
    at_once, late = filled(1), filled(80)
    k, weights = 0, {}
    for n in range(1, 80):
        row = at_once.append(late.stamp(n))
        row[:] = late.inputs(n)
        at_once.step()
        while k < len(orderly) and orderly[k][0] <= late.stamp(n):
            t, kind, z = orderly[k]
            weights[t] = at_once.take(at_once.before(t), t, kind, z)
            k += 1
    assert k == len(orderly)
    before = late.state(late.head).copy()
    for t, kind, z in mixed:
        weight = late.take(late.before(t), t, kind, z)
        assert weight == (0.0 if z[0] == 70.0 else 1.0)
        assert (weights[t] == 0.0) == (z[0] == 70.0)
    assert late.state(late.head) == pytest.approx(at_once.state(at_once.head), abs=1e-9)
    assert late.covariance(late.head) == pytest.approx(at_once.covariance(at_once.head), abs=1e-9)
    assert np.abs(late.state(late.head) - before).max() > 0.01
    # filtered again from any sample it is the same once more
    kept = late.state(late.head).copy()
    for first in (0, 20, 78, 79):
        late.run(first)
        assert late.state(late.head) == pytest.approx(kept, abs=1e-12)


def test_two_at_one_stamp_and_one_on_a_sample() -> None:
    """A fix and a velocity of the same moment are both used, whichever comes first; on a sample, before its end."""
    fix, velocity = (ekf.FIX, (2.1, 0.1, 0.2)), (ekf.VELOCITY, (5.2, 0.1, 0.2))
    ends = []
    for order in ((fix, velocity), (velocity, fix)):
        history = filled(60)
        t = history.stamp(40)
        for kind, z in order:
            assert history.take(history.before(t), t, kind, z) == 1.0
        ends.append(history.state(59).copy())
        untouched = filled(60)
        assert np.array_equal(history.state(39), untouched.state(39))
        assert np.abs(history.state(40) - untouched.state(40)).max() > 1e-3
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)  # but for what is not linear


def test_more_than_it_can_keep_and_older_than_it_is() -> None:
    """Hundreds of measurements, and samples that go round: the newest state is that of a ring without end."""
    short, long = filled(1, 0.05), filled(1, 5.0)
    for n in range(1, 900):
        t = 0.002 * (n + 5)
        for history in (short, long):
            row = history.append(t)
            row[:] = 0.0
            row[ekf.GYRO_LOOSENESS] = 1.0
            history.step()
            at = t - 0.0015
            weight = history.take(history.before(at), at, ekf.FIX, (5.0 * at, 0.01, 0.3))
            assert weight > 0.0
    assert short.state(short.head) == pytest.approx(long.state(long.head), abs=1e-12)
    assert short.covariance(short.head) == pytest.approx(long.covariance(long.head), abs=1e-12)
    # one that comes late, too, is filtered with all that came since
    for history in (short, long):
        history.take(history.before(t - 0.04), t - 0.04, ekf.VELOCITY, (5.5, 0.0, 0.05))
    assert short.state(short.head) == pytest.approx(long.state(long.head), abs=1e-9)


# -- what the output makes of corrections ------------------------------------------------------


def corrected(blend: Blend, change: dict[int, float]) -> None:
    """The filter's state, at 10 m/s along a yaw of 0.3, is changed."""
    before = np.zeros(8)
    before[[ekf.YAW, ekf.SPEED]] = 0.3, 10.0
    after = before.copy()
    for state, value in change.items():
        after[state] += value
    blend.correct(before, after)


@pytest.mark.parametrize(("state", "index"), [(ekf.X, 0), (ekf.Y, 1), (ekf.YAW, 2)])
def test_a_correction_dies_away_critically_damped(state: int, index: int) -> None:
    time, step = 0.3, 0.02
    blend = Blend(time, 5.0, 5.0)
    assert blend.step(0.0) == (0.0, 0.0, 0.0, 0.0)
    corrected(blend, {state: 0.1})
    before = np.array([10.0 * math.cos(0.3), 10.0 * math.sin(0.3)])
    for k in range(1, 60):
        out = blend.step(k * step)
        t = k * step
        assert out[index] == pytest.approx(-0.1 * (1.0 + t / time) * math.exp(-t / time), rel=1e-9)
        if state == ekf.YAW:  # what turns the velocity is made up for, so that the place has no kink
            off = before - 10.0 * np.array([math.cos(0.4), math.sin(0.4)])
            assert out[:2] == pytest.approx(off * t * math.exp(-t / time), rel=1e-9)
        else:
            assert [out[i] for i in range(4) if i != index] == [0.0, 0.0, 0.0]


def test_a_correction_of_the_speed_leaves_place_and_velocity_without_a_step() -> None:
    blend = Blend(0.3, 5.0, 5.0)
    blend.step(0.0)
    corrected(blend, {ekf.SPEED: 0.5})
    x, y, yaw, v = blend.step(1e-4)
    assert (x / 1e-4, y / 1e-4) == pytest.approx((-0.5 * math.cos(0.3), -0.5 * math.sin(0.3)), rel=1e-3)
    assert yaw == 0.0
    assert v == pytest.approx(-0.5 * math.exp(-1e-4 / 0.3))
    assert blend.step(0.15)[3] == pytest.approx(-0.5 * math.exp(-0.15 / 0.3))
    assert max(map(abs, blend.step(0.2))) > 0.0
    blend.clear()
    assert blend.step(0.3) == (0.0, 0.0, 0.0, 0.0)


def test_a_large_correction_of_the_place_drifts_over_slowly() -> None:
    blend = Blend(0.3, 0.5, 5.0)
    blend.step(0.0)
    corrected(blend, {ekf.X: -2.4, ekf.Y: 3.2})
    places = np.array([blend.step(0.01 * k)[:2] for k in range(1, 3000)])
    assert math.hypot(*places[0]) == pytest.approx(4.0, abs=0.01)
    assert places[0] / 4.0 == pytest.approx([0.6, -0.8], abs=0.01)
    pace = np.hypot(*np.diff(places, axis=0).T) / 0.01
    assert pace[:100].max() < 0.51
    assert 0.49 < pace.max() <= 0.5 + 1e-9  # unheld it were 4.9 m/s
    assert np.hypot(*places[-1]) < 0.01


@pytest.mark.parametrize(
    ("change", "jumps"),
    [
        ({ekf.X: 4.0, ekf.Y: 2.9}, False),
        ({ekf.X: 4.0, ekf.Y: 3.1}, True),
        ({ekf.YAW: 0.45}, False),
        ({ekf.YAW: -0.55}, True),
    ],
)
def test_what_is_too_far_off_jumps(change: dict[int, float], jumps: bool) -> None:
    blend = Blend(0.3, 0.5, 5.0)
    blend.step(0.0)
    corrected(blend, change)
    assert (max(map(abs, blend.step(0.001))) == 0.0) == jumps


def test_corrections_add_up_and_a_pause_is_no_leap() -> None:
    blend = Blend(0.3, 5.0, 5.0)
    blend.step(0.0)
    corrected(blend, {ekf.X: 0.1})
    corrected(blend, {ekf.X: -0.04, ekf.Y: 0.02})
    assert blend.step(1e-9)[:2] == pytest.approx((-0.06, -0.02))
    # after a pause of the samples it goes on as after a fifth of a second
    there = blend.step(10.0)
    assert there[0] == pytest.approx(-0.06 * (1.0 + 0.2 / 0.3) * math.exp(-0.2 / 0.3), rel=1e-6)
