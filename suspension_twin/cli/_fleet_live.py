# SPDX-License-Identifier: Apache-2.0
"""``run --fleet``: the live twins of many vehicles in one process or a few, and how they are in a few lines."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from suspension_twin.cli._status import say
from suspension_twin.errors import printable

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from suspension_twin.nodes.composed import Condition

__all__ = ["rows", "run_fleet", "summary"]

#: Takes what :func:`rows` gives.
Tell = Callable[[Mapping[str, Mapping[str, Any]]], None]

#: s between lines on a terminal, and in a log.
_PERIOD, _LOG_PERIOD = 1.0, 10.0
#: Twins of which a complaint is shown, and whose names are said at the start: what a terminal holds.
_COMPLAINTS, _NAMES = 5, 6


def run_fleet(
    manifest: Path,
    namespace: str,
    processes: int,
    params: Path | None,
    wanted: Mapping[str, Mapping[str, Any]],
    arguments: Sequence[str],
    beside: Sequence[AbstractContextManager[None]] = (),
    pages: Callable[[Mapping[str, str]], AbstractContextManager[Tell]] | None = None,
) -> None:
    """Hold the twins of a manifest until the process is asked to stop.

    ``processes`` 0 is one a core; ``params`` is the parameter file with its names ``wanted``, ``arguments`` are those
    for ROS; ``beside`` are entered while the twins run, and ``pages``, made for the twin files by namespace, is told
    every second how they are. Raises InputError for a manifest or a twin that cannot be used.
    """
    from suspension_twin.addons.fleet.manifest import read_manifest
    from suspension_twin.addons.fleet.twins import fleet_twins
    from suspension_twin.nodes.composed import Helpers, TwinFleet, check_namespace
    from suspension_twin.nodes.parameters import check_names
    from suspension_twin.nodes.process import ros_context, stopping

    with ExitStack() as stack:
        stop = stack.enter_context(stopping())
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="suspension_twin_"))
        above = namespace.strip("/")
        twins = {
            "/".join(p for p in (above, t.namespace) if p): str(t.file)
            for t in fleet_twins(read_manifest(manifest), Path(folder))
        }
        for name in twins:
            check_namespace(name)
        names = list(twins)
        count = min(processes or len(os.sched_getaffinity(0)), len(names))
        shares = [{name: twins[name] for name in names[k::count]} for k in range(count)]
        where = "1 process" if count == 1 else f"{count} processes"
        first = ", ".join(f"/{name}" for name in names[:_NAMES])
        more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
        say(f"{len(names)} twins in {where}, a namespace each: {first}{more}")
        context = stack.enter_context(ros_context(list(arguments)))
        helpers = stack.enter_context(Helpers(shares[1:], arguments))
        fleet = TwinFleet(context, shares[0])
        stack.callback(fleet.close)
        if params is not None:
            check_names(params, wanted, fleet.parameter_names())
        fleet.settle_memory()
        helpers.wait(lambda: not stop.asked)
        for each in beside:
            stack.enter_context(each)
        _watch(
            fleet.step,
            lambda: fleet.conditions() | helpers.conditions(),
            lambda: stop.asked or not context.ok(),
            None if pages is None else stack.enter_context(pages(twins)),
        )


def _watch(
    step: Callable[[], None],
    conditions: Callable[[], dict[str, Condition]],
    stop_asked: Callable[[], bool],
    tell: Tell | None = None,
) -> None:
    """Go on step by step; say how the twins are every second on a terminal, every ten seconds in a log, and to
    ``tell``."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    live: Live | None = None
    if console.is_terminal:
        live = Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False)
    due = told = time.monotonic() + _PERIOD
    with live or ExitStack():
        while not stop_asked():
            step()
            now = time.monotonic()
            if tell is not None and now >= told:
                told = now + _PERIOD
                tell(rows(conditions()))
            if now < due:
                continue
            text = summary(conditions())
            if live is not None:
                live.update(text, refresh=True)
            else:
                console.print(text)
            due = time.monotonic() + (_PERIOD if live is not None else _LOG_PERIOD)
    end = conditions().values()
    say(
        f"{sum(c.answers for c in end)} answers to {sum(c.samples for c in end)} IMU samples of {len(end)} twins"
    )


def rows(conditions: Mapping[str, Condition]) -> dict[str, dict[str, Any]]:
    """How each twin is, as the page of the fleet shows it."""
    found = {}
    for name, c in conditions.items():
        known = c.gap is not None and math.isfinite(c.gap)
        found[name] = {
            "rate": c.rates["imu"] if math.isfinite(c.rates["imu"]) else 0.0,
            "gap": c.gap if known else None,
            "normalised": c.normalised if known else None,
            "text": printable(c.complaints[0]) if c.complaints else "",
            "failing": c.failing,
        }
    return found


def summary(conditions: Mapping[str, Condition]) -> Text:
    """How the twins are: one line of all, one for every twin that complains, the errors first."""
    rates = sorted(c.rates["imu"] for c in conditions.values() if c.rates["imu"] > 0.0)
    parts = [f"{len(conditions)} twins, {len(rates)} with samples"]
    if rates:
        low, high = f"{rates[0]:.0f}", f"{rates[-1]:.0f}"
        parts[0] += f" at {low if low == high else f'{low} to {high}'} Hz"
    gaps = {name: c for name, c in conditions.items() if c.gap is not None and not math.isnan(c.gap)}
    if gaps:
        # Beside its noise floor where that is known, for vehicles and roads differ.
        name = max(gaps, key=lambda n: (gaps[n].normalised or 0.0, gaps[n].gap or 0.0))
        worst = gaps[name]
        times = "" if worst.normalised is None else f" ({worst.normalised:.1f} ×)"
        parts.append(f"largest gap /{name} {worst.gap:.2f} m/s²{times}")
    text = Text(" | ".join(parts))
    unwell = sorted(
        (n for n, c in conditions.items() if c.complaints), key=lambda n: not conditions[n].failing
    )
    for name in unwell[:_COMPLAINTS]:
        c = conditions[name]
        more = f" (+{len(c.complaints) - 1})" if len(c.complaints) > 1 else ""
        text.append(
            f"\n/{name}: {printable(c.complaints[0])}{more}", style="bold red" if c.failing else "yellow"
        )
    if len(unwell) > _COMPLAINTS:
        text.append(f"\nand {len(unwell) - _COMPLAINTS} more twins", style="yellow")
    return text
