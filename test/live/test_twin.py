# SPDX-License-Identifier: Apache-2.0
"""The whole live twin without ROS, against the twin over the same drive offline."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.inference.simulated import SimulatedDrive, simulate_drive
from suspension_twin.live.follow import FollowSettings
from suspension_twin.live.gap import RunningGap
from suspension_twin.live.twin import DigitalTwin, Update, digital_twin, lock_stage, replay
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.types import PoseSettings, Trajectory
from suspension_twin.signals.filters import CausalLowPass, FilterSpec
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.vehicle.twin import Twin, load_twin

BAGS = Path(__file__).resolve().parents[2] / "bags"


class Case(NamedTuple):
    """A bundled drive, live and offline: the live answers from two seconds after it has driven off, and the samples of
    the offline drive that they belong to."""

    twin: Twin
    updates: list[Update]
    later: np.ndarray
    offline: SimulatedDrive
    kept: np.ndarray
    gap: RunningGap

    def live(self, take) -> np.ndarray:
        """A value of every live answer."""
        return np.array([take(u) for u in self.updates])

    def off(self, live: np.ndarray, offline: np.ndarray) -> tuple[float, float]:
        """Mean and standard deviation of a difference while driving, as shares of the rms of the live signal."""
        difference, rms = (live - offline)[self.later], np.sqrt(np.mean(live[self.later] ** 2))
        return float(abs(difference.mean()) / rms), float(difference.std() / rms)

    def filtered(self, signal: np.ndarray) -> np.ndarray:
        """Through the live low-pass at the rate of the drive: its delay is the same on both sides."""
        return CausalLowPass(FilterSpec(), self.offline.observation.signals.rate_hz, 1).process(signal)

    def trajectory(self, live: tuple[str, ...]) -> Trajectory:
        """The smoothed path of the drive with these columns of the live one."""
        smooth = self.offline.observation.trajectory
        known = {
            "x": self.live(lambda u: u.pose.x),
            "y": self.live(lambda u: u.pose.y),
            "yaw": self.live(lambda u: u.pose.yaw),
            "velocity": self.live(lambda u: u.pose.motion[:2]),
            "yaw_rate": self.live(lambda u: u.pose.motion.yaw_rate),
            "acceleration": self.live(lambda u: u.followed.acceleration),
        }
        columns = {k: known[k] if k in live else getattr(smooth, k)[self.kept] for k in EVERY}
        t = self.live(lambda u: u.sample.t)
        return Trajectory(t=t, **columns, valid=np.ones(t.size, dtype=bool))

    def simulated(self, path: Trajectory) -> np.ndarray:
        """The twin's vertical acceleration offline along a path, low-passed."""
        ground = self.offline.observation.road_excitation.path.ground
        response = simulate_twin(self.twin, excitation(path, self.twin.vehicle, ground))
        return self.filtered(response.vertical_acceleration)


@pytest.fixture(scope="module", params=["crg_road", "bump_15kmh"])
def case(request) -> Case:
    bag = BAGS / request.param
    drive, twin = read_drive(bag), load_twin(bag / "twin.yaml")
    live = digital_twin(twin)
    updates = [u for u in replay(drive, live) if u.followed is not None]
    offline = simulate_drive(drive, twin)
    t = np.array([u.sample.t for u in updates])
    kept = np.searchsorted(offline.observation.signals.t, t - 1e-6)
    assert np.abs(offline.observation.signals.t[kept] - t).max() < 1e-6
    moving = np.array([abs(u.pose.motion.speed) > 0.5 for u in updates])
    later = t > t[np.flatnonzero(moving)[0]] + 2.0
    return Case(twin, updates, later, offline, kept, live.follower.gap)


def test_the_live_gap_is_the_offline_one_once_settled(case):
    """Without the first seconds, for which live there was no heading; errors of the live pose of some millimetres are
    most of what is left, and the noise of its accelerations."""
    offline = case.offline.gap_from(case.gap.driving_since).rms
    assert case.gap.driving_rms == pytest.approx(offline, rel=0.02)


EVERY = ("x", "y", "yaw", "velocity", "yaw_rate", "acceleration")


def test_along_the_same_path_live_and_offline_are_one_excitation(case):
    live = case.live(lambda u: u.followed.vertical_acceleration)
    mean, spread = case.off(live, case.simulated(case.trajectory(EVERY)))
    assert np.hypot(mean, spread) < 0.01


def test_the_measured_signal_is_the_same_but_for_what_the_future_shows(case):
    """Offline the bias comes from all standstills, the vertical from both sides and from the receiver's speeds."""
    live = case.live(lambda u: u.sample.vertical_acceleration)
    offline = case.filtered(case.offline.observation.signals.vertical_acceleration)[case.kept]
    mean, spread = case.off(live, offline)
    assert mean < 0.012 and spread < 0.01
    assert np.hypot(mean, spread) < {"crg_road": 0.01, "bump_15kmh": 0.015}[case.offline.name]


def test_beyond_that_live_lacks_the_smoother_and_the_denoising(case):
    """With the path and the motion smoothed over the whole drive: the shares of the pose and of the accelerations."""
    live = case.live(lambda u: u.followed.vertical_acceleration)
    smooth = case.offline.response.vertical_acceleration
    smooth = case.filtered(smooth - case.offline.observation.standing_vertical(case.offline.response))[
        case.kept
    ]
    share = {"crg_road": (0.08, 0.05, 0.07), "bump_15kmh": (0.09, 0.07, 0.07)}[case.offline.name]
    whole = case.off(live, smooth)
    of_the_pose = case.off(case.simulated(case.trajectory(("x", "y", "yaw"))), smooth)
    of_the_motion = case.off(case.simulated(case.trajectory(EVERY[3:])), smooth)
    for found, most in zip((whole, of_the_pose, of_the_motion), share, strict=True):
        assert 0.01 < np.hypot(*found) < most
    assert np.hypot(np.hypot(*of_the_pose), np.hypot(*of_the_motion)) == pytest.approx(
        np.hypot(*whole), rel=0.2
    )


def test_accelerations_are_those_of_the_offline_drive_but_for_noise(case):
    live, smooth = case.trajectory(EVERY), case.trajectory(())
    for error in (live.acceleration - smooth.acceleration)[case.later].T:
        assert np.std(error) < 0.3 and abs(error.mean()) < 0.02


@pytest.fixture(scope="module")
def drive() -> Drive:
    return read_drive(BAGS / "crg_road")


@pytest.fixture(scope="module")
def vehicle() -> Twin:
    return load_twin(BAGS / "crg_road" / "twin.yaml")


def test_a_second_round_gives_the_same_answers(drive, vehicle):
    twin = digital_twin(vehicle)
    rounds = [[u.followed.vertical_acceleration for u in replay(drive, twin) if u.followed] for _ in range(2)]
    assert len(rounds[0]) == len(drive.imu) - 16
    assert rounds[0] == rounds[1]


def test_each_stage_works_without_the_others(drive, vehicle):
    whole = digital_twin(vehicle)
    alone = DigitalTwin(ingest=whole.ingest)
    answers = list(replay(changed(drive, imu=drive.imu.select(np.arange(200))), alone))
    assert len(answers) == 184 and all(u.pose is None and u.followed is None for u in answers)
    assert DigitalTwin().push_imu(0.0, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)) is None
    whole.reset()
    assert whole.findings and whole.follower.gap.now() is None


def test_samples_before_the_first_fix_are_counted(vehicle):
    twin = digital_twin(vehicle)
    for k in range(50):
        update = twin.push_imu(1.0 + 0.01 * k, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
    assert update.pose is None and update.followed is None and twin.follower.lost == 34


def test_records_hold_what_the_nodes_publish(drive, vehicle):
    twin = digital_twin(vehicle)
    (*_, last) = replay(changed(drive, imu=drive.imu.select(np.arange(600))), twin)
    at = last.followed
    sensed = twin.follower.virtual_imu(at)
    assert np.linalg.norm(sensed.force) == pytest.approx(np.linalg.norm(at.state.force))
    for turn in (sensed.orientation, at.orientation):
        assert np.linalg.norm(turn) == pytest.approx(1.0)
    assert len(at.state.deflection) == len(vehicle.joint_names)


def test_another_low_pass_is_that_of_both_sides(drive, vehicle):
    slow = digital_twin(vehicle, ImuSettings(filter=FilterSpec(2, 3.0)))
    assert slow.follower.settings == FollowSettings(filter=FilterSpec(2, 3.0))
    rows = [u for u in replay(drive, slow) if u.followed]
    low, plain = (
        np.std([u.followed.vertical_acceleration for u in answers])
        for answers in (rows, [u for u in replay(drive, digital_twin(vehicle)) if u.followed])
    )
    assert low < 0.7 * plain


@pytest.mark.parametrize(("computed", "sent"), [(1, 10), (5, 50), (10, 10)])
def test_a_position_that_a_receiver_holds_is_taken_once(computed: int, sent: int) -> None:
    """The lock is told of each computed position at its first stamp."""
    twin = DigitalTwin(lock=lock_stage(None, PoseSettings(), None))
    told: list[float] = []
    twin.lock.on_fix = lambda t, *place: told.append(t)  # type: ignore[method-assign, union-attr]
    t = 1.7e9 + np.arange(20 * sent) / sent
    own = np.arange(20 * sent) * computed // sent
    for at, k in zip(t.tolist(), own.tolist(), strict=True):
        twin.push_fix(at, 47.0 + 1e-5 * k, 19.0, 100.0)
    later = np.array(told)[np.array(told) > 1.7e9 + 3.5 / computed]  # it has to see the receiver's pace first
    np.testing.assert_allclose(np.diff(later), 1 / computed, atol=1e-6)
    assert later[-1] == t[-sent // computed] and later.size >= 20 * computed - 4
