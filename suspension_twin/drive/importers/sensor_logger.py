# SPDX-License-Identifier: Apache-2.0
"""Sensor Logger (Android and iOS): its zip or folder of CSV files, one CSV of all sensors, its JSON or SQLite export.

Sources: UNITS.md, COORDINATES.md, CROSSPLATFORM.md and README.md of tszheichoi/awesome-sensor-logger.
``time`` is ns since the epoch. Columns come in the order z, y, x: they are read by name. iOS has all
three accelerometer axes (and gravity's) negated against Android, unless "Standardise Units & Frames"
was on; the gyroscope is the same on both. ``TotalAcceleration`` (Android) includes gravity;
``Accelerometer`` does not, so that without the former the sum with ``Gravity`` is taken. Values of
the JSON export are strings. In one CSV of all sensors the columns are ``gyroscope_x``, ``location_speed``. The database
has a table for each sensor, of the columns of its CSV file.
"""

from __future__ import annotations

import json
import sqlite3
from collections import defaultdict
from collections.abc import Collection
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final
from urllib.parse import quote

import numpy as np

from suspension_twin.drive.foreign_files import DataTable, RecordedFiles, read_table
from suspension_twin.drive.salvage import SQLITE_MAGIC
from suspension_twin.drive.streams import Series, Streams, phone_fix
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError

__all__ = ["IOS_FORCE_SIGN", "TITLE", "force_sensors", "is_database", "read", "recognises"]

TITLE = "Sensor Logger"

_SENSORS: Final = (
    "TotalAcceleration",
    "Accelerometer",
    "Gravity",
    "Gyroscope",
    "AccelerometerUncalibrated",
    "GyroscopeUncalibrated",
    "Location",
    "LocationGps",
    "Metadata",
)
#: Sensors whose sum is the specific force, the best first.
_FORCE_CHOICES: Final = (
    ("totalacceleration",),
    ("accelerometer", "gravity"),
    ("accelerometeruncalibrated",),
)
#: Bytes of memory that a text takes beside its characters (CPython: 49 and its place in a list).
_VALUE: Final = 64
#: On iOS the three axes of accelerometer and gravity are negated, unless they are standardised.
IOS_FORCE_SIGN: Final = -1.0


def force_sensors(present: Collection[str]) -> tuple[str, ...]:
    """Of the sensors present (lower case) those whose sum is the specific force; empty if there are none."""
    return next((names for names in _FORCE_CHOICES if set(names) <= set(present)), ())


def recognises(source: RecordedFiles) -> bool:
    """CSV files or tables with its columns, or a JSON array of its records."""
    if is_database(source):
        return True
    for sensor in ("TotalAcceleration", "Accelerometer", "Gyroscope"):
        name = source.find(f"{sensor}.csv")
        if name is not None and b"seconds_elapsed" in source.head(name):
            return True
    return any(_is_export(source, name) or _is_combined(source, name) for name in source.names[:20])


def is_database(source: RecordedFiles) -> bool:
    """Whether it is one database in whose schema, on the first pages, stands a column that the app alone has."""
    if len(source.names) != 1 or source.path.is_dir():
        return False
    head = source.head(source.names[0], 1 << 20)
    return head.startswith(SQLITE_MAGIC) and b"seconds_elapsed" in head


def _is_combined(source: RecordedFiles, name: str) -> bool:
    head = source.head(name).split(b"\n", 1)[0].lower()
    return b"seconds_elapsed" in head and b"gyroscope_x" in head


def _is_export(source: RecordedFiles, name: str) -> bool:
    head = source.head(name)
    return name.lower().endswith(".json") and b'"sensor"' in head and b'"time"' in head


def read(source: RecordedFiles) -> Streams:
    """Accelerometer with gravity, gyroscope and location, in Android's axes (REP-145's sign)."""
    tables = _tables(source)
    streams = Streams(origin=TITLE)
    for table in tables.values():
        streams.warnings += table.warnings
    platform, standardised = _platform(tables.get("Metadata"))
    streams.force = _force(tables, streams, source)
    if platform == "ios" and not standardised and streams.force is not None:
        streams.force = replace(streams.force, values=IOS_FORCE_SIGN * streams.force.values)
        streams.notes.append("iOS: all three accelerometer axes negated")
    rates = [tables[sensor] for sensor in ("Gyroscope", "GyroscopeUncalibrated") if sensor in tables]
    streams.rate = _vector(rates[0]) if rates else None
    if (location := tables.get("Location") or tables.get("LocationGps")) is not None:
        t = location.numbers("time") * 1e-9
        place = [location.numbers(name) for name in ("latitude", "longitude")]
        rest = [
            location.numbers_or_nan(name) for name in ("altitude", "horizontalAccuracy", "verticalAccuracy")
        ]
        streams.fix = phone_fix(t, *place, *rest)
        if location.has("speed", "bearing"):
            streams.add_course(t, location.numbers("speed"), location.numbers("bearing"))
    if platform is None:
        streams.warnings.append(f"{source.path}: no Metadata file names the platform: taken as Android")
    else:
        system = {"ios": "iOS", "android": "Android"}.get(platform, platform)
        streams.origin = f"{TITLE}, {system}{', standardised frames' if standardised else ''}"
    return streams


def _tables(source: RecordedFiles) -> dict[str, DataTable]:
    if is_database(source):
        return _database_tables(source.path)
    export = next((name for name in source.names if _is_export(source, name)), None)
    if export is not None and source.find("Gyroscope.csv") is None:
        return _json_tables(source, export)
    if combined := next((name for name in source.names if _is_combined(source, name)), None):
        return _combined_tables(source, combined)
    tables = {}
    for sensor in _SENSORS:
        if (name := source.find(f"{sensor}.csv")) is None:
            continue
        try:
            tables[sensor] = read_table(source.read(name), source.label(name), header=True, delimiter=",")
        except InputError as error:
            if "no rows" not in str(error) and "empty" not in str(error):
                raise  # a sensor that was switched on and never reported has a header alone
    return tables


def _combined_tables(source: RecordedFiles, name: str) -> dict[str, DataTable]:
    """The columns of each sensor in the rows where it has values."""
    whole = read_table(source.read(name), source.label(name), header=True, delimiter=",")
    columns = {key.casefold(): whole.numbers(i) for i, key in enumerate(whole.names)}
    time = columns["time"] if "time" in columns else columns["seconds_elapsed"] * 1e9
    if "time" not in columns:
        whole.warnings.append(f"{whole.label}: has no column time: its times count from 1970")
    tables = {}
    for sensor in _SENSORS:
        prefix = f"{sensor.casefold()}_"
        own = {key[len(prefix) :]: values for key, values in columns.items() if key.startswith(prefix)}
        if own:
            values = np.column_stack([time, *own.values()])
            some = np.isfinite(values[:, 1:]).any(axis=1)
            tables[sensor] = DataTable(whole.label, ["time", *own], values=values[some])
    if tables:
        next(iter(tables.values())).warnings += whole.warnings
    return tables


def _database_tables(path: Path) -> dict[str, DataTable]:
    """The tables of the sensors, of those that are stored: reading what is computed may never end."""
    budget, tables = Budget(path, path.stat().st_size), {}
    uri = f"file:{quote(str(path.resolve()))}?immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as database:
        stored = {
            str(name).casefold(): str(name)
            for (name,) in database.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
            )
        }
        for sensor in _SENSORS:
            name = stored.get(sensor.casefold())
            if name is None or any(c[6] for c in database.execute(f"PRAGMA table_xinfo('{name}')")):
                continue
            found = database.execute(f"SELECT * FROM '{name}'")
            rows = []
            for row in found:
                rows.append(tuple("" if value is None else str(value) for value in row))
                budget.take(sum(map(len, rows[-1])) + _VALUE * len(row))
            if rows:
                names = [str(column[0]) for column in found.description]
                tables[sensor] = DataTable(f"{path}: {name}", names, list(zip(*rows, strict=True)))
    return tables


def _json_tables(source: RecordedFiles, name: str) -> dict[str, DataTable]:
    label, text = source.label(name), source.text(name)
    warnings = []
    try:
        records: object = json.loads(text)
    except ValueError:
        if not (found := _whole_records(text)):
            raise InputError(label, "not JSON") from None
        warnings.append(f"{label}: cut off after {len(found)} records")
        records = found
    if not isinstance(records, list):
        raise InputError(label, "a list of records was expected")
    by_sensor: dict[str, list[dict[str, object]]] = defaultdict(list)
    for record in records:
        for inner in (
            record if isinstance(record, list) else [record]
        ):  # some versions nest those of each sensor
            if isinstance(inner, dict):
                by_sensor[str(inner.get("sensor"))].append(inner)
    tables = {}
    for sensor, rows in by_sensor.items():
        if sensor in _SENSORS:
            names = [key for key in rows[0] if key != "sensor"]
            columns = [tuple("" if row.get(key) is None else str(row[key]) for row in rows) for key in names]
            tables[sensor] = DataTable(f"{label}: {sensor}", names, columns)
    if tables:
        next(iter(tables.values())).warnings += warnings
    return tables


def _whole_records(text: str) -> list[object]:
    """Records of an array that is cut off."""
    end = text.rfind("}")
    for _ in range(5):  # a brace may also end something within a record
        try:
            records = json.loads(text[: end + 1] + "]")
        except ValueError:
            end = text.rfind("}", 0, max(end, 0))
            continue
        return records if isinstance(records, list) else []
    return []


def _platform(metadata: DataTable | None) -> tuple[str | None, bool]:
    """Platform in lower case, and whether axes and units were standardised."""
    if metadata is None or not metadata.rows or not metadata.has("platform"):
        return None, False
    standard = metadata.text("standardisation")[0].strip().lower() if metadata.has("standardisation") else ""
    return metadata.text("platform")[0].strip().lower(), standard in ("true", "1", "on", "yes")


def _vector(table: DataTable) -> Series:
    return Series(table.numbers("time") * 1e-9, table.vector("xyz"))


def _force(tables: dict[str, DataTable], streams: Streams, source: RecordedFiles) -> Series | None:
    """The specific force, of one sensor or as the sum of linear acceleration and gravity at the former's stamps."""
    named = {sensor.lower(): sensor for sensor in tables}
    chosen = [named[sensor] for sensor in force_sensors(named)]
    if not chosen:
        if "Accelerometer" in tables:
            raise InputError(
                source.path,
                "Accelerometer is without gravity: record TotalAcceleration (Android) or Gravity (iOS) too",
            )
        return None
    if chosen != ["TotalAcceleration"]:
        streams.notes.append(f"specific force: {' + '.join(chosen)}")
    force, *more = (_vector(tables[sensor]) for sensor in chosen)
    for gravity in more:
        order = np.argsort(gravity.t, kind="stable")
        t, values = gravity.t[order], gravity.values[order]
        good = np.isfinite(t) & np.isfinite(values).all(axis=1)
        if not good.any():
            return Series(force.t[:0], force.values[:0])
        at = [np.interp(force.t, t[good], values[good, i]) for i in range(3)]
        force = Series(force.t, force.values + np.stack(at, axis=1))
    return force
