# SPDX-License-Identifier: Apache-2.0
"""``run --fleet``: the live twins of many vehicles in one process or a few, and how they are in a few lines."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from suspension_twin.addons.cli.pages import fleet_pages, foxglove_address, free_address, node_process
from suspension_twin.addons.view.fleet import TwinRow
from suspension_twin.cli._status import UpdatedLines, complaint, say
from suspension_twin.errors import printable

if TYPE_CHECKING:
    from suspension_twin.cli.run import DisplaySettings, FleetSettings, RosSettings
    from suspension_twin.nodes.composed import Condition

__all__ = ["rows", "run_fleet", "summary"]

#: s between lines on a terminal.
_PERIOD = 1.0
#: Twins of which a complaint is shown, and whose names are said at the start: what a terminal holds.
_COMPLAINTS, _NAMES = 5, 6


def run_fleet(given: FleetSettings, display: DisplaySettings, ros: RosSettings) -> None:
    """Hold the twins of a manifest until the process is asked to stop.

    Raises InputError for a manifest or a twin that cannot be used.
    """
    bridge = None if display.foxglove is None else foxglove_address(display.foxglove)
    page = None if display.view is None else free_address("--view", display.view)
    wanted = ros.wanted()
    from suspension_twin.addons.fleet.manifest import read_manifest
    from suspension_twin.addons.fleet.twins import fleet_twins
    from suspension_twin.nodes.composed import Helpers, TwinFleet, check_namespace
    from suspension_twin.nodes.parameters import check_names
    from suspension_twin.nodes.process import ros_context, stopping

    assert given.fleet is not None
    with ExitStack() as stack:
        stop = stack.enter_context(stopping())
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="suspension_twin_"))
        above = ros.namespace.strip("/")
        twins = {
            "/".join(p for p in (above, name) if p): str(file)
            for name, file in fleet_twins(read_manifest(given.fleet), Path(folder)).items()
        }
        for name in twins:
            check_namespace(name)
        names = list(twins)
        count = min(given.processes or len(os.sched_getaffinity(0)), len(names))
        shares = [{name: twins[name] for name in names[k::count]} for k in range(count)]
        where = "1 process" if count == 1 else f"{count} processes"
        first = ", ".join(f"/{name}" for name in names[:_NAMES])
        more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
        say(f"{len(names)} twins in {where}, a namespace each: {first}{more}")
        context = stack.enter_context(ros_context(ros.arguments))
        helpers = stack.enter_context(Helpers(shares[1:], ros.arguments))
        fleet = TwinFleet(context, shares[0])
        stack.callback(fleet.close)
        if ros.params is not None:
            check_names(ros.params, wanted, fleet.parameter_names())
        fleet.settle_memory()
        helpers.wait(lambda: not stop.asked)
        if bridge is not None:
            values = {"host": bridge.host, "port": bridge.port}
            stack.enter_context(node_process("foxglove_bridge", values, ros.namespace, ros.arguments))
        _watch(
            fleet.step,
            lambda: fleet.conditions() | helpers.conditions(),
            lambda: stop.asked or not context.ok(),
            None if page is None else stack.enter_context(fleet_pages(page, ros, twins)),
        )


def _watch(
    step: Callable[[], None],
    conditions: Callable[[], dict[str, Condition]],
    stop_asked: Callable[[], bool],
    update_page: Callable[[Mapping[str, TwinRow]], None] | None,
) -> None:
    """Go on step by step; show how the twins are every second on a terminal and on the page, every ten in a log."""
    page_due = time.monotonic() + _PERIOD
    with UpdatedLines() as lines:
        while not stop_asked():
            step()
            now = time.monotonic()
            if update_page is not None and now >= page_due:
                page_due = now + _PERIOD
                update_page(rows(conditions()))
            lines.show(lambda: [summary(conditions())])
    end = conditions().values()
    say(
        f"{sum(c.answers for c in end)} answers to {sum(c.samples for c in end)} IMU samples of {len(end)} twins"
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def rows(conditions: Mapping[str, Condition]) -> dict[str, TwinRow]:
    """Each twin as the page of the fleet shows it."""
    found: dict[str, TwinRow] = {}
    for name, c in conditions.items():
        found[name] = {
            "rate": _finite(c.rates["imu"]) or 0.0,
            "gap": "" if c.gap is None or math.isnan(c.gap.rms) else str(c.gap),
            "text": printable(c.complaints[0]) if c.complaints else "",
            "failing": c.failing,
        }
    return found


def summary(conditions: Mapping[str, Condition]) -> Text:
    """One line for all twins, and one for every twin with a complaint, the errors first."""
    rates = sorted(c.rates["imu"] for c in conditions.values() if c.rates["imu"] > 0.0)
    parts = [f"{len(conditions)} twins, {len(rates)} with samples"]
    if rates:
        low, high = f"{rates[0]:.0f}", f"{rates[-1]:.0f}"
        parts[0] += f" at {low if low == high else f'{low} to {high}'} Hz"
    gaps = [(c.gap, name) for name, c in conditions.items() if c.gap is not None and math.isfinite(c.gap.rms)]
    if gaps:
        # Beside its noise floor where that is known, for vehicles and roads differ.
        worst, name = max(gaps, key=lambda g: (_finite(g[0].normalised) or 0.0, g[0].rms))
        parts.append(f"largest gap now /{name} {worst}")
    text = Text(" | ".join(parts))
    unwell = sorted((i for i in conditions.items() if i[1].complaints), key=lambda i: not i[1].failing)
    for name, c in unwell[:_COMPLAINTS]:
        said = complaint(c)
        text.append("\n").append(f"/{name}: ", style=said.style).append(said)
    if len(unwell) > _COMPLAINTS:
        text.append(f"\nand {len(unwell) - _COMPLAINTS} more twins", style="yellow")
    return text
