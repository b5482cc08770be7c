# SPDX-License-Identifier: Apache-2.0
"""Live sources on the terminal: how to connect, events as they happen, and the state of each device."""

from __future__ import annotations

import asyncio
import io
import signal
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import final

import segno
from rich.console import Console
from rich.text import Text

from suspension_twin.addons.sources import LiveSource
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.report import device_line, findings
from suspension_twin.cli._status import UpdatedLines, say
from suspension_twin.signals.checks import Finding

__all__ = [
    "DEFAULT_SOURCE",
    "LiveLines",
    "device_lines",
    "say_reached",
    "show_guide",
    "styled",
    "until_ended",
]

#: The source where none is named: any phone with Sensor Logger.
DEFAULT_SOURCE = "sensorlogger://0.0.0.0:8000"

#: s between lines on a terminal, and between looks for samples.
_PERIOD, _LOOK = 0.5, 0.05
_STYLES = {"ok": "", "warn": "yellow", "error": "bold red"}


def styled(finding: Finding, indent: str = "  ") -> Text:
    """A finding as a line in the colour of its level."""
    return Text(f"{indent}{finding.text}", style=_STYLES[finding.level])


def device_lines(hub: Hub, style: str = "", indent: str = "  ") -> list[Text]:
    """A line for each device of a hub, and one for each thing that is wrong now."""
    now = hub.now()
    lines = [Text(f"{indent}{device_line(device, now)}", style=style) for device in hub.devices.values()]
    return lines + [styled(finding) for finding in findings(hub, now)]


def say_reached(sources: Sequence[LiveSource]) -> None:
    """The first line of a command that others than this machine can send to."""
    for source in sources:
        if source.reached:
            say(source.reached)


async def until_ended(seconds: float | None = None) -> AsyncIterator[None]:
    """Yields some times a second until Ctrl-C, SIGTERM or the end of the time."""
    end, began = asyncio.Event(), time.monotonic()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, end.set)
    while not end.is_set() and (seconds is None or time.monotonic() - began < seconds):
        yield
        try:
            await asyncio.wait_for(end.wait(), _LOOK)
        except asyncio.TimeoutError:
            continue


async def show_guide(console: Console, sources: Sequence[LiveSource], urls: Sequence[str]) -> None:
    """How to connect: each source's address, its QR code on a terminal, the app's settings step by step; and how the
    same is recorded and followed."""
    for source in sources:
        console.print()
        for note in source.notes:
            console.print(Text(note, style="bold"))
        if source.code and console.is_terminal:
            buffer = io.StringIO()
            segno.make(source.code, error="m").terminal(out=buffer, compact=True)
            console.print(Text(buffer.getvalue()), no_wrap=True)
        for number, step in enumerate(source.steps, 1):
            console.print(Text(f"  {number}. {step}"))
    given = " ".join(f"--source '{url}'" for url in urls)
    console.print()
    console.print(Text(f"Record: suspension-twin record {given} --out drive"))
    console.print(Text(f"Follow: suspension-twin run --twin TWIN.YAML {given}"))
    console.print()


@final
class LiveLines(UpdatedLines):
    """The same, with the events of a hub as they happen."""

    def __init__(self, hub: Hub, console: Console | None = None, log_period: float = 10.0) -> None:
        super().__init__(console, _PERIOD, log_period)
        self._hub = hub

    def show(self, lines: Callable[[], Sequence[Text]]) -> None:
        """See the base class."""
        self.say(styled(event, "") for event in self._hub.events())
        super().show(lines)
