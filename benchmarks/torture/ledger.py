# SPDX-License-Identifier: Apache-2.0
"""What is kept of a torture: how many trials, which failed, and the worst of what was measured.

Trial ``n`` of a row is the same on every machine: it draws from a generator seeded by the row's name and ``n``. A run
goes on with the trial after the last that is kept.
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

__all__ = ["Tally", "load", "save"]

#: Failures kept in words; beyond them they are only counted.
_KEPT = 50


@dataclass
class Tally:
    """Trials of one row. ``worst`` holds the largest of each figure, ``notes`` what could not be done here."""

    name: str
    bar: str
    trials: int = 0
    failed: int = 0
    seconds: float = 0.0
    failures: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    worst: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    deadline: float = 0.0

    def rng(self, trial: int) -> np.random.Generator:
        """The generator of a trial."""
        return np.random.default_rng([zlib.crc32(self.name.encode()), trial])

    def left(self) -> float:
        """Seconds until this run ends."""
        return self.deadline - time.monotonic()

    def numbers(self) -> Iterator[int]:
        """Numbers of the trials from where the last run ended, until the time is over; at least one."""
        began, first = time.monotonic(), True
        before = self.seconds
        while first or self.left() > 0:
            first = False
            yield self.trials
            self.trials += 1
            self.seconds = before + time.monotonic() - began

    def count(self, what: str, number: int = 1) -> None:
        """So many more of a kind of outcome."""
        self.counts[what] = self.counts.get(what, 0) + number

    def measure(self, what: str, value: float) -> None:
        """A figure of which the largest is kept."""
        self.worst[what] = max(self.worst.get(what, -np.inf), float(value))

    def fail(self, text: str) -> None:
        """The trial under way did what it must not."""
        self.failed += 1
        if len(self.failures) < _KEPT:
            self.failures.append(f"trial {self.trials}: {text[:300]}")

    def note(self, text: str) -> None:
        """Something that this machine does not allow."""
        if text not in self.notes:
            self.notes.append(text)


def load(path: Path) -> dict[str, Tally]:
    """Tallies by name; empty if there is no file."""
    if not path.is_file():
        return {}
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return {row["name"]: Tally(**row) for row in rows}


def save(path: Path, tallies: dict[str, Tally], machine: str) -> None:
    """Write all tallies, whole or not at all."""
    from suspension_twin.files import write_text

    rows = [{k: v for k, v in asdict(t).items() if k != "deadline"} for t in tallies.values()]
    write_text(path, json.dumps({"machine": machine, "rows": rows}, indent=1, ensure_ascii=False) + "\n")
