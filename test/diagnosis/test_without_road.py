# SPDX-License-Identifier: Apache-2.0
"""A recording of a real car whose IMU sits tilted and late, without telling the twin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.diagnosis.case import read_case
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.types import Drive, cut
from suspension_twin.drive.write import write_drive
from suspension_twin.vehicle.twin import Datum, Imu, Place, Twin, load_twin, save_twin

ROOF = "rtklibexplorer_GNSS_IMU"


def recorded(folder: Path, repository: Path, mapping: str) -> Drive:
    """A recording among the measured data."""
    if not folder.is_dir():
        pytest.skip(f"no measured data: {folder.name}")
    return import_drive([folder], mapping=repository / "config" / "import" / f"{mapping}.yaml").drive


def mounted(car: Twin, drive: Drive, imu: Imu, antenna: float) -> Twin:
    """A car with that IMU and an antenna so many m above the road, about the drive's first fix."""
    fix = drive.fix
    datum = Datum(latitude=fix.latitude[0], longitude=fix.longitude[0], altitude=fix.altitude[0])
    gps = Place(frame="gps_link", position=(0.0, 0.0, antenna))
    return car.model_copy(update={"imu": imu, "gps": gps, "datum": datum})


@pytest.mark.long
@pytest.mark.parametrize("told", [np.pi, 0.0], ids=["it looks backwards", "nothing of it"])
def test_tilt_and_clock_of_a_real_roof_imu_are_named(
    shared_data: Path, repository: Path, car: Twin, tmp_path: Path, told: float
) -> None:
    drive = recorded(shared_data / ROOF, repository, "rtklibexplorer_gnss_imu_raw")
    write_drive(drive, tmp_path / "raw")
    save_twin(
        mounted(car, drive, Imu(position=(0.0, 0.0, 1.5), rpy=(0.0, 0.0, told)), 2.15), tmp_path / "twin.yaml"
    )
    document = diagnose(DiagnosisRequest(str(tmp_path / "twin.yaml"), (str(tmp_path / "raw"),))).document
    assert document["verdict"] == "effect"
    assert set(document["combination"]) == {"time_offset", "sensor_tilt", "clock_drift"}
    found = {c["effect"]: c["parameters"] for c in document["causes"]}
    # as documented, in axes that point forward, right, down: seen in ours, pitch and yaw change sign; pitch once more
    # where the sensor itself looks the other way
    assert found["time_offset"]["offset"] == pytest.approx(0.125, abs=0.015)
    assert found["clock_drift"]["drift_ppm"] == pytest.approx(257, abs=80)
    turned = np.degrees(found["sensor_tilt"]["yaw"]) + (0.0 if told else 180.0)
    assert np.degrees(found["sensor_tilt"]["pitch"]) == pytest.approx(6.79 if told else -6.79, abs=2.0)
    assert (turned + 5.35 + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=2.0)
    assert document["where"]["road"] == []
    assert any("names no road" in w for w in document["warnings"])


@pytest.mark.long
def test_every_cause_comes_once_and_all_probabilities_are_one(
    shared_data: Path, repository: Path, car: Twin, tmp_path: Path
) -> None:
    """Two set-up errors at once: late by 0.4 s, and turned by 3 degrees more than the file says."""
    whole = recorded(shared_data / ROOF, repository, "rtklibexplorer_gnss_imu")
    start = float(whole.imu.t[0])
    drive = cut(whole, start + 200.0, start + 280.0)
    drive = replace(drive, imu=replace(drive.imu, t=drive.imu.t + 0.4))
    write_drive(drive, tmp_path / "late")
    save_twin(
        mounted(car, drive, Imu(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180 + 0.05, 3.0476)), 2.15),
        tmp_path / "twin.yaml",
    )
    document = diagnose(DiagnosisRequest(str(tmp_path / "twin.yaml"), (str(tmp_path / "late"),))).document
    causes = [c["effect"] for c in document["causes"]]
    assert set(document["combination"]) == {"time_offset", "sensor_tilt"}
    assert len(set(causes)) == len(causes)
    # members of a set share its probability
    singles = sum(c["probability"] for c in document["causes"])
    total = singles + document["no_gap_probability"] + document["unknown_probability"]
    assert total == pytest.approx(1.0, abs=1e-3)


@pytest.mark.long
def test_what_no_prior_expects_has_its_true_size(
    shared_data: Path, repository: Path, car: Twin, tmp_path: Path
) -> None:
    """Clocks drift by some tens of ppm: one that drifts by 8000 is not drawn towards them."""
    whole = recorded(shared_data / ROOF, repository, "rtklibexplorer_gnss_imu")
    start = float(whole.imu.t[0])
    bags = []
    for name, since, until in (("one", 200.0, 280.0), ("other", 390.0, 450.0)):
        drive = cut(whole, start + since, start + until)
        first = float(drive.imu.t[0])
        stretched = replace(drive.imu, t=first + 1.008 * (drive.imu.t - first))
        write_drive(replace(drive, imu=stretched), tmp_path / name)
        bags.append(str(tmp_path / name))
    save_twin(
        mounted(car, whole, Imu(position=(0.0, 0.0, 1.5), rpy=(0.0111, -0.1180, 3.0476)), 2.15),
        tmp_path / "twin.yaml",
    )
    document = diagnose(DiagnosisRequest(str(tmp_path / "twin.yaml"), tuple(bags))).document
    assert document["combination"] == ["clock_drift"]
    assert document["causes"][0]["parameters"]["drift_ppm"] == pytest.approx(8000.0, rel=0.1)


@pytest.mark.long
def test_a_reference_whose_motion_is_hardly_above_its_noise_is_no_reason_to_refuse(
    shared_data: Path, repository: Path, car: Twin, tmp_path: Path
) -> None:
    """A straight motorway, a phone behind the windshield and its receiver; nothing changed between the two halves."""
    whole = recorded(shared_data / "comma2k19_Example_1", repository, "comma2k19")
    start = float(whole.imu.t[0])
    save_twin(
        mounted(car, whole, Imu(position=(1.9, 0.0, 1.2), rpy=(0.014, 0.0675, -0.0003)), 1.5),
        tmp_path / "twin.yaml",
    )
    for name, first, last in (("reference", 4.0, 33.0), ("drive", 33.3, 59.8)):
        write_drive(cut(whole, start + first, start + last), tmp_path / name)
    request = DiagnosisRequest(
        str(tmp_path / "twin.yaml"), (str(tmp_path / "drive"),), (str(tmp_path / "reference"),)
    )
    document = diagnose(request).document
    assert document["verdict"] == "no_gap"
    assert any("reference: calibrated on it alone, the twin still misses" in w for w in document["warnings"])


def test_a_drive_far_from_the_origin_of_a_twin_without_a_road_is_whole(
    repository: Path, tmp_path: Path
) -> None:
    there = load_twin(repository / "bags" / "crg_road" / "twin.yaml").model_copy(update={"road": None})
    datum = Datum(latitude=40.1, longitude=-105.1, altitude=1600.0)  # another continent
    seconds = []
    for number, twin in enumerate((there, there.model_copy(update={"datum": datum}))):
        save_twin(twin, tmp_path / f"{number}.yaml")
        request = DiagnosisRequest(str(tmp_path / f"{number}.yaml"), (str(repository / "bags" / "crg_road"),))
        case = read_case(request, lambda _: None, lambda: False)
        seconds.append(float(case.drives[0].mask.sum() / case.drives[0].rate))
        assert case.twin.datum == twin.datum and not any("off the road" in w for w in case.warnings)
    assert seconds[0] == seconds[1] > 5.0
