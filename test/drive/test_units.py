# SPDX-License-Identifier: Apache-2.0
"""The units of an IMU are recognised alike in recordings, files and live samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.importing import Imported, import_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.drive.units import rates_in_degrees, recognise_units, turning_fault, windowed
from suspension_twin.drive.write import write_drive
from suspension_twin.live.twin import DigitalTwin, ingest_stage, replay
from suspension_twin.signals.imu import ImuSettings
from suspension_twin.signals.offline import ingest_drive
from suspension_twin.vehicle.twin import Twin, load_twin

G = 9.80665


def turning(seconds: float = 40.0, yaw_rate: float = 0.2, noise: float = 0.002) -> Drive:
    """Standing for 5 s, then in a circle at 8 m/s on a smooth road, with a sensor that is upright."""
    rng = np.random.default_rng(2)
    t = np.arange(0.0, seconds, 0.01)
    drives = np.clip((t - 5.0) / 4.0, 0.0, 1.0)
    turn, speed = yaw_rate * drives, 8.0 * drives
    force = np.column_stack([np.gradient(speed, t), speed * turn, 0.0 * t + G])
    force += 0.03 * rng.standard_normal((t.size, 3))
    rate = np.column_stack([0.0 * t, 0.0 * t, turn]) + noise * rng.standard_normal((t.size, 3))
    yaw = np.cumsum(turn) * 0.01
    enu = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * t])[::10]
    drive = read_drive(Path(__file__).parents[2] / "bags" / "crg_road")
    imu = ImuData(1.7e9 + t, force, rate)
    velocity = VelocityData(1.7e9 + t[::10], enu)
    return replace(drive, name="circle", imu=imu, fix=FixData.empty(), velocity=velocity)


def spoilt(drive: Drive, force: Callable[[np.ndarray], np.ndarray], rate: float = 1.0) -> Drive:
    imu = drive.imu
    return replace(
        drive,
        imu=replace(imu, specific_force=force(imu.specific_force), angular_rate=rate * imu.angular_rate),
    )


WRONG = {
    "g": (lambda f: f / G, 1.0, "so in g"),
    "gravity removed": (lambda f: f - [0.0, 0.0, G], 1.0, "gravity seems to be removed"),
    "times ten": (lambda f: 10.0 * f, 1.0, "check the unit"),
    "degrees": (lambda f: f, float(np.degrees(1.0)), "deg/s, taken times π/180"),
}


@pytest.fixture
def as_bag(tmp_path: Path) -> Callable[[Drive], Imported]:
    def imported(drive: Drive) -> Imported:
        write_drive(drive, tmp_path / "bag")
        return import_drive([tmp_path / "bag"])

    return imported


@pytest.mark.parametrize("wrong", WRONG)
def test_a_bag_is_checked_like_a_file(as_bag: Callable[[Drive], Imported], wrong: str) -> None:
    force, rate, says = WRONG[wrong]
    sound = turning()
    found = as_bag(spoilt(sound, force, rate))
    assert any(says in line for line in (*found.notes, *found.drive.warnings))
    if wrong in ("g", "degrees"):
        np.testing.assert_allclose(found.drive.imu.specific_force, sound.imu.specific_force, atol=1e-9)
        np.testing.assert_allclose(found.drive.imu.angular_rate, sound.imu.angular_rate, atol=1e-9)


def test_a_sound_bag_has_nothing_to_convert(as_bag: Callable[[Drive], Imported]) -> None:
    found = as_bag(turning())
    assert found.drive.warnings == () and not any("taken" in note for note in found.notes)


@pytest.mark.parametrize("seed", range(4))
def test_a_rough_road_with_gravity_removed_is_not_in_g(seed: int) -> None:
    rough = np.random.default_rng(seed).normal(0.0, 0.6, (3000, 3))  # of a length of about 1
    assert recognise_units(rough) == "gravity removed"


def test_half_a_turn_of_the_phone_does_not_remove_gravity() -> None:
    force = np.tile([0.0, 0.0, G], (2000, 1))
    force[1000:] *= -1.0
    assert recognise_units(force) == "m/s2"


@pytest.mark.parametrize("yaw_rate", [0.05, -0.05])
def test_degrees_by_the_course_of_a_smooth_ride(yaw_rate: float) -> None:
    drive = turning(yaw_rate=yaw_rate, noise=1e-4)
    imu = drive.imu

    def evidence(scale: float) -> str:
        return rates_in_degrees(windowed(imu.t, imu.specific_force, scale * imu.angular_rate), drive.velocity)

    assert evidence(1.0) == ""
    assert "course" in evidence(float(np.degrees(1.0)))


def test_a_gyroscope_that_contradicts_gravity_in_either_unit_is_left_alone() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    rate = np.column_stack([np.cos(0.5 * t), np.sin(0.5 * t), 0.0 * t])
    assert rates_in_degrees(windowed(t, np.tile([0.0, 0.0, G], (t.size, 1)), rate)) == ""


@pytest.fixture(scope="module")
def bump(repository: Path) -> tuple[Drive, Twin]:
    folder = repository / "bags" / "bump_15kmh"
    return read_drive(folder), load_twin(folder / "twin.yaml")


def test_degrees_of_a_real_ride_are_converted_by_gravity_offline_and_live(bump: tuple[Drive, Twin]) -> None:
    drive, twin = bump
    degrees = spoilt(drive, lambda f: f, float(np.degrees(1.0)))
    sound, found = (ingest_drive(d, twin.imu) for d in (drive, degrees))
    (text,) = [f.text for f in found.findings if f.code == "degrees"]
    assert "gravity turns by" in text and "imu.rpy" not in text
    np.testing.assert_allclose(found.rate, sound.rate, atol=1e-9)
    live = DigitalTwin(ingest_stage(twin, ImuSettings()))
    *_, last = replay(degrees, live)
    assert [f.code for f in live.findings] == ["degrees"]
    assert last.sample is not None and np.abs(last.sample.rate).max() < 0.02


def test_degrees_that_may_not_be_converted_are_an_error(bump: tuple[Drive, Twin]) -> None:
    drive, twin = bump
    degrees = spoilt(drive, lambda f: f, float(np.degrees(1.0)))
    found = ingest_drive(degrees, twin.imu, ImuSettings(convert_units=False))
    assert [f.level for f in found.findings if f.code == "rates_unknown"] == ["error"]


SENSES = {
    "sound": (np.eye(3), np.eye(3), ""),
    "the phone upright": (np.eye(3)[[0, 2, 1]] * [1, 1, -1], np.eye(3)[[0, 2, 1]] * [1, 1, -1], ""),
    "forces negated": (-np.eye(3), np.eye(3), "one of the two is negated"),
    "rates negated": (np.eye(3), -np.eye(3), "one of the two is negated"),
    "rates times ten": (np.eye(3), 10.0 * np.eye(3), "10 times what the course turns"),
    "rates in revolutions": (np.eye(3), np.eye(3) / (2 * np.pi), "0.16 times what the course turns"),
    "axes of one exchanged": (
        np.eye(3)[[0, 2, 1]],
        np.eye(3),
        "off the accelerometer's vertical: their axes differ",
    ),
}


@pytest.mark.parametrize("case", SENSES)
@pytest.mark.parametrize("yaw_rate", [0.2, -0.2])
def test_gyroscope_accelerometer_and_course_agree_or_it_is_said(case: str, yaw_rate: float) -> None:
    force_turn, rate_turn, says = SENSES[case]
    drive = turning(yaw_rate=yaw_rate)
    imu = drive.imu
    windows = windowed(imu.t, imu.specific_force @ force_turn.T, imu.angular_rate @ rate_turn.T)
    fault = turning_fault(windows, drive.velocity)
    assert says in fault if says else fault == ""
    assert rates_in_degrees(windows, drive.velocity) == ""


def test_a_course_that_errors_turn_to_and_fro_says_nothing_of_the_gyroscope() -> None:
    """A phone's velocities on a straight road at 4 m/s: 0.1 m/s to the left and to the right, with which the noise of
    the gyroscope goes by chance."""
    t = np.arange(0.0, 40.0, 0.02)
    side = 0.1 * (-1.0) ** np.arange(41)
    velocity = VelocityData(np.arange(41.0), np.column_stack([np.full(41, 4.0), side, np.zeros(41)]))
    turns = np.diff(np.arctan2(side, 4.0))
    rate = np.column_stack([np.zeros((t.size, 2)), 0.4 * turns[np.minimum(t.astype(int), 39)]])
    force = np.tile([0.0, 0.0, 9.81], (t.size, 1))
    assert turning_fault(windowed(t, force, rate), velocity) == ""
    bend = np.cumsum(np.full(41, 0.1))
    velocity = VelocityData(np.arange(41.0), 4.0 * np.column_stack([np.cos(bend), np.sin(bend), 0.0 * bend]))
    rate[:, 2] = 0.04
    assert "check their unit" in turning_fault(windowed(t, force, rate), velocity)
