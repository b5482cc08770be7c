# SPDX-License-Identifier: Apache-2.0
"""Live sources on the terminal: what is to be said at once, and how each device is doing."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from types import TracebackType
from typing import final

import segno
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from suspension_twin.addons.sources import Source
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.addons.sources.common.report import device_line, findings

__all__ = ["DEFAULT_SOURCE", "STYLES", "LiveLines", "show_guide"]

#: What connect and record listen to if nothing is named: any phone with Sensor Logger.
DEFAULT_SOURCE = "sensorlogger://0.0.0.0:8000"

#: Seconds between lines on a terminal, and in a log.
_PERIOD, _LOG_PERIOD = 0.5, 10.0
STYLES = {"ok": "", "warn": "yellow", "error": "bold red"}


async def show_guide(console: Console, sources: Sequence[Source], urls: Sequence[str]) -> None:
    """How to connect: what each source says, its QR code on a terminal, the app's settings step by step, and how
    the same is recorded and followed."""
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
class LiveLines:
    """Shows the devices of a hub while they send; ``notes`` are said first."""

    def __init__(self, hub: Hub, notes: Sequence[str], console: Console | None = None) -> None:
        self._hub = hub
        self._notes = notes
        self._console = console or Console(stderr=True, highlight=False, soft_wrap=True)
        self._live = (
            Live(console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False)
            if self._console.is_terminal
            else None
        )
        self._due = time.monotonic() + _PERIOD

    def __enter__(self) -> LiveLines:
        for note in self._notes:
            self._console.print(Text(note))
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str, style: str = "") -> None:
        """A line that stays."""
        self._console.print(Text(text, style=style))

    def show(self, head: str) -> None:
        """Say what has happened, and bring the lines up to date if it is time to."""
        for event in self._hub.heard():
            self._console.print(Text(event.text, style=STYLES[event.level]))
        now = time.monotonic()
        if now < self._due:
            return
        host = self._hub.now()
        lines = [Text(head)]
        lines += [Text(f"  {device_line(device, host)}") for device in self._hub.devices.values()]
        lines += [Text(f"  {f.text}", style=STYLES[f.level]) for f in findings(self._hub, host)]
        if self._live is not None:
            self._live.update(Group(*lines), refresh=True)
            self._due = now + _PERIOD
        else:
            for line in lines:
                self._console.print(line)
            self._due = now + _LOG_PERIOD
