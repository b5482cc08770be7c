# SPDX-License-Identifier: Apache-2.0
"""``fleet diagnose``: the answers of the single command, as rows."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import duckdb
import pytest

from suspension_twin.cli.main import main


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.long
def test_rows_are_the_answers_of_the_single_command(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin, run = repository / "config/twins/quarter_car.yaml", repository / "config/rig/random.csv"
    cut = tmp_path / "cut.csv"
    cut.write_bytes(run.read_bytes()[:200])
    manifest = tmp_path / "fleet.csv"
    manifest.write_text(
        f"vehicle,date,twin,drives\nrig,2026-01-01,{twin},{run}\nrig,2026-01-02,{twin},{cut}\n"
    )
    few = ("--effect", "strut_friction", "--effect", "bump_stop")
    out = tmp_path / "out"
    assert main(["fleet", "diagnose", str(manifest), "--out", str(out), *few]) == 1  # the cut one
    rows = duckdb.sql(
        f"SELECT status, verdict, probability, combination, message, folder FROM '{out}/results.parquet' ORDER BY date"
    ).fetchall()
    assert [r[0] for r in rows] == ["done", "failed"]
    capsys.readouterr()
    shutil.rmtree(tmp_path / "single", ignore_errors=True)
    assert main(["diagnose", "--twin", str(twin), str(run), "--out", str(tmp_path / "single"), *few]) == 0
    single = json.loads((tmp_path / "single" / "diagnosis.json").read_text())
    assert rows[0][1:5] == tuple(single[k] for k in ("verdict", "probability", "combination", "message"))
    assert json.loads((out / rows[0][5] / "diagnosis.json").read_text()) == single
    capsys.readouterr()
    assert main(["diagnose", "--twin", str(twin), str(cut), "--out", str(tmp_path / "other"), *few]) == 2
    assert capsys.readouterr().err == f"suspension-twin: {rows[1][4]}\n"


def test_what_is_no_effect_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "fleet",
        "diagnose",
        str(tmp_path / "m.csv"),
        "--out",
        str(tmp_path),
        "--effect",
        "strut_frictoin",
    ]
    assert main(arguments) == 2
    assert "strut_frictoin" in capsys.readouterr().err
