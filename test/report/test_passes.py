# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration shows the passes that were placed laid over one another, before and after."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.types import FixData
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.report.calibration import calibration_page
from suspension_twin.road import bump_road, half_sine, write_road
from suspension_twin.vehicle.twin import RoadFile, load_twin, save_twin


def test_passes_laid_over_one_another(repository: Path, tmp_path: Path) -> None:
    given = load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")
    road = bump_road(half_sine(0.9, 0.05), at=[20.0, 50.0], length=80.0)
    write_road(bump_road(half_sine(0.9, 0.05), at=[20.0, 50.0], length=80.0), tmp_path / "road.crg")
    drive = synthetic_drive(given, road, ((0.0, 0.0), (3.0, 0.0), (5.0, 5.0), (16.0, 5.0)), 1, u=6.0)
    assert given.datum is not None
    frame = LocalMap(given.datum)
    enu = frame.to_map(drive.fix.latitude, drive.fix.longitude, drive.fix.altitude)
    enu[:, 0] -= 2.0
    latitude, longitude, altitude = frame.to_geodetic(enu).T
    fix = FixData(
        drive.fix.t, latitude, longitude, altitude, drive.fix.status, np.full_like(drive.fix.sigma, 2.5)
    )
    write_drive(replace(drive, fix=fix), tmp_path / "drive")
    save_twin(given.model_copy(update={"road": RoadFile(file=tmp_path / "road.crg")}), tmp_path / "twin.yaml")
    request = CalibrationRequest(
        twin=str(tmp_path / "twin.yaml"),
        bags=(str(tmp_path / "drive"),),
        free=("vehicle.front.spring.force",),
        max_generations=2,
    )
    result = calibrate(request)
    fit = result.drives[0]
    assert fit.received is not None
    # the receiver says 2 m too little along the road
    np.testing.assert_allclose(fit.position - fit.received, 2.0, atol=0.3)
    page = calibration_page(result).write(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "laid over one another" in page
