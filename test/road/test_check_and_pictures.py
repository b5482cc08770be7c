# SPDX-License-Identifier: Apache-2.0
"""What ``road check``, ``show`` and ``mesh`` say, draw and write, and how they end."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from suspension_twin.cli.main import main
from suspension_twin.errors import InputError
from suspension_twin.road import (
    Road,
    bump_road,
    circular,
    curved_road,
    flat_road,
    grid_road,
    half_sine,
    write_road,
)
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.check import check_road, on_itself, wheel_paths
from suspension_twin.road.plots import road_figure, save_road_picture
from suspension_twin.road.roughness import iso8608_road


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """sound.crg, spiky.crg with a spike of 0.2 m at u = 20, v = 0.5 m, and broken.crg."""
    folder = tmp_path_factory.mktemp("roads")
    road = iso8608_road("C", 60, seed=4, x=12.0, y=-7.0, heading=0.5)
    write_road(road, folder / "sound.crg")
    z = np.array(road.z)
    z[400, 35] += 0.2
    write_road(replace(road, z=z), folder / "spiky.crg")
    (folder / "broken.crg").write_bytes((folder / "sound.crg").read_bytes()[:-999])
    return folder


TURN = np.linspace(0.0, 2.0 * np.pi, 400)
BACK = np.linspace(0.0, 1.0, 200)[:, None]
#: Lines of roads, and whether one of 3 m and one of 8 m width lies on itself.
LINES = {
    "circle": (np.column_stack([30.0 * np.cos(TURN), 30.0 * np.sin(TURN)]), False, False),
    "more than a lap": (np.column_stack([30.0 * np.cos(1.1 * TURN), 30.0 * np.sin(1.1 * TURN)]), True, True),
    "eight": (np.column_stack([40.0 * np.sin(TURN + 1.0), 20.0 * np.sin(2.0 * TURN + 2.0)]), True, True),
    "there and back beside": (
        np.vstack([
            BACK * [60.0, 0.0],
            [60.0, 3.0] + 3.0 * np.column_stack([np.sin(0.5 * TURN), -np.cos(0.5 * TURN)]),
            [60.0, 6.0] - BACK * [60.0, 0.0],
        ]),
        False,
        True,
    ),
    "bends": (np.column_stack([np.linspace(0.0, 200.0, 400), 8.0 * np.sin(4.0 * TURN)]), False, False),
}  # fmt: skip


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("name", LINES)
def test_a_road_that_lies_on_itself_is_wrong(name: str, wide: bool, tmp_path: Path) -> None:
    points, *lies = LINES[name]
    line = Centreline(points[:, 0], points[:, 1], 0.1)
    half = 4.0 if wide else 1.5
    road = road_over(line, np.zeros((line.x.size, 3)), np.array([-half, 0.0, half]), name)
    places = on_itself(road)
    assert (places is not None) is lies[wide]
    said = [finding for finding in check_road(road).findings if "lies on itself" in finding.text]
    assert [finding.fault for finding in said] == [True] * lies[wide]
    if places is not None:
        apart = np.subtract(*np.transpose(road.uv_to_xy(np.array(places), 0.0)))
        assert np.hypot(*apart) < 2.0 * half + 1.0


def test_check_ends_with_0_1_or_2(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["road", "check", str(folder / "sound.crg")]) == 0
    said = capsys.readouterr()
    assert said.out.rstrip().endswith("sound")
    assert "ISO 8608 class C" in said.out
    assert said.err == ""

    assert main(["road", "check", str(folder / "spiky.crg")]) == 1
    said = capsys.readouterr()
    assert re.search(r"wrong +spike of (19|20)\d mm.* at u 20.00 m, v 0.50 m", said.out)
    assert said.err == ""

    assert main(["road", "check", str(folder / "broken.crg")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "broken.crg: data: 999 bytes are missing" in said.err


def test_check_writes_its_figures(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "found.json"
    assert main(["road", "check", str(folder / "spiky.crg"), "--out", str(out)]) == 1
    record = json.loads(out.read_text())
    assert record["sound"] is False
    assert record["spikes"][0]["u"] == pytest.approx(20.0)
    assert record["spikes"][0]["height"] == pytest.approx(0.2, abs=0.02)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("detrended_rms_course_1in.crg", 1, "a step of 79 mm, at u 391.95 m, v -3.00 to 3.00 m"),
        ("belgian_block.crg", 0, "moves its start from (234.00, 77.72) m, heading 152.0 deg"),
        ("belgian_block.crg", 0, "6.5 % of the heights are missing in the file"),
        ("Horstwalde.crg", 1, "step of 770 mm at u 150.20 m"),
        ("handmade_curved_banked_sloped.crg", 0, "radius down to 90.9 m"),
        ("handmade_arc.crg", 1, "waves shorter than 8 m are missing"),
        ("belgian_block_CORRUPT_5_bytes_lost.crg", 2, "5 bytes are missing"),
        ("handmade_platform.crg", 2, "grid_nan_mode: '2.000000000+e00' is not a number"),
    ],
)
def test_check_of_real_roads(
    shared_data: Path, name: str, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["road", "check", str(next(shared_data.rglob(name)))]) == status
    said = capsys.readouterr()
    assert words in said.out + said.err


def _faults(road: Road) -> str:
    return " | ".join(f.text for f in check_road(road).findings if f.fault)


def test_each_fault_is_found_and_a_sound_road_has_none() -> None:
    assert _faults(bump_road(half_sine(3, 0.1))) == ""
    assert _faults(flat_road(100, 6)) == "a cross section every 100 m: waves shorter than 200 m are missing"
    assert "step of 7" in _faults(bump_road(circular(0.61, 0.305)))
    fine = grid_road(np.zeros((200, 5)), 0.1, np.arange(5.0))
    holes = np.array(fine.z)
    holes[50, 2], holes[60:70, 4] = np.nan, np.nan
    assert "1 of them between data" in _faults(replace(fine, z=holes))
    assert "the reference line climbs up to 40 %" in _faults(fine.with_line(z=0.4 * fine.u))
    assert "banked up to 30 %" in _faults(fine.with_line(bank=np.full(200, 0.3)))
    tight = curved_road(grid_road(np.zeros((200, 5)), 0.1, np.linspace(-1, 1, 5)), 0.5)
    assert "centre of a bend" in _faults(replace(tight, v=3 * tight.v))
    assert "the OpenCRG library warns: it" in _faults(replace(fine, notes=("it",)))


def test_figures_are_the_roads() -> None:
    road = curved_road(grid_road(np.zeros((301, 5)), 0.1, np.linspace(-1, 1, 5)), 0.02)
    road = road.with_line(z=0.05 * road.u, bank=np.linspace(0, 0.02, 301))
    facts = check_road(road).facts
    assert facts["slope"] == "5.00 to 5.00 %"
    assert facts["banking"] == "0.00 to 2.00 %"
    assert facts["curvature"] == "radius down to 50.0 m"
    assert facts["length"] == "30.00 m, 301 cross sections every 0.1 m"
    assert facts["width"] == "2.00 m (v -1 to 1 m), 5 long sections every 0.5 m"


def test_wheel_tracks_run_about_the_middle() -> None:
    road = grid_road(np.ones((20, 1)) * np.linspace(-3, 3, 7), 0.1, np.linspace(-3, 3, 7))
    (left_v, right_v), left, right = wheel_paths(road, 1.6)
    assert (left_v, right_v) == (0.8, -0.8)
    assert left == pytest.approx(0.8)
    assert right == pytest.approx(-0.8)
    one_side = grid_road(np.zeros((20, 3)), 0.1, [0.0, 1.0, 2.0])
    assert wheel_paths(one_side, 1.6)[0] == (1.5, 0.5)


def test_a_picture_shows_what_it_says(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "road.png"
    assert main(["road", "show", str(folder / "spiky.crg"), "--out", str(picture)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Writes {picture}\n")
    assert "IRI: left " in said
    pixels = matplotlib.image.imread(picture)[..., :3]
    assert pixels.shape == (1380, 1950, 3)
    assert 0.05 < (pixels.min(axis=2) < 0.8).mean() < 0.7

    figure = road_figure(check_road(iso8608_road("C", 60, seed=4)))
    heights, tracks, spectrum, place = figure.axes[:4]
    assert "Height map" in heights.get_title(loc="left")
    left = tracks.lines[1]
    road = iso8608_road("C", 60, seed=4)
    np.testing.assert_allclose(left.get_ydata(), 1e3 * road.heights_uv(road.u, 0.75), atol=1e-9)
    assert spectrum.get_xscale() == spectrum.get_yscale() == "log"
    assert {t.get_text() for t in spectrum.texts} >= set("ABCDE")
    assert place.get_aspect() == 1.0


@pytest.mark.parametrize(
    "road",
    [
        flat_road(),
        bump_road(circular(3, -0.1), length=8, at=2.0),
        grid_road(np.where(np.eye(30, 4) > 0, np.nan, 0.3), 0.1, [0.0, 0.1, 0.5, 0.9]),
        curved_road(grid_road(np.random.default_rng(0).normal(0, 3, (500, 3)), 0.1, [0.0, 1.0, 2.0]), 0.05),
    ],
    ids=["plane", "dip", "holes", "mountains"],
)
@pytest.mark.filterwarnings("error")
def test_any_road_can_be_drawn(road: Road, tmp_path: Path) -> None:
    save_road_picture(road, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_mesh_command(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "m.obj"
    command = ["road", "mesh", str(folder / "sound.crg"), "--out", str(out), "--up", "y", "--origin", "start"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "144000 triangles, start of the road at 12.000 -7.000 0.000 in map" in said
    text = out.read_text()
    assert text.count("\nf ") == 144000
    assert "# shift taken off the places in map: 12.0 -7.0 0.0" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["show", "none.crg"], "none.crg: no such file"),
        (["show", "ROAD", "--out", "a.gif"], "written as .png, .svg or .pdf"),
        (["mesh", "ROAD", "--out", "a.fbx"], "written as .stl or .obj"),
        (["mesh", "ROAD", "--spacing", "-1"], "--spacing"),
        (["check"], "ROAD"),
    ],
)
def test_unusable_arguments_end_with_2_and_one_line(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["road", *(str(folder / "sound.crg") if a == "ROAD" else a for a in arguments)]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_results_lie_in_the_current_folder_unless_told(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["road", "show", str(folder / "sound.crg")]) == 0
    assert main(["road", "mesh", str(folder / "sound.crg"), "--spacing", "1"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sound.obj", "sound.png"]
    with pytest.raises(InputError, match="picture"):
        save_road_picture(flat_road(), tmp_path / "a.txt")
