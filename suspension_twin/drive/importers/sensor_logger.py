# SPDX-License-Identifier: Apache-2.0
"""Sensor Logger (Android and iOS): its zip or folder of CSV files, or its JSON export.

Sources: UNITS.md, COORDINATES.md, CROSSPLATFORM.md and README.md of tszheichoi/awesome-sensor-logger.
``time`` is ns since the epoch. Columns come in the order z, y, x: they are read by name. iOS has all
three accelerometer axes (and gravity's) negated against Android, unless "Standardise Units & Frames"
was on; the gyroscope is the same on both. ``TotalAcceleration`` (Android) includes gravity;
``Accelerometer`` does not, so that without the former the sum with ``Gravity`` is taken. Values of
the JSON export are strings.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.intake.phones import IOS_FORCE_SIGN, force_sensors, phone_fix
from suspension_twin.drive.intake.source import Source
from suspension_twin.drive.intake.streams import Series, Streams
from suspension_twin.drive.intake.table import Table, read_table
from suspension_twin.drive.intake.velocity import velocities_from_course
from suspension_twin.drive.types import FixData
from suspension_twin.errors import InputError

__all__ = ["TITLE", "read", "recognises"]

TITLE = "Sensor Logger"

_SENSORS = (
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
_AXES = ("x", "y", "z")


def recognises(source: Source) -> bool:
    """CSV files with its columns, or a JSON array of its records."""
    for sensor in ("TotalAcceleration", "Accelerometer", "Gyroscope"):
        name = source.find(f"{sensor}.csv")
        if name is not None and b"seconds_elapsed" in source.head(name):
            return True
    return any(_is_export(source, name) for name in source.names[:20])


def _is_export(source: Source, name: str) -> bool:
    head = source.head(name)
    return name.lower().endswith(".json") and b'"sensor"' in head and b'"time"' in head


def read(source: Source) -> Streams:
    """Accelerometer with gravity, gyroscope and location, in Android's axes (REP-145's sign)."""
    tables = _tables(source)
    label = str(source.path)
    platform, standardised = _platform(tables.get("Metadata"))
    ios = platform == "ios" and not standardised
    streams = Streams(origin=TITLE)
    for table in tables.values():
        streams.warnings += table.warnings

    named = {sensor.lower(): sensor for sensor in tables}
    chosen = [named[sensor] for sensor in force_sensors(named)]
    if chosen:
        streams.force = _vector(tables[chosen[0]])
        if chosen[1:]:
            streams.force = _sum(streams.force, _vector(tables[chosen[1]]))
        if chosen != ["TotalAcceleration"]:
            streams.notes.append(f"specific force: {' + '.join(chosen)}")
    elif "Accelerometer" in tables:
        raise InputError(
            label, "Accelerometer is without gravity: record TotalAcceleration (Android) or Gravity (iOS) too"
        )
    if ios and streams.force is not None:
        streams.force = Series(streams.force.t, IOS_FORCE_SIGN * streams.force.values)
        streams.notes.append("iOS: all three accelerometer axes negated")
    for sensor in ("Gyroscope", "GyroscopeUncalibrated"):
        if streams.rate is None and sensor in tables:
            streams.rate = _vector(tables[sensor])
    location = tables.get("Location") or tables.get("LocationGps")
    if location is not None:
        t = _time(location)
        streams.fix = _fix(location, t)
        if location.has("speed", "bearing"):
            streams.velocity = velocities_from_course(
                t, location.numbers("speed"), location.numbers("bearing")
            )
            streams.notes.append("velocity: from speed and bearing")
    if platform is None:
        streams.warnings.append(f"{label}: no Metadata file names the platform: taken as Android")
    else:
        system = {"ios": "iOS", "android": "Android"}.get(platform, platform)
        streams.origin = f"{TITLE}, {system}{', standardised frames' if standardised else ''}"
    return streams


def _tables(source: Source) -> dict[str, Table]:
    export = next((name for name in source.names if _is_export(source, name)), None)
    if export is not None and source.find("Gyroscope.csv") is None:
        return _json_tables(source, export)
    tables = {}
    for sensor in _SENSORS:
        name = source.find(f"{sensor}.csv")
        if name is None:
            continue
        try:
            tables[sensor] = read_table(source.read(name), source.label(name), header=True, delimiter=",")
        except InputError as error:
            if "no rows" not in str(error) and "empty" not in str(error):
                raise  # a sensor that was switched on and never reported has a header alone
    return tables


def _json_tables(source: Source, name: str) -> dict[str, Table]:
    label = source.label(name)
    text = source.text(name)
    warnings = []
    try:
        records = json.loads(text)
    except ValueError:
        records = _whole_records(text)
        if not records:
            raise InputError(label, "not JSON") from None
        warnings.append(f"{label}: cut off after {len(records)} records")
    if not isinstance(records, list):
        raise InputError(label, "a list of records was expected")
    by_sensor: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        if isinstance(record, list):  # some versions nest the records of each sensor
            for inner in record:
                if isinstance(inner, dict):
                    by_sensor.setdefault(str(inner.get("sensor")), []).append(inner)
        elif isinstance(record, dict):
            by_sensor.setdefault(str(record.get("sensor")), []).append(record)
    tables = {}
    for sensor, rows in by_sensor.items():
        if sensor in _SENSORS:
            names = [key for key in rows[0] if key != "sensor"]
            columns = [tuple("" if row.get(key) is None else str(row[key]) for row in rows) for key in names]
            tables[sensor] = Table(f"{label}: {sensor}", names, columns)
    if tables:
        next(iter(tables.values())).warnings += warnings
    return tables


def _whole_records(text: str) -> list[Any]:
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


def _platform(metadata: Table | None) -> tuple[str | None, bool]:
    """Platform in lower case, and whether axes and units were standardised."""
    if metadata is None or not metadata.rows or not metadata.has("platform"):
        return None, False
    standard = metadata.text("standardisation")[0].strip().lower() if metadata.has("standardisation") else ""
    return metadata.text("platform")[0].strip().lower(), standard in ("true", "1", "on", "yes")


def _time(table: Table) -> Floats:
    return table.numbers("time") * 1e-9


def _vector(table: Table) -> Series:
    return Series(_time(table), table.vector(_AXES))


def _sum(linear: Series, gravity: Series) -> Series:
    """Linear acceleration and gravity at the former's stamps."""
    order = np.argsort(gravity.t, kind="stable")
    t, values = gravity.t[order], gravity.values[order]
    good = np.isfinite(t) & np.isfinite(values).all(axis=1)
    if not good.any():
        return Series(linear.t[:0], linear.values[:0])
    at = [np.interp(linear.t, t[good], values[good, i]) for i in range(3)]
    return Series(linear.t, linear.values + np.stack(at, axis=1))


def _fix(table: Table, t: Floats) -> FixData:
    def column(name: str) -> Floats:
        return table.numbers(name) if table.has(name) else np.full(t.size, np.nan)

    accuracies = column("horizontalAccuracy"), column("verticalAccuracy")
    return phone_fix(
        t, table.numbers("latitude"), table.numbers("longitude"), column("altitude"), *accuracies
    )
