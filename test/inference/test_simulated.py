# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin simulate``: what it writes, read back and compared by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

import suspension_twin as st
from suspension_twin.cli.main import main
from suspension_twin.drive.types import Drive, ImuData
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.road import Road, flat_road, write_road
from suspension_twin.vehicle.twin import Imu, RoadFile, Twin, save_twin

KNOTS = [(0.0, 0.0), (3.0, 0.0), (6.0, 5.0), (10.0, 5.0), (12.0, 0.0), (14.0, 0.0)]
RPY = (0.02, -0.03, 1.2)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory, twin: Twin, bumps: Road) -> Path:
    """A twin whose IMU is mounted askew, and a drive with a stutter: repeated and swapped stamps."""
    folder = tmp_path_factory.mktemp("simulate")
    write_road(bumps, folder / "road.crg")
    askew = twin.model_copy(
        update={
            "imu": Imu(position=(1.9, 0.1, 1.2), rpy=RPY),
            "road": RoadFile(file=folder / "road.crg"),
        }
    )
    save_twin(askew, folder / "twin.yaml")
    drive = synthetic_drive(askew, bumps, KNOTS, seed=4, errors=SensorErrors(), name="drive")
    order = np.arange(len(drive.imu))
    order[[700, 701]] = order[[701, 700]]
    order = np.insert(order, 900, 900)
    imu = ImuData(drive.imu.t[order], drive.imu.specific_force[order], drive.imu.angular_rate[order])
    write_drive(replace(drive, imu=imu), folder / "drive")
    return folder


def messages(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    return found


def stamps(rows: list[Any]) -> list[tuple[int, int]]:
    return [(m.header.stamp.sec, m.header.stamp.nanosec) for m in rows]


def xyz(rows: list[Any], name: str) -> np.ndarray:
    return np.array([[getattr(m, name).x, getattr(m, name).y, getattr(m, name).z] for m in rows])


@pytest.fixture(scope="module")
def written(case: Path) -> Path:
    out = case / "out"
    assert main(["simulate", "--twin", str(case / "twin.yaml"), str(case / "drive"), "--out", str(out)]) == 0
    return out


def test_one_message_of_each_topic_for_every_imu_sample_at_its_stamp(case: Path, written: Path) -> None:
    recorded = messages(case / "drive")["/imu/data_raw"]
    topics = messages(written / "simulated")
    assert set(topics) == {
        "/twin/imu",
        "/twin/vertical_acceleration",
        "/imu/vertical_acceleration",
        "/twin/pose",
        "/joint_states",
    }
    for rows in topics.values():
        assert sorted(stamps(rows)) == sorted(set(stamps(recorded)))  # one that is there twice is taken once
    assert (written / "simulated" / "metadata.yaml").is_file()


def test_the_virtual_imu_has_the_sensors_axes_and_gravity(written: Path) -> None:
    rows = messages(written / "simulated")["/twin/imu"]
    force = xyz(rows, "linear_acceleration")[:200].mean(axis=0)
    np.testing.assert_allclose(Rotation.from_euler("xyz", RPY).apply(force), [0, 0, 9.807], atol=0.05)
    assert rows[0].header.frame_id == "imu_link"


def test_the_gap_can_be_had_from_the_two_recordings(case: Path, written: Path) -> None:
    """By a filter of one's own over both sides, as anyone else would do it."""
    turn = Rotation.from_euler("xyz", RPY)
    sides = []
    for path, topic in ((case / "drive", "/imu/data_raw"), (written / "simulated", "/twin/imu")):
        rows = messages(path)[topic]
        t = np.array([s + 1e-9 * n for s, n in stamps(rows)])
        order = np.unique(t, return_index=True)[1]
        grid = np.arange(t.min(), t.max(), 0.01)
        vertical = np.interp(grid, t[order], turn.apply(xyz(rows, "linear_acceleration"))[order, 2])
        sides.append(sosfiltfilt(butter(2, 20.0, fs=100.0, output="sos"), vertical))
    pose = messages(written / "simulated")["/twin/pose"]
    t, x = (
        np.array(v)
        for v in zip(
            *((s + 1e-9 * n, m.pose.position.x) for (s, n), m in zip(stamps(pose), pose, strict=True)),
            strict=True,
        )
    )
    driving = np.abs(np.gradient(np.interp(grid, t, x), 0.01)) > 0.1
    driving[:50] = driving[-50:] = False
    by_hand = float(np.std((sides[0] - sides[1])[driving]))
    gap = json.loads((written / "gap.json").read_text())
    assert gap["rms"] == pytest.approx(by_hand, rel=0.05)
    assert gap["seconds"] == pytest.approx(np.count_nonzero(driving) / 100, abs=1.0)
    assert gap["mse"] == pytest.approx(gap["rms"] ** 2)
    assert set(gap["channels"]) == {
        "vertical_acceleration",
        "roll_rate",
        "pitch_rate",
        "longitudinal_acceleration",
        "lateral_acceleration",
        "yaw_rate",
    }
    assert 0.9 * gap["noise_rms"] < gap["rms"] < 0.06
    assert gap["filter"] == {
        "kind": "Butterworth low-pass",
        "order": 2,
        "cutoff_hz": 20.0,
        "zero_phase": True,
    }


def test_measured_and_simulated_lie_side_by_side(written: Path) -> None:
    topics = messages(written / "simulated")
    measured, simulated = (
        np.array([m.accel.linear.z for m in topics[f"/{side}/vertical_acceleration"]])
        for side in ("imu", "twin")
    )
    gap = json.loads((written / "gap.json").read_text())
    assert np.std(measured) > 5 * gap["rms"]
    assert np.std(measured - simulated) == pytest.approx(gap["rms"], rel=0.2)  # a causal filter


def test_pose_and_joints_follow_the_road(written: Path, bumps: Road) -> None:
    topics = messages(written / "simulated")
    pose = np.array([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in topics["/twin/pose"]])
    u, v = bumps.xy_to_uv(pose[:, 0], pose[:, 1])
    assert u[0] == pytest.approx(5.0, abs=0.05) and np.abs(v).max() < 0.05
    assert pose[:200, 2] == pytest.approx(0.0, abs=2e-3)
    joints = topics["/joint_states"]
    assert joints[0].name == [
        f"{c}_suspension" for c in ("front_left", "front_right", "rear_left", "rear_right")
    ]
    travel = np.array([m.position for m in joints])
    assert travel.shape[1] == 4 and np.ptp(travel[:, 0]) > 0.01
    vertical = np.array([m.accel.linear.z for m in topics["/twin/vertical_acceleration"]])
    assert np.abs(vertical[:200]).max() < 0.05 and np.abs(vertical).max() > 0.5


def test_it_writes_over_its_own_result_and_nothing_else(case: Path, written: Path) -> None:
    arguments = ["simulate", "--twin", str(case / "twin.yaml"), str(case / "drive"), "--out"]
    before = (written / "gap.json").read_bytes()
    assert main([*arguments, str(written)]) == 2
    assert main([*arguments, str(written), "--force"]) == 0
    assert (written / "gap.json").read_bytes() == before
    other = case / "other"
    (other / "simulated").mkdir(parents=True)
    (other / "simulated" / "precious.txt").write_text("mine")
    assert main([*arguments, str(other), "--force"]) == 2
    assert (other / "simulated" / "precious.txt").read_text() == "mine"


def test_what_cannot_be_simulated_is_one_line(
    case: Path, twin: Twin, drive: Drive, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    save_twin(twin, tmp_path / "no_road.yaml")
    write_road(flat_road(100.0, 10.0, x=5000.0, y=5000.0), tmp_path / "elsewhere.crg")
    save_twin(
        twin.model_copy(update={"road": RoadFile(file=tmp_path / "elsewhere.crg")}),
        tmp_path / "elsewhere.yaml",
    )
    silent = replace(drive, fix=replace(drive.fix, status=np.full(len(drive.fix), -1, dtype=np.int8)))
    write_drive(silent, tmp_path / "no_fix")
    for name, bag, words in (
        ("no_road.yaml", case / "drive", "road"),
        ("elsewhere.yaml", case / "drive", "not on the road"),
        ("elsewhere.yaml", tmp_path / "no_fix", "fix"),
        ("missing.yaml", case / "drive", "missing.yaml"),
        ("no_road.yaml", tmp_path / "nowhere", "nowhere"),
    ):
        status = main(["simulate", "--twin", str(tmp_path / name), str(bag), "--out", str(tmp_path / "out")])
        error = capsys.readouterr().err
        assert status == 2 and words in error and error.count("\n") == 1
        assert not (tmp_path / "out" / "gap.json").exists()


def test_how_much_measured_and_simulated_have_in_common_is_printed(
    case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = st.simulate(case / "drive", case / "twin.yaml")
    rows = result.observation.driving
    for name, value in result.correlation.items():
        by_hand = np.corrcoef(result.measured[name][rows], result.simulated[name][rows])[0, 1]
        assert value == pytest.approx(by_hand, abs=1e-9)
    assert (
        main(["simulate", "--twin", str(case / "twin.yaml"), str(case / "drive"), "--out", str(tmp_path)])
        == 0
    )
    line = next(row for row in capsys.readouterr().out.splitlines() if row.startswith("vertical acc"))
    assert line.split()[-1] == f"{result.correlation['vertical_acceleration']:.2f}"
