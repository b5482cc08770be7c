# SPDX-License-Identifier: Apache-2.0
"""Three real recordings through the mapping files of this project, against what is documented of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from suspension_twin.drive.checks import path_length, summarise
from suspension_twin.drive.importing import Imported, import_drive
from suspension_twin.drive.read import Topics, read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive

Same = Callable[[Drive, Drive], None]


def _import(folder: Path, repository: Path, name: str, mapping: str) -> Imported:
    if not (folder / name).exists():
        pytest.skip(f"no measured data: {name} is not in {folder.name}")
    return import_drive([folder / name], mapping=repository / "config" / "import" / f"{mapping}.yaml")


@pytest.fixture(scope="module")
def car(shared_data: Path, repository: Path) -> Drive:
    return _import(shared_data, repository, "rtklibexplorer_GNSS_IMU", "rtklibexplorer_gnss_imu").drive


@pytest.fixture(scope="module")
def raw_car(shared_data: Path, repository: Path) -> Drive:
    return _import(shared_data, repository, "rtklibexplorer_GNSS_IMU", "rtklibexplorer_gnss_imu_raw").drive


@pytest.fixture(scope="module")
def comma(shared_data: Path, repository: Path) -> Drive:
    return _import(shared_data, repository, "comma2k19_Example_1", "comma2k19").drive


def _east_north(drive: Drive) -> np.ndarray:
    fix = drive.fix
    origin = fix.latitude[0], fix.longitude[0], fix.altitude[0]
    return np.stack(pymap3d.geodetic2enu(fix.latitude, fix.longitude, fix.altitude, *origin)[:2], axis=1)


# --- a car with a roof IMU and an RTK receiver


def test_the_car_has_its_documented_figures(car: Drive) -> None:
    summary = summarise(car)
    assert summary.imu.count == 54_860
    assert summary.imu.rate == pytest.approx(100, rel=1e-3)
    assert summary.imu.duration == pytest.approx(548.6, abs=0.1)
    assert summary.imu.gaps == () and summary.fix.gaps == ()
    assert summary.fix.count == 2197 and summary.fix.rate == pytest.approx(4.0)
    assert (car.fix.status == 2).all()  # 2189 fixed, the others float
    assert summary.path == pytest.approx(4050, abs=10)
    assert path_length(car.fix) == pytest.approx(4050, abs=10)
    assert summary.top_speed == pytest.approx(16.3, abs=0.05)
    assert summary.gravity.axis == "+z"
    assert np.degrees(summary.gravity.tilt) == pytest.approx(
        6.79, abs=0.5
    )  # the documented pitch of its mount
    assert car.warnings == ()


def _yaw_lag(drive: Drive, start: float, stop: float) -> float:
    """How much later than the path's course the gyroscope turns, s, between two times of the drive."""
    t = drive.fix.t
    spline = CubicSpline(t, _east_north(drive))
    velocity = spline(t, 1)
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    moving = (np.hypot(*velocity.T) > 2) & (t - t[0] > start) & (t - t[0] < stop)
    step = np.diff(drive.imu.t, prepend=drive.imu.t[0])
    yaw = np.cumsum(drive.imu.angular_rate[:, 2] * step)
    i = np.flatnonzero(moving[:-2] & moving[2:])
    turned = course[i + 2] - course[i]
    lags = np.arange(-0.4, 0.6, 0.01)
    error = []
    for lag in lags:
        by_gyro = np.interp(t[i + 2] + lag, drive.imu.t, yaw) - np.interp(t[i] + lag, drive.imu.t, yaw)
        slope, offset = np.polyfit(by_gyro, turned, 1)
        error.append(np.std(turned - slope * by_gyro - offset))
    return float(lags[int(np.argmin(error))])


def test_the_clocks_agree_with_the_corrections_and_not_without(car: Drive, raw_car: Drive) -> None:
    """Gyroscope against the course of the RTK positions: 125 ms and 257 ppm, and after correction neither."""
    early, late = (40.0, 200.0), (360.0, 520.0)
    raw = _yaw_lag(raw_car, *early), _yaw_lag(raw_car, *late)
    assert raw[0] == pytest.approx(0.125 + 257e-6 * 120, abs=0.03)
    assert raw[1] == pytest.approx(0.125 + 257e-6 * 440, abs=0.03)
    for stretch in (early, late):
        assert abs(_yaw_lag(car, *stretch)) < 0.03


def test_a_bump_driven_over_twice_is_at_one_place(car: Drive) -> None:
    """t = 337.6 s and 362.6 s, 6.3 and 5.9 m/s, the peaks 6 cm apart along the track."""
    t = car.imu.t
    start = car.fix.t[0]
    vertical = sosfiltfilt(butter(2, [0.7, 5.0], "band", fs=100, output="sos"), car.imu.specific_force[:, 2])
    track = CubicSpline(car.fix.t, _east_north(car))
    peaks = []
    for moment in (337.6, 362.6):
        near = np.flatnonzero(np.abs(t - start - moment) < 0.8)
        peaks.append(t[near[np.argmax(vertical[near])]])
    np.testing.assert_allclose(np.array(peaks) - start, [337.6, 362.6], atol=0.1)
    speeds = [float(np.hypot(*track(peak, 1))) for peak in peaks]
    np.testing.assert_allclose(speeds, [6.3, 5.9], atol=0.1)
    direction = track(peaks[0], 1) / speeds[0]
    assert abs(float((track(peaks[1]) - track(peaks[0])) @ direction)) < 0.06


# --- a phone-like device on a windshield


def test_the_windshield_device_has_its_documented_figures(comma: Drive) -> None:
    summary = summarise(comma)
    assert summary.imu.rate == pytest.approx(104.36, abs=0.01)
    assert summary.imu.duration == pytest.approx(60, abs=0.1)
    assert summary.fix.rate == pytest.approx(10, rel=1e-3)
    assert summary.top_speed == pytest.approx(20, abs=0.5)
    # recorded forward, right, down with a mean z of -9.66: turned to forward, left, up
    assert summary.gravity.axis == "+z"
    assert comma.imu.specific_force[:, 2].mean() == pytest.approx(9.66, abs=0.01)
    assert (comma.imu.t[0], comma.fix.t[0]) == pytest.approx((1_533_226_488, 1_533_226_488), abs=2)


def test_the_receivers_speed_is_that_of_the_can_bus(comma: Drive, shared_data: Path) -> None:
    """With the fixes at their own UTC: at the time of their logging they would come 0.2 s late."""
    folder = shared_data / "comma2k19_Example_1"
    boot = np.load(folder / "global_pose" / "frame_times")
    gps = np.load(folder / "global_pose" / "frame_gps_times")
    offset = np.median(315_964_800 + gps[:, 0] * 604_800 + gps[:, 1] - 18 - boot)
    can_t = np.load(folder / "processed_log" / "CAN" / "speed" / "t") + offset
    can = np.load(folder / "processed_log" / "CAN" / "speed" / "value")[:, 0]
    t, speed = comma.velocity.t, np.hypot(*comma.velocity.enu[:, :2].T)
    inside = (t > can_t[0] + 1) & (t < can_t[-1] - 1)

    def error(lag: float) -> float:
        return float(np.std(speed[inside] - np.interp(t[inside] + lag, can_t, can)))

    lags = np.arange(-0.5, 0.5, 0.01)
    assert abs(lags[int(np.argmin([error(lag) for lag in lags]))]) <= 0.05
    difference = speed[inside] - np.interp(t[inside], can_t, can)
    assert np.sqrt(np.mean(difference**2)) < 0.25  # m/s


def test_a_segment_is_recognised_without_a_mapping(comma: Drive, shared_data: Path, same: Same) -> None:
    imported = import_drive([shared_data / "comma2k19_Example_1"])
    assert imported.origin == "comma2k19"
    same(imported.drive, comma)


# --- robots, ROS 1 bags


def test_the_robot_has_its_documented_figures(shared_data: Path, repository: Path) -> None:
    imported = _import(shared_data, repository, "robot_localization_bags", "robot_localization_test1")
    drive, summary = imported.drive, summarise(imported.drive)
    assert summary.imu.rate == pytest.approx(30, rel=0.01)
    assert summary.imu.duration == pytest.approx(395, abs=0.5)
    assert summary.fix.rate == pytest.approx(2.5, rel=0.01)
    assert (len(drive.imu), len(drive.fix)) == (11_865, 989)
    assert summary.gravity.axis == "+y"
    assert 0.5 < summary.top_speed < 3  # what a Husky drives
    assert any("derived from the positions" in note for note in imported.notes)


def test_header_stamps_not_times_of_recording(shared_data: Path) -> None:
    """The IMU of test1.bag was recorded 21 to 36 ms after its stamps."""
    path = shared_data / "robot_localization_bags" / "test1.bag"
    if not path.exists():
        pytest.skip("no measured data: test1.bag")
    from rosbags.rosbag1 import Reader

    drive = read_drive(path, topics=Topics(imu="imu/data"))
    with Reader(path) as reader:
        connections = [c for c in reader.connections if c.topic == "/imu/data"]
        recorded = np.array([stamp for _, stamp, _ in reader.messages(connections)]) * 1e-9
    late = recorded - drive.imu.t
    assert late.min() > 0.020 and np.percentile(late, 99) < 0.037


def test_the_smaller_robot(shared_data: Path) -> None:
    path = shared_data / "robot_localization_bags" / "test2.bag"
    if not path.exists():
        pytest.skip("no measured data: test2.bag")
    drive = import_drive([path], topics=Topics(imu="/imu/data")).drive
    summary = summarise(drive)
    assert summary.imu.rate == pytest.approx(50, rel=0.01)
    assert summary.imu.duration == pytest.approx(61, abs=0.5)
    assert summary.gravity.axis == "+z"
    assert not len(drive.fix) and np.isnan(summary.path)


def test_they_become_bags_that_read_back(car: Drive, comma: Drive, same: Same, tmp_path: Path) -> None:
    for drive in (car, comma):
        write_drive(drive, tmp_path / drive.name)
        same(read_drive(tmp_path / drive.name), drive)
