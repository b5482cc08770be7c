# SPDX-License-Identifier: Apache-2.0
"""The state of a running twin, in a line on the terminal."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from suspension_twin.errors import printable

if TYPE_CHECKING:
    from suspension_twin.nodes.composed import Composed, Condition

__all__ = ["Status", "complaint", "line", "say"]

#: Seconds between lines on a terminal, and in a log.
_PERIOD, _LOG_PERIOD = 1.0, 10.0
_WIDTH = 80


def say(text: str) -> None:
    """Print one line for the user that is not a result."""
    Console(stderr=True, highlight=False, soft_wrap=True).print(Text(printable(text)))


def line(condition: Condition) -> Text:
    """``condition`` in a line of at most 80 columns; below it the learnt road, and complaints in colour."""
    parts = []
    if (played := condition.played) is not None:
        again = f", round {played.rounds + 1}" if played.rounds else ""
        parts.append(f"{played.position:.0f} of {played.duration:.0f} s{again}")
    known = (f"{n} {'-' if math.isnan(r) else f'{r:.0f}'}" for n, r in condition.rates.items())
    text = Text(_fitting([*parts, f"{', '.join(known)} Hz", f"gap {condition.gap or '-'}"]))
    if condition.learning is not None:
        text.append(f"\n{condition.learning[:_WIDTH]}")
    if condition.complaints:
        text.append("\n").append(complaint(condition))
    return text


def complaint(condition: Condition) -> Text:
    """The first complaint and how many there are beside it, in colour."""
    first, *others = condition.complaints
    more = f" (+{len(others)})" if others else ""
    return Text(printable(first) + more, style="bold red" if condition.failing else "yellow")


def _fitting(parts: list[str]) -> str:
    """The parts in one line, closer together where they would not fit."""
    texts = [
        between.join(part.replace(", ", comma) for part in parts)
        for between in (" | ", "|")
        for comma in (", ", " ")
    ]
    return next((text for text in texts if len(text) <= _WIDTH), texts[-1][:_WIDTH])


@final
class Status:
    """Shows the condition once a second on a terminal, every ten seconds in a log."""

    def __init__(self, composed: Composed, console: Console | None = None) -> None:
        self._composed = composed
        self._console = console or Console(stderr=True, highlight=False, soft_wrap=True)
        self._live = Live(
            console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        )
        self._began = time.monotonic()
        self._due = self._began + _PERIOD

    def __enter__(self) -> Status:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._live.stop()

    def show(self) -> None:
        """Bring the line up to date, if it is due."""
        now = time.monotonic()
        if now < self._due:
            return
        text = line(self._composed.condition())
        if self._console.is_terminal:
            self._live.update(text, refresh=True)
            self._due = now + _PERIOD
        else:
            self._console.print(text)
            self._due = now + _LOG_PERIOD

    def conclude(self) -> None:
        """Print the last line, in place of the one that was updated."""
        if self._live.is_started:
            self._live.update(Text(""), refresh=True)
            self._live.stop()
        condition = self._composed.condition()
        seconds = time.monotonic() - self._began
        self._console.print(
            Text(f"{condition.answers} answers to {condition.samples} IMU samples in {seconds:.1f} s")
        )
        whole = self._composed.model.whole_gap()
        if not math.isnan(whole):
            self._console.print(Text(f"Gap over the whole drive: {whole:.3f} m/s² rms"))
