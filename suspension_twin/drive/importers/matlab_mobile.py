# SPDX-License-Identifier: Apache-2.0
"""MATLAB Mobile: sensor logs as ``.mat`` files or as CSV files written from them.

Source: MathWorks documentation of ``mobiledev``, ``accellog``, ``angvellog``, ``poslog`` and "Logging
Accelerometer Data". The app logs the timetables ``Acceleration`` (X, Y, Z in m/s², gravity included),
``AngularVelocity`` (X, Y, Z in rad/s) and ``Position`` (latitude, longitude, altitude, speed, course,
hacc) with row times ``Timestamp``. Read are ``.mat`` files (through ``mat-io``, which reads timetables and
version 7.3, unlike SciPy) with these timetables, with structs of those fields, or with arrays (n, 3) that
have a time vector beside them or (n, 4) with the time first; and ``writetimetable``'s CSV files.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import text_to_posix
from suspension_twin.drive.foreign_files import RecordedFiles, read_table
from suspension_twin.drive.mat import fields_of, of_mat, variables_of
from suspension_twin.drive.streams import Series, Streams
from suspension_twin.drive.types import FixData
from suspension_twin.drive.unpack import Budget
from suspension_twin.errors import InputError

__all__ = ["TITLE", "read", "recognises"]

TITLE = "MATLAB Mobile"

#: Names of each log, in the app and in the scripts that save its arrays.
_LOGS = {
    "acceleration": ("acceleration", "accel", "acc"),
    "angularvelocity": ("angularvelocity", "angvel", "gyro"),
    "position": ("position", "pos"),
}
_TIMES = ("timestamp", "timestamps", "time", "t")
_XYZ = ("x", "y", "z")
_POSITION = ("latitude", "longitude", "altitude", "speed", "course", "hacc")

Columns = dict[str, object]


def recognises(source: RecordedFiles) -> bool:
    """A ``.mat`` file, or a CSV file of one of the logs with a time column."""
    return _mat(source) is not None or any(
        _is_csv(source, log) for log in ("acceleration", "angularvelocity")
    )


def _mat(source: RecordedFiles) -> str | None:
    return next((name for name in source.names if name.lower().endswith(".mat")), None)


def _is_csv(source: RecordedFiles, log: str) -> str | None:
    for name in source.names:
        if log in Path(name).stem.lower() and name.lower().endswith((".csv", ".txt")):
            head = source.head(name, 512).split(b"\n", 1)[0].lower()
            if re.search(rb"\btime(stamp)?\b", head) and re.search(rb"\bx\b|_x\b", head):
                return name
    return None


def read(source: RecordedFiles) -> Streams:
    """Acceleration, angular velocity and position."""
    streams = Streams(origin=TITLE)
    if (mat := _mat(source)) is not None:
        logs = of_mat(_logs_of_variables, source.read(mat), source.label(mat))
    else:
        logs = _logs_of_csv(source, streams)
    if "acceleration" in logs:
        streams.force = _series(logs["acceleration"], source.label("Acceleration"))
    if "angularvelocity" in logs:
        streams.rate = _series(logs["angularvelocity"], source.label("AngularVelocity"))
    if "position" in logs:
        _position(logs["position"], streams, source.label("Position"))
    streams.notes.append("time: MATLAB Mobile logs local time without its zone, taken as UTC")
    return streams


def _logs_of_csv(source: RecordedFiles, streams: Streams) -> dict[str, Columns]:
    logs = {}
    positions = (n for n in source.names if "position" in n.lower() and n.lower().endswith(".csv"))
    for log in _LOGS:
        name = next(positions, None) if log == "position" else _is_csv(source, log)
        if name is None:
            continue
        table = read_table(source.read(name), source.label(name), header=True)
        streams.warnings += table.warnings
        columns: Columns = {}
        for i, full in enumerate(table.names):
            numbers = table.numbers(i)
            columns[full.lower().rsplit("_", 1)[-1]] = (
                numbers if np.isfinite(numbers).any() else list(table.text(i))
            )
        logs[log] = columns
    return logs


def _logs_of_variables(path: str, budget: Budget) -> dict[str, Columns]:
    """The logs in a file."""
    label, variables = str(budget.source), variables_of(path, budget)
    named = {name.lower(): value for name, value in variables.items()}
    for value in list(named.values()):  # readMobileSensorData gives one struct of all logs
        fields = _fields(value)
        if any(key in fields for key in _LOGS):
            named |= fields
    logs: dict[str, Columns] = {}
    for log, aliases in _LOGS.items():
        name = next((alias for alias in aliases if alias in named), None)
        if name is not None and (columns := _columns(named, name, label)):
            logs[log] = columns
    if not logs:
        known = ", ".join(named) or "none"
        raise InputError(label, f"holds neither Acceleration nor AngularVelocity; its variables are {known}")
    return logs


def _fields(value: Any) -> Columns:
    """Fields of a struct or columns of a timetable, by lower-case name."""
    return {name.lower(): field for name, field in fields_of(value).items()}


def _columns(named: Columns, name: str, label: str) -> Columns:
    """Columns of one log by lower-case name, whichever way it was saved."""
    if fields := _fields(named[name]):
        return fields
    array = np.asarray(named[name])
    if array.dtype.kind not in "fiu" or array.ndim != 2:
        return {}
    names = _POSITION if name.startswith("pos") else _XYZ
    if array.shape[1] == len(names) + 1:
        return {"timestamp": array[:, 0], **{key: array[:, i + 1] for i, key in enumerate(names)}}
    forms = ("{name}_{t}", "{t}_{name}", "{name}{t}", "{t}{name}", "{t}")
    beside = (form.format(name=name, t=t) for form in forms for t in _TIMES)
    time = next((key for key in beside if key in named), None)
    if time is None or array.shape[1] > len(names):
        raise InputError(label, name, f"no time beside it: save it as {name}_t")
    return {"timestamp": named[time], **{key: array[:, i] for i, key in enumerate(names[: array.shape[1]])}}


def _number_column(columns: Columns, name: str, label: str) -> Floats:
    if name not in columns:
        raise InputError(label, name, f"is missing; there are {', '.join(columns)}")
    try:
        return np.asarray(columns[name], dtype=np.float64).ravel()
    except (ValueError, TypeError):
        raise InputError(label, name, "does not hold numbers") from None


def _times(columns: Columns, label: str) -> Floats:
    """POSIX times from text, datetimes, serial day numbers or seconds, recognised by their size."""
    name = next((key for key in _TIMES if key in columns), None)
    if name is None:
        raise InputError(label, f"has no Timestamp; there are {', '.join(columns)}")
    array = np.asarray(columns[name])
    if array.dtype.kind == "M":  # dates
        return np.asarray(array.astype("datetime64[ns]").astype(np.int64) * 1e-9, dtype=np.float64).ravel()
    if array.dtype.kind == "m":  # durations
        return np.asarray(array / np.timedelta64(1, "s"), dtype=np.float64).ravel()
    if array.dtype.kind not in "fiu":
        t = text_to_posix([str(np.asarray(text).ravel()[0]) for text in array.ravel()])
        if not np.isfinite(t).any():
            raise InputError(label, name, "holds neither numbers nor dates")
        return t
    t = array.astype(np.float64).ravel()
    largest = float(np.nanmax(np.abs(t))) if t.size and np.isfinite(t).any() else 0.0
    step = float(np.nanmedian(np.diff(t))) if t.size > 1 else 0.0
    if 600_000 < largest < 800_000 and step < 0.01:  # datenum: days since year 0
        return (t - 719_529.0) * 86_400.0
    for size, scale in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)):
        if largest > size:
            return t * scale
    return t


def _series(columns: Columns, label: str) -> Series:
    t = _times(columns, label)
    values = [_number_column(columns, name, label) for name in _XYZ]
    if any(column.size != t.size for column in values):
        raise InputError(label, f"{values[0].size} samples for {t.size} times")
    return Series(t, np.stack(values, axis=1))


def _position(columns: Columns, streams: Streams, label: str) -> None:
    t = _times(columns, label)
    nothing = np.full(t.size, np.nan)
    latitude, longitude = (_number_column(columns, name, label) for name in ("latitude", "longitude"))
    altitude, accuracy = (
        _number_column(columns, name, label) if name in columns else nothing for name in ("altitude", "hacc")
    )
    if not t.size == latitude.size == longitude.size:
        raise InputError(label, f"{latitude.size} positions for {t.size} times")
    with np.errstate(invalid="ignore"):
        horizontal = np.where(accuracy > 0, accuracy / np.sqrt(2), np.nan)
    sigma = np.stack([horizontal, horizontal, nothing], axis=1)
    streams.fix = FixData(t, latitude, longitude, altitude, np.zeros(t.size, dtype=np.int8), sigma)
    if "speed" in columns and "course" in columns:
        speed, course = (_number_column(columns, name, label) for name in ("speed", "course"))
        streams.add_course(t, speed, course, "speed and course")
