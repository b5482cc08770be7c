# SPDX-License-Identifier: Apache-2.0
"""The results of a fleet: a folder for every task by its key, and tables to be asked.

A task's folder is written whole or not at all. ``results.parquet`` has a row for every item of the manifest,
``health.parquet`` a row for every quantity followed over time, ``changes.parquet`` a row for every quantity of a
vehicle with the probability that it changed; DuckDB, pandas and whatever reads Parquet can ask them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from suspension_twin.addons.fleet.changes import ChangePoint
from suspension_twin.addons.fleet.work import Record
from suspension_twin.errors import InputError
from suspension_twin.files import check_writable, parse_yaml, read_json, replacing, together, write_text
from suspension_twin.vehicle.twin import RoadFile, parse_twin, save_twin

if TYPE_CHECKING:
    from suspension_twin.addons.fleet.engine import FleetOutcome, FleetPlan

__all__ = [
    "CHANGES",
    "HEALTH",
    "MARK",
    "RESULTS",
    "TWIN",
    "Ledger",
    "health_rows",
    "result_rows",
    "write_tables",
]

#: The file by which a folder is known as one of a fleet.
MARK = "fleet.json"
TWIN = "twin.yaml"
_RECORD = "record.json"
_FORMAT = 1
RESULTS, HEALTH, CHANGES = "results.parquet", "health.parquet", "changes.parquet"
#: Copied from a record as they are: name and Arrow type.
_PLAIN: Final = {
    "channel": "string",
    "gap_before": "double",
    "gap_after": "double",
    "noise": "double",
    "verdict": "string",
    "probability": "double",
    "shrink": "double",
    "shrink_low": "double",
    "shrink_high": "double",
    "seconds": "double",
    "peak_memory": "int64",
    "version": "string",
}
_LISTS = ("warnings", "combination", "parameters", "causes", "places", "health")
#: Columns of the tables by their Arrow types; a mapping is a list of structs.
_RESULT_COLUMNS: Final[Mapping[str, object]] = {
    **dict.fromkeys(("vehicle", "date", "status", "message"), "string"),
    "drives": "strings",
    **_PLAIN,
    "combination": "strings",
    "causes": {"effect": "string", "probability": "double"},
    "parameters": {
        "key": "string",
        **dict.fromkeys(("start", "value", "low", "high"), "double"),
        "status": "string",
    },
    "places": dict.fromkeys(("along", "latitude", "longitude", "rms", "seconds"), "double"),
    "warnings": "strings",
    "key": "string",
    "folder": "string",
}
_HEALTH_COLUMNS: Final[Mapping[str, object]] = {
    **dict.fromkeys(("vehicle", "date", "quantity"), "string"),
    **dict.fromkeys(("value", "low", "high"), "double"),
    "unit": "string",
    "identified": "bool",
    "key": "string",
}
_CHANGE_COLUMNS: Final[Mapping[str, object]] = {
    **dict.fromkeys(("vehicle", "quantity"), "string"),
    "probability": "double",
    **dict.fromkeys(("date", "earliest", "latest"), "string"),
    **dict.fromkeys(("before", "after", "ratio", "ratio_low", "ratio_high"), "double"),
    "drives": "int64",
    "unit": "string",
}


class Ledger:
    """Records of the tasks that have been done. A record that is there is whole, and is never computed again.

    Raises InputError for a folder that holds something else.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        mark = folder / MARK
        if folder.is_dir() and any(folder.iterdir()) and not mark.is_file():
            raise InputError(folder, "holds something else than a fleet's results: name another folder")
        check_writable(mark)

    def begin(self) -> None:
        """Make the folder, and mark it as one of a fleet."""
        if not (self.folder / MARK).exists():
            write_text(self.folder / MARK, json.dumps({"format": _FORMAT}) + "\n")

    def place(self, key: str) -> Path:
        """The folder of a task's results."""
        return self.folder / "items" / key[:2] / key

    def load(self, key: str) -> Record | None:
        """The record of a task, or None: it has to be done."""
        try:
            record = read_json(self.place(key) / _RECORD)
            whole = record["key"] == key and record["status"] in ("done", "failed")
        except (InputError, LookupError, TypeError):
            return None
        return record if whole else None

    def save(self, record: Record) -> Record:
        """Write a record and its files; returns the record as it is kept."""
        kept = {k: v for k, v in record.items() if k != "files"}
        place = self.place(record["key"])
        with together():  # the record takes its place last: where it is, its files are
            for name, text in record.get("files", {}).items():
                if name == TWIN and (record.get("road") or record.get("program")):
                    _write_twin(place / name, text, record.get("road", ""), record.get("program", ""))
                else:
                    write_text(place / name, text)
            write_text(place / _RECORD, json.dumps(kept, ensure_ascii=False, allow_nan=False) + "\n")
        return kept


def _write_twin(path: Path, text: str, road: str, program: str) -> None:
    """A twin file whose road and program are named from where it now lies."""
    heading = "".join(line for line in text.splitlines(keepends=True) if line.startswith("#"))
    twin = parse_twin(parse_yaml(text, path), path)
    if program:
        twin = twin.with_paths(lambda file: Path(program) if file == twin.program else file)
    if road:
        twin = twin.model_copy(update={"road": RoadFile(file=Path(road))})
    save_twin(twin, path, heading)


def result_rows(plan: FleetPlan, outcome: FleetOutcome) -> list[Record]:
    """A row for every item of the manifest, in its order.

    Parameters
    ----------
    plan : FleetPlan
        Items and tasks.
    outcome : FleetOutcome
        Records.

    Returns
    -------
    list of dict
        ``folder`` is relative to that of the results; ``status`` is "done", "failed" (would fail again) or "lost"
        (another run tries it again).

    Examples
    --------
    >>> result_rows(plan, outcome)[0]["status"]  # doctest: +SKIP
    'done'
    """
    rows = []
    for item, task in zip(plan.items, plan.tasks, strict=True):
        key = "" if isinstance(task, str) else task.key
        record: Record = outcome.records.get(key, {})
        if record:
            folder = f"items/{key[:2]}/{key}" if record["status"] == "done" else None
            status = {"status": record["status"], "message": record["message"], "folder": folder}
        elif isinstance(task, str):
            status = {"status": "failed", "message": task}
        else:
            status = {"status": "lost", "message": outcome.lost.get(key, "was not done")}
        row: Record = {
            "vehicle": item.vehicle,
            "date": item.date or ("" if isinstance(task, str) else task.date),
            "drives": list(item.drives),
            "key": key or None,
            **status,
            **{name: record.get(name) for name in _PLAIN},
            **{name: record.get(name) or [] for name in _LISTS},
        }
        row["causes"] = [{k: c[k] for k in ("effect", "probability")} for c in row["causes"]]
        rows.append(row)
    return rows


def health_rows(rows: Iterable[Record]) -> list[Record]:
    """A row for every quantity of every item that is done, from :func:`result_rows`; by vehicle, quantity and date."""
    common = ("vehicle", "date", "key")
    found = [{**{k: row[k] for k in common}, **quantity} for row in rows for quantity in row["health"]]
    return sorted(found, key=lambda r: (r["vehicle"], r["quantity"], r["date"]))


def write_tables(folder: Path, rows: Sequence[Record], changes: Sequence[ChangePoint]) -> None:
    """Write the three tables.

    Parameters
    ----------
    folder : Path
        Where to.
    rows : sequence of dict
        From :func:`result_rows`.
    changes : sequence of ChangePoint
        Of every vehicle and quantity.

    Raises
    ------
    InputError
        The extra ``fleet`` is not installed.

    Examples
    --------
    >>> write_tables(Path("results"), rows, ())  # doctest: +SKIP
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise InputError("fleet", 'needs pyarrow: pip install "suspension-twin[fleet]"') from None
    kinds = {"string": pa.string(), "double": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}

    def schema(columns: Mapping[str, object]) -> list[tuple[str, object]]:
        """Columns with types of Arrow: by name, a list of such for a one-element list, of structs for a mapping."""
        return [(name, arrow(kind)) for name, kind in columns.items()]

    def arrow(kind: object) -> object:
        if isinstance(kind, Mapping):
            return pa.list_(pa.struct(schema(kind)))
        return pa.list_(pa.string()) if kind == "strings" else kinds[str(kind)]

    tables = {
        RESULTS: (_RESULT_COLUMNS, rows),
        HEALTH: (_HEALTH_COLUMNS, health_rows(rows)),
        CHANGES: (_CHANGE_COLUMNS, [c.as_row() for c in changes]),
    }
    for name, (columns, content) in tables.items():
        kept = [{column: row.get(column) for column in columns} for row in content]
        with replacing(folder / name) as part:
            pq.write_table(pa.Table.from_pylist(kept, schema=pa.schema(schema(columns))), part)
