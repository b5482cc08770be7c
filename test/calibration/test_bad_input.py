# SPDX-License-Identifier: Apache-2.0
"""Recordings that cannot tell what is asked of them, through the command: a reason and a way out, no wrong twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from suspension_twin.calibration.output import details_path
from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData, ImuData, cut
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import bump_road, circular, write_road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import load_twin

Run = Callable[[Drive | Path], tuple[int, str, Path]]


@pytest.fixture
def drive(rough_case: Any) -> Drive:
    return read_drive(rough_case.bag("one"))


@pytest.fixture
def calibrated(rough_case: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs ``calibrate`` on a drive: exit status, what it said, and the file it was to write."""

    def run(
        drive: Drive | Path, command: str = "calibrate", twin: str = rough_case.twin
    ) -> tuple[int, str, Path]:
        bag = drive if isinstance(drive, Path) else tmp_path / drive.name
        if isinstance(drive, Drive):
            write_drive(drive, bag)
        out = tmp_path / "out" / "calibrated.yaml"
        status = main(
            [command, "--twin", twin, str(bag), "--out", str(out if command == "calibrate" else out.parent)]
        )
        said = capsys.readouterr()
        return status, said.err if status else said.out, out

    return run


def refused(found: tuple[int, str, Path], *words: str, status: int = 2) -> None:
    code, text, out = found
    assert code == status, text
    assert len(text.strip().splitlines()) == 1
    for word in words:
        assert word in text
    assert not out.exists()


def altered(drive: Drive, name: str, force: Any, rate: Any) -> Drive:
    return replace(drive, name=name, imu=ImuData(drive.imu.t, force, rate))


def test_without_excitation(rough_case: Any, calibrated: Run) -> None:
    smooth = bump_road(circular(0.9, 0.001), at=70.0, length=140.0, x=4.0, y=2.0, heading=0.3)
    knots = [(0, 0), (3.2, 0), (6, 5), (14, 5), (17, 0), (19, 0)]
    refused(
        calibrated(synthetic_drive(rough_case.truth, smooth, knots, seed=4, name="smooth")),
        "smooth",
        "does not excite the car",
        "drive over a bump or a rough road",
    )


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_parked(rough_case: Any, calibrated: Any, command: str) -> None:
    road = iso8608_road("C", 140.0, seed=2, x=4.0, y=2.0, heading=0.3)
    parked = synthetic_drive(rough_case.truth, road, [(0, 0), (12, 0)], seed=4, name="parked")
    refused(calibrated(parked, command), "parked", "record a drive over the road")


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_upside_down(drive: Drive, calibrated: Any, command: str) -> None:
    flip = np.array([1.0, -1.0, -1.0])
    turned = altered(drive, "flipped", drive.imu.specific_force * flip, drive.imu.angular_rate * flip)
    refused(calibrated(turned, command), "flipped", "upside down", "set imu.rpy: [")


def test_at_30_hz(rough_case: Any, drive: Drive, calibrated: Any) -> None:
    even = np.arange(drive.imu.t[0], drive.imu.t[-1], 1 / 30)

    def sampled(values: Any) -> Any:
        return np.column_stack([np.interp(even, drive.imu.t, column) for column in values.T])

    imu = ImuData(even, sampled(drive.imu.specific_force), sampled(drive.imu.angular_rate))
    slow = replace(drive, name="slow", imu=imu)
    refused(calibrated(slow), "slow", "30 Hz", "record at 50 Hz or more")


def test_without_gps(drive: Drive, calibrated: Run) -> None:
    none = np.empty(0)
    fix = FixData(none, none, none, none, np.empty(0, dtype=np.int8), np.empty((0, 3)))
    refused(calibrated(replace(drive, name="blind", fix=fix)), "blind", "no positions", "record /fix")


def test_far_from_the_road(rough_case: Any, drive: Drive, calibrated: Run) -> None:
    fix = replace(drive.fix, latitude=drive.fix.latitude + 0.01)
    refused(
        calibrated(replace(drive, name="elsewhere", fix=fix)),
        "elsewhere",
        "never drives on the road",
        "datum",
    )


@pytest.mark.long
def test_on_another_road_at_the_same_place(rough_case: Any, calibrated: Any, tmp_path: Path) -> None:
    write_road(iso8608_road("C", 140.0, seed=77, x=4.0, y=2.0, heading=0.3), tmp_path / "other.crg")
    twin = yaml.safe_load(Path(rough_case.twin).read_text())
    twin["road"] = {"file": "other.crg"}
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(twin))
    found = calibrated(Path(rough_case.bag("one")), twin=str(tmp_path / "twin.yaml"))
    refused(found, "little in common", "another road than", status=1)


def test_cut_off_to_a_few_seconds(drive: Drive, calibrated: Run) -> None:
    start = float(drive.imu.t[0])
    refused(calibrated(replace(cut(drive, start, start + 5.0), name="short")), "short", "are needed")


def test_a_file_cut_off_is_used_as_far_as_it_goes(rough_case: Any, calibrated: Run, tmp_path: Path) -> None:
    (file,) = Path(rough_case.bag("one")).glob("*.mcap")
    whole = file.read_bytes()
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(whole[: int(0.8 * len(whole))])
    status, text, out = calibrated(broken)
    assert status == 0, text
    assert "cut off" in text
    near_the_truth(rough_case, out)


def test_in_g_is_converted_and_said(rough_case: Any, drive: Drive, calibrated: Run) -> None:
    light = altered(drive, "light", drive.imu.specific_force / 9.80665, drive.imu.angular_rate)
    status, text, out = calibrated(light)
    assert status == 0, text
    assert "accelerations come in g" in text and "send m/s²" in text
    near_the_truth(rough_case, out)


def near_the_truth(case: Any, out: Path) -> None:
    """What came out is no wrong calibration: its identified dampers are the true ones."""
    found = load_twin(out).vehicle
    details = yaml.safe_load(details_path(out).read_text())
    sure = [p["key"] for p in details["parameters"] if p["status"] == "identified" and "damper" in p["key"]]
    assert len(sure) >= 6
    errors = []
    for key in sure:
        _, axle, part, _, index = key.split(".")
        ours, true = (getattr(getattr(v, axle), part).force[int(index)] for v in (found, case.truth.vehicle))
        errors.append(abs(ours / true - 1))
    assert np.median(errors) < 0.08
