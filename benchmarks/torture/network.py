# SPDX-License-Identifier: Apache-2.0
"""Phones behind a bad network: late, lost, reordered and cut off.

The network is a relay in user space, since a namespace of its own needs a kernel with ``netem`` to be bad. TCP hides a
lost packet behind a pause: the relay holds a connection up for as long as a retransmission takes. Connections are late
each by itself, so what is pushed over several of them arrives out of order.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import aiohttp
import numpy as np
from scipy.spatial import cKDTree

from torture.commands import ROOT
from torture.ledger import Tally

sys.path.insert(0, str(ROOT / "test" / "addons" / "sources"))  # the emulators of the apps

__all__ = ["BAR", "torture"]

BAR = "no sample invented or repeated, gaps named, a new sample within 1 s and four round trips of the network's return"
_PATIENCE, _ROUNDS = 1.0, 4  # s; what connecting takes: TCP, and what the app is asked
_PAUSE = (0.2, 0.4)  # s: the least time-out of a retransmission under Linux, and twice it
_SECONDS = 8.0  # of the drive


class Network:
    """Connections to ``port`` of this machine through a relay: ``delay`` s, up to ``jitter`` s more for each
    connection, and the share ``loss`` of what is sent held up."""

    def __init__(self, rng: np.random.Generator, delay: float, jitter: float, loss: float) -> None:
        self._rng, self.delay, self.jitter, self.loss = rng, delay, jitter, loss
        self.target = 0
        self.up = True
        self._open: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Network:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port: int = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exception: object) -> None:
        self._server.close()
        self.cut()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def cut(self) -> None:
        """Break every connection, wherever it is."""
        for writer in self._open:
            writer.transport.abort()
        self._open.clear()

    def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self.up:
            writer.transport.abort()
            return
        task = asyncio.ensure_future(self._connect(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            there, out = await asyncio.open_connection("127.0.0.1", self.target)
            self._open |= {writer, out}
            late = self.delay + self.jitter * float(self._rng.random())
            await asyncio.gather(self._relay(reader, out, late), self._relay(there, writer, late))
            self._open -= {writer, out}

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, late: float) -> None:
        loop, due = asyncio.get_running_loop(), 0.0
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def deliver() -> None:
            while True:
                at, data = await waiting.get()
                await asyncio.sleep(max(at - loop.time(), 0.0))
                if not data or writer.is_closing():
                    writer.close()
                    return
                writer.write(data)

        sender, data = asyncio.ensure_future(deliver()), b"-"
        while data:
            try:
                data = await reader.read(65536)
            except OSError:
                data = b""
            held = float(self._rng.uniform(*_PAUSE)) if self._rng.random() < self.loss else 0.0
            due = max(due, loop.time() + late + held)  # a stream stays in order
            waiting.put_nowait((due, data))
        await sender


async def _cut_off(network: Network, rng: np.random.Generator) -> float:
    """A cut somewhere in the drive; when the network was back, s."""
    await asyncio.sleep(float(rng.uniform(2.0, 3.5)))
    network.up = False
    network.cut()
    await asyncio.sleep(float(rng.uniform(0.3, 2.5)))
    network.up = True
    return time.monotonic()


async def _push(app: Any, url: str) -> None:
    """A message a connection, none waiting for another; what fails is lost."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    connector = aiohttp.TCPConnector(force_close=True)
    async with aiohttp.ClientSession(connector=connector) as session:

        async def post(due: float, message: dict[str, Any]) -> None:
            await asyncio.sleep(max(0.0, began + due - loop.time()))
            with contextlib.suppress(aiohttp.ClientError, asyncio.TimeoutError):
                async with session.post(url, json=message) as answer:
                    await answer.read()

        await asyncio.gather(*(post(due, message) for due, message in app.messages()))


async def _played(kind: str, drive: Any, network: Network, sources: Any) -> None:
    """The drive on the phone, in real time."""
    if kind == "sensorlogger":
        from sensor_logger_app import SensorLoggerApp

        url = sources[0].server.url()
        network.target = int(url.rstrip("/").rpartition(":")[2])
        await _push(SensorLoggerApp(drive), f"http://127.0.0.1:{network.port}/")
    elif kind == "sensorserver":
        from sensor_server_app import SensorServerApp

        async with SensorServerApp(drive, speed=1.0) as app:
            network.target = app.port
            await app.play()
            await asyncio.sleep(2.0)  # what is under way
    else:
        from phyphox_app import PhyphoxApp

        experiment = ROOT / "config" / "phyphox" / "suspension_twin.phyphox"
        async with PhyphoxApp(drive, experiment, speed=1.0) as app:
            network.target = app.port
            await app.done.wait()
            await asyncio.sleep(2.0)


async def _trial(
    kind: str, network: Network, drive: Any, cut: Callable[[], Awaitable[float]] | None
) -> tuple[Any, list[float], float]:
    """What was heard, when each packet of IMU samples came, and when the network was back."""
    from listening import Taken

    from suspension_twin.addons.sources import make_sources
    from suspension_twin.addons.sources.common.hub import Hub
    from suspension_twin.addons.sources.common.runner import running

    hub, came, back = Hub(), [], 0.0
    taken = Taken(hub)
    async with network:
        url = {
            "sensorlogger": "sensorlogger://127.0.0.1:0",
            "sensorserver": f"sensorserver://127.0.0.1:{network.port}",
            "phyphox": f"phyphox://127.0.0.1:{network.port}?period=0.05",
        }[kind]
        sources = make_sources([url], hub)
        async with running(sources, hub):
            player = asyncio.ensure_future(_played(kind, drive, network, sources))
            cutter = None if cut is None else asyncio.ensure_future(cut())
            count, end = 0, time.monotonic() + 60.0
            while not player.done() and time.monotonic() < end:
                await asyncio.sleep(0.01)
                taken.take()
                if taken.count("imu") > count:
                    count = taken.count("imu")
                    came.append(time.monotonic())
            player.result()
            if cutter is not None:
                back = await cutter
        taken.take()
    return taken, came, back


def _wrong(drive: Any, taken: Any, lossless: bool, tally: Tally) -> str | None:
    """What was heard beside what was sent: which samples they are, by what they measured."""
    if not taken.count("imu"):
        return f"nothing was heard; says: {'; '.join(taken.said)[:200]}"
    imu = taken.imu
    distance, which = map(np.asarray, cKDTree(drive.imu.specific_force).query(imu.specific_force))
    if distance.max() > 1e-4:
        return f"{int((distance > 1e-4).sum())} samples that were never sent"
    if np.diff(which).min(initial=1) < 1:
        return "a sample came twice or out of order"
    if np.diff(imu.t).min(initial=1.0) <= 0.0:
        return "stamps that do not rise"
    shift = imu.t - drive.imu.t[which]
    tally.measure("stamps moved, ms", 1e3 * float(shift.max() - shift.min()))
    lost = int(which[-1] - which[0] + 1 - which.size)
    tally.measure("samples lost", lost)
    if lost and lossless:
        return f"{lost} samples were lost without a cut; says: {'; '.join(taken.said)[:200]}"
    counted = {n for device in taken.hub.devices.values() for n, c in device.counts.items() if c}
    if lost and not taken.said and not counted - {"imu", "fix", "vel"}:
        return f"{lost} samples were lost and nothing says so"
    return None


#: Delay and jitter in s, share lost, whether it is cut off.
_FAULTS = {
    "late": (0.2, 0.0, 0.0, False),
    "lossy": (0.02, 0.0, 0.05, False),
    "out of order": (0.05, 0.3, 0.0, False),
    "cut off": (0.02, 0.0, 0.0, True),
    "all at once": (0.2, 0.1, 0.05, True),
}
_KINDS = ("sensorlogger", "sensorserver", "phyphox")


def torture(tally: Tally) -> None:
    """Eight seconds of a drive from one phone through one bad network a trial."""
    from suspension_twin.drive.read import read_drive
    from suspension_twin.drive.types import cut as shortened

    whole = read_drive(ROOT / "bags" / "bump_15kmh")
    start = float(whole.imu.t[0]) + 8.0
    drive = shortened(whole, start, start + _SECONDS)
    tally.note("the network is a relay in user space, not a kernel's")
    cases = [(kind, fault) for fault in _FAULTS for kind in _KINDS]
    for number in tally.numbers():
        kind, fault = cases[number % len(cases)]
        delay, jitter, loss, cut = _FAULTS[fault]
        rng = tally.rng(number)
        network = Network(rng, delay, jitter, loss)
        what = f"{kind}, {fault}"
        try:
            taken, came, back = asyncio.run(
                _trial(kind, network, drive, partial(_cut_off, network, rng) if cut else None)
            )
        except Exception as error:
            taken = None
            tally.fail(f"{what}: {type(error).__name__}: {error}")
        tally.count(what)
        if taken is None:
            continue
        problem = _wrong(drive, taken, not cut, tally)
        if cut and problem is None:
            after = [t - back for t in came if t > back]
            tally.measure(f"first sample, {fault}, s", min(after, default=np.inf))
            if min(after, default=np.inf) > _PATIENCE + _ROUNDS * 2 * (delay + jitter):
                problem = f"{min(after, default=np.inf):.1f} s to the first sample after the cut"
        if problem:
            tally.fail(f"{what}: {problem}")
