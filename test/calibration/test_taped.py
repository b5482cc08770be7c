# SPDX-License-Identifier: Apache-2.0
"""A bump by tape measure that is not as high as the file says is not read as another spring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import write_road
from suspension_twin.road.recipe import Taped, make_road, parse_feature
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin

SAID = parse_feature("bump", "0.9x0.05@16")
SPRINGS = ("vehicle.front.spring.force", "vehicle.rear.spring.force")


@pytest.fixture(scope="module")
def given(repository: Path) -> Twin:
    return load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")


def calibrated(given: Twin, height: float, taped: bool, folder: Path) -> CalibrationResult:
    """A car with springs 15 % stiffer over a bump of that height; the file says 5 cm."""
    rate = 1.15 * 23_000.0
    stiffer = [rate * x for x in (0.1, 0.3, 0.5, 1.0)]
    truth = given.with_changes(dict.fromkeys(SPRINGS, stiffer))
    real, said = (make_road(50.0, features=[parse_feature("bump", f"0.9x{h}@16")]) for h in (height, 0.05))
    drive = synthetic_drive(truth, real, ((0.0, 0.0), (3.0, 0.0), (5.0, 4.0), (10.5, 4.0)), 3, u=5.0)
    write_drive(drive, folder / "drive")
    write_road(said, folder / "road.crg", Taped((SAID,)).comment if taped else "")
    twin = given.model_copy(update={"road": RoadFile(file=folder / "road.crg")})
    save_twin(twin, folder / "twin.yaml")
    return calibrate(
        CalibrationRequest(twin=str(folder / "twin.yaml"), bags=(str(folder / "drive"),), free=SPRINGS)
    )


def rates(result: CalibrationResult) -> np.ndarray:
    """(2, 3) lowest, middle and highest rate of both springs over what was driven, N/m."""
    found = []
    for curve in result.curves:
        band = curve.from_rest
        assert band is not None
        ends = [-1, 0]
        middle, half = 0.5 * (band.low + band.high)[ends], 0.5 * (band.high - band.low)[ends]
        length = band.x[-1] - band.x[0]
        rate, width = (middle[0] - middle[1]) / length, half.sum() / length
        found.append((rate - width, rate, rate + width))
    return np.array(found)


@pytest.mark.parametrize("height", [0.055, 0.046])
def test_a_bump_of_another_height(given: Twin, height: float, tmp_path: Path) -> None:
    result = calibrated(given, height, True, tmp_path)
    low, found, high = rates(result).T
    assert (low < 1.01 * 26_450.0).all() and (high > 0.99 * 26_450.0).all()
    np.testing.assert_allclose(found, 26_450.0, rtol=0.04)
    tape = {n.name: n for n in result.nuisances if n.name.startswith("tape.")}
    assert tape["tape.0.height"].value == pytest.approx(height - 0.05, abs=1e-3)
    assert result.drives[0].gap_after.rms < result.drives[0].gap_before.rms


def test_without_a_tape_it_is_another_spring(given: Twin, tmp_path: Path) -> None:
    """A surveyed road is believed."""
    result = calibrated(given, 0.055, False, tmp_path)
    assert not any(n.name.startswith("tape.") for n in result.nuisances)
    assert np.abs(rates(result)[:, 1] / 26_450.0 - 1.0).max() > 0.06


def test_a_right_tape_costs_little(given: Twin, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    surveyed, taped = (calibrated(given, 0.05, t, tmp_path / f) for t, f in ((False, "a"), (True, "b")))
    np.testing.assert_allclose(rates(taped)[:, 1], rates(surveyed)[:, 1], rtol=0.03)
    width = [np.diff(rates(r)[:, ::2], axis=1) for r in (surveyed, taped)]
    assert (width[1] >= 0.9 * width[0]).all()
