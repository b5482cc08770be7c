# SPDX-License-Identifier: Apache-2.0
"""Tortures: bad files and messages, kills, full disks, wrong clocks, load, parameters at their ends, cancelled goals,
strangers at the page, costly files, floods, paths in goals, senders of nonsense.

Each row goes on where the last run ended (``benchmarks/results/torture.json``); trial n of a row is the same on every
machine. ``--minutes`` are for all rows asked for together. Exit status 1 if a trial of this run failed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

from options import parse_options

from torture.ledger import Tally, load, save

RESULTS = Path(__file__).resolve().parents[1] / "results" / "torture.json"
#: Name of a row, and the module and function that make its trials.
ROWS = {
    "messages": ("messages", "torture"),
    "files": ("files", "torture"),
    "kill": ("kills", "torture"),
    "disk": ("disk", "torture"),
    "time": ("clocks", "stamps"),
    "clock": ("clocks", "clock"),
    "loop": ("clocks", "loop"),
    "day": ("clocks", "day"),
    "load": ("load", "torture"),
    "network": ("network", "torture"),
    "numerics": ("numerics", "torture"),
    "cancel": ("cancel", "torture"),
    "who": ("trust", "who"),
    "budget": ("trust", "budget"),
    "flood": ("trust", "flood"),
    "peer": ("trust", "peer"),
    "sender": ("senders", "torture"),
}


def table(tallies: dict[str, Tally]) -> str:
    """What is kept, a row each."""
    lines = [f"{'torture':<10}{'trials':>8}{'failed':>8}{'minutes':>9}  worst"]
    for tally in tallies.values():
        worst = ", ".join(f"{name} {value:.3g}" for name, value in tally.worst.items())
        lines.append(f"{tally.name:<10}{tally.trials:>8}{tally.failed:>8}{tally.seconds / 60:>9.1f}  {worst}")
        lines += [f"{'':<10}note: {note}" for note in tally.notes]
        lines += [f"{'':<10}{text}" for text in tally.failures[:5]]
        if len(tally.failures) > 5:
            lines.append(f"{'':<10}and {tally.failed - 5} more")
    return "\n".join(lines)


def main() -> int:
    """Run the rows asked for and show all that is kept."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=8.0, help="for all rows together (default 8)")
    parser.add_argument(
        "--only", action="append", choices=list(ROWS), metavar="NAME", help="this row; repeatable"
    )
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.add_argument("--anew", action="store_true", help="forget what is kept of these rows")
    parser.add_argument("--out", type=Path, default=RESULTS, help="where the figures are kept")
    options = parse_options(parser, minutes=0.0, out=Path(tempfile.gettempdir()) / "torture_smoke.json")
    tallies = load(options.out)
    names = options.only or list(ROWS)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    failed = 0
    for name in names:
        module, function = ROWS[name]
        row = import_module(f"torture.{module}")
        bar = row.BARS[name] if hasattr(row, "BARS") else row.BAR
        tally = Tally(name, bar) if options.anew or name not in tallies else tallies[name]
        tallies[name] = tally
        tally.bar, before = bar, tally.failed
        tally.deadline = time.monotonic() + 60 * options.minutes / len(names)
        try:
            getattr(row, function)(tally)
        finally:
            ordered = {n: tallies[n] for n in ROWS if n in tallies}
            save(options.out, ordered, machine)
        failed += tally.failed - before
    if options.json:
        print(
            json.dumps(
                {n: {k: v for k, v in asdict(t).items() if k != "deadline"} for n, t in ordered.items()}
            )
        )
    else:
        print(table(ordered))
    return 1 if failed else 0
