# SPDX-License-Identifier: Apache-2.0
"""The command line with a twin on tracks."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from suspension_twin.cli.main import main


@pytest.fixture
def files(repository: Path) -> tuple[str, list[str]]:
    folder = repository / "config" / "tracked"
    return str(folder / "pt91.yaml"), [str(folder / "runs" / f"13kmh_{i}.csv") for i in (1, 2)]


def test_calibrate_writes_a_twin_and_a_page(files: tuple[str, list[str]], tmp_path: Path, capsys) -> None:
    twin, runs = files
    out, report = tmp_path / "calibrated.yaml", tmp_path / "report"
    preset = ["--preset", "tracked_paper", "--max-generations", "1"]
    assert main(["calibrate", "--twin", twin, *runs, "--out", str(out), "--report", str(report), *preset]) == 0
    data = yaml.safe_load(out.read_text(encoding="utf-8"))
    assert data["model"] == "tracked" and 1e5 <= data["vehicle"]["track"]["stiffness"] <= 1e9
    said = capsys.readouterr().out
    assert "0.94 and 0.87" in said and "says nothing of amplitude" in said
    assert "Fig. 12" in (report / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["calibrate", "--preset", "paper"], "a twin on tracks takes tracked_paper"),
        (["calibrate", "--preset", "tracked_paper", "--objective", "mse"], "one of correlation, amplitude, motion"),
    ],
)
def test_what_a_twin_on_tracks_does_not_take(
    files: tuple[str, list[str]], arguments: list[str], word: str, tmp_path: Path, capsys
) -> None:
    twin, runs = files
    status = main([*arguments, "--twin", twin, *runs, "--out", str(tmp_path / "out.yaml")])
    error = capsys.readouterr().err
    assert status == 2 and word in " ".join(error.split()) and "Traceback" not in error


def test_dampers_are_of_a_twin_on_tracks(repository: Path, capsys) -> None:
    car = str(min((repository / "config" / "twins").glob("*.yaml")))
    assert main(["damping", "--twin", car]) == 2
    assert "the dampers of a tracked vehicle are chosen here" in " ".join(capsys.readouterr().err.split())
    tracked = str(repository / "config" / "tracked" / "pt91.yaml")
    assert main(["damping", "--twin", tracked, "--range", "56", "60"]) == 2
    assert "no speed of 5, 10 ... 55 km/h" in capsys.readouterr().err
