# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin plan``: what a set-up could show, and never tell apart, before anyone drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, ProgressLine, TwinFile, output, print_table

__all__ = ["command"]

RoadFile = Annotated[
    Path | None,
    typer.Option(
        "--road", help="An OpenCRG road instead of the twin file's.", metavar="ROAD", show_default=False
    ),
]
Speeds = Annotated[
    list[float] | None,
    typer.Option(
        "--speed",
        help="Speed of a drive; repeatable.  [default: 20 and 40]",
        metavar="KMH",
        show_default=False,
    ),
]
Out = Annotated[
    Path,
    typer.Option("--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False),
]


def command(
    twin: TwinFile, out: Out, road: RoadFile = None, speed: Speeds = None, force: Force = False
) -> None:
    """What this set-up could show, and never tell apart.

    From sensitivities alone, nothing is driven: the smallest size of each fault that would show, the pairs that look
    alike, and what would separate them. Writes DIR/plan.json and DIR/plan.html.
    """
    page = out / "plan.html"
    outputs = Outputs(out / "plan.json", page, force=force)
    from suspension_twin.diagnosis import wording
    from suspension_twin.diagnosis.plan import SPEEDS, plan
    from suspension_twin.report.plan import plan_page, size_text
    from suspension_twin.road import load_road
    from suspension_twin.vehicle.twin import load_twin

    loaded = load_twin(twin)
    surface = None if road is None else load_road(road)
    outputs.announce()
    with outputs, ProgressLine() as line:
        found = plan(loaded, surface, speed or SPEEDS, on_progress=line.show)
        found.write(out)
        plan_page(found).write(page)
    console = output()
    rows = [
        (
            wording.effect_at(s.effect, s.place),
            wording.parameter_name(s.effect, s.parameter),
            size_text(s, s.size),
            size_text(s, s.typical),
            "" if s.size is None else wording.channel_name(s.channel),
        )
        for s in found.shown
    ]
    columns = "fault", "quantity", "shows from", "typical", "first in"
    print_table(
        console, "What these drives could show", columns, rows, words=("fault", "quantity", "first in")
    )
    pairs = [
        (
            wording.effect_name(p.effect),
            wording.effect_name(p.rival),
            f"{p.angle:.0f}",
            size_text(p.shown, p.size),
            f"{p.remedy}: from {size_text(p.shown, p.remedy_size)}" if p.remedy else "nothing that was tried",
        )
        for p in found.pairs
    ]
    if pairs:
        columns = "fault", "taken for", "angle [°]", "told apart from", "what separates them"
        words = ("fault", "taken for", "what separates them")
        print_table(console, "What looks alike", columns, pairs, words=words)
    console.print(f"Written to {out}", markup=False)
