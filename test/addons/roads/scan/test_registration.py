# SPDX-License-Identifier: Apache-2.0
"""A cloud in coordinates of its own finds its place on a drive, or one line says why not."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from suspension_twin.addons.roads.scan.clouds import Georeference
from suspension_twin.arrays import Floats
from suspension_twin.cli.main import main
from suspension_twin.road import load_road

BAGS = Path(__file__).resolve().parents[4] / "bags"


def cloud_of(
    bag: str,
    file: Path,
    turn: float,
    move: tuple[float, float],
    ends: tuple[float, float],
    unit: float = 1.0,
) -> None:
    """The bundled road of a drive with a kerb on its left and grass on its right, turned and moved, as text."""
    road, rng = load_road(BAGS / bag / "road.crg"), np.random.default_rng(5)
    u, v = rng.uniform(*ends, 150_000), rng.uniform(-5.0, 5.0, 150_000)
    edge = 0.5 * road.width - 0.01
    inner = np.clip(v, -edge, edge)
    x, y = road.uv_to_xy(u, inner)
    ahead = road.uv_to_xy(u + 0.01, inner)
    heading = np.arctan2(ahead[1] - y, ahead[0] - x)
    x, y = x - np.sin(heading) * (v - inner), y + np.cos(heading) * (v - inner)
    z = road.heights_uv(u, inner) + 0.12 * (v > 3.5) + (v < -3.0) * rng.exponential(0.06, u.size)
    c, s = math.cos(turn), math.sin(turn)
    points = np.column_stack([c * x - s * y + move[0], s * x + c * y + move[1], z + 40.0])
    np.savetxt(file, (points + rng.normal(0.0, 0.003, points.shape)) / unit, fmt="%.3f")


def scan(tmp_path: Path, bag: str, *more: str) -> int:
    return main(
        [
            *("road", "scan", str(tmp_path / "own.xyz"), "--path", str(BAGS / bag)),
            *("--twin", str(BAGS / bag / "twin.yaml"), "--out", str(tmp_path / "road.crg"), "--fit", *more),
        ]
    )


@pytest.mark.long
def test_the_cloud_is_placed_where_the_drive_was(tmp_path: Path) -> None:
    true = load_road(BAGS / "crg_road" / "road.crg")
    cloud_of("crg_road", tmp_path / "own.xyz", 2.1, (310.0, -85.0), (true.u_first, true.u_last - 0.02))
    assert scan(tmp_path, "crg_road", "--width", "3", "--section", "5", "60") == 0
    (words,) = {c["placing"] for c in json.loads((tmp_path / "road.json").read_text())["clouds"]}
    assert words.startswith("fitted to the drive: turned by -120.")
    found = load_road(tmp_path / "road.crg")
    places = found.uv_to_xy(np.linspace(2.0, found.length - 2.0, 300), np.full(300, 0.7))
    difference = found.heights(*places) - true.heights(*places)
    # by as much as a road of these slopes differs where the place is off by 0.2 m
    assert np.std(difference) < 0.35 * np.std(true.heights(*places))


@pytest.mark.long
def test_a_cloud_in_feet_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And of a drive that goes on beyond it, the part on the cloud is enough."""
    true = load_road(BAGS / "crg_road" / "road.crg")
    cloud_of("crg_road", tmp_path / "own.xyz", -0.7, (31.0, 8.0), (true.u_first, 0.7 * true.u_last), 0.3048)
    assert scan(tmp_path, "crg_road") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "own.xyz: fits the drive crg_road in feet and not in metres: give --unit ft" in said


@pytest.mark.long
def test_one_bump_could_have_been_driven_either_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud_of("bump_15kmh", tmp_path / "own.xyz", 0.4, (3.0, 8.0), (20.0, 60.0))
    assert scan(tmp_path, "bump_15kmh") == 2
    assert "in several places alike" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("heights", "words"),
    [
        (lambda x, y: 0.0 * x, "fits the drive crg_road nowhere"),
        (lambda x, y: np.sin(40.0 * x) * np.sin(30.0 * y), "holds no 20 m of ground"),
    ],
)
def test_ground_that_was_not_driven_is_one_line(
    heights: object, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x, y = np.random.default_rng(0).uniform([0.0, 0.0], [60.0, 5.0], (20_000, 2)).T
    z = heights(x, y) + np.random.default_rng(1).normal(0.0, 0.003, x.size)  # type: ignore[operator]
    np.savetxt(tmp_path / "own.xyz", np.column_stack([x, y, z]), fmt="%.3f")
    assert scan(tmp_path, "crg_road") == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_fit_needs_a_drive_and_no_crs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savetxt(tmp_path / "own.xyz", np.zeros((3, 3)))
    (tmp_path / "line.csv").write_text("x,y\n0,0\n9,0\n")
    command = ["road", "scan", str(tmp_path / "own.xyz"), "--out", str(tmp_path / "road.crg"), "--fit"]
    assert main([*command, "--path", str(tmp_path / "line.csv")]) == 2
    assert "--fit: needs a recorded drive" in capsys.readouterr().err
    assert main([*command, "--path", str(BAGS / "crg_road"), "--crs", "EPSG:25832"]) == 2
    assert "--fit: cannot be given with --crs" in capsys.readouterr().err
    tracked = BAGS.parent / "config" / "tracked" / "pt91.yaml"
    assert main([*command, "--path", str(BAGS / "crg_road"), "--twin", str(tracked)]) == 2
    assert "drives on one, tracked does not" in " ".join(capsys.readouterr().err.split())


@given(
    turn=st.floats(-4.0, 4.0),
    move=st.tuples(st.floats(-900.0, 900.0), st.floats(-900.0, 900.0)),
    points=st.lists(st.tuples(*[st.floats(-500.0, 500.0)] * 3), min_size=1, max_size=9),
)
def test_what_lies_along_the_path_lies_in_its_box(
    turn: float, move: tuple[float, float], points: list[tuple[float, float, float]]
) -> None:
    own_frame, own = Georeference(unit=0.5, turn=turn, move=move), np.array(points)
    placed: Floats = own_frame.to_map(own)
    far = np.hypot(*(placed[:, None, :2] - placed[None, :, :2]).T)
    np.testing.assert_allclose(far, 0.5 * np.hypot(*(own[:, None, :2] - own[None, :, :2]).T), atol=1e-9)
    box = own_frame.box(placed[:, 0], placed[:, 1], 0.01)
    assert len(own_frame.within(own, box)) == len(own)
