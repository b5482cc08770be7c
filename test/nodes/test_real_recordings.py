# SPDX-License-Identifier: Apache-2.0
"""Three real recordings through all four nodes, against what is documented of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.types import Drive, cut
from suspension_twin.testing import running_twin
from suspension_twin.vehicle.twin import Twin


@dataclass
class Replayed:
    """Outputs of the nodes: ``odom`` (n, 5) stamp s, x, y m, yaw rad, speed m/s where the yaw is known; accelerations
    (m, 2) stamp s, m/s²; the complaints of all nodes; the measured sample rate in Hz."""

    drive: Drive
    odom: np.ndarray
    twin: np.ndarray
    measured: np.ndarray
    complaints: str
    rate: float


def replay(drive: Drive, twin: Twin) -> Replayed:
    """The drive through the four nodes at full speed, its first fix as datum."""
    fix = drive.fix
    datum = {"latitude": fix.latitude[0], "longitude": fix.longitude[0], "altitude": fix.altitude[0]}
    changed = {"datum": {k: float(v) for k, v in datum.items()}}
    topics = ("twin/odom", "twin/vertical_acceleration", "imu/vertical_acceleration", "/diagnostics")
    with running_twin(twin.with_changes(changed)) as nodes:
        odom, simulated, measured, diagnostics = nodes.replay(drive, topics).values()
    z, w = (odom[f"pose.pose.orientation.{axis}"] for axis in "zw")
    places = [odom[f"pose.pose.position.{axis}"] for axis in "xy"]
    path = np.column_stack([odom.t, *places, 2 * np.arctan2(z, w), odom["twist.twist.linear.x"]])
    tables = (np.column_stack([r.t, r["accel.linear.z"]]) for r in (simulated, measured))
    statuses = [status for message in diagnostics.messages for status in message.status]
    values = {pair.key: pair.value for status in statuses for pair in status.values}
    complaints = " | ".join(sorted({status.message for status in statuses}))
    known = odom["pose.covariance"][:, 35] < 1.0
    return Replayed(drive, path[known], *tables, complaints, float(values["sample rate (Hz)"]))


def imported(shared_data: Path, repository: Path, name: str, mapping: str) -> Drive:
    if not (shared_data / name).exists():
        pytest.skip(f"no measured data: {name} is not in {shared_data.name}")
    return import_drive(
        [shared_data / name], mapping=repository / "config" / "import" / f"{mapping}.yaml"
    ).drive


@pytest.mark.long
def test_a_car_with_an_rtk_receiver(shared_data, repository, twin):
    """100 Hz, 16.3 m/s at most; a bump met twice, at the same place within centimetres: the stretch around both."""
    whole = imported(shared_data, repository, "rtklibexplorer_GNSS_IMU", "rtklibexplorer_gnss_imu")
    begin = float(whole.fix.t[0])
    drive = cut(whole, begin + 235.0, begin + 385.0)
    # The IMU faces backwards and leans; the antenna is taken for above the rear axle.
    mounted = twin.with_changes(
        {
            "imu.position": (0.0, 0.0, 1.5),
            "imu.rpy": (0.0111, -0.1180, 3.0476),
            "gps.position": (0.0, 0.0, 2.15),
        }
    )
    out = replay(drive, mounted)
    assert out.rate == pytest.approx(100.0, rel=2e-3)
    assert len(out.twin) == len(out.measured) == len(drive.imu) - 16
    assert np.isfinite(out.twin).all()
    assert np.std(out.twin[:, 1]) < 0.5 * np.std(out.measured[:, 1])  # its road is level, the real one is not
    steps = np.hypot(np.diff(out.odom[:, 1]), np.diff(out.odom[:, 2]))
    fix, degree = drive.fix, math.radians(6_371_000.0)
    north, east = (
        np.diff(angle) * degree * scale
        for angle, scale in ((fix.latitude, 1.0), (fix.longitude, math.cos(math.radians(fix.latitude[0]))))
    )
    assert steps.sum() == pytest.approx(np.hypot(north, east).sum(), rel=1e-2) and steps.max() < 0.25
    assert out.odom[:, 4].max() == pytest.approx(16.3, abs=0.2)
    # gravity is out, on whatever axis it was; what is left is a bias, which only a standstill shows
    assert abs(out.measured[:, 1].mean()) < 0.2
    peaks = []
    for since in (337.6, 362.6):
        near = np.abs(out.measured[:, 0] - begin - since) < 0.6
        at = out.measured[near][np.argmax(np.abs(out.measured[near, 1])), 0]
        peaks.append([np.interp(at, out.odom[:, 0], out.odom[:, c]) for c in (1, 2, 3)])
    (x0, y0, yaw), (x1, y1, _) = peaks
    assert abs((x1 - x0) * math.cos(yaw) + (y1 - y0) * math.sin(yaw)) < 0.2
    assert "upside" not in out.complaints and "gravity lies" not in out.complaints


@pytest.mark.long
def test_a_phone_on_a_windshield_against_the_can_bus(shared_data, repository, twin):
    drive = imported(shared_data, repository, "comma2k19_Example_1", "comma2k19")
    out = replay(drive, twin)
    assert out.rate == pytest.approx(104.36, rel=5e-3)
    assert len(out.twin) == len(drive.imu) - 16
    folder = shared_data / "comma2k19_Example_1"
    boot = np.load(folder / "global_pose" / "frame_times")
    gps = np.load(folder / "global_pose" / "frame_gps_times")
    offset = np.median(315_964_800 + gps[:, 0] * 604_800 + gps[:, 1] - 18 - boot)
    can_t = np.load(folder / "processed_log" / "CAN" / "speed" / "t") + offset
    can = np.load(folder / "processed_log" / "CAN" / "speed" / "value")[:, 0]
    settled = (out.odom[:, 0] > drive.imu.t[0] + 5.0) & (out.odom[:, 0] < can_t[-1])
    difference = out.odom[settled, 4] - np.interp(out.odom[settled, 0], can_t, can)
    assert np.sqrt(np.mean(difference**2)) < 0.25
    assert np.isfinite(out.twin).all()


@pytest.mark.long
def test_a_robot_whose_imu_stands_on_its_side(shared_data, repository, twin):
    """30 Hz are too few for a wheel and gravity is on y: both are said, and the nodes go through with it."""
    drive = imported(shared_data, repository, "robot_localization_bags", "robot_localization_test1")
    out = replay(drive, twin)
    assert out.rate == pytest.approx(30.0, rel=0.01)
    assert len(out.twin) == len(out.measured) == len(drive.imu) - 16
    assert np.isfinite(out.twin).all() and np.isfinite(out.odom).all()
    assert "too slow" in out.complaints and "gravity lies" in out.complaints
    assert abs(out.measured[:, 1].mean()) < 0.1
    assert np.abs(out.odom[:, 4]).max() < 4.0
