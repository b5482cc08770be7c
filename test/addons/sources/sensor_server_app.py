# SPDX-License-Identifier: Apache-2.0
"""An emulator of the app SensorServer on an Android phone, which plays a drive.

Written from README.md of umer0586/SensorServer and its Location.toJson: a WebSocket server; on
``/sensors/connect?types=["a","b"]`` one event a message with values, timestamp (ns since the boot), accuracy and type,
on ``/gps`` locations. Close codes 4001 and following as in its companion object.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from aiohttp import WSCloseCode, web

from suspension_twin.drive.types import Drive

__all__ = ["SensorServerApp"]

BOOTED = 1_699_913_600.25  # UTC in s at which the phone booted, before the drive


@dataclass
class SensorServerApp:
    """The app on one phone, playing at ``speed`` times real time once both connections are there."""

    drive: Drive
    speed: float = 20.0
    android: int = 13
    has: tuple[str, ...] = ("android.sensor.accelerometer", "android.sensor.gyroscope")
    port: int = 0
    drop_after: int = 0  # events after which every connection is cut, once
    sockets: dict[str, list[web.WebSocketResponse]] = field(default_factory=dict)
    done: bool = False

    async def __aenter__(self) -> SensorServerApp:
        app = web.Application()
        app.router.add_get("/sensors/connect", self._sensors)
        app.router.add_get("/gps", self._gps)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await self._runner.setup()
        site = web.TCPSite(self._runner, "127.0.0.1", self.port)
        await site.start()
        self.port = self._runner.addresses[0][1]
        return self

    async def __aexit__(self, *exception: object) -> None:
        await self._runner.cleanup()

    async def _serve(self, request: web.Request, path: str, close: tuple[int, str] | None = None):
        socket = web.WebSocketResponse(compress=False)
        await socket.prepare(request)
        if close is not None:
            await socket.close(code=close[0], message=close[1].encode())
            return socket
        self.sockets.setdefault(path, []).append(socket)
        async for _ in socket:
            pass
        return socket

    async def _sensors(self, request: web.Request):
        try:
            types = json.loads(request.query["types"])
        except ValueError:
            return await self._serve(request, "sensors", (4006, "Syntax error"))
        for kind in types:
            if kind not in self.has:
                return await self._serve(request, "sensors", (4001, f"sensor of type {kind} not found"))
        return await self._serve(request, "sensors")

    async def _gps(self, request: web.Request):
        return await self._serve(request, "gps")

    def _events(self) -> list[tuple[float, str, dict[str, Any]]]:
        imu, found = self.drive.imu, []
        for kind, rows in (("accelerometer", imu.specific_force), ("gyroscope", imu.angular_rate)):
            for t, values in zip(imu.t.tolist(), rows.tolist(), strict=True):
                event = {"values": values, "timestamp": round((t - BOOTED) * 1e9), "accuracy": 3}
                found.append((t, "sensors", event | {"type": f"android.sensor.{kind}"}))
        fix, velocity = self.drive.fix, self.drive.velocity
        for i, t in enumerate(fix.t.tolist()):
            east, north, _ = velocity.enu[int(np.argmin(np.abs(velocity.t - t)))].tolist()
            place = {
                "longitude": float(fix.longitude[i]),
                "latitude": float(fix.latitude[i]),
                "altitude": float(fix.altitude[i]),
                "bearing": float(np.degrees(np.arctan2(east, north)) % 360.0),
                "accuracy": float(fix.sigma[i, 0] * np.sqrt(2.0)),
                "speed": float(np.hypot(east, north)),
                "time": round(t * 1e3),
                "lastKnowLocation": False,
            }
            if self.android >= 8:
                place |= {
                    "elapsedRealtimeNanos": round((t - BOOTED) * 1e9),
                    "verticalAccuracyMeters": float(fix.sigma[i, 2]),
                    "speedAccuracyMetersPerSecond": 0.1,
                }
            found.append((t, "gps", place))
        return sorted(found, key=lambda event: event[0])

    async def play(self) -> None:
        """Send the drive to who is connected."""
        while not (self.sockets.get("sensors") and self.sockets.get("gps")):
            await asyncio.sleep(0.01)
        loop = asyncio.get_running_loop()
        began, start = loop.time(), float(self.drive.imu.t[0])
        for number, (t, path, event) in enumerate(self._events()):
            pause = began + (t - start) / self.speed - loop.time()
            if pause > 0.002:
                await asyncio.sleep(pause)
            if self.drop_after and number == self.drop_after:
                await self.drop()
                while not (self.sockets.get("sensors") and self.sockets.get("gps")):
                    await asyncio.sleep(0.01)
                began = loop.time() - (t - start) / self.speed
            for socket in self.sockets.get(path, ()):
                if not socket.closed:
                    with contextlib.suppress(ConnectionError):  # cut off a moment ago
                        await socket.send_str(json.dumps(event))
        self.done = True

    async def drop(self) -> None:
        """Close every connection, as when the app is stopped."""
        for sockets in self.sockets.values():
            for socket in sockets:
                await socket.close(code=WSCloseCode.GOING_AWAY)
        self.sockets.clear()
