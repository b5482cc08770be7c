# SPDX-License-Identifier: Apache-2.0
"""The nodes through a client's eyes: nothing lost, the same every time, errors in words."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.nodes.session import session

BAG = Path(__file__).resolve().parents[2] / "bags" / "crg_road"


@pytest.fixture(scope="module")
def drive():
    return read_drive(BAG)


@pytest.fixture(scope="module")
def replays(drive):
    shares = []
    with session() as ros:
        first = ros.replay(drive, BAG / "twin.yaml", shares.append)
        second = ros.replay(drive, BAG / "twin.yaml")
    return first, second, shares


def test_every_sample_is_answered(replays, drive):
    first, _, _ = replays
    # The ingest begins to answer once it knows the gravity.
    assert len(drive.imu) - first.t.size < 50
    assert np.all(np.isin(np.round(first.t, 6), np.round(drive.imu.t, 6)))
    assert np.isfinite(first.measured).all()
    assert np.isfinite(first.simulated).all()
    assert np.all(np.diff(first.t) > 0)


def test_a_replay_gives_the_same_every_time(replays):
    first, second, _ = replays
    np.testing.assert_array_equal(first.t, second.t)
    np.testing.assert_array_equal(first.measured, second.measured)
    np.testing.assert_array_equal(first.simulated, second.simulated)
    np.testing.assert_array_equal(first.path, second.path)


def test_the_locked_path_is_where_the_car_was(replays):
    """RTK and gyroscope keep the pose within centimetres, against the truth beside the drive."""
    first, _, _ = replays
    with np.load(BAG / "truth.npz") as truth:
        t = float(truth["start"]) + np.arange(truth["t"].size) * 0.01
        x, y, yaw = (truth[k].astype(float) for k in ("x", "y", "yaw"))
    path = first.path[np.isfinite(first.path[:, 5])]
    path = path[path[:, 0] > path[0, 0] + 1.0]
    off = np.hypot(path[:, 1] - np.interp(path[:, 0], t, x), path[:, 2] - np.interp(path[:, 0], t, y))
    assert np.quantile(off, 0.99) < 0.05
    turned = path[:, 3] - np.interp(path[:, 0], t, np.unwrap(yaw))
    assert np.abs(np.remainder(turned + np.pi, 2 * np.pi) - np.pi).max() < np.radians(1.0)


def test_progress_rises_to_one(replays):
    _, _, shares = replays
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_session_leaves_the_surroundings_as_they_were():
    before = dict(os.environ)
    with session():
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "OFF"
    assert dict(os.environ) == before


def test_a_wrong_twin_file_is_named(drive, tmp_path):
    (tmp_path / "twin.yaml").write_text("model: truck\n")
    with session() as ros, pytest.raises(InputError, match=r"twin\.yaml"):
        ros.replay(drive, tmp_path / "twin.yaml")


def test_a_drive_without_samples_is_an_error(drive):
    silent = replace(
        drive,
        imu=replace(
            drive.imu,
            t=drive.imu.t[:1],
            specific_force=drive.imu.specific_force[:1],
            angular_rate=drive.imu.angular_rate[:1],
        ),
    )
    with session() as ros, pytest.raises(WorkError, match="none of 1 IMU samples was simulated"):
        ros.replay(silent, BAG / "twin.yaml")


def test_the_action_says_why_it_fails(tmp_path):
    with session() as ros, pytest.raises(WorkError, match="nowhere"):
        ros.calibrate(BAG / "twin.yaml", [tmp_path / "nowhere"], tmp_path / "out.yaml")
