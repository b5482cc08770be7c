# SPDX-License-Identifier: Apache-2.0
"""A road is laid where a drive felt its bumps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.cli.main import main
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.felt_passes import felt_road
from suspension_twin.inference.observation import observe
from suspension_twin.inference.placement import place
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import Road, load_road
from suspension_twin.road.recipe import FIRST_AT, make_road, parse_feature, taped_features
from suspension_twin.vehicle.twin import Twin, load_twin

KNOTS = ((0.0, 0.0), (4.0, 0.0), (7.0, 5.0), (13.0, 5.0), (15.0, 3.0))


@pytest.fixture(scope="module")
def twin(repository: Path) -> Twin:
    return load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")


def real(*at: float) -> Road:
    """Somewhere on the map, in some direction."""
    features = [parse_feature("bump", f"0.9x0.05@{a}") for a in at]
    return make_road(70.0, features=features, x=120.0, y=-40.0, heading=2.3)


def driven(twin: Twin, road: Road, error: float = 0.01) -> Drive:
    from suspension_twin.inference.synthetic import SensorErrors

    return synthetic_drive(twin, road, KNOTS, 1, SensorErrors(position=error), u=5.0)


def test_one_bump(twin: Twin) -> None:
    road, bump = real(25.0), parse_feature("bump", "0.9x0.05", placed=False)
    drive = driven(twin, road)
    found = felt_road(drive, twin, [bump], twin.datum)
    assert [f.at for f in found.features] == [FIRST_AT] and len(found.passes) == 1
    assert found.heading == pytest.approx(2.3, abs=0.02)
    laid = make_road(80.0, features=found.features, x=found.x, y=found.y, heading=found.heading)
    np.testing.assert_allclose(laid.uv_to_xy(FIRST_AT + 0.45, 0.0), road.uv_to_xy(25.45, 0.0), atol=0.5)
    # and there a calibration finds the pass
    observed = observe(drive, twin, laid)
    at = observed.position[np.argmax(np.abs(observed.measured["pitch_rate"]))]
    assert abs(at - FIRST_AT) < 4.0 and place(observed, twin) is None


def test_two_bumps_at_an_unknown_distance(twin: Twin) -> None:
    bump = parse_feature("bump", "0.9x0.05", placed=False)
    for drive in (
        driven(twin, real(20.0, 31.5)),
        replace(driven(twin, real(20.0, 31.5)), fix=FixData.empty()),
    ):
        found = felt_road(drive, twin, [bump, bump], twin.datum if len(drive.fix) else None)
        first, second = (f.at for f in found.features)
        assert first == FIRST_AT and second - first == pytest.approx(11.5, abs=3.0 * found.places)
        assert found.places < 0.5


def test_what_was_not_felt_is_said(twin: Twin) -> None:
    bump = parse_feature("bump", "0.9x0.05", placed=False)
    drive = driven(twin, real(25.0))
    with pytest.raises(InputError, match="was felt 1 times"):
        felt_road(drive, twin, [bump, bump], twin.datum)
    with pytest.raises(
        InputError, match=r"bump 0.9x0.05 was felt 0 times: check its size and the twin's imu.rpy"
    ):
        felt_road(driven(twin, make_road(70.0, iso="A")), twin, [bump], twin.datum)


def test_the_command(
    twin: Twin, repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_drive(driven(twin, real(25.0)), tmp_path / "drive")
    given = str(repository / "bags" / "bump_15kmh" / "twin.yaml")
    command = ["road", "make", "--felt", str(tmp_path / "drive"), "--out", str(tmp_path / "road.crg")]
    assert main([*command, "--hump", "0.9x0.05"]) == 2
    assert "--twin" in capsys.readouterr().err
    assert main([*command, "--twin", given, "--iso", "A"]) == 2
    assert "needs the size of a bump" in capsys.readouterr().err
    assert main([*command, "--twin", given, "--bump", "0.9x0.05"]) == 0
    said = capsys.readouterr().out
    assert "felt 9.5 s after" in said and "at 18 km/h" in said and "datum: {latitude: 47.4025" in said
    taped = taped_features(tmp_path / "road.crg")
    assert taped is not None and [f.at for f in taped.features] == [FIRST_AT]
    assert load_road(tmp_path / "road.crg").headings[0] == pytest.approx(2.3, abs=0.02)
    assert main(["road", "make", "--bump", "0.9x0.05", "--out", str(tmp_path / "nowhere.crg")]) == 2
    assert "@U" in capsys.readouterr().err
