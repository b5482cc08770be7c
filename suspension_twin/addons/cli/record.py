# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin record``: the samples of live sources become a bag."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.padding import Padding
from rich.text import Text

from suspension_twin.addons.cli.live_lines import (
    DEFAULT_SOURCE,
    LiveLines,
    device_lines,
    say_reached,
    show_guide,
    until_ended,
)
from suspension_twin.addons.sources import LiveSource, make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.recorder import LiveRecorder
from suspension_twin.addons.sources.common.runner import running
from suspension_twin.cli.common import Force, Outputs, SourceUrls, output
from suspension_twin.drive.checks import summarise
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import BagWriter

__all__ = ["Seconds", "command"]

Seconds = Annotated[
    float | None,
    typer.Option("--seconds", metavar="S", help="End after so many seconds.", min=0.1, show_default=False),
]


def command(
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="BAG", help="The bag to write: a folder, or a file if it ends in .mcap."
        ),
    ],
    source: SourceUrls = None,
    seconds: Seconds = None,
    force: Force = False,
) -> None:
    """Live phones, receivers and IMUs into a bag, without a twin and without ROS. Ctrl-C ends it.

    Without --source it listens to phones with Sensor Logger and shows how to connect one. The bag is what calibrate
    takes. Stand still for some seconds before you drive off.
    """
    urls = source or [DEFAULT_SOURCE]
    outputs = Outputs(out, force=force)
    BagWriter(out, overwrite=force)  # replaces nothing but a recording
    hub = Hub()
    sources = make_sources(urls, hub)
    console = output()
    say_reached(sources)
    outputs.announce()
    with LiveRecorder(out, overwrite=force) as recorder:
        asyncio.run(_record(sources, hub, recorder, seconds, [] if source else urls))
    drive = read_drive(out)
    for line in [*summarise(drive).lines(), *(f"warning: {text}" for text in drive.warnings)]:
        console.print(Padding(Text(line), (0, 0, 0, 2), expand=False))
    console.print(f"Written to {out}", markup=False)


async def _record(
    sources: Sequence[LiveSource],
    hub: Hub,
    recorder: LiveRecorder,
    seconds: float | None,
    guide: Sequence[str],
) -> None:
    """Until Ctrl-C, SIGTERM or the end of the time; how to connect the URLs of ``guide`` is shown first."""

    def lines() -> list[Text]:
        head = f"{recorder.counts['imu']} IMU samples, {recorder.counts['fix']} positions"
        return [Text(head), *device_lines(hub)]

    async with running(sources, hub):
        if guide:
            await show_guide(output(), sources, guide)
        with LiveLines(hub) as live:
            live.say(Text(note) for source in sources for note in source.notes if not guide)
            async for _ in until_ended(seconds):
                recorder.write(hub.take())
                live.show(lines)
    recorder.write(hub.take())
