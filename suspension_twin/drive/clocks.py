# SPDX-License-Identifier: Apache-2.0
"""Clocks of recordings: units, GPS time and its leap seconds, RTKLIB's time tags, phyphox's time of an experiment.

A drive's time is POSIX time, so UTC without leap seconds.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = [
    "GPS_EPOCH",
    "ROLLOVER",
    "TIME_UNITS",
    "ExperimentTime",
    "gps_to_posix",
    "iso_to_posix",
    "rolled_over",
    "rtklib_tag",
    "text_to_posix",
    "week_to_posix",
]

#: POSIX time of 1980-01-06, the beginning of GPS time.
GPS_EPOCH: Final = 315_964_800.0
_WEEK: Final = 604_800.0
#: s after which the week number of GPS begins again (10 bits, IS-GPS-200): the dates of a receiver that does not
#: know how often it did are so far back, or a multiple.
ROLLOVER: Final = 1024 * _WEEK

TIME_UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0}

#: Leap seconds since 1980 (IERS Bulletin C): from each of these UTC dates on, GPS time is 1 s more ahead.
_LEAPS: Final = [
    "1981-07-01",
    "1982-07-01",
    "1983-07-01",
    "1985-07-01",
    "1988-01-01",
    "1990-01-01",
    "1991-01-01",
    "1992-07-01",
    "1993-07-01",
    "1994-07-01",
    "1996-01-01",
    "1997-07-01",
    "1999-01-01",
    "2006-01-01",
    "2009-01-01",
    "2012-07-01",
    "2015-07-01",
    "2017-01-01",
]


def iso_to_posix(text: str) -> float:
    """POSIX time of an ISO 8601 date and time, UTC where it names no zone; ValueError otherwise."""
    moment = datetime.fromisoformat(text.strip().replace("Z", "+00:00").replace("/", "-"))
    return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()


_MOMENT = re.compile(
    r"\s*(?:(?P<date>\d[\w./-]*?)[T\s,]+)?(?P<h>\d{1,2}):(?P<m>\d\d)"
    r"(?::(?P<s>\d\d(?:[.,]\d+)?)(?::(?P<ms>\d{3}))?)?\s*(?P<half>[AaPp][Mm])?"
    r"\s*(?:Z|UTC|GMT)?\s*(?:(?P<sign>[+-])(?P<zh>\d\d?)(?::?(?P<zm>\d\d))?)?\s*$"
)
#: Dates as programs write them. Of several that fit a column the first is taken, so month before day as in America.
_DATES = (
    "%Y-%m-%d",
    "%Y/%m/%d",
    "%d-%b-%Y",
    "%d.%m.%Y",
    "%m/%d/%Y",
    "%d/%m/%Y",
    "%d-%m-%Y",
    "%Y%m%d",
)
_DAY: Final = 86_400.0


def _dates(texts: set[str]) -> dict[str, float]:
    """POSIX time of dates, all by the one pattern that reads most of them; those that it does not read are left out."""

    def read(pattern: str) -> dict[str, float]:
        found = {}
        for text in texts:
            with suppress(ValueError):
                found[text] = datetime.strptime(text, pattern).replace(tzinfo=timezone.utc).timestamp()
        return found

    return max(map(read, _DATES), key=len)


def text_to_posix(texts: Sequence[str], day: float = math.nan) -> Floats:
    """POSIX times (n,) of dates and times as programs write them; UTC where none names a zone, NaN
    where it is no date and time. ``05/06/2024`` is taken as May, as American programs mean it, unless another date of
    the column has no such month. Times without a date count from ``day`` (s) and go on past midnight."""
    t = np.full(len(texts), np.nan)
    matches = [_MOMENT.match(text) for text in texts]
    dates = _dates({match["date"] for match in matches if match is not None and match["date"]})
    before = 0.0
    for i, match in enumerate(matches):
        if match is None:
            continue
        hour = int(match["h"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"].lower() == "pm" else 0)
        second = float((match["s"] or "0").replace(",", ".")) + int(match["ms"] or 0) * 1e-3
        second += hour * 3600 + int(match["m"]) * 60
        if not match["date"]:
            if second < before - 0.5 * _DAY:
                day += _DAY
            before = second
        shift = (int(match["zh"] or 0) * 60 + int(match["zm"] or 0)) * (-60 if match["sign"] == "-" else 60)
        t[i] = (dates.get(match["date"], math.nan) if match["date"] else day) + second - shift
    return t


#: GPS time counted as UTC at which each leap second has passed.
_AHEAD: Final = np.array([iso_to_posix(date) + i for i, date in enumerate(_LEAPS, start=1)])


def gps_to_posix(t: Floats) -> Floats:
    """POSIX time of GPS time that was counted as if it were UTC (calendar dates in GPST)."""
    return np.asarray(t - np.searchsorted(_AHEAD, t, side="right").astype(np.float64))


def week_to_posix(week: Floats, seconds: Floats) -> Floats:
    """POSIX time of GPS week and second of the week."""
    return gps_to_posix(GPS_EPOCH + week * _WEEK + seconds)


def rolled_over(t: float, now: float) -> float:
    """By how many s a receiver's time ``t`` s is back because its week number began again, at about ``now`` s; or 0."""
    back = ROLLOVER * max(round((now - t) / ROLLOVER), 0)
    return back if abs(now - t - back) < 86_400.0 else 0.0


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


@dataclass(frozen=True, eq=False)
class ExperimentTime:
    """phyphox's time of an experiment, which stands still during pauses, beside UTC: at ``begin`` (k,) s, when it was
    started or went on, UTC was ``offset`` (k,) s more."""

    begin: Floats
    offset: Floats

    @classmethod
    def of_events(cls, events: Sequence[str], experiment: Floats, system: Floats) -> ExperimentTime:
        """From the events START and PAUSE, and both clocks in s at each; others are left out."""
        known = np.isfinite(experiment) & np.isfinite(system)
        starts = [i for i, event in enumerate(events) if event == "START" and known[i]]
        return cls(experiment[starts], system[starts] - experiment[starts])

    def utc(self, t: Floats) -> Floats:
        """UTC in s of experiment times ``t`` (n,) s."""
        # a sample at the very moment of a pause belongs to the segment before it
        segment = np.clip(np.searchsorted(self.begin, t, side="left") - 1, 0, self.begin.size - 1)
        return np.asarray(t + self.offset[segment])
