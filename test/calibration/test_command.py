# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin calibrate``: its options, its files, its page, and its words for what cannot be."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from suspension_twin.calibration.output import details_path
from suspension_twin.cli.main import main
from suspension_twin.models.parameters import twin_value
from suspension_twin.vehicle.twin import load_twin


def asked(case: Any, out: Path, *more: str) -> list[str]:
    return ["calibrate", "--twin", case.twin, case.bag("pass"), "--out", str(out), *more]


def test_every_option_reaches_the_calibration(
    pass_case: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "found" / "calibrated.yaml"
    status = main(
        asked(
            pass_case,
            out,
            "--objective",
            "mse",
            "--channel",
            "vertical_acceleration=2",
            "--channel",
            "pitch_rate=30",
            "--free",
            "vehicle.front.damper_push",
            "--free",
            "vehicle.rear.damper_pull",
            "--also",
            "vehicle.sprung_inertia.pitch",
            "--freeze",
            "vehicle.front.damper_push.force.3",
            "--freeze",
            "nuisances.gain",
            "--freeze",
            "nuisances.bias",
            "--bound",
            "vehicle.sprung_inertia.pitch=2000:3000",
            "--seed",
            "3",
            "--report",
            str(tmp_path / "page"),
        )
    )
    said = capsys.readouterr()
    assert status == 0, said.err
    assert said.out.startswith(f"Writes {out}, {details_path(out)}, ")
    assert "Parameters found" in said.out and str(out) in said.out
    details = yaml.safe_load(details_path(out).read_text())
    keys = [p["key"] for p in details["parameters"]]
    assert len(keys) == 3 + 4 + 1 and "vehicle.front.damper_push.force.3" not in keys
    (inertia,) = (p for p in details["parameters"] if p["key"].endswith("inertia.pitch"))
    assert inertia["bounds"] == [2000.0, 3000.0] and 2000.0 <= inertia["value"] <= 3000.0
    names = {n["name"] for n in details["nuisances"]}
    assert "gain" not in names and not any(".bias." in n for n in names)
    assert {"map_position", "tilt_roll", "tilt_pitch", "pass.clock_offset"} <= names
    assert (details["seed"], details["objective"]) == (3, "mse")
    start, found = load_twin(pass_case.twin), load_twin(out)
    assert found.vehicle.front.spring == start.vehicle.front.spring
    assert found.vehicle.front.damper_push.force[3] == start.vehicle.front.damper_push.force[3]
    assert details["cost"] < 0.5 * details["initial_cost"]
    page = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    for words in (
        "Result",
        "Characteristics",
        "Parameters",
        "Nuisances",
        "The search",
        "90 % interval",
    ):
        assert words in page
    assert not list((tmp_path / "found").glob(".*"))


def test_the_estimate_lies_within_its_interval_and_centrally_where_identified(
    pass_case: Any, tmp_path: Path
) -> None:
    out = tmp_path / "calibrated.yaml"
    assert main(asked(pass_case, out, "--objective", "euclidean")) == 0
    rows = yaml.safe_load(details_path(out).read_text())["parameters"]
    # a valley's end, where the objective found the value, is also its interval's
    assert all(p["interval_90"][0] <= p["value"] <= p["interval_90"][1] for p in rows)
    assert all(p["interval_90"][0] < p["interval_90"][1] for p in rows)
    sure = [p for p in rows if p["status"] == "identified"]
    assert len(sure) >= 4
    place = np.array([(p["value"] - p["interval_90"][0]) / np.ptp(p["interval_90"]) for p in sure])
    assert np.mean((place > 0.03) & (place < 0.97)) > 0.8 and 0.2 < np.median(place) < 0.8


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--preset", "slow"), "preset: slow: one of fast, paper, tracked_paper is expected"),
        (("--bound", "vehicle.mass=1"), "--bound: vehicle.mass=1: must read KEY=LOW:HIGH"),
        (("--bound", "vehicle.mass=1:2"), "bounds: vehicle.mass: is not free"),
        (("--channel", "pitch_rate=x"), "--channel: pitch_rate=x: must read NAME or NAME=WEIGHT"),
        (("--channel", "noise"), "objective: noise: no such channel"),
        (("--objective", "nearest"), "objective: nearest: one of euclidean"),
        (("--free", "vehicle.wings"), "vehicle.wings"),
        (("--freeze", "vehicle.foo"), "vehicle.foo: no such key in the twin file (name, mass, "),
        (
            ("--freeze", "vehicle.front.damper_psh"),
            "did you mean damper_push?",
        ),
        (("--freeze", "vehicle.front"), "vehicle.front: is not a number of the twin file"),
        (
            ("--bound", "vehicle.rear.damper_pul.force.0=1:2"),
            "did you mean vehicle.rear.damper_pull.force.0?",
        ),
        (("--preset", "fats"), "is expected, did you mean fast?"),
        (("--freeze", "nuisances.luck"), "freeze: nuisances.luck: one of nuisances.clock_offset"),
    ],
)
def test_wrong_options_are_one_line(
    pass_case: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], words: str
) -> None:
    out = tmp_path / "calibrated.yaml"
    assert main(asked(pass_case, out, *more)) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("suspension-twin: ") and words in line
    assert not out.exists()


@pytest.mark.long
def test_the_bundled_drive_gives_the_inertia_and_intervals_around_what_was_found(
    repository: Path, tmp_path: Path
) -> None:
    """Another reality than the twin's: the truth has effects that the model lacks. The drive hardly rolls."""
    bag = repository / "bags" / "bump_15kmh"
    out = tmp_path / "calibrated.yaml"
    assert main(["calibrate", "--twin", str(bag / "twin.yaml"), str(bag), "--out", str(out)]) == 0
    details = yaml.safe_load(details_path(out).read_text())
    assert (
        details["explained_variance"]["held_out"] == "passes" and details["explained_variance"]["twin"] > 0.8
    )
    rows = {p["key"]: p for p in details["parameters"]}
    true = load_twin(bag / "truth.yaml").vehicle
    found = load_twin(out).vehicle
    assert found.sprung_inertia.pitch == pytest.approx(true.sprung_inertia.pitch, rel=0.05)
    low, high = rows["vehicle.sprung_inertia.pitch"]["interval_90"]
    assert low <= true.sprung_inertia.pitch <= high
    roll = rows["vehicle.sprung_inertia.roll"]
    assert roll["status"] == "kept" and found.sprung_inertia.roll == roll["start"] == 550.0
    spans = {r["curve"]: (r["from"], r["to"]) for r in details["excited_ranges"]}
    following = set()
    for key, row in rows.items():
        curve, _, index = key.rpartition(".force.")
        if row["status"] in ("interpolated", "extrapolated"):
            low, high = spans[curve]
            reached = low <= twin_value(load_twin(out), curve).points[0][int(index)] <= high
            assert row["status"] == ("interpolated" if reached else "extrapolated"), key
            following.add(reached)
    assert following == {True, False}
    (kept,) = [w for w in details["warnings"] if w.startswith("kept at their start")]
    assert re.search(r"sprung inertia roll at 4\d\d kg m², rear linkage recession at 0[.]\d+;", kept)
    inner = [p for p in rows.values() if p["value"] not in p["bounds"]]
    assert len(inner) > 30
    place = [(p["value"] - p["interval_90"][0]) / np.ptp(p["interval_90"]) for p in inner]
    assert min(place) > 0.02 and max(place) < 0.98


def test_what_is_written_is_said_once_the_input_is_known_to_be_usable(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = repository / "bags" / "bump_15kmh" / "twin.yaml"
    bare = tmp_path / "bare.yaml"
    bare.write_text(re.sub(r"(?m)^road:.*$", "", twin.read_text(encoding="utf-8")), encoding="utf-8")
    for given, bag in ((twin, tmp_path / "nothing"), (bare, repository / "bags" / "bump_15kmh")):
        for command in ("calibrate", "diagnose"):
            out = tmp_path / f"{command}.yaml"
            assert main([command, "--twin", str(given), str(bag), "--out", str(out)]) in (1, 2)
            assert capsys.readouterr().out == "", command
