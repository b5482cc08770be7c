# SPDX-License-Identifier: Apache-2.0
"""The follower's inputs: samples paired with poses in any order, and the planar acceleration that excites the model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from suspension_twin.live.follow import BodyAcceleration, Pairing, PlanarAcceleration
from suspension_twin.pose.lock import PlanarMotion, PlanarState
from suspension_twin.signals.filters import FilterSpec

MS = 1_000_000


def at(ns: int, **changes: object) -> tuple[int, PlanarState]:
    """Driving at 10 m/s and turning at 0.1 rad/s; everything follows from the stamp."""
    t = ns / 1e9
    motion = PlanarMotion(10.0, 0.1 * t, 0.1)
    yaw = math.remainder(0.1 * t, 2 * math.pi)
    return ns, PlanarState(t, 10.0 * t, -2.0 * t, yaw, motion, True, True, (0.0,) * 6)._replace(**changes)


@given(
    st.lists(st.integers(1, 3), min_size=1, max_size=40),
    st.sets(st.integers(0, 39), max_size=8),
    st.integers(0, 5),
    st.randoms(use_true_random=False),
)
def test_every_sample_between_two_poses_gets_its_pose_once_and_in_order(steps, missing, lead, random):
    stamps = [10 * MS * sum(steps[: k + 1]) for k in range(len(steps))]
    poses = [s for k, s in enumerate(stamps) if k not in missing]
    samples = list(stamps)
    pairing, got = Pairing(), []
    while poses or samples:
        # one topic may run ahead of the other by a few messages
        ahead = bool(poses) and (
            not samples or random.random() < 0.5 or poses[0] < samples[0] - lead * 10 * MS
        )
        got += pairing.pose(*at(poses.pop(0))) if ahead else pairing.sample(samples[0], float(samples.pop(0)))
    known = [s for k, s in enumerate(stamps) if k not in missing]
    if not known:
        assert got == []
        return
    expected = [s for s in stamps if known[0] <= s <= known[-1]]
    assert [ns for ns, _, _ in got] == expected
    assert [measured for _, _, measured in got] == [float(s) for s in expected]
    for ns, found, _ in got:
        _, wanted = at(ns)
        assert found.t == wanted.t and found.x == pytest.approx(wanted.x)
        assert found.motion.lateral_speed == pytest.approx(wanted.motion.lateral_speed)


def test_yaw_is_taken_the_short_way_round():
    pairing = Pairing()
    pairing.pose(*at(0, yaw=3.1))
    pairing.sample(5 * MS, 1.0)
    ((_, found, _),) = pairing.pose(*at(10 * MS, yaw=-3.1))
    assert abs(math.remainder(found.yaw - math.pi, 2 * math.pi)) < 1e-12


def test_a_guess_of_the_heading_stays_a_guess():
    pairing = Pairing()
    pairing.pose(*at(0, aligned=False))
    pairing.sample(5 * MS, 1.0)
    ((_, found, _),) = pairing.pose(*at(10 * MS))
    assert not found.aligned


def test_samples_without_a_pose_are_counted_and_not_kept_for_ever():
    pairing = Pairing()
    for k in range(1000):
        assert pairing.sample(10 * MS * (k + 1), 0.0) == []
    assert pairing.lost == 1000 - 201
    assert pairing.pose(*at(10_005 * MS)) == []
    assert pairing.lost == 1000


def test_late_and_repeated_ones_are_passed_over():
    pairing = Pairing()
    assert len(pairing.pose(*at(10 * MS)) + pairing.sample(10 * MS, 1.0)) == 1
    assert pairing.sample(10 * MS, 2.0) == [] and pairing.sample(9 * MS, 2.0) == []
    assert pairing.pose(*at(10 * MS)) == [] and pairing.pose(*at(5 * MS)) == []
    assert len(pairing.sample(20 * MS, 1.0) + pairing.pose(*at(20 * MS))) == 1


DRIVING = PlanarMotion(speed=10.0)


def accelerations(sensed, path, motion=DRIVING, lever=(0.0, 0.0, 0.0), rate=100.0) -> np.ndarray:
    """(n, 2) of the complementary filter over samples of the IMU and of the path."""
    planar = PlanarAcceleration(lever)
    return np.array(
        [planar.step(k / rate, s, motion, p) for k, (s, p) in enumerate(zip(sensed, path, strict=True))]
    )


def test_slow_accelerations_are_the_paths_and_quick_ones_the_imus():
    t = np.arange(0.0, 40.0, 0.01)
    slow, quick = np.sin(2 * np.pi * 0.03 * t), 0.5 * np.sin(2 * np.pi * 1.0 * t)
    # the IMU has a bias, the path misses what is quick
    sensed = [BodyAcceleration((a + 0.3, -a, 0.0)) for a in slow + quick]
    found = accelerations(sensed, zip(slow, -slow, strict=True))
    late = t > 5.0
    delayed = slow + np.interp(t - FilterSpec(2, 2.5).delay(100.0), t, quick)  # of the bandwidth
    assert np.std(found[late, 0] - delayed[late]) < 0.13
    assert np.abs(found[:, 0] + found[:, 1])[late].max() < 0.02  # the bias is gone
    assert np.std((found[:, 0] - slow)[late]) == pytest.approx(np.std(quick[late]), rel=0.1)


def test_the_lever_of_the_sensor_is_taken_off():
    t = np.arange(0.0, 20.0, 0.01)
    pitch_acceleration = np.gradient(0.2 * np.sin(2 * np.pi * 1.5 * t), t)
    between = 0.5 * (pitch_acceleration + np.concatenate([[0.0], pitch_acceleration[:-1]]))
    sensed = [
        BodyAcceleration((0.7 * a, 0.0, 0.0), (0.0, b, 0.0))
        for a, b in zip(pitch_acceleration, between, strict=True)
    ]
    found = accelerations(sensed, [(0.0, 0.0)] * t.size, lever=(0.4, 0.0, 0.7))
    assert np.std(found[:, 0]) < 1e-9


def test_a_vehicle_that_stands_is_not_shaken_by_noise_and_drives_off_without_a_step():
    noise = np.random.default_rng(0).normal(0.0, 0.1, 200)
    sensed = [BodyAcceleration((a, a, 0.0)) for a in noise]
    assert not accelerations(sensed, [(0.0, 0.0)] * 200, PlanarMotion()).any()
    planar = PlanarAcceleration((0.0, 0.0, 0.0))
    bias = BodyAcceleration((0.4, 0.0, 0.0))
    planar.step(0.0, bias, PlanarMotion(), (0.0, 0.0))
    assert planar.step(0.01, bias, DRIVING, (0.1, 0.0)) == pytest.approx((0.1, 0.0))


def test_after_a_pause_it_begins_with_the_paths():
    planar = PlanarAcceleration((0.0, 0.0, 0.0))
    for k in range(50):
        planar.step(0.01 * k, BodyAcceleration((1.0, 1.0, 0.0)), DRIVING, (0.0, 0.0))
    assert planar.step(3.0, BodyAcceleration((5.0, 5.0, 0.0)), DRIVING, (0.2, 0.3)) == (0.2, 0.3)
