# SPDX-License-Identifier: Apache-2.0
"""RTKLIB solution files (``.pos``): positions with their quality, velocities if they were put out.

Sources: RTKLIB manual, section B.1 "Positioning solution file", and ``src/solution.c``. The line of
column names, which begins with ``%`` and the time system (GPST, UTC or JST), names the columns:
time as date and time or as GPS week and second; latitude and longitude in degrees or in degrees,
minutes and seconds; or x, y, z (ECEF). Standard deviations come in the order north, east, up; an
off-diagonal one carries the sign of its covariance. Q: 1 fix, 2 float, 3 SBAS, 4 DGPS, 5 single,
6 PPP, 7 dead reckoning.
"""

from __future__ import annotations

import re

import numpy as np
import pymap3d

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import gps_to_posix, text_to_posix, week_to_posix
from suspension_twin.drive.foreign_files import RecordedFiles, number
from suspension_twin.drive.streams import Streams
from suspension_twin.drive.types import FixData, VelocityData
from suspension_twin.errors import InputError

__all__ = ["TITLE", "read", "recognises"]

TITLE = "RTKLIB"

_SYSTEMS = ("GPST", "UTC", "JST")
_DEFAULT = (
    "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
)
# sensor_msgs/NavSatStatus by Q: fix and float are ground-based augmentation
_STATUS = {1: 2, 2: 2, 3: 1, 4: 2, 5: 0, 6: 0}
_QUALITY = {1: "fix", 2: "float", 3: "SBAS", 4: "DGPS", 5: "single", 6: "PPP", 7: "dead reckoning"}


def recognises(source: RecordedFiles) -> bool:
    """A file with RTKLIB's header, or one that ends in ``.pos``."""
    return _solution(source) is not None


def _solution(source: RecordedFiles) -> str | None:
    for name in source.names:
        if name.lower().endswith(".pos"):
            return name
    if len(source.names) == 1:
        head = source.head(source.names[0])
        if head.startswith(b"%") and (b"GPST" in head or b"UTC" in head) and b"Q" in head:
            return source.names[0]
    return None


def read(source: RecordedFiles) -> Streams:
    """Positions and, where they were put out, velocities."""
    name = _solution(source)
    assert name is not None
    return read_solution(source.read(name), source.label(name))


def read_solution(data: bytes, label: str) -> Streams:
    """Positions and velocities of one file; InputError where it is none."""
    streams = Streams(origin=TITLE)
    system, names, rows = _parse(data.decode("utf-8", "replace"), label, streams)
    t = _times(rows, system, label)
    timed = np.isfinite(t)
    if not timed.all():
        streams.warnings.append(f"{label}: {int((~timed).sum())} lines begin with no time: left out")
        t, rows = t[timed], [row for row, good in zip(rows, timed, strict=True) if good]
    values = np.array([[number(v) for v in row[2 : 2 + len(names)]] for row in rows], dtype=np.float64)
    columns = {re.sub(r"\(.*\)", "", name).lower(): values[:, i] for i, name in enumerate(names)}
    quality = columns.get("q", np.full(t.size, 5.0))
    if {"latitude", "longitude", "height"} <= columns.keys():
        place = np.stack([columns["latitude"], columns["longitude"], columns["height"]], axis=1)
        sigma = _sigma(columns, ("sde", "sdn", "sdu"))
    elif {"x-ecef", "y-ecef", "z-ecef"} <= columns.keys():
        xyz = np.stack([columns["x-ecef"], columns["y-ecef"], columns["z-ecef"]], axis=1)
        place = np.stack(pymap3d.ecef2geodetic(*xyz.T), axis=1)
        sigma = _sigma_from_ecef(columns, place)
    else:
        raise InputError(
            label, "holds no positions: put the solution out as latitude, longitude, height or x, y, z"
        )
    status = np.array([_STATUS.get(int(q) if np.isfinite(q) else 0, -1) for q in quality], dtype=np.int8)
    streams.fix = FixData(t, place[:, 0], place[:, 1], place[:, 2], status, sigma)
    counts = {int(q): int((quality == q).sum()) for q in np.unique(quality[np.isfinite(quality)])}
    share = ", ".join(f"{count} {_QUALITY.get(q, f'Q={q}')}" for q, count in counts.items())
    streams.notes.append(f"RTKLIB: times in {system}; {share}")
    streams.velocity = _velocity(t, columns, place)
    if streams.velocity is None:
        streams.notes.append("RTKLIB: no velocities put out")
    return streams


def _parse(text: str, label: str, streams: Streams) -> tuple[str, list[str], list[list[str]]]:
    """Time system, column names after the time, and rows whose first two fields are the time."""
    system, head = "GPST", ""
    lines = text.splitlines()
    for line in lines:
        words = line.lstrip("% ").replace(",", " ").split()
        if line.startswith("%") and words and words[0] in _SYSTEMS and len(words) > 3:
            system, head = words[0], " ".join(words[1:])
    if not head:
        head = _DEFAULT
        streams.warnings.append(
            f"{label}: no line of column names: taken as latitude, longitude, height in GPST"
        )
    rows = [re.split(r"[\s,;]+", line.strip()) for line in lines if line.strip() and not line.startswith("%")]
    names = head.split()
    if any(n.startswith("latitude") and "deg" not in n for n in names):
        rows = [_degrees(row) for row in rows]
    whole = [row for row in rows if len(row) >= 2 + len(names)]
    if len(whole) < len(rows):
        streams.warnings.append(f"{label}: {len(rows) - len(whole)} lines are not whole: left out")
    if not whole:
        raise InputError(label, "holds no positions")
    return system, names, whole


def _degrees(row: list[str]) -> list[str]:
    """Degrees, minutes and seconds of latitude and longitude in one field each."""
    if len(row) < 8:
        return []
    angles = []
    for at in (2, 5):
        degrees, minutes, seconds = (number(value) for value in row[at : at + 3])
        sign = -1.0 if row[at].startswith("-") else 1.0
        angles.append(repr(sign * (abs(degrees) + minutes / 60 + seconds / 3600)))
    return row[:2] + angles + row[8:]


def _times(rows: list[list[str]], system: str, label: str) -> Floats:
    """POSIX times of date and time or of week and second; NaN where a line has neither."""
    posix = text_to_posix([f"{row[0]} {row[1]}" for row in rows])
    if np.isfinite(posix).any():
        posix = gps_to_posix(posix) if system == "GPST" else posix - (9 * 3600.0 if system == "JST" else 0.0)
    else:
        week, seconds = (np.array([number(row[i]) for row in rows]) for i in (0, 1))
        posix = np.where((week > 0) & (week < 10_000), week_to_posix(week, seconds), np.nan)
    if not np.isfinite(posix).any():
        raise InputError(label, "lines begin neither with a date nor with a GPS week")
    return posix


def _sigma(columns: dict[str, Floats], names: tuple[str, str, str]) -> Floats:
    """(n, 3) east, north, up; NaN where it was not put out or is 0."""
    missing = np.full(len(next(iter(columns.values()))), np.nan)
    sigma = np.stack([columns.get(name, missing) for name in names], axis=1)
    return np.where(sigma > 0, sigma, np.nan)


def _to_enu(place: Floats) -> Floats:
    """(n, 3, 3) rotations from ECEF to east, north, up at each place."""
    return np.stack(pymap3d.ecef2enuv(*np.eye(3), place[:, :1], place[:, 1:2]), axis=1)


def _sigma_from_ecef(columns: dict[str, Floats], place: Floats) -> Floats:
    if not {"sdx", "sdy", "sdz"} <= columns.keys():
        return np.full((place.shape[0], 3), np.nan)
    zero = np.zeros(place.shape[0])

    def covariance(name: str) -> Floats:
        value = columns.get(name, zero)
        return np.asarray(np.sign(value) * value**2)

    xx, yy, zz = (columns[name] ** 2 for name in ("sdx", "sdy", "sdz"))
    xy, yz, zx = covariance("sdxy"), covariance("sdyz"), covariance("sdzx")
    matrix = np.stack([np.stack(row, axis=1) for row in ([xx, xy, zx], [xy, yy, yz], [zx, yz, zz])], axis=1)
    rotation = _to_enu(place)
    variance = np.diagonal(rotation @ matrix @ rotation.transpose(0, 2, 1), axis1=1, axis2=2)
    return np.sqrt(np.where(variance > 0, variance, np.nan))


def _velocity(t: Floats, columns: dict[str, Floats], place: Floats) -> VelocityData | None:
    if {"vn", "ve", "vu"} <= columns.keys():
        return VelocityData(t, np.stack([columns["ve"], columns["vn"], columns["vu"]], axis=1))
    if {"vx", "vy", "vz"} <= columns.keys():
        xyz = np.stack([columns["vx"], columns["vy"], columns["vz"]], axis=1)
        return VelocityData(t, np.asarray((_to_enu(place) @ xyz[:, :, None])[:, :, 0]))
    return None
