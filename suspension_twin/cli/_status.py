# SPDX-License-Identifier: Apache-2.0
"""The condition of a running twin, in a line on the terminal."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import TYPE_CHECKING, final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from suspension_twin.errors import printable

if TYPE_CHECKING:
    from suspension_twin.nodes.composed import Composed, Condition

__all__ = ["Status", "line", "say"]

#: Seconds between lines on a terminal, and in a log.
_PERIOD, _LOG_PERIOD = 1.0, 10.0
_WIDTH = 80


def say(text: str) -> None:
    """One line for the user that is not a result."""
    Console(stderr=True, highlight=False, soft_wrap=True).print(Text(printable(text)))


def line(condition: Condition) -> Text:
    """``condition`` in a line of at most 80 columns; what is learnt of the road in another, what is wrong in a last one
    and in colour."""
    parts = []
    if condition.position is not None:
        again = f", round {condition.rounds + 1}" if condition.rounds else ""
        parts.append(f"{condition.position:.0f} of {condition.duration:.0f} s{again}")
    known = (f"{n} {'-' if math.isnan(r) else f'{r:.0f}'}" for n, r in condition.rates.items())
    parts.append(f"{', '.join(known)} Hz")
    if condition.gap is None:
        parts.append("gap -")
    else:
        times = "" if condition.normalised is None else f" ({condition.normalised:.1f} ×)"
        parts.append(f"gap {condition.gap:.2f} m/s²{times}")
    text = Text(_fitting(parts))
    if condition.learning is not None:
        text.append(f"\n{condition.learning[:_WIDTH]}")
    if condition.complaints:
        more = f" (+{len(condition.complaints) - 1})" if len(condition.complaints) > 1 else ""
        text.append("\n")
        text.append(condition.complaints[0] + more, style="bold red" if condition.failing else "yellow")
    return text


def _fitting(parts: list[str]) -> str:
    """The parts in one line, closer together where they would not fit."""
    for between in (" | ", "|"):
        for comma in (", ", " "):
            text = between.join(part.replace(", ", comma) for part in parts)
            if len(text) <= _WIDTH:
                return text
    return text[:_WIDTH]


@final
class Status:
    """Shows the condition once a second on a terminal, every ten seconds in a log."""

    def __init__(self, composed: Composed, console: Console | None = None) -> None:
        self._composed = composed
        self._console = console or Console(stderr=True, highlight=False, soft_wrap=True)
        self._live: Live | None = None
        if self._console.is_terminal:
            self._live = Live(
                console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
            )
        self._began = time.monotonic()
        self._due = self._began + _PERIOD

    def __enter__(self) -> Status:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self) -> None:
        """Bring the line up to date, if it is time to."""
        now = time.monotonic()
        if now < self._due:
            return
        text = line(self._composed.condition())
        if self._live is not None:
            self._live.update(text, refresh=True)
            self._due = now + _PERIOD
        else:
            self._console.print(text)
            self._due = now + _LOG_PERIOD

    def conclude(self) -> None:
        """The last line, in place of the one that was updated."""
        if self._live is not None:
            self._live.update(Text(""), refresh=True)
            self._live.stop()
            self._live = None
        condition = self._composed.condition()
        seconds = time.monotonic() - self._began
        lines = [f"{condition.answers} answers to {condition.samples} IMU samples in {seconds:.1f} s"]
        if condition.whole_gap is not None:
            lines.append(f"Gap over the whole drive: {condition.whole_gap:.3f} m/s² rms")
        self._console.print(Text("\n".join(lines)))
