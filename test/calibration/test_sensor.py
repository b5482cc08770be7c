# SPDX-License-Identifier: Apache-2.0
"""What a calibration finds of the sensor goes into the twin file, and nothing that it is not sure of."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from suspension_twin.calibration.output import write_result
from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.sensor import common_offset, sensor_estimates
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import WorkError
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import load_twin

LATE, TILT = 0.006, math.radians(0.5)


@pytest.fixture(scope="module")
def late_case(rough_case: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Two drives of a car whose sensor is late and tilted, on a road that the twin file knows."""
    folder = tmp_path_factory.mktemp("late")
    truth = rough_case.truth.with_changes({"imu.rpy": (0.0, TILT, 0.0)})
    road = load_road(rough_case.folder / "road.crg")
    errors = SensorErrors(clock_offset=LATE, position=0.005)
    for name, top, seed in (("learnt", 7.0, 11), ("held_out", 5.5, 12)):
        knots = [(0, 0), (3.2, 0), (5.5, top), (8, 0.4 * top), (10, top), (16, top), (18, 0), (20.5, 0)]
        write_drive(synthetic_drive(truth, road, knots, seed, errors, name=name), folder / name)
    return SimpleNamespace(folder=folder, truth=truth, twin=rough_case.twin, start=rough_case.start)


@pytest.fixture(scope="module")
def result(late_case: Any) -> CalibrationResult:
    return calibrate(CalibrationRequest(late_case.twin, (str(late_case.folder / "learnt"),), seed=1))


def test_latency_and_tilt_are_written_with_intervals_that_hold_the_truth(
    result: CalibrationResult, tmp_path: Path
) -> None:
    found = {s.key: s for s in result.sensor}
    for key, truth in (("imu.latency", LATE), ("mount.pitch", TILT)):
        assert found[key].written, found[key]
        assert abs(found[key].value - truth) < found[key].high - found[key].low  # 3.3 standard deviations
    path, details = write_result(result, tmp_path / "calibrated.yaml")
    imu = load_twin(path).imu
    assert imu.latency == pytest.approx(found["imu.latency"].value, abs=1e-9)
    assert imu.rpy[1] == pytest.approx(found["mount.pitch"].value, abs=1e-9)
    said = {s["key"]: s for s in yaml.safe_load(details.read_text())["sensor"]}
    low, high = said["imu.latency"]["interval_90"]
    assert said["imu.latency"]["written"] and low < said["imu.latency"]["value"] < high


def test_a_held_out_drive_is_left_with_the_noise(late_case: Any, result: CalibrationResult) -> None:
    drive, true = (
        read_drive(late_case.folder / "held_out"),
        late_case.truth.with_changes({"imu.latency": LATE}),
    )
    ours, best, before = (
        simulate_drive(drive, t).gap.rms
        for t in (result.twin, true, result.twin.model_copy(update={"imu": late_case.start.imu}))
    )
    assert ours < 1.1 * best
    assert before > 2 * best


def test_the_gap_after_is_that_of_the_twin_as_it_is_written(
    late_case: Any, result: CalibrationResult
) -> None:
    (fit,) = result.drives
    again = simulate_drive(read_drive(late_case.folder / "learnt"), result.twin).gap
    assert fit.gap_after.rms == pytest.approx(again.rms, rel=1e-3)
    assert fit.gap_after.rms < 1.1 * fit.nuisance_free
    before = simulate_drive(read_drive(late_case.folder / "learnt"), late_case.start).gap
    assert fit.gap_before.rms == pytest.approx(before.rms, rel=1e-3)


def test_a_sensor_that_is_to_be_kept_is_kept(late_case: Any, result: CalibrationResult) -> None:
    request = CalibrationRequest(
        late_case.twin, (str(late_case.folder / "learnt"),), seed=1, keep_sensor=True, max_generations=2
    )
    kept = calibrate(request)
    assert kept.twin.imu == late_case.start.imu
    assert len(kept.sensor) == len(result.sensor) and not any(s.written for s in kept.sensor)


def test_what_a_fit_blames_on_the_sensor_is_not_written_against_the_evidence(
    late_case: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fitted tilt that gravity contradicts, and a clock offset that only a map's offset makes up for."""
    seen: list[Any] = []

    def watched(*given: Any) -> Any:
        seen.append(given)
        return sensor_estimates(*given)

    monkeypatch.setattr("suspension_twin.calibration.outcome.sensor_estimates", watched)
    calibrate(CalibrationRequest(late_case.twin, (str(late_case.folder / "learnt"),), seed=1))
    setup, outcome, uncertainty, _ = seen[0]
    names, wrong = list(outcome.problem.nuisances.names), outcome.nuisance.copy()
    wrong[names.index("tilt_pitch")] += 0.06
    wrong[names.index("learnt.clock_offset")] += 0.02
    found = {s.key: s for s in sensor_estimates(setup, replace(outcome, nuisance=wrong), uncertainty)}
    assert not found["mount.pitch"].written and found["mount.pitch"].consistency < 1e-3
    assert not found["imu.latency"].written
    right = {s.key: s for s in sensor_estimates(setup, outcome, uncertainty)}
    assert right["mount.pitch"].written and right["mount.pitch"].consistency > 1e-3


def test_a_calibration_goes_on_from_the_latency_of_the_file(
    late_case: Any, result: CalibrationResult, tmp_path: Path
) -> None:
    path, _ = write_result(result, tmp_path / "twin.yaml")
    again = calibrate(CalibrationRequest(str(path), (str(late_case.folder / "held_out"),), seed=1))
    latency = {s.key: s for s in again.sensor}["imu.latency"]
    assert latency.start == result.twin.imu.latency
    assert latency.value == pytest.approx(LATE, abs=2e-3)


# -- one value for several drives ------------------------------------------------------------------


def test_a_receiver_that_is_late_is_no_early_sensor(late_case: Any, tmp_path: Path) -> None:
    """A sample cannot come before it is taken."""
    road = load_road(Path(late_case.twin).with_name("road.crg"))
    knots = [(0, 0), (3.2, 0), (5.5, 7), (8, 3), (10, 7), (16, 7), (18, 0), (20.5, 0)]
    errors = SensorErrors(clock_offset=-0.012, position=0.005)
    write_drive(synthetic_drive(late_case.truth, road, knots, 11, errors, name="early"), tmp_path / "early")
    found = calibrate(CalibrationRequest(late_case.twin, (str(tmp_path / "early"),), seed=1))
    (latency,) = [s for s in found.sensor if s.key == "imu.latency"]
    assert latency.value == pytest.approx(-0.012, abs=4e-3)
    assert not latency.written and found.twin.imu.latency == 0.0
    (said,) = [w for w in found.warnings if "imu.latency stays" in w]
    assert "before they are taken" in said


def test_no_twin_is_written_that_is_farther_from_its_drives(
    result: CalibrationResult, tmp_path: Path
) -> None:
    (drive,) = result.drives
    assert not result.is_farther
    worse = replace(drive, gap_after=replace(drive.gap_after, rms=2.0 * drive.gap_before.rms))
    assert not replace(result, drives=(worse,)).is_farther  # not with the drive's own clock and place
    worse = replace(worse, nuisance_free=1.5 * drive.gap_before.rms)
    assert (
        replace(result, drives=(worse,)).is_farther
        and not replace(result, drives=(worse, drive, drive, drive)).is_farther
    )
    with pytest.raises(WorkError, match="no twin is written.*learnt"):
        write_result(replace(result, drives=(worse,)), tmp_path / "twin.yaml")
    assert not list(tmp_path.iterdir())


def test_offsets_that_agree_have_their_weighted_mean() -> None:
    sigma = np.array([1e-3, 2e-3])
    value, spread, p = common_offset(np.array([5e-3, 6e-3]), np.diag(sigma**2))
    assert value == pytest.approx((5e-3 / 1 + 6e-3 / 4) / (1 + 1 / 4))
    assert spread == pytest.approx(1e-3 / math.sqrt(1.25))
    assert p > 0.5


def test_offsets_that_scatter_widen_the_interval_of_their_mean() -> None:
    """Two clocks that have nothing to do with each other: no common value is sure."""
    value, spread, p = common_offset(np.array([-50e-3, 60e-3]), np.diag([1e-6, 1e-6]))
    assert value == pytest.approx(5e-3)
    assert spread == pytest.approx(55e-3)
    assert p < 1e-6


def test_one_drive_has_no_consistency() -> None:
    value, spread, p = common_offset(np.array([4e-3]), np.array([[4e-6]]))
    assert (value, spread) == (pytest.approx(4e-3), pytest.approx(2e-3)) and math.isnan(p)


@pytest.mark.parametrize(("sigma", "written"), [(0.01, True), (2.0, False)])
def test_at_one_speed_the_receiver_says_whether_it_is_the_clock(
    pass_case: Any, tmp_path: Path, sigma: float, written: bool
) -> None:
    """A clock 6 ms late and a map that is 25 mm off are the same at 4 m/s: where the receiver knows its place to a
    centimetre it is the clock, where it does not nobody can say, and only the place is looked for."""
    drive = read_drive(pass_case.bag("pass"))
    fix = replace(drive.fix, sigma=np.full_like(drive.fix.sigma, sigma))
    late = replace(SensorCorrection(clock=-LATE).timed(drive), fix=fix, name="late")
    write_drive(late, tmp_path / "late")
    found = calibrate(CalibrationRequest(pass_case.twin, (str(tmp_path / "late"),)))
    assert [s.written for s in found.sensor if s.key == "imu.latency"] == [True] * written
    assert found.twin.imu.latency == pytest.approx(LATE if written else 0.0, abs=2e-3)
