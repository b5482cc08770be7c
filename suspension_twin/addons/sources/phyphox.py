# SPDX-License-Identifier: Apache-2.0
"""``phyphox://HOST:PORT``: a phone with the app phyphox (Android, iOS), its remote access switched on.

Source: "Remote-interface communication" of the phyphox wiki. ``/config`` names the buffers that each sensor fills,
``/get?accX=T|acc_time&acc_time=T`` gives what is newer than the experiment time T, with eight significant digits, and
``/time`` ties the experiment's time to the phone's clock. Eight digits of a latitude are 0.1 m: the experiment that
comes with this program (config/phyphox) also has what lies behind the decimal point as a buffer of its own.

Option: ``period`` s between two questions.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import quote

import aiohttp
import numpy as np

from suspension_twin.addons.sources.common.clock import host_time
from suspension_twin.addons.sources.common.connection import (
    Address,
    PlainSource,
    fetch,
    keep_connected,
    read_object,
    url_host,
)
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import ExperimentTime
from suspension_twin.drive.streams import phone_fix
from suspension_twin.errors import InputError

__all__ = ["EXAMPLE", "TITLE", "Phyphox", "make"]

TITLE = "phyphox"
EXAMPLE = "phyphox://192.168.1.20:8080"

_PORT: Final = 8080  # Android's; iPhones have 80
#: Bytes of an answer: two minutes of 400 Hz. Its objects take up to 24 times as much (measured; tolerance).
_MOST: Final = 8_000_000
_PATIENCE: Final = 5.0  # s
_CLEARED: Final = 2.0  # s without anything new
_NOTHING: Final = np.empty(0)
#: What is asked of each sensor: by its name in /config the components, the time first.
_WANTED: Final = {
    "accelerometer": ("t", "x", "y", "z"),
    "gyroscope": ("t", "x", "y", "z"),
    "location": ("t", "lat", "lon", "zwgs84", "z", "v", "dir", "accuracy", "zAccuracy"),
}
#: Buffers of the experiment that comes with this program: whole degrees and what is beyond them.
_FINE: Final = (("lat", "latWhole", "latRest"), ("lon", "lonWhole", "lonRest"))


@dataclass
class _Sensor:
    """The buffers of one sensor by component; ``newest`` is the last experiment time that was received."""

    buffers: dict[str, str]
    newest: float = -math.inf

    def query(self) -> list[str]:
        time = self.buffers["t"]
        if self.newest == -math.inf:  # the last value alone: from now on
            return [quote(time)]
        since = f"{self.newest:.9g}"
        names = (f"{quote(name)}={since}{quote(f'|{time}')}" for c, name in self.buffers.items() if c != "t")
        return [f"{quote(time)}={since}", *names]


class Phyphox(PlainSource):
    """One phone, asked again and again."""

    steps: Sequence[str] = (
        "Phone and laptop are in one network, such as the phone's hotspot.",
        "In phyphox: + > Add experiment from QR code: the code above (config/phyphox/suspension_twin.phyphox).",
        "Open it; in its menu: Allow remote access. The app shows the address that belongs into phyphox://HOST:PORT.",
        "Mount the phone rigidly and keep the app in front.",
    )

    def __init__(self, address: Address, hub: Hub, rank: int) -> None:
        address.check_options(("period",))
        if not address.host:
            raise InputError(str(address), "names no host: write phyphox://HOST:PORT as the app shows it")
        self._period = address.number("period", 0.1, 0.02, 5.0)
        self._base = f"http://{url_host(address.host)}:{address.port or _PORT}"
        self._hub = hub
        self.device = hub.own_device(str(address), f"phone {address.host}", rank=rank)
        self.device.position_clock = self.device.clock
        self.notes = [f"phyphox: connects to {self._base}"]
        self._sensors: dict[str, _Sensor] = {}
        self._time: ExperimentTime | None = None
        self._session_id = ""
        self._measuring = False

    async def run(self) -> None:
        """See :class:`~suspension_twin.addons.sources.LiveSource`."""
        timeout = aiohttp.ClientTimeout(total=_PATIENCE, sock_connect=_PATIENCE)
        async with aiohttp.ClientSession(timeout=timeout) as self._session:
            await keep_connected(self._hub, self.device.name, self._poll)

    async def _get(self, path: str) -> bytes:
        return await fetch(self._session, self._base + path, _MOST)

    async def _poll(self) -> None:
        await self._look()
        heard = host_time()
        while True:
            sensors = list(self._sensors.items())
            query = "&".join(part for _, sensor in sensors for part in sensor.query())
            answer = read_object(await self._get(f"/get?{query}"))
            arrival = host_time()
            buffers, status = answer.get("buffer"), answer.get("status")
            if not isinstance(buffers, dict) or not isinstance(status, dict):
                raise InputError(self.device.name, "answers something else than phyphox")
            session, measuring = str(status.get("session"))[:64], status.get("measuring") is True
            if session != self._session_id or measuring != self._measuring:
                await self._restarted(session, measuring)
            columns = {name: _column(buffers.get(name)) for _, s in sensors for name in s.buffers.values()}
            rows = {name: self._fresh(sensor, columns) for name, sensor in sensors}
            self._take(rows, arrival)
            if any(row.get("t", _NOTHING).size for row in rows.values()):
                heard = arrival
            elif measuring and arrival - heard > _CLEARED:
                self._begin_again()  # the data have been cleared, and the time of the experiment begins at 0
                heard = arrival
            await asyncio.sleep(self._period)

    async def _look(self) -> None:
        """Read which sensors and buffers the experiment on the phone has."""
        config = read_object(await self._get("/config"))
        found: dict[str, dict[str, str]] = {}
        for entry in _list(config.get("inputs")):
            if isinstance(entry, dict) and entry.get("source") in _WANTED:
                outputs = [o for o in _list(entry.get("outputs")) if isinstance(o, dict)]
                named = {str(k): str(v)[:64] for output in outputs for k, v in output.items()}
                found[entry["source"]] = {c: named[c] for c in _WANTED[entry["source"]] if c in named}
        there = {str(b.get("name")) for b in _list(config.get("buffers")) if isinstance(b, dict)}
        missing = [name for name in ("accelerometer", "gyroscope") if len(found.get(name, ())) < 4]
        if missing:
            raise InputError(
                self.device.name,
                f"its experiment has no {' and no '.join(missing)} (open that of config/phyphox)",
            )
        if {"t", "lat", "lon"} <= found.get("location", {}).keys():
            for coordinate, whole, rest in _FINE:
                if {whole, rest} <= there:
                    found["location"] |= {f"{coordinate} whole": whole, f"{coordinate} rest": rest}
        else:
            found.pop("location", None)
        kept = {name: sensor.newest for name, sensor in self._sensors.items()}
        self._sensors = {n: _Sensor(buffers, kept.get(n, -math.inf)) for n, buffers in found.items()}
        status = read_object(await self._get("/get?")).get("status")
        if isinstance(status, dict) and status.get("measuring") is False:
            await self._get("/control?cmd=start")
            self._hub.notify("ok", "started", f"{self.device.name}: the measurement was started")
        await self._read_time()

    async def _restarted(self, session: str, measuring: bool) -> None:
        """Another experiment, or a pause that has begun or ended."""
        other = session != self._session_id
        if self._session_id and other:
            self._begin_again()
        if self._measuring and not measuring:
            self._hub.notify("warn", "paused", f"{self.device.name}: the measurement is paused, press play")
        self._session_id, self._measuring = session, measuring
        await self._read_time()

    def _begin_again(self) -> None:
        for sensor in self._sensors.values():
            sensor.newest = -math.inf

    async def _read_time(self) -> None:
        try:
            events = [e for e in _list(json.loads(await self._get("/time"))) if isinstance(e, dict)]
        except (ValueError, RecursionError):
            raise InputError(self.device.name, "/time is not JSON") from None
        clocks = [_column([e.get(key) for e in events]) for key in ("experimentTime", "systemTime")]
        time = ExperimentTime.of_events([str(e.get("event")) for e in events], *clocks)
        self._time = time if time.begin.size else None

    def _fresh(self, sensor: _Sensor, columns: dict[str, Floats]) -> dict[str, Floats]:
        """The rows that are complete and newer than the last ones."""
        own = {component: columns[name] for component, name in sensor.buffers.items()}
        first_look = sensor.newest == -math.inf
        size = min(column.size for column in own.values()) if not first_look else own["t"].size
        own = {component: column[:size] for component, column in own.items()}
        new = np.isfinite(own["t"]) & (own["t"] > sensor.newest)
        if first_look:
            sensor.newest = _last(own["t"], sensor.newest)
            return {}
        if new.any():
            sensor.newest = float(own["t"][new].max())
        return {component: column[new] for component, column in own.items()}

    def _take(self, rows: dict[str, dict[str, Floats]], arrival: float) -> None:
        device = self.device
        if self._time is None:
            return
        for name, take in (("gyroscope", device.rate), ("accelerometer", device.force)):
            if rows.get(name):
                own = rows[name]
                take(self._time.utc(own["t"]), np.column_stack([own[axis] for axis in "xyz"]), arrival)
        device.flush(arrival, complete=True)
        place = rows.get("location")
        if place and place["t"].size:
            t = self._time.utc(place["t"])
            unknown = np.full(t.size, np.nan)
            for coordinate, _, _ in _FINE:
                if f"{coordinate} rest" in place:
                    fine = place[f"{coordinate} whole"] + place[f"{coordinate} rest"]
                    agree = np.abs(fine - place[coordinate]) < 1e-5
                    place[coordinate] = np.where(agree, fine, place[coordinate])
            height = place.get("zwgs84", place.get("z", unknown))
            accuracy = place.get("accuracy", unknown), place.get("zAccuracy", unknown)
            device.fix(phone_fix(t, place["lat"], place["lon"], height, *accuracy), arrival)
            device.course(t, place.get("v", unknown), place.get("dir", unknown), arrival)


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _column(buffer: object) -> Floats:
    """Numbers of a buffer or a list, NaN for what is none."""
    values = buffer.get("buffer") if isinstance(buffer, dict) else buffer
    found = (
        float(v) if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e300 else math.nan
        for v in _list(values)
    )
    return np.fromiter(found, dtype=np.float64)


def _last(column: Floats, otherwise: float) -> float:
    finite = column[np.isfinite(column)]
    return float(finite[-1]) if finite.size else otherwise


#: See ``SourceModule``.
make = Phyphox
