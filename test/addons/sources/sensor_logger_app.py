# SPDX-License-Identifier: Apache-2.0
"""An emulator of the app Sensor Logger, which plays a drive.

Written from PUSHING.md, UNITS.md and CROSSPLATFORM.md of tszheichoi/awesome-sensor-logger: messages
``{messageId, sessionId, deviceId, payload}`` once a batch period, readings ``{name, time, values}`` with UTC in ns. On
iOS accelerometer and gravity are negated and the uncalibrated accelerometer is in g, unless "Standardise Units &
Frames" is on; only Android has the total acceleration, iOS and Android 14 the altitude above mean sea level.
"""

from __future__ import annotations

import asyncio
import contextlib
import csv
import json
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from suspension_twin.drive.types import Drive

__all__ = ["SensorLoggerApp"]

GRAVITY = 9.80665


@dataclass
class SensorLoggerApp:
    """The app on one phone. ``sensors`` are those switched on; ``shift`` s is what its clock is ahead of UTC.

    ``sea_level``: whether its locations have the altitude above mean sea level; None: as iOS and old Androids do.
    """

    drive: Drive
    platform: str = "android"
    standardise: bool = False
    sensors: tuple[str, ...] = ("accelerometer", "gravity", "totalacceleration", "gyroscope", "location")
    batch: float = 0.2
    device: str = "5f0c1a7e-9d7b-4f8e-8a63-0d5f3c1b2a90"
    session: str = "2c9e0b64-91a5-4a3d-8d3e-0e6a7f1c5b11"
    shift: float = 0.0
    sea_level: bool | None = None
    seed: int = 0
    answers: list[int] = field(default_factory=list)

    def messages(self) -> list[tuple[float, dict[str, Any]]]:
        """What is sent: when, in s after the beginning of the drive, and what."""
        readings = sorted(self._readings(), key=lambda r: r[0])
        start = float(self.drive.imu.t[0])
        shuffled = random.Random(self.seed)
        messages: list[tuple[float, dict[str, Any]]] = []
        due, waiting = self.batch, []
        for t, reading in [*readings, (np.inf, None)]:
            while waiting and t > start + due:
                shuffled.shuffle(waiting)  # readings come in no order
                body = {"messageId": len(messages), "sessionId": self.session, "deviceId": self.device}
                messages.append((due, body | {"payload": waiting}))
                due, waiting = due + self.batch, []
            waiting.append(reading)
        return messages

    def _readings(self) -> list[tuple[float, dict[str, Any]]]:
        imu, found = self.drive.imu, []
        ios = self.platform == "ios"
        sign = -1.0 if ios and not self.standardise else 1.0
        up = imu.specific_force.mean(axis=0)
        up *= GRAVITY / np.linalg.norm(up)
        tables = {
            "accelerometer": (imu.t, sign * (imu.specific_force - up)),
            "gravity": (imu.t, sign * np.broadcast_to(up, imu.specific_force.shape)),
            "gyroscope": (imu.t, imu.angular_rate),
            "accelerometeruncalibrated": (
                imu.t,
                sign * imu.specific_force / (GRAVITY if ios and not self.standardise else 1.0),
            ),
        }
        if not ios:
            tables["totalacceleration"] = (imu.t, imu.specific_force)
        for name, (stamps, rows) in tables.items():
            if name in self.sensors:
                for t, (x, y, z) in zip(stamps.tolist(), rows.tolist(), strict=True):
                    found.append((t, self._reading(name, t, {"z": z, "y": y, "x": x})))
        if "location" in self.sensors:
            found += [(t, self._reading("location", t, values)) for t, values in self._places(ios)]
        return found

    def _reading(self, name: str, t: float, values: dict[str, float]) -> dict[str, Any]:
        return {"name": name, "time": round((t + self.shift) * 1e9), "values": values}

    def _places(self, ios: bool) -> list[tuple[float, dict[str, float]]]:
        fix, velocity, found = self.drive.fix, self.drive.velocity, []
        for i, t in enumerate(fix.t.tolist()):
            k = int(np.argmin(np.abs(velocity.t - t)))
            east, north, _ = velocity.enu[k].tolist()
            values = {
                "latitude": float(fix.latitude[i]),
                "longitude": float(fix.longitude[i]),
                "altitude": float(fix.altitude[i]),
                "speed": float(np.hypot(east, north)),
                "bearing": float(np.degrees(np.arctan2(east, north)) % 360.0),
                "horizontalAccuracy": float(fix.sigma[i, 0] * np.sqrt(2.0)),
                "verticalAccuracy": float(fix.sigma[i, 2]),
                "speedAccuracy": -1.0,
                "bearingAccuracy": -1.0,
            }
            if ios if self.sea_level is None else self.sea_level:
                values["altitudeAboveMeanSeaLevel"] = values["altitude"] - 40.0
            found.append((t, values))
        return found

    def export(self, folder: Path) -> Path:
        """The recording as the app exports it: a CSV file a sensor, columns time, seconds_elapsed, z, y, x."""
        names = {
            "accelerometer": "Accelerometer",
            "gravity": "Gravity",
            "gyroscope": "Gyroscope",
            "totalacceleration": "TotalAcceleration",
            "accelerometeruncalibrated": "AccelerometerUncalibrated",
            "location": "Location",
        }
        rows: dict[str, list[dict[str, Any]]] = {}
        for _, reading in self._readings():
            row = {"time": reading["time"], "seconds_elapsed": 0.0, **reading["values"]}
            rows.setdefault(names[reading["name"]], []).append(row)
        rows["Metadata"] = [{"platform": self.platform, "standardisation": str(self.standardise).lower()}]
        folder.mkdir(parents=True)
        for name, found in rows.items():
            with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(found[0]))
                writer.writeheader()
                writer.writerows(found)
        return folder

    async def push_until(self, url: str, seconds: float, end: Callable[[], object]) -> None:
        """Send in real time for so long, call ``end`` and be gone."""
        pushing = asyncio.ensure_future(self.push(url))
        await asyncio.sleep(seconds)
        end()
        pushing.cancel()
        with contextlib.suppress(Exception, asyncio.CancelledError):
            await pushing

    async def push(self, url: str, speed: float = 1.0) -> None:
        """Send everything by HTTP, at ``speed`` times real time."""
        loop = asyncio.get_running_loop()
        began = loop.time()
        async with aiohttp.ClientSession() as session:
            for due, message in self.messages():
                await asyncio.sleep(max(0.0, began + due / speed - loop.time()))
                async with session.post(url, json=message) as answer:
                    self.answers.append(answer.status)

    async def send(self, url: str, speed: float = 1.0) -> None:
        """Send everything through one WebSocket."""
        loop = asyncio.get_running_loop()
        began = loop.time()
        async with aiohttp.ClientSession() as session, session.ws_connect(url) as socket:
            for due, message in self.messages():
                await asyncio.sleep(max(0.0, began + due / speed - loop.time()))
                await socket.send_str(json.dumps(message))
