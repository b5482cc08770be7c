# SPDX-License-Identifier: Apache-2.0
"""CSV files of logger apps that have every sensor in one table: a row of the table :data:`_APPS` each.

Sources: files that the apps wrote, in public repositories. AndroSensor: ``ACCELEROMETER X (m/s²)``,
``LOCATION Latitude :``, times like ``2019-09-07 09:13:29:506``. SensorLog (iOS): ``accelerometerAccelerationX(G)`` in
Apple's sign, which is that of gravity. Physics Toolbox Sensor Suite: ``gFx``, ``wx``, seconds or times of the day.
RaceChrono's CSV of version 3: a preamble, then names, units and sources.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import text_to_posix
from suspension_twin.drive.foreign_files import DataTable, RecordedFiles, read_table
from suspension_twin.drive.streams import Series, Streams, phone_fix
from suspension_twin.errors import InputError
from suspension_twin.units import STANDARD_GRAVITY

__all__ = ["TITLE", "read", "recognises"]

TITLE = "AndroSensor, SensorLog, Physics Toolbox, RaceChrono"


@dataclass(frozen=True)
class _App:
    """Columns of one app as regular expressions on their names, ``{}`` for x, y and z, and factors to SI units.

    ``place``: latitude, longitude, altitude, horizontal and vertical accuracy, speed, course; an empty one for a column
    that the app does not have.
    """

    title: str
    time: str
    force: tuple[str, float]
    rate: tuple[str, float]
    place: tuple[str, ...]
    speed: float = 1.0


_APPS: Final = (
    _App(
        "AndroSensor",
        r"(date )?\(?yyyy-mo-dd",
        (r"accelerometer {} \(m/s", 1.0),
        (r"gyroscope {} \(rad/s", 1.0),
        (
            r"(location|gps) latitude",
            r"(location|gps) longitude",
            r"(location|gps) altitude \(",
            r"(location|gps) accuracy",
            "",
            r"(location|gps) speed \( ?kmh",
            r"(location|gps) orientation",
        ),
        1.0 / 3.6,
    ),
    _App(
        "SensorLog",
        r"loggingtime\(txt\)",
        (r"accelerometeracceleration{}\(g\)", -STANDARD_GRAVITY),
        (r"(gyrorotation|motionrotationrate){}\(rad/s\)", 1.0),
        (
            r"locationlatitude",
            r"locationlongitude",
            r"locationaltitude",
            r"locationhorizontalaccuracy",
            r"locationverticalaccuracy",
            r"locationspeed\(m/s\)",
            r"locationcourse\(",
        ),
    ),
    _App(
        "Physics Toolbox",
        r"time$",
        (r"gf{}$", STANDARD_GRAVITY),
        (r"w{}$", 1.0),
        (r"latitude", r"longitude", r"altitude", "", "", r"speed \(m/s\)", r"(bearing|heading)"),
    ),
    _App(
        "RaceChrono",
        r"timestamp$",
        (r"{}_acc$", STANDARD_GRAVITY),
        (r"{}_rate_of_rotation$", math.radians(1.0)),
        (r"latitude", r"longitude", r"altitude", "", "", r"speed$", r"bearing$"),
    ),
)


def recognises(source: RecordedFiles) -> bool:
    """A line of names with an app's columns of acceleration and time, in a file that is alone."""
    return len(source.names) == 1 and _layout(source) is not None


def _layout(source: RecordedFiles) -> tuple[_App, int] | None:
    """The app, and the lines of the file before that of the names."""
    lines = source.head(source.names[0], 16384).decode("utf-8", "replace").splitlines()
    for number, line in enumerate(lines[:40]):
        names = [_plain(name) for name in re.split(r"[,;\t]", line)]
        for app in _APPS:
            wanted = [app.time, *(app.force[0].replace("{}", axis) for axis in "xyz")]
            if all(any(re.match(pattern, name) for name in names) for pattern in wanted):
                return app, number
    return None


def _plain(name: str) -> str:
    return " ".join(name.strip().strip('"').casefold().split())


def read(source: RecordedFiles) -> Streams:
    """Accelerometer with gravity, gyroscope and location."""
    if (found := _layout(source)) is None:
        raise InputError(source.path, f"no CSV file of {TITLE}")
    app, number = found
    name = source.names[0]
    table = read_table(source.read(name), source.label(name), header=number)
    names = [_plain(column) for column in table.names]

    def column(pattern: str) -> int | None:
        return next((i for i, n in enumerate(names) if pattern and re.match(pattern, n)), None)

    def vector(sensor: tuple[str, float]) -> Floats | None:
        indices = [column(sensor[0].replace("{}", axis)) for axis in "xyz"]
        known = [i for i in indices if i is not None]
        return table.vector(known) * sensor[1] if len(known) == 3 else None

    streams = Streams(origin=app.title, warnings=list(table.warnings))
    time = column(app.time)
    assert time is not None
    t = _times(table, time, streams)
    rows = np.arange(t.size) >= np.argmax(np.isfinite(t))  # what stands above the first stamp are units
    force, rate = vector(app.force), vector(app.rate)
    if force is not None:
        streams.force = Series(t[rows], force[rows], "m/s²")
    if rate is None:
        raise InputError(table.label, f"a recording of {app.title} without its gyroscope: switch it on")
    streams.rate = Series(t[rows], rate[rows])
    place = [column(pattern) for pattern in app.place]
    if place[0] is not None and place[1] is not None:
        columns = [np.full(t.size, np.nan) if i is None else table.numbers(i) for i in place]
        _location(t, columns, app.speed, streams)
    return streams


def _times(table: DataTable, column: int, streams: Streams) -> Floats:
    """POSIX times of stamps in s or of dates and times."""
    numbers = table.numbers(column)
    if np.isfinite(numbers).sum() >= 0.5 * numbers.size:
        if np.nanmedian(numbers) < 1e8:
            streams.warnings.append(f"{table.label}: its times have no date: they count from 1970")
        return numbers
    texts = table.text(column)
    t = text_to_posix(texts)
    if not np.isfinite(t).any():
        t = text_to_posix(texts, 0.0)
        if not np.isfinite(t).any():
            raise InputError(
                table.label, f"column {table.names[column]}", f"{texts[0]!r} is no date and time"
            )
        streams.warnings.append(f"{table.label}: its times have no date: they are of the first day of 1970")
    return t


def _location(t: Floats, columns: list[Floats], speed: float, streams: Streams) -> None:
    """Fixes and velocities; rows that repeat a place, as a table of faster sensors has them, are left to the intake."""
    table = np.stack(columns)
    known = np.isfinite(table[:2]).all(axis=0) & np.isfinite(t)
    if not known.any():
        return
    latitude, longitude, altitude, horizontal, vertical, velocity, course = table[:, known]
    streams.fix = phone_fix(t[known], latitude, longitude, altitude, horizontal, vertical)
    if np.isfinite(velocity).any():
        streams.add_course(t[known], velocity * speed, course)
