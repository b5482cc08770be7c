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


@pytest.mark.long
def test_calibrate_writes_a_twin_and_a_page(files: tuple[str, list[str]], tmp_path: Path, capsys) -> None:
    twin, runs = files[0], [str(tmp_path / Path(path).name) for path in files[1]]
    for path, short in zip(
        files[1], runs, strict=True
    ):  # two seconds of each: over the obstacle's first edge
        lines = Path(path).read_text(encoding="utf-8").splitlines()
        Path(short).write_text("\n".join(lines[:101]) + "\n", encoding="utf-8")
    out, report = tmp_path / "calibrated.yaml", tmp_path / "report"
    preset = ["--preset", "tracked_paper", "--max-generations", "1"]
    assert (
        main(["calibrate", "--twin", twin, *runs, "--out", str(out), "--report", str(report), *preset]) == 0
    )
    data = yaml.safe_load(out.read_text(encoding="utf-8"))
    assert data["model"] == "tracked" and 1e5 <= data["vehicle"]["track"]["stiffness"] <= 1e9
    said = capsys.readouterr().out
    assert "track stiffness" in said and "N/m" in said and "idler setting" in said
    page = (report / "report.html").read_text(encoding="utf-8")
    assert "13kmh_1" in page and "track stiffness" in page


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["calibrate", "--preset", "slow"], "one of fast, paper, tracked_paper is expected"),
        (["calibrate", "--preset", "tracked_paper", "--objective", "motion"], "one of euclidean, mse"),
        (["calibrate", "--channel", "roll_rate"], "roll_rate: no such channel: one of marker_A"),
        (["calibrate", "--free", "vehicle.front.spring"], "vehicle.front.spring"),
        (["diagnose", "--effect", "rust"], "--effect: rust: is not an effect"),
    ],
)
def test_what_a_twin_on_tracks_does_not_take(
    files: tuple[str, list[str]], arguments: list[str], word: str, tmp_path: Path, capsys
) -> None:
    twin, runs = files
    status = main([*arguments, "--twin", twin, *runs, "--out", str(tmp_path / "out.yaml")])
    error = capsys.readouterr().err
    assert status == 2 and word in " ".join(error.split()) and "Traceback" not in error


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("markers", {"A": [-1000.0, 587.0], "B": [-1445.0, 620.0], "C": [0.0, 0.0]}, "front to rear"),
        (
            "idler",
            {"height": -0.169, "radius": 0.255, "setting": -5600.0, "taut_at": -5550.0},
            "-5590 and -5550 mm",
        ),
        ("obstacle", {"height": 0.7, "ramp": 4.0, "top": 0.3}, "cannot be passed"),
        ("obstacle", {"height": 0.3, "ramp": 0.1, "top": 0.3}, "steeper than 45 degrees"),
    ],
)
def test_a_twin_that_cannot_be_is_refused_in_a_line(
    files: tuple[str, list[str]], command: str, key: str, value: dict, word: str, tmp_path: Path, capsys
) -> None:
    data = yaml.safe_load(Path(files[0]).read_text(encoding="utf-8"))
    data["vehicle"][key] = value
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    status = main([command, "--twin", str(tmp_path / "twin.yaml"), *files[1], "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert status == 2 and word in error and "twin.yaml" in error
    assert error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_run_that_cannot_be_is_refused_in_a_line(
    files: tuple[str, list[str]], tmp_path: Path, capsys
) -> None:
    lines = Path(files[1][0]).read_text(encoding="utf-8").splitlines()
    shuffled = tmp_path / "13kmh_1.csv"
    shuffled.write_text("\n".join([lines[0], *lines[:0:-1]]), encoding="utf-8")
    status = main(["diagnose", "--twin", files[0], str(shuffled), "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert status == 2 and "13kmh_1.csv" in error and "must rise" in error and error.count("\n") == 1


def test_dampers_are_of_a_twin_on_tracks(repository: Path, capsys) -> None:
    car = str(min((repository / "config" / "twins").glob("*.yaml")))
    assert main(["damping", "--twin", car]) == 2
    assert "the dampers of a tracked vehicle are chosen here" in " ".join(capsys.readouterr().err.split())
    tracked = str(repository / "config" / "tracked" / "pt91.yaml")
    assert main(["damping", "--twin", tracked, "--range", "56", "60"]) == 2
    assert "no speed of 5, 10 ... 55 km/h" in capsys.readouterr().err
