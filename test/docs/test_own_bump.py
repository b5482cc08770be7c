# SPDX-License-Identifier: Apache-2.0
"""The page "Your own car, your own bump" goes through on the bundled drive of a phone, command by command."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from suspension_twin.cli.main import main
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import load_twin


def commands(repository: Path) -> list[list[str]]:
    """Those of the bundled drive."""
    page = (repository / "docs" / "own_bump.md").read_text(encoding="utf-8")
    block = re.search(r"## The bundled drive.*?```bash\n(.*?)```", page, re.DOTALL)
    assert block is not None
    return [shlex.split(line)[1:] for line in block[1].splitlines()]


@pytest.fixture
def folder(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "bags").symlink_to(repository / "bags")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_road_and_a_twin(repository: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands(repository)[:2]:
        assert main(command) == 0
    assert capsys.readouterr().out.count("at 15 km/h") == 3
    twin = load_twin(folder / "my_car.yaml")
    assert twin.road is not None and twin.datum is not None
    road, real = load_road(twin.road.file), load_road(repository / "bags" / "bump_15kmh" / "road.crg")
    assert road.headings[0] == pytest.approx(real.headings[0], abs=0.1)


@pytest.mark.long
def test_the_calibration(repository: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On the other bundled drive, which it has not seen, the gap is half of what it was."""
    from suspension_twin.drive.read import read_drive
    from suspension_twin.inference.simulated import simulate_drive

    for command in commands(repository):
        assert main(command) == 0
    said = capsys.readouterr().out
    assert "placed on the road by what was felt" in said
    assert "laid over one another" in (folder / "out" / "report" / "report.html").read_text("utf-8")
    there = load_twin(repository / "bags" / "crg_road" / "twin.yaml")
    drive = read_drive(repository / "bags" / "crg_road")
    gaps = [
        simulate_drive(drive, there.model_copy(update={"vehicle": load_twin(folder / name).vehicle})).gap.rms
        for name in ("my_car.yaml", "calibrated.yaml")
    ]
    assert gaps[1] < 0.5 * gaps[0]
