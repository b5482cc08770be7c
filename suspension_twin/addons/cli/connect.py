# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin connect``: what can be reached, how a phone is connected, and what arrives."""

from __future__ import annotations

import asyncio
import io
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from suspension_twin.addons.cli.live_lines import (
    DEFAULT_SOURCE,
    LiveLines,
    device_lines,
    say_reached,
    show_guide,
    styled,
    until_ended,
)
from suspension_twin.addons.cli.record import Seconds
from suspension_twin.addons.sources import LiveSource, make_sources
from suspension_twin.addons.sources.common.assess import assess, verdict
from suspension_twin.addons.sources.common.connection import parse_address
from suspension_twin.addons.sources.common.hub import Hub, Packet
from suspension_twin.addons.sources.common.report import discover, findings
from suspension_twin.addons.sources.common.runner import running
from suspension_twin.addons.sources.common.server import PushServer
from suspension_twin.addons.sources.phyphox import Phyphox
from suspension_twin.cli.common import bundled, output
from suspension_twin.drive.types import FixData, ImuData, VelocityData
from suspension_twin.errors import WorkError

__all__ = ["command"]

#: s of samples that are judged, and between judgements in a log.
_WINDOW, _LOG_PERIOD = 10.0, 5.0
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
    seconds: Seconds = None,
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
    say_reached(sources)
    console.print(Text("On this machine", style="bold"))
    for line in discover():
        console.print(Text(f"  {line}"))

    async def work() -> None:
        async with running(sources, hub), _experiment(sources):
            await show_guide(console, sources, urls or [DEFAULT_SOURCE])
            await _watch(hub, console, seconds)

    asyncio.run(work())
    if not hub.chosen:
        raise WorkError("nothing arrived" + (f" within {seconds:g} s" if seconds else ""))


@asynccontextmanager
async def _experiment(sources: Sequence[LiveSource]) -> AsyncIterator[None]:
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


def _judged(packets: Sequence[Packet], hub: Hub) -> list[Text]:
    """The findings on these samples and the verdict, a line each; ``hub`` knows which sensor is not switched on."""
    absent = (f.text for f in findings(hub, hub.now()) if f.code.startswith("missing"))
    samples = [packet.samples for packet in packets]
    imu = [s for s in samples if isinstance(s, ImuData)]
    fix = [s for s in samples if isinstance(s, FixData)]
    velocity = [s for s in samples if isinstance(s, VelocityData)]
    found = assess(
        ImuData.joined(imu or [ImuData(np.empty(0), np.empty((0, 3)), np.empty((0, 3)))]),
        FixData.joined(fix or [FixData.empty()]),
        VelocityData.joined(velocity or [VelocityData.empty()]),
        next(absent, ""),
    )
    return [styled(finding) for finding in [*found, verdict(found)]]


async def _watch(hub: Hub, console: Console, seconds: float | None) -> None:
    """Show the devices and the judgement of the last seconds, on a terminal from the first sample on."""
    packets: list[Packet] = []
    shown = False

    def lines() -> list[Text]:
        nonlocal shown
        ready = bool(packets) and hub.now() - min(p.arrival for p in packets) > _FIRST
        shown |= ready
        if not (ready or console.is_terminal):
            return []
        if not hub.chosen:
            return [Text("Waiting for the first samples ...")]
        return [*device_lines(hub, "bold", ""), *(_judged(packets, hub) if ready else [])]

    with LiveLines(hub, console, _LOG_PERIOD) as live:
        async for _ in until_ended(seconds):
            packets = [p for p in packets if p.arrival > hub.now() - _WINDOW] + hub.take()
            live.show(lines)
    if not shown and hub.chosen:
        live.say([*device_lines(hub, "bold", ""), *_judged(packets, hub)])
