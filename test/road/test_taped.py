# SPDX-License-Identifier: Apache-2.0
"""A road file says that its bumps were measured by tape, and how the road is where the tape was wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from suspension_twin.cli.main import main
from suspension_twin.road import load_road
from suspension_twin.road.recipe import Kind, Taped, make_road, parse_feature, taped_features

SHAPES: tuple[tuple[Kind, str], ...] = (
    ("bump", "0.9x0.05@20"),
    ("hump", "0.9x0.05@20"),
    ("hump", "1.2x0.08x0.6@20:left"),
    ("plank", "0.2x0.045@20:-1.5..1.5"),
    ("pothole", "0.6x0.07@20:right"),
    ("ramp", "4x0.3@20"),
)


@pytest.mark.parametrize(("kind", "text"), SHAPES)
def test_the_file_says_what_was_taped(
    kind: Kind, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = ["road", "make", f"--{kind}", text, "--length", "50", "--out"]
    assert main([*made, str(tmp_path / "taped.crg")]) == 0
    assert taped_features(tmp_path / "taped.crg") == Taped((parse_feature(kind, text),))
    assert main([*made, str(tmp_path / "two.crg"), "--bump", "1x0.06@40.125", "--tape", "0.01"]) == 0
    taped = taped_features(tmp_path / "two.crg")
    assert taped is not None and taped.sizes == 0.01
    assert {str(f) for f in taped.features} == {f"{kind} {text}", "bump 1x0.06@40.125"}
    assert main([*made, str(tmp_path / "surveyed.crg"), "--tape", "0"]) == 0
    assert taped_features(tmp_path / "surveyed.crg") is None
    np.testing.assert_array_equal(load_road(tmp_path / "surveyed.crg").z, load_road(tmp_path / "taped.crg").z)


def test_a_surveyed_road_has_nothing_taped(repository: Path) -> None:
    assert taped_features(repository / "bags" / "bump_15kmh" / "road.crg") is None


@pytest.mark.parametrize(("kind", "text"), SHAPES)
def test_the_road_where_the_tape_was_wrong(kind: Kind, text: str) -> None:
    feature = parse_feature(kind, text)
    taped = Taped((feature, parse_feature("bump", "1x0.06@40")))
    road = make_road(50.0, features=taped.features)
    names = [name for name, _ in taped.errors]
    assert names == ["tape.0.height", "tape.0.length", "tape.1.height", "tape.1.length", "tape.1.place"]

    def differs(name: str, metres: float) -> np.ndarray:
        return taped.changed(road, np.array([metres * (n == name) for n in names])).z - road.z

    np.testing.assert_array_equal(differs("tape.0.height", 0.0), 0.0)
    higher = differs("tape.0.height", 0.004)
    assert np.abs(higher).max() == pytest.approx(0.004, abs=1e-5)
    assert np.sign(higher[np.abs(higher) > 1e-6]).min() == (-1 if kind == "pothole" else 1)
    longer = differs("tape.0.length", 0.02)
    middle = round((20.0 + 0.5 * feature.size[0]) / 0.02)
    assert np.abs(longer).max() > 5e-4 and np.abs(longer[middle]).max() < 0.1 * np.abs(longer).max()
    assert np.abs(longer[1500:]).max() < 1e-6
    nearer = differs("tape.1.place", -0.1)
    assert np.abs(nearer[:1500]).max() == 0.0 and nearer[1999].max() > 0.01 and nearer[2045].min() < -0.01


def test_a_longer_bump_is_the_bump_of_that_length() -> None:
    said, real = (
        make_road(40.0, features=[parse_feature("bump", t)]) for t in ("0.9x0.05@20", "0.92x0.056@19.99")
    )
    found = Taped((parse_feature("bump", "0.9x0.05@20"),)).changed(said, np.array([0.006, 0.02]))
    np.testing.assert_allclose(found.z, real.z, atol=2e-4)
