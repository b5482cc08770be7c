# SPDX-License-Identifier: Apache-2.0
"""Runs of a rig: units in the header, recordings, and what is refused with one clear line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.rig import RigRecord, read_rig, write_rig
from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import InputError, WorkError

T = np.arange(200) / 100
ROAD = 0.01 * np.sin(2 * np.pi * 2 * T)
BODY = 0.5 * np.cos(2 * np.pi * 2 * T)


def table(path: Path, header: str, *columns: np.ndarray, separator: str = ",") -> Path:
    rows = (separator.join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "separator"),
    [
        ("time_ms,road_displacement_mm,body_acceleration_g,actuator_force_kN", ","),
        ("Time [ms];Road_displacement (mm);Body_acceleration [g];Actuator_force_kn", ";"),
    ],
)
def test_units_are_in_the_header(tmp_path: Path, header: str, separator: str) -> None:
    file = table(
        tmp_path / "run.csv", header, 1e3 * T, 1e3 * ROAD, BODY / 9.80665, 0.1 + 0 * T, separator=separator
    )
    run = read_rig(file)
    assert run.name == "run" and run.t == pytest.approx(T) and run.warnings == ()
    assert run.columns["road_displacement"] == pytest.approx(ROAD, abs=1e-9)
    assert run.columns["body_acceleration"] == pytest.approx(BODY, abs=1e-8)
    assert run.columns["actuator_force"] == pytest.approx(100.0)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    columns = {"road_velocity": ROAD, "body_acceleration": BODY, "tyre_force": 1e3 * BODY}
    write_rig(RigRecord("run", 1.7e9 + T, columns), tmp_path / "new" / "run.csv", "a comment")
    run = read_rig(tmp_path / "new" / "run.csv")
    assert run.t == pytest.approx(1.7e9 + T, abs=1e-6) and set(run.columns) == set(columns)
    assert run.columns["tyre_force"] == pytest.approx(1e3 * BODY, rel=1e-5)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkError, match="file"):
        write_rig(run, tmp_path / "file" / "run.csv")


def test_a_recording_has_joints_and_accelerometers(tmp_path: Path) -> None:
    """Joint states of another rate than the accelerometers, brought to the stamps of the body's."""
    fine = 1.7e9 + np.arange(-20, 420) / 200
    phase = 2 * np.pi * 2 * (fine - 1.7e9)
    joints = np.c_[0.002 * np.cos(phase), 0.01 * np.sin(phase)]
    with BagWriter(tmp_path / "run") as bag:
        for topic, scale in (("/imu/data_raw", 1.0), ("/wheel/imu/data_raw", 2.0)):
            # before the clock was set
            bag.write(topic, "sensor_msgs/msg/Imu", np.array([3, 3]), {"linear_acceleration.z": 9.81})
            bag.write(topic, "sensor_msgs/msg/Imu", 1.7e9 + T, {"linear_acceleration.z": 9.81 + scale * BODY})
        names = {"name": ["suspension", "road"], "position": joints, "effort": np.zeros_like(joints)}
        bag.write("/joint_states", "sensor_msgs/msg/JointState", fine, names)
    run = read_rig(tmp_path / "run")
    assert run.t == pytest.approx(1.7e9 + T, abs=1e-6)
    assert len(run.warnings) == 2 and "1 stamps lie far from the others" in run.warnings[0]
    assert run.columns["road_displacement"] == pytest.approx(ROAD, abs=1e-6)
    assert run.columns["suspension_deflection"] == pytest.approx(0.004 * BODY, abs=1e-6)
    assert run.columns["wheel_acceleration"] == pytest.approx(9.81 + 2 * BODY, abs=1e-9)
    assert not run.columns["actuator_force"].any() and "road_velocity" not in run.columns


def test_a_recording_without_a_body_accelerometer_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.write("/fix", "sensor_msgs/msg/NavSatFix", 1.7e9 + T, {})
    with pytest.raises(InputError, match=r"run: /imu/data_raw: is missing, there are /fix"):
        read_rig(tmp_path / "run")


@pytest.mark.parametrize(
    ("header", "change", "message"),
    [
        (
            "time_s,road_displacement_m,body_acceleration",
            {},
            r"body_acceleration: needs a unit: body_acceleration_m_s2",
        ),
        (
            "time_s,road_displacement_m,body_acc_m_s2",
            {},
            "body_acceleration: is missing, there are time, road_disp",
        ),
        (
            "time_s,road_m,body_acceleration_m_s2",
            {},
            "road_displacement: is missing, and so is road_velocity",
        ),
        ("time_s,road_displacement_m,road_displacement_mm", {}, "road_displacement: has two columns"),
        ("time_s,road_displacement_m,body_acceleration_m_s2", {0: T[::-1]}, "time: does not rise in row 2"),
        (
            "time_s,road_displacement_m,body_acceleration_m_s2",
            {2: BODY * np.nan},
            "body_acceleration: is no number in",
        ),
        (
            "time_s,road_displacement_m,body_acceleration_m_s2",
            {1: 1e3 * ROAD},
            "ranges over 20 m: is its unit another",
        ),
    ],
)
def test_bad_tables(tmp_path: Path, header: str, change: dict[int, np.ndarray], message: str) -> None:
    columns = [change.get(i, values) for i, values in enumerate((T, ROAD, BODY))]
    with pytest.raises(InputError, match=message):
        read_rig(table(tmp_path / "run.csv", header, *columns))


def test_bad_files(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "zeros.csv").write_bytes(bytes(5000))
    for name, message in (
        ("none.csv", "No such file"),
        ("empty.csv", "empty"),
        ("zeros.csv", "not a text file"),
    ):
        with pytest.raises(InputError, match=f"{name}: {message}"):
            read_rig(tmp_path / name)
    with pytest.raises(InputError, match="no recording"):
        read_rig(tmp_path)


def test_columns_that_mean_nothing_are_named(tmp_path: Path) -> None:
    header = "time_s,road_displacement_m,body_acceleration_m_s2,oil_temperature"
    run = read_rig(table(tmp_path / "run.csv", header, T, ROAD, BODY, 0 * T))
    assert run.warnings == ("columns not used: oil_temperature",)
