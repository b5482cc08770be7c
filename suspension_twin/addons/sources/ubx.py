# SPDX-License-Identifier: Apache-2.0
"""``ubx:/dev/ttyACM0`` or ``ubx://HOST:PORT``: a u-blox receiver in its own binary protocol.

Source: u-blox F9 interface description. NAV-PVT gives time, position, velocity and their accuracies, NAV-HPPOSLLH of
the same epoch the digits of the position below 1 cm, NAV-RELPOSNED the heading from one antenna to another.

Options: ``baud`` bit/s of a serial port; ``rate`` Hz, which sets the receiver up for it and for these messages (in its
memory, until it is switched off); ``heading`` degrees by which the line from the first antenna to the second is turned
clockwise against the vehicle's forward axis: only then RELPOSNED counts as the vehicle's heading.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any, Final

import numpy as np
from pyubx2 import UBXMessage, UBXReader, calc_checksum
from pyubx2.exceptions import UBXMessageError, UBXParseError, UBXStreamError, UBXTypeError

from suspension_twin.addons.sources.common.connection import Address
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.receiver import ByteStream, Receiver
from suspension_twin.drive.types import FixData, HeadingData, VelocityData

__all__ = ["EXAMPLE", "TITLE", "Ubx", "make"]

TITLE = "u-blox receiver"
EXAMPLE = "ubx:/dev/ttyACM0"

_SYNC: Final = b"\xb5\x62"
_LONGEST: Final = 1200  # bytes of a frame that is waited for; those used have 100
_PVT, _HP, _RELATIVE = b"\x01\x07", b"\x01\x14", b"\x01\x3c"
#: NAV-HPPOSLLH: flags, iTOW; lon, lat in 1e-7 degrees, height in mm; then their digits below, in 1e-9 degrees and
#: 0.1 mm; horizontal and vertical accuracy in 0.1 mm.
_HP_FORMAT: Final = struct.Struct("<3xBIiiiibbbbII")
#: Raised for a frame that is none, lacks a field, or has a date that is none.
_WRONG: Final = (
    *(UBXParseError, UBXMessageError, UBXTypeError, UBXStreamError),
    *(ValueError, TypeError, AttributeError, struct.error),
)
#: Configuration keys of the messages, on each port that a computer may be at.
_MESSAGES: Final = ("UBX_NAV_PVT", "UBX_NAV_HPPOSLLH")
_PORTS: Final = ("USB", "UART1", "UART2")


class Ubx(Receiver):
    """One receiver."""

    steps: Sequence[str] = (
        "?rate=10 switches NAV-PVT and NAV-HPPOSLLH on, until the receiver is switched off.",
        "Antenna on the roof; its place belongs into the twin file (gps.position).",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        super().__init__(address, hub, rank, "u-blox", 38400, ("rate", "heading"))
        self._rate = address.number("rate", 0.0, 0.1, 50.0)
        self._turn = math.radians(address.number("heading", 0.0, -360.0, 360.0))
        self._has_heading = "heading" in address.options
        self._rest = b""
        self._precise: dict[int, bytes] = {}
        self._waits_for_precise = False
        self._pvt: tuple[int, Any, float] | None = None
        self._utc_of_week = math.nan

    def opened(self, stream: ByteStream) -> None:
        """Set the receiver up, if that was asked for."""
        if self._rate:
            keys: list[tuple[str | int, Any]] = [
                ("CFG_RATE_MEAS", round(1000.0 / self._rate)),
                ("CFG_RATE_NAV", 1),
            ]
            keys += [(f"CFG_MSGOUT_{message}_{port}", 1) for message in _MESSAGES for port in _PORTS]
            stream.write(UBXMessage.config_set(1, 0, keys).serialize())

    def doubt(self) -> str:
        """See the base class."""
        return (
            f"sends no UBX NAV-PVT at {self.baud} bit/s: add ?rate=10 to switch it on, try another ?baud=, "
            "or read it as nmea:"
        )

    def feed(self, data: bytes, arrival: float) -> None:
        """See the base class."""
        rest = self._rest + data
        while (start := rest.find(_SYNC)) >= 0:
            rest = rest[start:]
            if len(rest) < 8:
                break
            size = 8 + int.from_bytes(rest[4:6], "little")
            if size > _LONGEST:
                rest = rest[2:]
            elif len(rest) < size:
                break
            elif calc_checksum(rest[2 : size - 2]) != rest[size - 2 : size]:
                self.device.counts["frames with a wrong checksum"] += 1
                rest = rest[2:]
            else:
                self._frame(rest[:size], arrival)
                rest = rest[size:]
        self._rest = rest[-_LONGEST:] if _SYNC in rest else rest[-1:]

    def _frame(self, frame: bytes, arrival: float) -> None:
        kind, payload = frame[2:4], frame[6:-2]
        if kind == _HP and len(payload) == _HP_FORMAT.size:
            week_ms = int.from_bytes(payload[4:8], "little")
            self._precise, self._waits_for_precise = {week_ms: payload}, True
            if self._pvt is not None and self._pvt[0] == week_ms:
                self._emit()
        elif kind in (_PVT, _RELATIVE):
            try:
                self._message(kind, UBXReader.parse(frame), payload, arrival)
            except _WRONG:
                self.device.counts["frames that cannot be read"] += 1

    def _message(self, kind: bytes, message: Any, payload: bytes, arrival: float) -> None:
        self.understood += 1
        if kind == _PVT:
            self._emit()  # whose precise part has not come
            self._pvt = int.from_bytes(payload[0:4], "little"), message, arrival
            if self._pvt[0] in self._precise or not self._waits_for_precise:
                self._emit()
        elif self._has_heading and message.relPosHeadingValid and message.relPosValid:
            self._heading(message, int.from_bytes(payload[4:8], "little"), arrival)

    def _emit(self) -> None:
        """Hand an epoch on."""
        if self._pvt is None:
            return
        (week_ms, pvt, arrival), self._pvt = self._pvt, None
        precise = self._precise.get(week_ms)
        self._waits_for_precise = precise is not None
        self._precise = {}
        if not (pvt.validDate and pvt.validTime):
            self.device.counts["epochs without a time"] += 1
            return
        second = min(pvt.second, 59)  # 60 in a leap second
        moment = datetime(pvt.year, pvt.month, pvt.day, pvt.hour, pvt.min, second, tzinfo=timezone.utc)
        t = np.array([moment.timestamp() + pvt.nano * 1e-9])
        self._utc_of_week = float(t[0]) - week_ms * 1e-3
        if not pvt.gnssFixOk or pvt.fixType not in (2, 3, 4):
            self.device.counts["epochs without a fix"] += 1
            return
        place = pvt.lat, pvt.lon, pvt.height * 1e-3, pvt.hAcc * 1e-3, pvt.vAcc * 1e-3
        if precise is not None:
            place = _precise_place(precise) or place
        latitude, longitude, height, horizontal, vertical = (np.array([value]) for value in place)
        # hAcc is the radius of a circle that one standard deviation falls into, as that of phones.
        east = horizontal / math.sqrt(2.0)
        status = np.array([2 if pvt.carrSoln else 1 if pvt.diffSoln else 0], dtype=np.int8)
        sigma = np.column_stack([east, east, vertical])
        self.device.fix(FixData(t, latitude, longitude, height, status, sigma), arrival)
        self.device.velocity(VelocityData(t, np.array([[pvt.velE, pvt.velN, -pvt.velD]]) * 1e-3), arrival)

    def _heading(self, relative: Any, week_ms: int, arrival: float) -> None:
        if math.isnan(self._utc_of_week):
            return
        t = np.array([self._utc_of_week + week_ms * 1e-3])
        yaw = math.pi / 2.0 - math.radians(relative.relPosHeading) + self._turn
        self.device.heading(HeadingData(t, np.array([math.remainder(yaw, 2.0 * math.pi)])), arrival)


def _precise_place(payload: bytes) -> tuple[float, float, float, float, float] | None:
    """Latitude, longitude (degrees), height, horizontal and vertical accuracy (m); None where they are not valid."""
    flags, _, lon, lat, height, _, lon_below, lat_below, height_below, _, horizontal, vertical = (
        _HP_FORMAT.unpack(payload)
    )
    if flags & 1:
        return None
    return (
        lat * 1e-7 + lat_below * 1e-9,
        lon * 1e-7 + lon_below * 1e-9,
        height * 1e-3 + height_below * 1e-4,
        horizontal * 1e-4,
        vertical * 1e-4,
    )


#: See ``SourceModule``.
make = Ubx
