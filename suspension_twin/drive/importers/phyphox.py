# SPDX-License-Identifier: Apache-2.0
"""phyphox: the zip or folder of its CSV export, in any of its delimiters and languages.

Sources: the export code and file format pages of phyphox (RWTH Aachen), and the names and translations in its
experiments (github.com/phyphox/phyphox-experiments, ``gps.phyphox``). Columns carry their unit in brackets:
``Acceleration x (m/s^2)``, ``Gyroscope x (rad/s)``, ``Latitude (°)``, ``Altitude WGS84 (m)``, ``Speed (m/s)``. Names
may follow the language of the phone; in one without words here units and the app's order decide. ``Linear
Acceleration`` is without gravity and no use.
Its time is that of the experiment, which stands still during a pause; ``meta/time.csv`` holds
the time of the clock at each START and PAUSE. On iOS the app itself turns values to Android's axes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import ExperimentTime
from suspension_twin.drive.foreign_files import DataTable, RecordedFiles, read_table
from suspension_twin.drive.streams import Series, Streams, phone_fix
from suspension_twin.errors import InputError

__all__ = ["TITLE", "read", "recognises"]

TITLE = "phyphox"

_LINEAR = re.compile(r"line[aá]|liné|lineer|ohne g|without g|線形|线性", re.IGNORECASE)
_ACCELERATION = re.compile(r"\bm\s*/\s*s(\^2|²)")
_RATE = re.compile(r"\brad\s*/\s*s\b")
_AXIS = re.compile(r"(?:^|[\s_])([xyz])\b", re.IGNORECASE)
_DEGREES = re.compile(r"\(\s*(°|deg)")
_METRES = re.compile(r"\(\s*m\s*\)")
_SPEED = re.compile(r"\(\s*m\s*/\s*s\s*\)")
#: Words of the app for the columns of a location, in its languages.
_LATITUDE = re.compile(
    r"latit|breite|breedte|šířka|szeroko|широт|πλάτος|緯度|纬度|enlem|vĩ độ|širina", re.IGNORECASE
)
_LONGITUDE = re.compile(
    r"longit|länge|lengte|délka|długo|долгот|μήκος|経度|經度|经度|boylam|kinh độ|dužina|देशांतर", re.IGNORECASE
)
_ACCURACY = re.compile(
    r"accura|genauigkeit|nauwkeurig|přesnost|dokładno|точност|ακρίβεια|精度|精準度|precis|précis|doğruluk|sai số"
    r"|tačnost|სიზუსტე|यथार्थता",
    re.IGNORECASE,
)
_VERTICAL = re.compile(
    r"vertical|verticaal|vertikal|vertikáln|pionie|вертикал|κατακόρυφ|垂直|鉛直|dikey|cao|ვერტიკალ|उर्ध्वाधर",
    re.IGNORECASE,
)
_TIME_HEAD = re.compile(rb"\(s\)")


def recognises(source: RecordedFiles) -> bool:
    """A time reference in ``meta``, or a CSV file whose columns carry phyphox's units."""
    tables = (name for name in source.names[:20] if name.lower().endswith((".csv", ".txt")))
    return source.find("meta/time.csv") is not None or any(_head(source, name) for name in tables)


def _head(source: RecordedFiles, name: str) -> bool:
    first = source.head(name, 2048).split(b"\n", 1)[0]
    units = (b"(m/s^2)", "(m/s²)".encode(), b"(rad/s)", "(°)".encode(), b"(\xb0)")
    return bool(_TIME_HEAD.search(first)) and any(unit in first for unit in units)


def read(source: RecordedFiles) -> Streams:
    """Accelerometer with gravity, gyroscope and location."""
    streams = Streams(origin=TITLE)
    linear_only = False
    for name in source.names:
        table_name = name.lower().endswith((".csv", ".txt")) and "meta/" not in f"/{name.lower()}"
        if not table_name or not _head(source, name):
            continue
        try:
            table = read_table(source.read(name), source.label(name), header=True)
        except InputError as error:
            if "no rows" in str(error):
                continue  # a sensor that never reported
            raise
        linear_only |= _take(table, name, streams)
        streams.warnings += table.warnings
    if streams.force is None and linear_only:
        raise InputError(
            source.path, "acceleration is without gravity: use the experiment 'Acceleration (with g)' or both"
        )
    _to_epoch(source, streams)
    return streams


def _columns(table: DataTable, unit: re.Pattern[str]) -> list[int]:
    """The x, y and z columns of a unit, in this order; empty if they are not all there."""
    found: dict[str, int] = {}
    for i, name in enumerate(table.names):
        axis = _AXIS.search(name.split("(")[0])
        if unit.search(name) and axis and not _LINEAR.search(name):
            found.setdefault(axis.group(1).lower(), i)
    return [found[axis] for axis in "xyz"] if len(found) == 3 else []


def _take(table: DataTable, name: str, streams: Streams) -> bool:
    """Add the streams of one file; returns whether it holds acceleration without gravity."""
    t = table.numbers(0)
    linear = bool(_LINEAR.search(name)) or any(_LINEAR.search(column) for column in table.names)
    if streams.force is None and not _LINEAR.search(name) and (force := _columns(table, _ACCELERATION)):
        streams.force = Series(t, table.vector(force))
    if streams.rate is None and (rate := _columns(table, _RATE)):
        streams.rate = Series(t, table.vector(rate))
    if streams.fix is None:
        _location(table, t, streams)
    return linear


def _location(table: DataTable, t: Floats, streams: Streams) -> None:
    """Fixes and velocities of a table with latitude and longitude; of two altitudes the one over WGS 84."""

    def of(unit: re.Pattern[str], without: Sequence[int] = ()) -> list[int]:
        return [i for i, name in enumerate(table.names) if unit.search(name) and i not in without]

    def named(words: re.Pattern[str], among: list[int], otherwise: int) -> list[int]:
        """The columns of a name first; where there is none, the one at this place."""
        return [i for i in among if words.search(table.names[i])] or among[otherwise : otherwise + 1]

    def numbers(columns: list[int]) -> Floats:
        return table.numbers(columns[0]) if columns else np.full(t.size, np.nan)

    accuracies = of(_ACCURACY)
    degrees, metres, speeds = of(_DEGREES, accuracies), of(_METRES, accuracies), of(_SPEED)
    if len(degrees) < 2:
        return
    latitude, longitude = named(_LATITUDE, degrees, 0), named(_LONGITUDE, degrees, 1)
    altitude = named(re.compile("WGS", re.IGNORECASE), metres, 0)
    if not accuracies:  # a language without words here
        accuracies = [i for i in metres[1:] if i not in altitude]
        vertical = accuracies[1:]
    else:
        vertical = [i for i in accuracies if _VERTICAL.search(table.names[i])]
    horizontal = [i for i in accuracies if i not in vertical]
    places = (numbers(columns) for columns in (latitude, longitude, altitude, horizontal, vertical))
    streams.fix = phone_fix(t, *places)
    if speeds and (course := [i for i in degrees if i not in (latitude[0], longitude[0])]):
        streams.add_course(t, numbers(speeds), numbers(course), "speed and direction")


def _to_epoch(source: RecordedFiles, streams: Streams) -> None:
    """Replace the time of the experiment by that of the clock."""
    name = source.find("meta/time.csv") or source.find("time.csv")
    if name is None:
        streams.warnings.append(
            f"{source.path}: no meta/time.csv: times count from the start of the experiment"
        )
        return
    table = read_table(source.read(name), source.label(name), header=True)
    events = [value.strip().strip('"').upper() for value in table.text(0)]
    experiment, system = table.numbers(1), table.numbers(2)
    clock = ExperimentTime.of_events(events, experiment, system)
    if not clock.begin.size:
        raise InputError(source.label(name), "holds no START")
    if pauses := clock.begin.size - 1:
        streams.notes.append(f"time: the recording was paused {pauses} times")
    for name in ("force", "rate", "fix", "velocity"):
        if (stream := getattr(streams, name)) is not None:
            setattr(streams, name, replace(stream, t=clock.utc(stream.t)))
