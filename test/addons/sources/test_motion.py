# SPDX-License-Identifier: Apache-2.0
"""The lag between IMU and receiver, from motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.motion import MotionLag
from suspension_twin.addons.sources.common.report import device_values
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, cut


@pytest.fixture(scope="module")
def curvy(repository: Path) -> Drive:
    return read_drive(repository / "bags" / "crg_road")


def lag_of(drive: Drive, late: float, every: int = 1, turn: float = 0.7):
    """What is estimated where the IMU's stamps are so much late, its axes turned, and its velocities thinned out."""
    lag, (c, s) = MotionLag(), (np.cos(turn), np.sin(turn))
    force = drive.imu.specific_force @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    lag.imu(replace(drive.imu, t=drive.imu.t + late, specific_force=force))
    lag.velocity(drive.velocity.select(slice(None, None, every)))
    return lag.estimate()


@pytest.mark.parametrize("late", [-0.4, -0.07, 0.0, 0.1, 0.8])
def test_the_lag_is_found_whatever_the_mounting(curvy: Drive, late: float) -> None:
    zero, found = lag_of(curvy, 0.0), lag_of(curvy, late)
    assert found.sigma < 0.03 and found.correlation > 0.9
    assert found.lag - zero.lag == pytest.approx(late, abs=0.01)
    assert abs(zero.lag) < 0.03 + 3.0 * zero.sigma


def test_two_velocities_a_second_do(curvy: Drive) -> None:
    found = lag_of(curvy, 0.2, every=5)
    assert found.lag == pytest.approx(0.2, abs=0.08)


def test_standing_tells_nothing(curvy: Drive) -> None:
    still = replace(curvy, velocity=replace(curvy.velocity, enu=0.0 * curvy.velocity.enu))
    assert lag_of(still, 0.0) is None


def test_straight_at_one_speed_tells_nothing(curvy: Drive) -> None:
    steady = replace(curvy, velocity=replace(curvy.velocity, enu=0.0 * curvy.velocity.enu + [5.0, 1.0, 0.0]))
    assert lag_of(steady, 0.0) is None


def test_noise_tells_nothing(curvy: Drive) -> None:
    rng = np.random.default_rng(1)
    other = replace(
        curvy,
        imu=replace(curvy.imu, specific_force=rng.normal(0, 1, (len(curvy.imu), 3)) + np.array([0, 0, 9.8])),
    )
    assert lag_of(other, 0.0) is None


def play(curvy: Drive, late: float, phone_alone: bool) -> tuple[Hub, list[tuple[float, float]]]:
    """Live, on the paper: a phone's IMU and a receiver; the stamps handed on beside the true ones."""
    hub = Hub()
    phone = hub.device("phone")
    receiver = phone if phone_alone else hub.device("receiver", rank=100)
    assert phone is not None and receiver is not None
    given, start = [], float(curvy.imu.t[0])
    for second in np.arange(start, float(curvy.imu.t[-1]), 0.2):
        part = cut(curvy, second, second + 0.2)
        arrival = second + 0.22
        if len(part.fix):
            receiver.fix(part.fix, arrival + 0.05)
            receiver.velocity(part.velocity, arrival + 0.05)
        if len(part.imu):
            phone.imu(part.imu.t + late, part.imu.specific_force, part.imu.angular_rate, arrival)
        for packet in hub.take():
            if packet.stream == "imu":
                given.append((second - start, float(packet.samples.t[0] - part.imu.t[0])))
    return hub, given


def test_a_receiver_s_time_is_reached_by_arrival_and_by_motion(curvy: Drive) -> None:
    """By their arrivals the clocks are told apart to the 50 ms that the receiver's bytes are longer on their way."""
    hub, given = play(curvy, 0.8, phone_alone=False)
    first = [error for at, error in given if at < 1.0]
    last = [error for at, error in given if at > given[-1][0] - 2.0]
    assert np.mean(first) == pytest.approx(0.8, abs=0.01)
    assert abs(np.mean(last)) < 0.035
    assert hub.motion is not None and "by its motion" in " ".join(
        device_values(hub.devices["phone"], hub.now())
    )


def test_a_phone_s_own_stamps_are_left_as_they_are(curvy: Drive) -> None:
    hub, given = play(curvy, 0.2, phone_alone=True)
    assert {round(error, 6) for _, error in given} == {0.2}
    assert hub.motion is not None and hub.motion.lag == pytest.approx(0.2, abs=0.05)
