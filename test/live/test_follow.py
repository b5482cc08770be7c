# SPDX-License-Identifier: Apache-2.0
"""Samples find their poses in whatever order the two come."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from suspension_twin.live.follow import Pairing
from suspension_twin.pose.lock import PlanarMotion, PlanarState

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
