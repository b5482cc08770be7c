# SPDX-License-Identifier: Apache-2.0
"""An emulator of the app phyphox with remote access, which plays a drive into the buffers of an experiment.

Written from "Remote-interface communication" of the phyphox wiki: ``/config``, ``/time``, ``/control``, and ``/get``,
whose parameters are buffers, alone (the last value), ``=full``, ``=T`` (values above T) or ``=T|reference`` (values at
the indices where the reference is above T). Numbers have eight significant digits. Which buffers an experiment has,
and what its analysis makes of them, is read from its file.
"""

from __future__ import annotations

import asyncio
import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from aiohttp import web

from suspension_twin.drive.types import Drive

__all__ = ["PhyphoxApp"]


@dataclass
class PhyphoxApp:
    """The app with an experiment, playing at ``speed`` times real time from when it is started."""

    drive: Drive
    experiment: Path
    speed: float = 20.0
    session: str = "3fa2c1"
    measuring: bool = False
    later: float = 0.0  # s by which a second measurement begins after the first
    buffers: dict[str, list[float]] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    silent: bool = False

    def __post_init__(self) -> None:
        root = ElementTree.parse(self.experiment).getroot()
        self.title = root.findtext("title")
        self.sizes = {c.text: int(c.get("size", "1")) for c in root.iter("container")}
        self.inputs = {}
        for sensor in root.find("input"):
            name = sensor.get("type") if sensor.tag == "sensor" else sensor.tag
            self.inputs[name] = {o.get("component"): o.text for o in sensor.iter("output")}
        self.analysis = list(root.find("analysis") or ())
        self.buffers = {name: [] for name in self.sizes}
        self.done = asyncio.Event()
        self.events: list[dict] = []

    async def __aenter__(self) -> PhyphoxApp:
        app = web.Application()
        for path in ("get", "config", "time", "control"):
            app.router.add_get(f"/{path}", self._answer)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        self.port = self._runner.addresses[0][1]
        self._player = None
        return self

    async def __aexit__(self, *exception: object) -> None:
        if self._player is not None:
            self._player.cancel()
        await self._runner.cleanup()

    async def _answer(self, request: web.Request) -> web.Response:
        self.requests.append(request.path_qs)
        if self.silent:
            raise web.HTTPServiceUnavailable
        if request.path == "/control":
            ok = request.query.get("cmd") == "start"
            if ok:
                self._start()
            return web.Response(text=json.dumps({"result": ok}), content_type="application/json")
        if request.path == "/time":
            return web.json_response(self.events)
        if request.path == "/config":
            inputs = [
                {"source": name, "outputs": [{c: b} for c, b in outputs.items()]}
                for name, outputs in self.inputs.items()
            ]
            buffers = [{"name": name, "size": size} for name, size in self.sizes.items()]
            return web.json_response({"title": self.title, "buffers": buffers, "inputs": inputs})
        return web.Response(text=self._get(request), content_type="application/json")

    def _get(self, request: web.Request) -> str:
        parts = []
        for name, asked in request.query.items():
            if name not in self.buffers:
                continue
            values = self.buffers[name]
            if asked == "":
                mode, shown = "single", values[-1:] or [math.nan]
            elif asked == "full":
                mode, shown = "full", values
            else:
                since, _, reference = asked.partition("|")
                against = self.buffers[reference] if reference else values
                threshold = float(since)
                if threshold > 0:  # "moved to avoid receiving a close number multiple times"
                    threshold += 10.0 ** math.floor(math.log10(threshold / 1e7))
                mode = "partial"
                shown = [v for v, r in zip(values, against, strict=False) if not r <= threshold]
            numbers = ",".join("null" if not math.isfinite(v) else _eight(v) for v in shown)
            parts.append(
                f'"{name}":{{"size":{self.sizes[name]},"updateMode":"{mode}", "buffer":[{numbers}]}}'
            )
        status = {"session": self.session, "measuring": self.measuring, "timedRun": False, "countDown": 0}
        return f'{{"buffer":{{\n{",".join(parts)}\n}},\n"status":{json.dumps(status)}\n}}\n'

    def _start(self) -> None:
        if not self.measuring:
            self.measuring = True
            start = float(self.drive.imu.t[0]) - 1.0
            self.events.append({"event": "START", "experimentTime": 0.0, "systemTime": start + self.later})
            self._player = asyncio.ensure_future(self._play(start))

    async def _play(self, start: float) -> None:
        drive, loop = self.drive, asyncio.get_running_loop()
        velocity = drive.velocity.enu[[int(np.argmin(np.abs(drive.velocity.t - t))) for t in drive.fix.t]]
        speed, course = (
            np.hypot(*velocity.T[:2]),
            np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) % 360.0,
        )
        tables = {
            "accelerometer": (drive.imu.t, dict(zip("xyz", drive.imu.specific_force.T, strict=True))),
            "gyroscope": (drive.imu.t, dict(zip("xyz", drive.imu.angular_rate.T, strict=True))),
            "location": (
                drive.fix.t,
                {
                    "lat": drive.fix.latitude,
                    "lon": drive.fix.longitude,
                    "z": drive.fix.altitude - 40.0,
                    "zwgs84": drive.fix.altitude,
                    "v": speed,
                    "dir": course,
                    "accuracy": drive.fix.sigma[:, 0] * np.sqrt(2.0),
                    "zAccuracy": drive.fix.sigma[:, 2],
                },
            ),
        }
        given = dict.fromkeys(tables, 0)
        began = loop.time()
        while any(given[name] < t.size for name, (t, _) in tables.items()):
            await asyncio.sleep(0.005)
            now = start + (loop.time() - began) * self.speed
            for name, (t, columns) in tables.items():
                until = int(np.searchsorted(t, now, side="right"))
                for component, buffer in self.inputs.get(name, {}).items():
                    column = t - start if component == "t" else columns[component]
                    self._append(buffer, column[given[name] : until].tolist())
                given[name] = until
            await asyncio.sleep(0)  # a request may come between the data and their analysis
            self._analyse()
        self.done.set()

    def _append(self, buffer: str, values: list[float]) -> None:
        kept = self.buffers[buffer] + values
        self.buffers[buffer] = kept[-self.sizes[buffer] :] if self.sizes[buffer] else kept

    def _analyse(self) -> None:
        """The two modules that are used: round down, subtract."""
        for module in self.analysis:
            into = module.findtext("output")
            read = [self.buffers[i.text] for i in module.iter("input")]
            if module.tag == "round":
                self.buffers[into] = [float(math.floor(v)) for v in read[0]]
            else:
                self.buffers[into] = [a - b for a, b in zip(*read, strict=True)]


def _eight(value: float) -> str:
    """Java's DecimalFormat("0.#######E0")."""
    mantissa, _, exponent = f"{value:.7E}".partition("E")
    return f"{mantissa.rstrip('0').rstrip('.')}E{int(exponent)}"
