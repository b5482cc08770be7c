# SPDX-License-Identifier: Apache-2.0
"""``gpsd://HOST:PORT``: a receiver by way of gpsd.

Source: gpsd_json(5). After ``?WATCH={"enable":true,"json":true};`` the daemon sends a JSON object a line; TPV has time,
position, velocity and their error estimates, ATT the heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from suspension_twin.addons.sources.common.connection import Address, number, read_object
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.receiver import ByteStream, Receiver
from suspension_twin.drive.clocks import iso_to_posix
from suspension_twin.drive.types import FixData, HeadingData, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.files import Json

__all__ = ["EXAMPLE", "TITLE", "Gpsd", "make"]

TITLE = "gpsd"
EXAMPLE = "gpsd://localhost:2947"

_PORT: Final = 2947
_LONGEST: Final = 65536  # bytes of a line: SKY of many satellites has some thousand
#: NavSatStatus by the ``status`` of TPV: 2 differential, 3 and 4 RTK.
_STATUS: Final = {2: 1, 3: 2, 4: 2}


@dataclass(frozen=True, eq=False)
class _Report:
    """A position, the other fields that were ``given`` (NaN: not) and how many of them are ``known``."""

    fix: FixData
    given: dict[str, float]
    known: int
    arrival: float


class Gpsd(Receiver):
    """One daemon; of several receivers behind it that report an epoch, the one that knows most of it."""

    steps: Sequence[str] = ("Antenna on the roof; its place belongs into the twin file (gps.position).",)

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        if not address.host:
            raise InputError(str(address), "names no host: write gpsd://HOST:PORT")
        super().__init__(replace(address, port=address.port or _PORT), hub, rank, TITLE, 9600)
        hub.correctors.remove(self._correct)  # gpsd has NTRIP of its own
        self._rest = b""
        self._best: _Report | None = None
        self._wanted, self._done = math.inf, False

    def opened(self, stream: ByteStream) -> None:
        """See the base class."""
        stream.write(b'?WATCH={"enable":true,"json":true};\n')

    def doubt(self) -> str:
        """See the base class."""
        return "sends nothing that can be read: is it gpsd?"

    def feed(self, data: bytes, arrival: float) -> None:
        """See the base class."""
        lines = (self._rest + data).split(b"\n")
        self._rest = lines.pop()[-_LONGEST:]
        for line in lines:
            try:
                report = read_object(line)
                self.understood += 1
                if report.get("class") == "TPV":
                    self._position(report, arrival)
                elif report.get("class") == "ATT":
                    self._attitude(report, arrival)
            except (KeyError, TypeError, ValueError, OverflowError, AttributeError, InputError):
                self.device.counts["reports with a wrong field"] += 1

    def _position(self, report: Json, arrival: float) -> None:
        if not isinstance(report.get("time"), str) or report.get("mode", 0) not in (2, 3):
            self.device.counts["epochs without a fix"] += 1
            return
        t = np.array([iso_to_posix(report["time"])])
        known = sum(name in report for name in _FIELDS)
        given: dict[str, float] = {
            name: number(report[name]) if name in report else math.nan for name in _FIELDS
        }
        circle = given["eph"] / math.sqrt(2.0)
        sigma = [circle if math.isnan(given[name]) else given[name] for name in ("epx", "epy")]
        height = given["altHAE"] if not math.isnan(given["altHAE"]) else given["alt"]
        fix = FixData(
            t,
            np.array([number(report["lat"])]),
            np.array([number(report["lon"])]),
            np.array([height]),
            np.array([_STATUS.get(report.get("status", 1), 0)], dtype=np.int8),
            np.array([[*sigma, given["epv"]]]),
        )
        self._take(_Report(fix, given, known, arrival))

    def _take(self, report: _Report) -> None:
        """Hand on the most complete report of an epoch, once: as soon as it has as many fields as that of the epoch
        before, or when the next epoch begins. gpsd reports an epoch again when it knows more of it."""
        best = self._best
        if best is None or report.fix.t[0] != best.fix.t[0]:
            if best is not None:
                self._wanted = best.known
                if not self._done:
                    self._hand_on(best)
            self._best, self._done = report, False
        elif report.known > best.known:
            self._best = report
        if not self._done and report.known >= self._wanted:
            self._done = True
            self._hand_on(report)

    def _hand_on(self, report: _Report) -> None:
        fix, given, arrival = report.fix, report.given, report.arrival
        self.device.fix(fix, arrival)
        if math.isnan(given["velN"] + given["velE"]):
            self.device.course(fix.t, np.array([given["speed"]]), np.array([given["track"]]), arrival)
        else:
            down = given["velD"] if not math.isnan(given["velD"]) else -given["climb"]
            enu = [given["velE"], given["velN"], -down]
            self.device.velocity(VelocityData(fix.t, np.array([enu])), arrival)

    def _attitude(self, report: Json, arrival: float) -> None:
        if "heading" in report and isinstance(report.get("time"), str):
            yaw = math.radians(90.0 - number(report["heading"]))
            self.device.heading(
                HeadingData(np.array([iso_to_posix(report["time"])]), np.array([yaw])), arrival
            )


_FIELDS: Final = (
    "altHAE",
    "alt",
    "eph",
    "epx",
    "epy",
    "epv",
    "speed",
    "track",
    "climb",
    "velN",
    "velE",
    "velD",
)


#: See ``SourceModule``.
make = Gpsd
