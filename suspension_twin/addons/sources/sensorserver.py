# SPDX-License-Identifier: Apache-2.0
"""``sensorserver://HOST:PORT``: a phone with the app SensorServer (Android), which serves its sensors by WebSocket.

Source: README.md and SensorWebSocketServer.kt of umer0586/SensorServer. ``/sensors/connect?types=[...]`` sends
``{values, timestamp, accuracy, type}``, one event a message, the time in ns since the phone booted; ``/gps`` sends
Android's ``Location``, whose ``elapsedRealtimeNanos`` is of the same clock.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Sequence
from typing import Any, Final
from urllib.parse import quote

import aiohttp
import numpy as np

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import (
    Address,
    PlainSource,
    Stay,
    keep_connected,
    number,
    read_object,
    url_host,
)
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.arrays import Floats
from suspension_twin.drive.streams import phone_fix
from suspension_twin.errors import InputError
from suspension_twin.files import Json

__all__ = ["EXAMPLE", "TITLE", "SensorServer", "make"]

TITLE = "SensorServer"
EXAMPLE = "sensorserver://192.168.1.20:8080"

_FORCE: Final = "android.sensor.accelerometer"
_RATE: Final = "android.sensor.gyroscope"
_PORT: Final = 8080
_LONGEST: Final = 10_000  # bytes of a message
#: Codes with which the app closes for good (its companion object), and what to do.
_CLOSED: Final = {
    4001: "this phone lacks the sensor that was asked for",
    4002: "this is another app, or a version without several sensors on one connection",
    4009: "allow the app to use the location",
}


class SensorServer(PlainSource):
    """One phone: a connection for its sensors and one for its location."""

    steps: Sequence[str] = (
        "Phone and laptop are in one network, such as the phone's hotspot; or by USB: Local Host on, adb forward.",
        "In SensorServer: Settings > Sampling rate: 10000 µs or less; allow the location.",
        "Start: the app shows the address that belongs into sensorserver://HOST:PORT.",
        "Mount the phone rigidly and keep the app in front.",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        address.check_options(())
        if not address.host:
            raise InputError(
                str(address), "names no host: write sensorserver://HOST:PORT as the app shows it"
            )
        self._base = f"ws://{url_host(address.host)}:{address.port or _PORT}"
        self._name = f"phone {address.host}"
        self._hub = hub
        self.device = hub.own_device(str(address), self._name, rank=rank, epoch=False)
        self.notes = [f"SensorServer: connects to {self._base}"]

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        timeout = aiohttp.ClientTimeout(sock_connect=5.0)
        async with aiohttp.ClientSession(timeout=timeout) as self._session:
            await asyncio.gather(
                keep_connected(self._hub, f"{self._name} sensors", self._sensors),
                keep_connected(self._hub, f"{self._name} location", self._location),
            )

    async def _listen(self, path: str, take: Any) -> None:
        async with self._session.ws_connect(
            f"{self._base}{path}", max_msg_size=_LONGEST, heartbeat=10.0, compress=0
        ) as socket:
            async for message in socket:
                if message.type != aiohttp.WSMsgType.TEXT:
                    continue
                try:
                    take(read_object(message.data), host_time())
                except (KeyError, TypeError, ValueError, IndexError, OverflowError, InputError):
                    self.device.counts["messages with a wrong field"] += 1
            if socket.close_code in _CLOSED:
                raise Stay(_CLOSED[socket.close_code])

    async def _sensors(self) -> None:
        types = quote(json.dumps([_FORCE, _RATE], separators=(",", ":")))
        await self._listen(f"/sensors/connect?types={types}", self._take)

    async def _location(self) -> None:
        await self._listen("/gps", self._take_location)

    def _take(self, data: Json, arrival: float) -> None:
        t = np.array([number(data["timestamp"]) * 1e-9])
        values: Floats = np.array([[number(value) for value in data["values"][:3]]])
        if values.shape != (1, 3) or t[0] <= 0:
            raise ValueError
        if data["type"] == _FORCE:
            self.device.force(t, values, arrival)
        elif data["type"] == _RATE:
            self.device.rate(t, values, arrival)
        self.device.flush(arrival, complete=False)

    def _take_location(self, data: Json, arrival: float) -> None:
        if data.get("lastKnowLocation") is True:  # as the app spells it
            return
        device, of_boot = self.device, "elapsedRealtimeNanos" in data
        device.position_clock = device.clock if of_boot else device.own_position_clock
        stamp = number(data["elapsedRealtimeNanos"]) * 1e-9 if of_boot else number(data["time"]) * 1e-3
        names = (
            "latitude",
            "longitude",
            "altitude",
            "accuracy",
            "verticalAccuracyMeters",
            "speed",
            "bearing",
        )
        found = [np.array([number(data[name]) if name in data else math.nan]) for name in names]
        t = np.array([stamp])
        device.fix(phone_fix(t, *found[:5]), arrival)
        device.course(t, found[5], found[6], arrival)


#: See ``SourceModule``.
make = SensorServer
