# SPDX-License-Identifier: Apache-2.0
"""The results of a fleet as Parquet, to be asked with DuckDB, pandas or whatever reads it.

``results.parquet`` has a row for every item of the manifest, ``health.parquet`` a row for every quantity followed over
time, ``changes.parquet`` a row for every quantity of a vehicle with the probability that it changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from suspension_twin.addons.fleet.changes import Change
from suspension_twin.addons.fleet.engine import Outcome, Plan
from suspension_twin.errors import InputError
from suspension_twin.files import replacing

__all__ = ["CHANGES", "HEALTH", "RESULTS", "health_rows", "result_rows", "write_tables"]

RESULTS, HEALTH, CHANGES = "results.parquet", "health.parquet", "changes.parquet"
#: Copied from a record as they are: name and Arrow type.
_PLAIN = {
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
Row = dict[str, Any]


def result_rows(plan: Plan, outcome: Outcome) -> list[Row]:
    """A row for every item of the manifest, in its order.

    Parameters
    ----------
    plan : Plan
        Items and tasks.
    outcome : Outcome
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
    for number, (item, task) in enumerate(zip(plan.items, plan.tasks, strict=True)):
        row: Row = {
            "vehicle": item.vehicle,
            "date": item.date or (task.date if task else ""),
            "drives": list(item.drives),
        }
        record: Mapping[str, Any] = {}
        if task is None:
            row |= {"status": "failed", "message": plan.lines[number]}
        elif task.key in outcome.records:
            record = outcome.records[task.key]
            place = f"items/{task.key[:2]}/{task.key}" if record["status"] == "done" else None
            row |= {"status": record["status"], "message": record["message"], "folder": place}
        else:
            row |= {"status": "lost", "message": outcome.lost.get(task.key, "was not done")}
        row |= {name: record.get(name) for name in _PLAIN}
        row["key"] = task.key if task else None
        row["warnings"] = record.get("warnings") or []
        row["combination"] = record.get("combination") or []
        row["parameters"] = record.get("parameters") or []
        row["causes"] = [
            {"effect": c["effect"], "probability": c["probability"]} for c in record.get("causes") or []
        ]
        row["places"] = record.get("places") or []
        row["health"] = record.get("health") or []
        rows.append(row)
    return rows


def health_rows(rows: Iterable[Row]) -> list[Row]:
    """A row for every quantity of every item that is done, from :func:`result_rows`; by vehicle, quantity and date."""
    found = [
        {"vehicle": row["vehicle"], "date": row["date"], "key": row["key"], **quantity}
        for row in rows
        for quantity in row["health"]
    ]
    return sorted(found, key=lambda r: (r["vehicle"], r["quantity"], r["date"]))


def write_tables(folder: Path, rows: Sequence[Row], changes: Sequence[Change]) -> tuple[Path, ...]:
    """Write the three tables.

    Parameters
    ----------
    folder : Path
        Where to.
    rows : sequence of dict
        From :func:`result_rows`.
    changes : sequence of Change
        Of every vehicle and quantity.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    InputError
        The extra ``fleet`` is not installed.

    Examples
    --------
    >>> write_tables(Path("results"), rows, ())  # doctest: +SKIP
    (PosixPath('results/results.parquet'), ...)
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise InputError("fleet", 'needs pyarrow: pip install "suspension-twin[fleet]"') from None
    number, text = pa.float64(), pa.string()
    estimate = {"key": text, "start": number, "value": number, "low": number, "high": number, "status": text}
    place = {"along": number, "latitude": number, "longitude": number, "rms": number, "seconds": number}
    cause = {"effect": text, "probability": number}
    plain = {
        name: number if kind == "double" else pa.int64() if kind == "int64" else text
        for name, kind in _PLAIN.items()
    }
    columns = {
        **dict.fromkeys(("vehicle", "date", "status", "message"), text),
        "drives": pa.list_(text),
        **plain,
        "combination": pa.list_(text),
        "causes": pa.list_(pa.struct(list(cause.items()))),
        "parameters": pa.list_(pa.struct(list(estimate.items()))),
        "places": pa.list_(pa.struct(list(place.items()))),
        "warnings": pa.list_(text),
        "key": text,
        "folder": text,
    }
    health = {
        **dict.fromkeys(("vehicle", "date", "quantity"), text),
        **dict.fromkeys(("value", "low", "high"), number),
        "unit": text,
        "identified": pa.bool_(),
        "key": text,
    }
    change = {
        **dict.fromkeys(("vehicle", "quantity"), text),
        "probability": number,
        **dict.fromkeys(("date", "earliest", "latest"), text),
        **dict.fromkeys(("before", "after", "ratio", "ratio_low", "ratio_high"), number),
        "drives": pa.int64(),
        "unit": text,
    }
    tables = {
        RESULTS: (columns, [dict(row) for row in rows]),
        HEALTH: (health, health_rows(rows)),
        CHANGES: (change, [c.as_row() for c in changes]),
    }
    paths = []
    for name, (schema, content) in tables.items():
        kept = [{column: row.get(column) for column in schema} for row in content]
        table = pa.Table.from_pylist(kept, schema=pa.schema(list(schema.items())))
        with replacing(folder / name) as part:
            pq.write_table(table, part)
        paths.append(folder / name)
    return tuple(paths)
