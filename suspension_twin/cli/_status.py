# SPDX-License-Identifier: Apache-2.0
"""The state of a running twin, in a line on the terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from suspension_twin.errors import printable

if TYPE_CHECKING:
    from typing import Self  # of Python 3.11

    from suspension_twin.inference.gap import Gap
    from suspension_twin.nodes.composed import Composed, Condition

__all__ = ["UpdatedLines", "complaint", "conclusion", "line", "say"]

_WIDTH = 80


def say(text: str) -> None:
    """Print one line for the user that is not a result."""
    Console(stderr=True, highlight=False, soft_wrap=True).print(Text(printable(text)))


def line(condition: Condition) -> Text:
    """``condition`` in a line of at most 80 columns; below it the learnt road, and complaints in colour."""
    parts = []
    if (played := condition.played) is not None:
        again = f", loop {played.rounds + 1}" if played.rounds else ""
        at = f"{played.position:.0f} of {played.duration:.0f} s{again}"
        parts.append("waits for the page" if played.waiting else at)
    known = (f"{n} {'-' if math.isnan(r) else f'{r:.0f}'}" for n, r in condition.rates.items())
    text = Text(_fitting([*parts, f"{', '.join(known)} Hz", f"gap now {condition.gap or '-'}"]))
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


class UpdatedLines:
    """Lines that are brought up to date in place on a terminal every ``period`` s, and printed in a log every
    ``log_period`` s."""

    def __init__(self, console: Console | None = None, period: float = 1.0, log_period: float = 10.0) -> None:
        self.console = console or Console(stderr=True, highlight=False, soft_wrap=True)
        self._live: Live | None = None
        if self.console.is_terminal:
            self._live = Live(
                console=self.console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
            )
        self._period = period if self._live else log_period
        self._due = time.monotonic() + period

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, lines: Iterable[Text]) -> None:
        """Lines that stay."""
        for text in lines:
            self.console.print(text)

    def show(self, lines: Callable[[], Sequence[Text]]) -> None:
        """These lines, where it is time to; none: not yet."""
        if time.monotonic() < self._due or not (made := lines()):
            return
        if self._live is not None:
            self._live.update(Group(*made), refresh=True)
        else:
            self.say(made)
        self._due = time.monotonic() + self._period

    def conclude(self, lines: Iterable[Text]) -> None:
        """Lines that stay in place of those that were updated."""
        if self._live is not None:
            self._live.update(Text(""), refresh=True)
            self._live.stop()
        self.say(lines)


def conclusion(composed: Composed, seconds: float, offline: tuple[Gap, Gap] | None = None) -> list[Text]:
    """The last lines of a run of so many seconds: how many samples were answered, and the live gap; of a replay also
    the gap with the whole drive known, of all driving and of that which the live one counts."""
    end, live = composed.condition(), composed.model.whole_gap()
    lines = [f"{end.answers} answers to {end.samples} IMU samples in {seconds:.1f} s"]
    if not math.isnan(live):
        same = "" if offline is None else f" ({offline[1].rms:.3f} with the whole drive known)"
        lines.append(f"Live gap since the twin settled: {live:.3f} m/s² rms{same}")
    if offline is not None:
        lines.append(f"Gap over all driving: {offline[0].rms:.3f} m/s² rms")
    return [Text(text) for text in lines]
