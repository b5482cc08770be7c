# SPDX-License-Identifier: Apache-2.0
"""``fleet calibrate``: every row done once, whatever happens meanwhile, and a line for each that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import duckdb
import pytest

from suspension_twin.addons.fleet.manifest import Item
from suspension_twin.addons.fleet.results import Ledger
from suspension_twin.addons.fleet.storage import identity, outline
from suspension_twin.addons.fleet.work import Options, plan_task
from suspension_twin.cli.main import main
from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import load_twin

#: The cheapest calibration that there is.
CHEAP = ("--max-generations", "1", "--freeze", "vehicle.front.spring", "--freeze", "vehicle.rear.spring")


@pytest.mark.long
def test_rows_become_parquet_and_are_done_once(
    manifest: Path, tmp_path: Path, in_this_process: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["fleet", "calibrate", str(manifest), "--out", str(out), *CHEAP]
    assert main(command) == 1  # two rows cannot be done
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and "2 of 4 rows failed" in said.err
    rows = duckdb.sql(
        f"SELECT vehicle, date, status, message, folder FROM '{out}/results.parquet' ORDER BY vehicle, date"
    ).fetchall()
    assert [r[:3] for r in rows] == [
        ("car_a", "2023-11-14", "done"),
        ("car_a", "2023-11-17", "done"),
        ("car_b", "", "failed"),
        ("car_b", "2024-01-01", "failed"),
    ]
    for bag, row in zip(("notes.txt", "missing"), rows[2:], strict=True):
        single = str(manifest.parent / bag)
        assert (
            main(
                [
                    "calibrate",
                    "--twin",
                    str(manifest.parent / "twin.yaml"),
                    single,
                    "--out",
                    f"{tmp_path}/x.yaml",
                ]
            )
            == 2
        )
        assert capsys.readouterr().err == f"suspension-twin: {row[3]}\n"
    twin = load_twin(out / rows[0][4] / "twin.yaml")
    assert twin.road is not None and twin.road.file == manifest.parent / "road.crg"
    force, low, high = duckdb.sql(
        f"SELECT value, low, high FROM '{out}/health.parquet' WHERE quantity = 'vehicle.front.damper_push@0.25' LIMIT 1"
    ).fetchall()[0]
    assert low < force < high

    written = {p: p.stat().st_mtime_ns for p in out.rglob("record.json")}
    assert len(written) == 3  # the reader found that the notes are no drive: that is a result, too
    (out / "fleet.html").unlink()
    assert main(command) == 1
    assert "notes.txt: not a recording" in (out / "fleet.html").read_text()
    assert "2 of 4 rows done, none computed now" in capsys.readouterr().out
    assert {p: p.stat().st_mtime_ns for p in out.rglob("record.json")} == written


def test_an_item_is_known_by_what_its_files_hold(fleet_folder: Path, tmp_path: Path) -> None:
    twin, drive = fleet_folder / "twin.yaml", fleet_folder / "one"
    options = Options("calibrate")
    first = plan_task(Item("a", "", str(twin), (str(drive),)), options)
    copy = tmp_path / "one"
    copy.mkdir()
    for file in drive.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    assert plan_task(Item("b", "2020-01-01", str(twin), (str(copy),)), options).key == first.key
    assert plan_task(Item("a", "", str(twin), (str(drive),)), Options("calibrate", seed=1)).key != first.key
    changed = next(copy.glob("*.mcap"))
    changed.write_bytes(changed.read_bytes()[:-1])
    assert plan_task(Item("a", "", str(twin), (str(copy),)), options).key != first.key
    assert identity(str(copy)) != identity(str(drive))
    assert outline(str(drive)).date == outline(str(next(drive.glob("*.mcap")))).date == "2023-11-14"


def test_half_a_record_is_done_again(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "out")
    ledger.begin()
    record = {"key": "ab12", "status": "done", "message": "", "files": {"a.txt": "x"}}
    ledger.save(record)
    assert ledger.load("ab12") == {"key": "ab12", "status": "done", "message": ""}
    path = ledger.place("ab12") / "record.json"
    path.write_text(json.dumps(record)[:20])
    assert ledger.load("ab12") is None


def test_a_folder_of_something_else_is_left_alone(manifest: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="holds something else"):
        Ledger(tmp_path)
