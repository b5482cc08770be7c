# SPDX-License-Identifier: Apache-2.0
"""Marker runs: from a tool's CSV, from poses in a recording, and what is neither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import InputError
from suspension_twin.inference.marker_runs import read_markers, read_run, run_speed
from suspension_twin.vehicle.tracked import TrackedVehicle, load_tracked

HEADER = "time_s,A_displacement_mm,B_displacement_mm"


@pytest.fixture(scope="module")
def vehicle(repository: Path) -> TrackedVehicle:
    return load_tracked(repository / "config" / "tracked" / "pt91.yaml")


def test_the_bundled_runs_are_three_repeats_at_three_speeds(
    repository: Path, vehicle: TrackedVehicle
) -> None:
    runs = [read_run(p, vehicle) for p in sorted((repository / "config" / "tracked" / "runs").glob("*.csv"))]
    assert [round(3.6 * r.speed) for r in runs] == [4] * 3 + [8] * 3 + [13] * 3
    for r in runs:
        assert r.rate == pytest.approx(50.0) and all(r.seen)
        assert 0.2 < np.ptp(r.markers[:, 0]) < 0.6
        # its velocity is that of its displacement
        slope = np.gradient(r.markers, r.t, axis=0)
        assert np.sqrt(np.mean((slope - r.velocity)[5:-5] ** 2)) < 0.1 * r.velocity.std()


def test_markers_are_read_as_they_were_written(tmp_path: Path) -> None:
    t = np.arange(0, 3, 0.004)
    table = np.stack([t, 100 * np.sin(t), 50 * np.cos(t)], axis=1)
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="t,A,B", comments="")
    read = read_markers(path, 1.1)
    inner = slice(15, -15)
    assert read.rate == pytest.approx(50.0) and read.seen == (True, True, False)
    assert np.abs(read.markers[:, 0] - 0.1 * np.sin(read.t))[inner].max() < 1e-4
    assert np.abs(read.velocity[:, 0] - 0.1 * np.cos(read.t))[inner].max() < 1e-3
    assert np.abs(read.acceleration[:, 1] + 0.05 * np.cos(read.t))[inner].max() < 1e-2
    assert (read.markers[:, 2] == 0).all()


def test_poses_in_a_recording_are_markers(tmp_path: Path, vehicle: TrackedVehicle) -> None:
    t = np.arange(0, 2, 0.01)
    z, pitch = 0.1 * np.sin(2 * t), 0.05 * np.sin(3 * t)
    with BagWriter(tmp_path / "13kmh_1") as bag:
        bag.write(
            "/pose",
            "geometry_msgs/msg/PoseStamped",
            1000.0 + t,
            {
                "pose.position.x": t,
                "pose.position.y": 0 * t,
                "pose.position.z": 5.0 + z,
                "pose.orientation.x": 0 * t,
                "pose.orientation.y": np.sin(pitch / 2),
                "pose.orientation.z": 0 * t,
                "pose.orientation.w": np.cos(pitch / 2),
            },
            frame="map",
        )
    run = read_run(tmp_path / "13kmh_1", vehicle)
    assert run.speed == pytest.approx(13 / 3.6)
    ahead = 3.347 - vehicle.stations[-1].x
    up = 0.587 - vehicle.ground_height
    expected = np.interp(run.t, t, z - ahead * np.sin(pitch) + up * (np.cos(pitch) - 1))
    assert np.abs(run.markers[:, 0] - expected)[15:-15].max() < 5e-4
    with pytest.raises(InputError, match=r"/pose: is missing: /fix"):
        with BagWriter(tmp_path / "8kmh") as bag:
            bag.write(
                "/fix", "geometry_msgs/msg/PoseStamped", 1000.0 + t, {"pose.position.x": t}, frame="map"
            )
        read_run(tmp_path / "8kmh", vehicle)


def test_the_speed_is_in_the_name() -> None:
    assert run_speed("a/13kmh_1.csv") == pytest.approx(13 / 3.6)
    assert run_speed("run_4.5_km_h.csv") == pytest.approx(4.5 / 3.6)
    with pytest.raises(InputError, match="the name has none"):
        run_speed("run.csv")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("time_s,A_displacement_mm\n1,2\n", "has no B_displacement_mm"),
        ("time_s,A_speed\n1,2\n", "'A_speed' is not a column"),
        ("t,t,A,B\n1,2,3,4\n", "stands there twice"),
        (f"{HEADER}\n1,2,x\n", "not a table"),
        (f"{HEADER}\n1,2,3\n", "at least 20 rows"),
        (f"{HEADER}\n" + "".join(f"{k % 7},1,2\n" for k in range(30)), "must rise"),
        (f"{HEADER}\n" + "".join(f"{k},nan,2\n" for k in range(30)), "no numbers"),
        (f"{HEADER}\n" + "".join(f"{k},{k * 1e6},2\n" for k in range(30)), "is the unit mm"),
        (f"{HEADER}\n" + "".join(f"{k - 5},1,2\n" for k in range(30)), "before 0"),
        (f"{HEADER}\n" + "".join(f"{k / 1000},1,2\n" for k in range(30)), "too short"),
    ],
)
def test_what_is_no_markers_file(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "markers.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=word) as error:
        read_markers(path, 1.0)
    assert "markers" in str(error.value) and "\n" not in str(error.value)
