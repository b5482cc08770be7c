# SPDX-License-Identifier: Apache-2.0
"""The command ``export``: what it prints, what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.cli.main import main


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--to", "csv", "--out", "twin.txt"], "twin.txt: a file for csv ends with .csv"),
        (["--to", "csv", "--out", "twin.csv", "--into", "Car"], "--into: is nothing that csv takes"),
        (["--to", "carmaker", "--out", "Car2", "--into", "Car"], "Car: No such file or directory"),
        (["--to", "excel", "--out", "twin.xls"], "--to: excel is not known; there are fmu, carmaker"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str], sentence: str, repository: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    twin = str(repository / "bags/crg_road/twin.yaml")
    named = [str(tmp_path / a) if a[0].isupper() or "." in a else a for a in arguments]
    assert main(["export", twin, *named]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_what_exists_stays_without_force(
    repository: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "twin.csv"
    command = ["export", str(repository / "bags/crg_road/twin.yaml"), "--to", "csv", "--out", str(out)]
    out.write_text("mine", encoding="utf-8")
    assert main(command) == 2
    assert out.read_text(encoding="utf-8") == "mine"
    assert main([*command, "--force"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"Writes {out}\n")
    assert out.read_text(encoding="utf-8").startswith("key,value,unit\n")
