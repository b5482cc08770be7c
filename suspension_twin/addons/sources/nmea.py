# SPDX-License-Identifier: Apache-2.0
"""``nmea:/dev/ttyUSB0`` or ``nmea://HOST:PORT``: a receiver that sends NMEA 0183 sentences.

Of an epoch (the sentences of one time) GGA gives the position, RMC the velocity and the date, GST the standard
deviations, HDT or THS the heading. The epoch is handed on when the last of the sentences has come that the epoch
before had.

Option: ``baud`` bit/s of a serial port.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import date, datetime, time, timedelta, timezone
from typing import Any, Final

import numpy as np
from pynmeagps import NMEAReader
from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEATypeError

from suspension_twin.addons.sources.common.connection import Address
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.receiver import Receiver
from suspension_twin.drive.types import FixData, HeadingData

__all__ = ["EXAMPLE", "TITLE", "Nmea", "make"]

TITLE = "NMEA receiver"
EXAMPLE = "nmea:/dev/ttyUSB0"

_KNOT: Final = 1852.0 / 3600.0  # m/s, exactly (BIPM)
_LONGEST: Final = 512  # bytes of a sentence; NMEA 0183 allows 82, some receivers send more
_USED: Final = ("GGA", "RMC", "GST", "HDT", "THS")
#: NavSatStatus and, where no GST comes, the standard deviation in m, by the quality of GGA: 1 autonomous, 2
#: differential, 4 and 5 RTK fixed and float. Autonomous ones have no number: the node has
#: its parameter fix_sigma.
_QUALITY: Final = {
    1: (0, math.nan),
    2: (1, math.nan),
    3: (0, math.nan),
    4: (2, 0.02),
    5: (2, 0.5),
    9: (1, math.nan),
}


class Nmea(Receiver):
    """One receiver."""

    steps: Sequence[str] = (
        "Switch GGA, RMC and GST on in the receiver, at 5 Hz or more.",
        "Antenna on the roof; its place belongs into the twin file (gps.position).",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        super().__init__(address, hub, rank, "NMEA", 9600)
        self._rest = b""
        self._epoch: dict[str, Any] = {}
        self._time: time | None = None
        self._expected: frozenset[str] = frozenset()
        self._done = False
        self._dated: datetime | None = None

    def feed(self, data: bytes, arrival: float) -> None:
        """See the base class."""
        lines = (self._rest + data).split(b"\n")
        self._rest = lines.pop()[-_LONGEST:]
        for line in lines:
            start = line.rfind(b"$")
            if start >= 0 and line[start + 3 : start + 6].decode("ascii", "replace") in _USED:
                self._sentence(line[start:].rstrip() + b"\r\n", arrival)
            elif start >= 0 and b"*" in line:
                self.understood += 1

    def _sentence(self, line: bytes, arrival: float) -> None:
        try:
            self._read(NMEAReader.parse(line), arrival)
        except (
            NMEAParseError,
            NMEAMessageError,
            NMEATypeError,
            ArithmeticError,
            ValueError,
            TypeError,
            IndexError,
            AttributeError,  # a sentence that ends before a field
        ):
            self.device.counts["sentences that cannot be read"] += 1

    def _read(self, message: Any, arrival: float) -> None:
        kind = getattr(message, "msgID", None)
        if kind not in _USED:  # a proprietary sentence that only looked like one of them
            return
        self.understood += 1
        at = getattr(message, "time", None)
        if kind in ("HDT", "THS"):
            at = self._time
        if not isinstance(at, time):
            return  # before the receiver knows the time
        if at != self._time:
            self._end(arrival)
            self._expected = frozenset(self._epoch)
            self._epoch, self._time, self._done = {}, at, False
        if kind == "RMC" and isinstance(message.date, date):
            self._dated = datetime.combine(message.date, at, timezone.utc)
        self._epoch[kind] = message
        if self._expected and self._expected <= self._epoch.keys():
            self._end(arrival)

    def _end(self, arrival: float) -> None:
        """Hand the epoch on, once."""
        if self._done or self._time is None or not self._epoch:
            return
        self._done = True
        t = np.array([self._utc(self._time, arrival)])
        place, motion, sigma = (self._epoch.get(kind) for kind in ("GGA", "RMC", "GST"))
        if place is not None:
            self._place(t, place, sigma, arrival)
        if motion is not None and motion.status == "A":
            speed, course = np.array([_number(motion.spd) * _KNOT]), np.array([_number(motion.cog)])
            self.device.course(t, speed, course, arrival)
        heading = self._epoch.get("HDT") or self._epoch.get("THS")
        if heading is not None and getattr(heading, "mi", "A") == "A":
            degrees = _number(heading.headingT if heading.msgID == "HDT" else heading.headt)
            self.device.heading(HeadingData(t, np.array([math.radians(90.0 - degrees)])), arrival)

    def _place(self, t: Any, place: Any, sigma: Any, arrival: float) -> None:
        quality = place.quality if isinstance(place.quality, int) else 0
        if quality not in _QUALITY:
            self.device.counts["epochs without a fix"] += 1
            return
        status, typical = _QUALITY[quality]
        spread = np.array([[typical, typical, 2.0 * typical]])
        if sigma is not None:
            given = np.array([[_number(sigma.stdLong), _number(sigma.stdLat), _number(sigma.stdAlt)]])
            spread = np.where(given > 0, given, spread)
        height = _number(place.alt) + np.nan_to_num(_number(place.sep))
        self.device.fix(
            FixData(
                t,
                np.array([_number(place.lat)]),
                np.array([_number(place.lon)]),
                np.array([height]),
                np.array([status], dtype=np.int8),
                spread,
            ),
            arrival,
        )

    def _utc(self, at: time, arrival: float) -> float:
        """POSIX time; the date is the one that comes nearest to the last RMC, or to this machine's time."""
        known = self._dated or datetime.fromtimestamp(arrival, timezone.utc)
        moment = datetime.combine(known.date(), at, timezone.utc)
        days = (moment + timedelta(days=d) for d in (-1, 0, 1))
        return min(days, key=lambda m: abs(m - known)).timestamp()


def _number(value: object) -> float:
    """NaN for a field that is empty."""
    return float(value) if isinstance(value, int | float) else math.nan


#: See ``SourceModule``.
make = Nmea
