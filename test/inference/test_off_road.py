# SPDX-License-Identifier: Apache-2.0
"""A drive that leaves the road: the policy is kept, and the result says for which part of the drive."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.cli.main import main
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import ObserveSettings, observe
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.road import Border, Road, bump_road, circular, write_road
from suspension_twin.vehicle.twin import RoadFile, Twin, save_twin


@pytest.fixture(scope="module")
def short(bumps: Road) -> Road:
    """The drive's road, but it ends after 45 m, lifted to 0.3 m so that hold and zero are not alike."""
    road = bump_road(
        circular(0.9, 0.04), at=[22.0, 40.0], length=45.0, width=6.0, step=0.02, x=3.0, y=-4.0, heading=0.5
    )
    return replace(road, name="short").with_line(z=road.ref_z + 0.3)


def test_policies_differ_beyond_the_end_alone(drive: Drive, twin: Twin, short: Road) -> None:
    runs = {
        policy: observe(drive, twin, short, ObserveSettings(outside=policy))
        for policy in ("road", "hold", "zero")
    }
    road, held, zero = (runs[p].excitation.road for p in ("road", "hold", "zero"))
    assert np.array_equal(road, held)  # what the file says unless it says otherwise
    off = np.abs(zero - held).max(axis=1) > 0.1
    assert 0.1 < off.mean() < 0.9
    np.testing.assert_allclose(zero[off].min(axis=1), 0.0, atol=1e-12)
    assert (held > 0.29).all()


def test_the_result_says_where_and_which_policy(drive: Drive, twin: Twin, short: Road) -> None:
    result = simulate_drive(drive, twin, short, ObserveSettings(outside="zero"))
    told = json.loads(json.dumps(result.as_dict()["off_road"]))
    assert told["policy"] == "zero" and len(told["stretches"]) == 1
    stretch = told["stretches"][0]
    prepared = result.observation
    assert stretch["end"] == prepared.trajectory.t[-1]
    assert told["seconds"] == pytest.approx(stretch["end"] - stretch["start"])
    assert told["share"] == pytest.approx(1 - prepared.inside.mean(), abs=0.01)
    assert not prepared.mask[prepared.t > stretch["start"] + 0.1].any()
    front = short.xy_to_uv(prepared.trajectory.x, prepared.trajectory.y)[0] + twin.vehicle.wheelbase
    at = np.searchsorted(prepared.trajectory.t, stretch["start"])
    assert front[at - 1] <= short.u_last < front[at] + 1e-6
    said = [w for w in prepared.warnings if "off the road short" in w]
    assert len(said) == 1 and "the height is 0" in said[0] and f"{told['share']:.0%}" in said[0]


def test_a_drive_on_the_road_has_nothing_to_say(drive: Drive, twin: Twin, bumps: Road) -> None:
    result = simulate_drive(drive, twin, bumps, ObserveSettings(outside="error"))
    assert result.as_dict()["off_road"] == {"policy": "error", "share": 0.0, "seconds": 0.0, "stretches": []}
    assert not any("off the road" in w for w in result.observation.warnings)


def test_error_refuses_by_the_drives_name(drive: Drive, twin: Twin, short: Road) -> None:
    with pytest.raises(
        InputError, match=r"^bumps: leaves the road short from \d+\.\d\d to 19\.\d\d s.*the policy"
    ):
        observe(drive, twin, short, ObserveSettings(outside="error"))
    none = replace(short, borders=replace(short.borders, u=Border(0)))
    with pytest.raises(InputError, match="and the road's file has no height there"):
        observe(drive, twin, none)


@pytest.fixture(scope="module")
def case(drive: Drive, twin: Twin, short: Road, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("off_road")
    write_drive(drive, folder / "drive")
    write_road(short, folder / "road.crg")
    save_twin(twin.model_copy(update={"road": RoadFile(file=folder / "road.crg")}), folder / "twin.yaml")
    return folder


def test_the_command_takes_a_policy(case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["simulate", "--twin", str(case / "twin.yaml"), str(case / "drive"), "--out", str(tmp_path)]
    assert main([*given, "--off-road", "error"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main([*given, "--off-road", "zero"]) == 0
    assert "off the road" in capsys.readouterr().out
    assert json.loads((tmp_path / "gap.json").read_text())["off_road"]["policy"] == "zero"


def test_a_calibration_says_so(case: Path) -> None:
    request = CalibrationRequest(
        str(case / "twin.yaml"),
        (str(case / "drive"),),
        free=("vehicle.front.damper_push",),
        max_generations=1,
    )
    result = calibrate(request)
    assert any(w.startswith("drive: off the road") and "are held" in w for w in result.warnings)
