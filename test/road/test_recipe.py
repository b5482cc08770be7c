# SPDX-License-Identifier: Apache-2.0
"""Roads made of numbers on the command line, and classes told with single events apart."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from suspension_twin.cli.main import main
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import half_sine, load_road, trapezoid
from suspension_twin.road.roughness import CLASSES, iso8608_road, profile_roughness
from suspension_twin.vehicle.twin import load_twin


def test_features_lie_where_they_were_put(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "road.crg"
    command = ["road", "make", "--out", str(out), "--length", "100", "--at", "10", "20", "90"]
    command += ["--bump", "0.9x0.05@40", "--pothole", "0.6x0.08@60:left", "--pothole", "1x0.05@70:-1..-0.5"]
    command += ["--hump", "3x0.1x1@20", "--hump", "2x0.08@30", "--ramp", "10x0.5@80"]
    assert main(command) == 0
    assert capsys.readouterr().out.startswith(f"Writes {out}\n")
    road = load_road(out)
    assert (road.x[0], road.y[0], road.x[-1], road.y[-1]) == pytest.approx((10, 20, 10, 120))
    at = {"start": 5.0, "table": 21.5, "round": 31.0, "bump": 40.45, "hole": 60.3, "top": 95.0}
    left, right = (road.heights_uv(list(at.values()), v) for v in (0.75, -0.75))
    np.testing.assert_allclose(left, [0, 0.1, 0.08, 0.05, -0.08, 0.5], atol=1e-4)
    np.testing.assert_allclose(right, [0, 0.1, 0.08, 0.05, 0, 0.5], atol=1e-4)
    np.testing.assert_allclose(road.heights_uv(70.5, [-0.4, -0.7, -1.1]), [0, -0.05, 0], atol=1e-6)


@pytest.mark.parametrize("place", [(47.4025, 19.284, 90.0), (-33.9, 151.2, 0.0), (0.0, -0.5, -135.0)])
def test_a_bump_lies_on_the_map_where_it_was_measured(
    place: tuple[float, float, float], tmp_path: Path, capsys: pytest.CaptureFixture[str], repository: Path
) -> None:
    latitude, longitude, heading = place
    out = tmp_path / "bump.crg"
    command = ["road", "make", "--bump", "0.9x0.05@20", "--length", "60", "--out", str(out)]
    assert main([*command, "--at", ",".join(map(str, place))]) == 0
    said = capsys.readouterr().out
    twin = (repository / "bags" / "bump_15kmh" / "twin.yaml").read_text()
    line = re.search(r"datum: \{.*\}", said)
    assert line is not None
    twin = re.sub(r"(?m)^datum:.*$", line[0], twin)
    (tmp_path / "twin.yaml").write_text(re.sub(r"(?m)^road:.*$", "road: {file: bump.crg}", twin))
    datum = load_twin(tmp_path / "twin.yaml").datum
    assert datum is not None
    road = load_road(out)
    bump = np.array([v * 1.0 for v in road.uv_to_xy(20.45, 0.0)])
    east, north = 20.45 * np.cos(np.radians(heading)), 20.45 * np.sin(np.radians(heading))
    np.testing.assert_allclose(bump, [east, north], atol=1e-6)
    metre = 180.0 / np.pi / 6.3781e6
    where = LocalMap(datum).to_geodetic([*bump, 0.0])
    assert where[0] == pytest.approx(latitude + north * metre, abs=0.2 * metre)
    assert where[1] == pytest.approx(longitude + east * metre / np.cos(np.radians(latitude)), abs=0.2 * metre)
    said_at = re.search(r"bump at u 20 m: (\S+), (\S+)", said)
    assert said_at is not None
    np.testing.assert_allclose([float(v) for v in said_at.groups()], where[:2], atol=0.6 * metre)
    assert f"bearing of {(90.0 - heading) % 360.0:.1f} deg" in said


def test_features_and_a_class_add_up(tmp_path: Path) -> None:
    made = ["road", "make", "--iso", "C", "--seed", "3", "--length", "60", "--out"]
    assert main([*made, str(tmp_path / "plain.crg")]) == 0
    assert main([*made, str(tmp_path / "both.crg"), "--bump", "0.9x0.05@40"]) == 0
    plain, both = (load_road(tmp_path / f"{name}.crg") for name in ("plain", "both"))
    bump = np.tile(half_sine(0.9, 0.05)(plain.u - 40.0)[:, None], plain.v.size)
    np.testing.assert_allclose(both.z - plain.z, bump, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give --iso, or one of --bump"),
        (["--iso", "C", "--at", "91,19,0"], "--at: '91,19,0' is no LAT,LON,HEADING in degrees"),
        (["--iso", "C", "--at", "47,19"], "--at: '47,19' is no LAT,LON,HEADING in degrees"),
        (["--iso", "C", "--at", "47,east,nan"], "--at: '47,east,nan' is no LAT,LON,HEADING"),
        (["--bump", "0.9@40"], "--bump: needs LENGTHxHEIGHT@U, not '0.9@40'"),
        (["--bump", "0.9x0.05"], "--bump: is written"),
        (["--bump", "0.9xa@40"], "--bump: 'a' is not a number"),
        (["--bump", "0.9x0.05@400"], "off the road"),
        (["--pothole", "1x-0.05@40"], "--pothole: the depth must be above 0"),
        (["--pothole", "1x0.05@40:top"], "--pothole: a side is left, right or LOW..HIGH"),
        (["--pothole", "1x0.05@40:1..-1"], "the second v must be above the first"),
        (["--ramp", "10x0.5@195"], "--ramp: 195 to 205 m is off the road"),
        (["--iso", "Q"], "one letter from A to H"),
        (["--iso", "C", "--length", "-5"], "--length: must be above 0"),
        (["--iso", "C", "--step", "1e-9"], "too many cross sections"),
    ],
)
def test_bad_numbers_are_one_line(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["road", "make", *arguments, "--out", str(tmp_path / "a.crg")]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("letter", ["A", "B", "C", "E"])
def test_events_do_not_change_the_class(letter: str) -> None:
    plain = iso8608_road(letter, 300.0, width=2.0, v_step=1.0, seed=CLASSES.index(letter))
    assert profile_roughness(plain.z[:, 0], plain.u_step).events == ()
    scale = 2.0 ** CLASSES.index(letter)  # a rougher road hides more
    events = ((half_sine(1.0, -0.04), 60.0), (half_sine(0.6, 0.03), 90.0), (trapezoid(20, 0.4, 1.0), 150.0))
    z = plain.z[:, 0] + sum(scale * shape(plain.u - at) for shape, at in events)
    found = profile_roughness(z, plain.u_step, 1000.0)
    assert found.letter == letter
    assert found.letter_with_events > letter
    for _, at in events:
        assert any(e.start - 0.3 <= 1000.0 + at <= e.start + 1.5 for e in found.events), at
    assert found.g0 == pytest.approx(profile_roughness(plain.z[:, 0], plain.u_step).g0, rel=0.25)


@pytest.mark.parametrize("length", ["30", "200"])
@pytest.mark.parametrize(
    ("feature", "height"), [(("--bump", "1x0.1@20"), 0.1), (("--pothole", "0.8x0.05@12:left"), -0.05)]
)
def test_a_level_road_has_events(
    feature: tuple[str, str], height: float, length: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Although it has no spectrum and so no class."""
    road, record = tmp_path / "road.crg", tmp_path / "road.json"
    assert main(["road", "make", *feature, "--length", length, "--out", str(road)]) == 0
    made = capsys.readouterr().out
    assert main(["road", "check", str(road), "--out", str(record)]) == 0
    checked = capsys.readouterr().out
    place = float(feature[1].partition("@")[2].partition(":")[0])
    left, right = json.loads(record.read_text())["wheel_paths"]
    (event,) = left["events"]
    assert event["height"] == pytest.approx(height, abs=0.005) and event["start"] == pytest.approx(
        place, abs=0.3
    )
    assert len(right["events"]) == ("left" not in feature[1])
    for said in (made, checked):
        assert f"{1e3 * abs(height):.0f} mm {'high' if height > 0 else 'deep'}" in said
    assert left["iso8608"] is None and "left not defined" in made


def test_check_tells_both_classes_and_the_index(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    road, record = tmp_path / "road.crg", tmp_path / "road.json"
    assert main(["road", "make", "--iso", "B", "--ramp", "20x1@60", "--pothole", "1x0.1@120:left",
                 "--out", str(road)]) == 0  # fmt: skip
    capsys.readouterr()
    assert main(["road", "check", str(road), "--out", str(record)]) == 0
    assert "left ISO 8608 class B" in capsys.readouterr().out
    left, right = json.loads(record.read_text())["wheel_paths"]
    assert (left["iso8608"], right["iso8608"]) == ("B", "B")
    assert left["iso8608_with_events"] > "B"
    assert any(abs(e["start"] - 120.0) < 0.5 and e["height"] < -0.08 for e in left["events"])
    assert not any(abs(e["start"] - 120.0) < 0.5 for e in right["events"])
    assert 0.003 < right["iri"] < left["iri"] < 0.03
