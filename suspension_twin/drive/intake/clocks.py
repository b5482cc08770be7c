# SPDX-License-Identifier: Apache-2.0
"""Clocks of recordings: units, GPS time and its leap seconds, RTKLIB's time tags.

A drive's time is POSIX time, so UTC without leap seconds.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import lru_cache
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = [
    "GPS_EPOCH",
    "TIME_UNITS",
    "gps_to_posix",
    "iso_to_posix",
    "rtklib_tag",
    "text_to_posix",
    "week_to_posix",
]

#: POSIX time of 1980-01-06, the beginning of GPS time.
GPS_EPOCH: Final = 315_964_800.0
WEEK: Final = 604_800.0

TIME_UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0}

# Leap seconds since 1980 (IERS Bulletin C): from this UTC date on, GPS time is so many s ahead.
_LEAPS = (
    ("1981-07-01", 1),
    ("1982-07-01", 2),
    ("1983-07-01", 3),
    ("1985-07-01", 4),
    ("1988-01-01", 5),
    ("1990-01-01", 6),
    ("1991-01-01", 7),
    ("1992-07-01", 8),
    ("1993-07-01", 9),
    ("1994-07-01", 10),
    ("1996-01-01", 11),
    ("1997-07-01", 12),
    ("1999-01-01", 13),
    ("2006-01-01", 14),
    ("2009-01-01", 15),
    ("2012-07-01", 16),
    ("2015-07-01", 17),
    ("2017-01-01", 18),
)


def iso_to_posix(text: str) -> float:
    """POSIX time of an ISO 8601 date and time, UTC where it names no zone; ValueError otherwise."""
    moment = datetime.fromisoformat(text.strip().replace("Z", "+00:00").replace("/", "-"))
    return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()


_MOMENT = re.compile(
    r"\s*(?P<date>\d[\w./-]*?)[T\s]+(?P<h>\d{1,2}):(?P<m>\d\d)(?::(?P<s>\d\d(?:[.,]\d+)?))?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>Z|UTC|GMT|[+-]\d\d:?\d\d)?\s*$"
)
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d-%b-%Y", "%d.%m.%Y", "%m/%d/%Y", "%Y%m%d")


@lru_cache(maxsize=64)
def _date(text: str) -> float:
    for pattern in _DATES:
        try:
            return datetime.strptime(text, pattern).replace(tzinfo=timezone.utc).timestamp()
        except ValueError:
            continue
    return float("nan")


def text_to_posix(texts: Sequence[str]) -> Floats:
    """POSIX times (n,) of dates and times as programs write them; UTC where none names a zone, NaN
    where it is no date and time. ``05/06/2024`` is taken as May, as American programs mean it."""
    t = np.full(len(texts), np.nan)
    for i, text in enumerate(texts):
        match = _MOMENT.match(text)
        if match is None:
            continue
        hour = int(match["h"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"].lower() == "pm" else 0)
        second = float((match["s"] or "0").replace(",", "."))
        zone = match["zone"] or "Z"
        shift = 0
        if zone[0] in "+-":
            shift = (int(zone[1:3]) * 60 + int(zone[-2:])) * (60 if zone[0] == "+" else -60)
        t[i] = _date(match["date"]) + hour * 3600 + int(match["m"]) * 60 + second - shift
    return t


_AHEAD = np.array([iso_to_posix(date) + seconds for date, seconds in _LEAPS])
_SECONDS = np.array([0] + [seconds for _, seconds in _LEAPS], dtype=np.float64)


def gps_to_posix(t: Floats) -> Floats:
    """POSIX time of GPS time that was counted as if it were UTC (calendar dates in GPST)."""
    return np.asarray(t - _SECONDS[np.searchsorted(_AHEAD, t, side="right")])


def week_to_posix(week: Floats, seconds: Floats) -> Floats:
    """POSIX time of GPS week and second of the week."""
    return gps_to_posix(GPS_EPOCH + week * WEEK + seconds)


def rtklib_tag(data: bytes, label: str) -> tuple[float, float]:
    """First and last time in a time tag file of RTKLIB's stream server, as GPS time counted as UTC.

    The file: 60 bytes of text, u32 tick, u32 seconds and f64 fraction of GPST at the start, then
    pairs (u32 ms since the start, u32 position in the logged file).
    """
    if not data.startswith(b"TIMETAG RTKLIB") or len(data) < 84:
        raise InputError(label, "not a time tag file of RTKLIB")
    seconds, fraction = struct.unpack_from("<Id", data, 64)
    pairs = np.frombuffer(data, dtype="<u4", count=(len(data) - 76) // 8 * 2, offset=76)
    start = seconds + fraction
    return start, start + float(pairs[-2]) * 1e-3
