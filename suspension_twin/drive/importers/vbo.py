# SPDX-License-Identifier: Apache-2.0
"""VBO files of Racelogic's VBOX, which RaceChrono and others write too: positions, velocities, maybe an IMU.

Source: Racelogic, "VBO file format" and "VBOX latitude and longitude calculations" (racelogic.support). Sections in
brackets; ``[column names]`` names what each row of ``[data]`` holds, with blanks between. Latitude and longitude are in
minutes, west positive; time is HHMMSS.ss of UTC on the day in "File created on"; speed is in km/h unless ``[header]``
names another unit; to the number of satellites 64 is added for a differential solution, 128 for the brake trigger.
"""

from __future__ import annotations

import re

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import text_to_posix
from suspension_twin.drive.foreign_files import DataTable, RecordedFiles, read_table
from suspension_twin.drive.streams import Series, Streams
from suspension_twin.drive.types import FixData
from suspension_twin.errors import InputError

__all__ = ["TITLE", "read", "recognises"]

TITLE = "VBO"

_SPEEDS = {"knots": 1852.0 / 3600.0, "kts": 1852.0 / 3600.0, "mph": 0.44704, "m/s": 1.0}
#: Names of a column, the long one of VBOX Tools and the short one of the file.
_NAMES = {
    "sats": ("sats", "satellites"),
    "time": ("time",),
    "lat": ("lat", "latitude"),
    "long": ("long", "longitude"),
    "speed": ("velocity", "velocity_kmh", "speed"),
    "heading": ("heading",),
    "height": ("height",),
    "rise": ("vert-vel", "vertical_velocity", "vertical-velocity"),
}
_FORCE = [(f"{a}_accel", f"{a}accel", f"{a}_acc", f"accel_{a}") for a in "xyz"]
_RATE = [
    (f"{n}rate", f"{n}_rate", f"gyro_{a}", f"{a}_gyro")
    for n, a in (("roll", "x"), ("pitch", "y"), ("yaw", "z"))
]


def recognises(source: RecordedFiles) -> bool:
    """One file with the sections of a VBO."""
    if len(source.names) != 1:
        return False
    head = source.head(source.names[0], 65536).lower()
    return b"[column names]" in head and (b"[data]" in head or b"[header]" in head)


def read(source: RecordedFiles) -> Streams:
    """Positions and velocities, and accelerations with angular rates where there are three of each."""
    label = source.label(source.names[0])
    sections: dict[str, list[str]] = {"": []}
    lines = sections[""]
    for line in source.text(source.names[0]).splitlines():
        if section := re.fullmatch(r"\[(.+)\]", line.strip()):
            lines = sections.setdefault(section[1].lower(), [])
        elif line.strip():
            lines.append(line.strip())
    names = " ".join(sections.get("column names", [])).split()
    if not (rows := sections.get("data", [])):
        raise InputError(label, "holds no [data]")
    table = read_table("\n".join(rows).encode(), label, header=False, delimiter=" ")
    table.names = names
    streams = Streams(origin=TITLE, warnings=list(table.warnings))
    for key in ("time", "lat", "long"):
        if _column(table, *_NAMES[key]) is None:
            raise InputError(label, f"column {key}", f"is not there; the columns are {', '.join(names[:40])}")
    day = _day("\n".join(sections[""]), label, streams)
    stamp = _column(table, *_NAMES["time"])
    assert stamp is not None
    hours, minutes = stamp // 10_000, stamp // 100 % 100
    t = day + 3600.0 * hours + 60.0 * minutes + stamp % 100
    t += 86_400.0 * np.cumsum(np.diff(t, prepend=t[0]) < -43_200.0)
    _positions(table, t, "\n".join(sections.get("header", [])).lower(), streams)
    _inertial(table, t, streams)
    return streams


def _column(table: DataTable, *names: str) -> Floats | None:
    """The column that has one of the names."""
    known = [name.casefold() for name in table.names]
    found = next((known.index(name) for name in names if name in known), None)
    return None if found is None else table.numbers(found)


def _day(text: str, label: str, streams: Streams) -> float:
    """POSIX time of the day on which the file was made."""
    if found := re.search(r"(\d\d)/(\d\d)/(\d{4})", text):
        day = float(text_to_posix([f"{found[3]}-{found[2]}-{found[1]} 00:00:00"])[0])
        if np.isfinite(day):
            return day
    streams.warnings.append(f"{label}: names no day on which it was made: taken for the first day of 1970")
    return 0.0


def _positions(table: DataTable, t: Floats, header: str, streams: Streams) -> None:
    unknown = np.full(t.size, np.nan)

    def of(key: str) -> Floats:
        found = _column(table, *_NAMES[key])
        return unknown if found is None else found

    satellites = np.nan_to_num(of("sats"), nan=1.0).astype(np.int64)
    status = np.where(satellites % 64 == 0, -1, np.where(satellites & 64, 2, 0))
    sigma = np.full((t.size, 3), np.nan)
    place = of("lat") / 60.0, -of("long") / 60.0, of("height")
    streams.fix = FixData(t, *place, status.astype(np.int8), sigma)
    unit = next((u for u in _SPEEDS if f"velocity {u}" in header), None)
    speed = of("speed") * (1.0 / 3.6 if unit is None else _SPEEDS[unit])
    if np.isfinite(speed).any():
        streams.add_course(t, speed, of("heading"), f"speed ({unit or 'km/h'}) and heading")


def _inertial(table: DataTable, t: Floats, streams: Streams) -> None:
    force, rate = ([_column(table, *names) for names in axes] for axes in (_FORCE, _RATE))
    found = [column for column in (*force, *rate) if column is not None]
    if len(found) == 6:
        streams.force = Series(t, np.stack(found[:3], axis=1))
        streams.rate = Series(t, np.radians(np.stack(found[3:], axis=1)))
        streams.notes.append("angular rates: taken for deg/s, as VBOX logs them")
