# SPDX-License-Identifier: Apache-2.0
"""Clocks of receivers that are apart from the IMU's by what GPS time is apart from UTC."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from suspension_twin.drive.checks import clean_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.drive.write import write_drive

Same = Callable[[Drive, Drive], None]
START = 1_700_000_000.0
WEEKS = 1024 * 604_800.0
METRE = 1.0 / 111_195.0  # degrees


def driven(
    seconds: float = 60.0, rate: float = 5.0, *, seed: int = 0, velocities: bool = True, even: bool = False
) -> Drive:
    """A car that drives off, brakes and turns, or goes on evenly, with an IMU that is turned anyhow."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)
    knots = np.arange(0.0, seconds + 5.0, 5.0)
    speed = np.full(t.size, 10.0) if even else 8 + np.interp(t, knots, rng.uniform(-5, 5, knots.size))
    turn = np.zeros(t.size) if even else np.interp(t, knots, rng.uniform(-0.25, 0.25, knots.size))
    course = np.cumsum(turn) * 0.01
    v = speed * np.exp(1j * course)
    place = np.cumsum(v) * 0.01
    force = np.stack([np.gradient(speed, t), speed * turn, np.full(t.size, 9.81)], axis=1)
    axes = Rotation.from_euler("zyx", [rng.uniform(-3, 3), 0.3, -0.2]).as_matrix()
    noise = rng.normal(size=(t.size, 6)) * [0.2] * 6
    imu = ImuData(START + t, force @ axes + noise[:, :3], np.stack([0 * t, 0 * t, turn], axis=1) @ axes)
    cut = slice(None, None, round(100 / rate))
    n = t[cut].size
    latitude = 47 + METRE * place.imag[cut]
    longitude = 11 + METRE * place.real[cut] / np.cos(np.radians(47))
    own = START + t[cut]
    fix = FixData(
        own, latitude, longitude, np.full(n, 500.0), np.zeros(n, dtype=np.int8), np.full((n, 3), 1.0)
    )
    enu = np.stack([v.real[cut], v.imag[cut], np.zeros(n)], axis=1)
    velocity = VelocityData(own, enu) if velocities else VelocityData.empty()
    return Drive("made", imu, fix, velocity, HeadingData(own, np.angle(v[cut])))


def later(drive: Drive, seconds: float) -> Drive:
    fix, velocity, heading = drive.fix, drive.velocity, drive.heading
    assert heading is not None
    return Drive(
        drive.name,
        drive.imu,
        FixData(fix.t + seconds, fix.latitude, fix.longitude, fix.altitude, fix.status, fix.sigma),
        VelocityData(velocity.t + seconds, velocity.enu),
        HeadingData(heading.t + seconds, heading.yaw),
    )


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("rate", [1.0, 10.0])
@pytest.mark.parametrize("off", [18.0, -18.0, 18.3, -WEEKS, -2 * WEEKS, 18.0 - WEEKS])
def test_gps_time_is_found_by_the_motion(off: float, rate: float, velocities: bool) -> None:
    for seed in range(3):
        drive = driven(rate=rate, seed=seed, velocities=velocities)
        found = clean_drive(later(drive, off))
        left = round(off - round(off), 6)  # the receiver's own delay stays
        assert found.heading is not None
        for samples in (found.fix, found.velocity, found.heading):
            np.testing.assert_allclose(samples.t, START + left + np.arange(len(samples)) / rate, atol=1e-5)
        text = " | ".join(found.warnings)
        assert ("GPS time" in text) == (abs(off) % WEEKS != 0.0) and ("1024 weeks" in text) == (
            abs(off) > 1e6
        )


@pytest.mark.parametrize("seconds", [30.0, 300.0])
@pytest.mark.parametrize("off", [0.0, 0.4, -1.0])
def test_clocks_that_agree_are_left_alone(off: float, seconds: float, same: Same) -> None:
    for seed in range(3):
        drive = later(driven(seconds, 2.0, seed=seed), off)
        same(clean_drive(drive), drive)
        assert clean_drive(drive).warnings == ()


@pytest.mark.parametrize("off", [0.0, 7.0])
def test_an_imu_that_feels_something_else_says_nothing(off: float, same: Same) -> None:
    """One in its owner's hand: no correction is made up."""
    for seed in range(5):
        drive, other = later(driven(120.0, 5.0, seed=seed), off), driven(120.0, 5.0, seed=seed + 10)
        drive = Drive("d", other.imu, drive.fix, drive.velocity, drive.heading)
        same(clean_drive(drive), drive)


def test_an_even_drive_is_asked_about(same: Same) -> None:
    """Where the motion says nothing, that the receiver begins and ends 18 s after the IMU does."""
    drive = later(driven(even=True), 18.0)
    found = clean_drive(drive)
    same(found, drive)
    assert found.warnings == (
        "the receiver begins and ends 18 s after the IMU: are its stamps GPS time? The motion does not say: they are "
        "left as they are",
    )


def test_of_a_bag(tmp_path: Path) -> None:
    write_drive(later(driven(), 18.0), tmp_path / "bag")
    read = read_drive(tmp_path / "bag")
    assert read.fix.t[0] == pytest.approx(START) and any("moved by -18 s" in line for line in read.warnings)
