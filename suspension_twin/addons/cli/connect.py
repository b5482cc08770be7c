# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin connect``: what can be reached, how a phone is connected, and what arrives."""

from __future__ import annotations

import asyncio
import io
import signal
import sys
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Annotated

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from suspension_twin.addons.sources import Source, make_sources
from suspension_twin.addons.sources.common.address import parse_address
from suspension_twin.addons.sources.common.assess import assess, verdict
from suspension_twin.addons.sources.common.discover import discover
from suspension_twin.addons.sources.common.hub import Hub, Packet
from suspension_twin.addons.sources.common.report import device_line, findings
from suspension_twin.addons.sources.common.runner import running
from suspension_twin.addons.sources.common.server import PushServer
from suspension_twin.addons.sources.phyphox import Phyphox
from suspension_twin.addons.cli.live_lines import DEFAULT_SOURCE, STYLES, show_guide
from suspension_twin.cli.common import bundled, output
from suspension_twin.drive.types import FixData, ImuData, Samples, VelocityData
from suspension_twin.errors import WorkError
from suspension_twin.signals.checks import Finding

__all__ = ["command"]

#: s of samples that are judged, and between judgements on a terminal and elsewhere.
_WINDOW, _PERIOD, _LOG_PERIOD = 10.0, 0.5, 5.0
_EXPERIMENT = "suspension_twin.phyphox"
#: s of samples before the first judgement.
_FIRST = 3.0


def command(
    urls: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="URL",
            help=f"What to connect, as for --source of run and record; {DEFAULT_SOURCE} if none is given.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds", metavar="S", help="End after so many seconds.", min=0.1, show_default=False
        ),
    ] = None,
) -> None:
    """Connect a phone, a receiver or an IMU, step by step. Ctrl-C ends it.

    Lists what this machine can reach, shows the address for the phone as a QR code with the app's settings, and says
    within seconds what arrives: rate, units, gravity, mounting, the receiver's accuracy, and whether it will do for a
    calibration. Writes nothing.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # a pipe's reader sees the address when it is there, too
    console = output()
    hub = Hub()
    sources = make_sources(urls or [DEFAULT_SOURCE], hub)
    console.print(Text("On this machine", style="bold"))
    for line in discover():
        console.print(Text(f"  {line}"))

    async def work() -> None:
        end = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, end.set)
        async with running(sources, hub), _experiment(sources):
            await show_guide(console, sources, urls or [DEFAULT_SOURCE])
            await _watch(hub, console, end, seconds)

    asyncio.run(work())
    if not hub.chosen:
        raise WorkError("nothing arrived" + (f" within {seconds:g} s" if seconds else ""))


@asynccontextmanager
async def _experiment(sources: Sequence[Source]) -> AsyncIterator[None]:
    """For phones with phyphox: the experiment to be opened is served, and its address is the QR code."""
    phones = [source for source in sources if isinstance(source, Phyphox)]
    if not phones:
        yield
        return
    server = PushServer(parse_address("sensorlogger://0.0.0.0:0"), lambda body, arrival: None)
    path = f"/{_EXPERIMENT}"
    server.files[path] = "application/octet-stream", bundled("config", "phyphox", _EXPERIMENT).read_bytes()
    await server.start()
    for phone in phones:
        phone.code = server.url(path=path).replace("http://", "phyphox://", 1)
    try:
        yield
    finally:
        await server.stop()


class _Window:
    """The samples of the last seconds."""

    def __init__(self) -> None:
        self._packets: list[Packet] = []

    def add(self, packets: list[Packet], now: float) -> None:
        """Take what has come, forget what is old."""
        self._packets = [p for p in self._packets if p.arrival > now - _WINDOW] + packets

    def _of(self, stream: str) -> list[Samples]:
        return [p.samples for p in self._packets if p.stream == stream]

    @property
    def first(self) -> float:
        """When its oldest sample came, s; infinite while it is empty."""
        return min((p.arrival for p in self._packets), default=float("inf"))

    def judged(self) -> list[Finding]:
        """The findings and the verdict."""
        imu = [s for s in self._of("imu") if isinstance(s, ImuData)]
        fix = [s for s in self._of("fix") if isinstance(s, FixData)]
        velocity = [s for s in self._of("vel") if isinstance(s, VelocityData)]
        nothing = ImuData(FixData.empty().t, FixData.empty().sigma, FixData.empty().sigma)
        found = assess(
            ImuData.joined(imu) if imu else nothing,
            FixData.joined(fix) if fix else FixData.empty(),
            VelocityData.joined(velocity) if velocity else VelocityData.empty(),
        )
        return [*found, verdict(found)]


async def _watch(hub: Hub, console: Console, end: asyncio.Event, seconds: float | None) -> None:
    window, began = _Window(), time.monotonic()
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    period = _PERIOD if live else _LOG_PERIOD
    due, shown = 0.0, False
    if live:
        live.start()
    try:
        while not end.is_set() and (seconds is None or time.monotonic() - began < seconds):
            window.add(hub.take(), hub.now())
            for event in hub.heard():
                console.print(Text(event.text, style=STYLES[event.level]))
            ready = hub.now() - window.first > _FIRST
            if time.monotonic() > due and (ready or live):
                lines = _lines(hub, window if ready else None)
                if live:
                    live.update(Group(*lines), refresh=True)
                else:
                    console.print(*lines, sep="\n")
                due, shown = time.monotonic() + period, shown or ready
            try:
                await asyncio.wait_for(end.wait(), 0.05)
            except asyncio.TimeoutError:
                continue
    finally:
        if live:
            live.stop()
    if not shown and hub.chosen:
        console.print(*_lines(hub, window), sep="\n")


def _lines(hub: Hub, window: _Window | None) -> list[Text]:
    now = hub.now()
    if not hub.chosen:
        return [Text("Waiting for the first samples ...")]
    lines = [Text(device_line(device, now), style="bold") for device in hub.devices.values()]
    lines += [Text(f"  {f.text}", style=STYLES[f.level]) for f in findings(hub, now)]
    if window is not None:
        lines += [Text(f"  {f.text}", style=STYLES[f.level]) for f in window.judged()]
    return lines
