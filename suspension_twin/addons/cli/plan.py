# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin plan``: the faults that a set-up could show, before anyone drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, ProgressLine, TwinFile, output, print_table

__all__ = ["command"]


def command(
    twin: TwinFile,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False
        ),
    ],
    road: Annotated[
        Path | None,
        typer.Option(
            "--road", help="An OpenCRG road instead of the twin file's.", metavar="ROAD", show_default=False
        ),
    ] = None,
    speed: Annotated[
        list[float] | None,
        typer.Option(
            "--speed",
            help="Speed of a drive in km/h; repeatable.  [default: 20 and 40]",
            metavar="KMH",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Faults that this set-up could show, and pairs that it could never tell apart.

    From sensitivities alone, nothing is driven: the smallest size of each fault that would show, the pairs that look
    alike, and what would separate them. Writes DIR/plan.json and DIR/plan.html.
    """
    outputs = Outputs(out / "plan.json", out / "plan.html", force=force)
    from suspension_twin.addons.plan.page import plan_page, size_text
    from suspension_twin.addons.plan.plan import SPEEDS, plan
    from suspension_twin.diagnosis import wording
    from suspension_twin.road import load_road
    from suspension_twin.vehicle.twin import load_twin

    loaded = load_twin(twin)
    surface = None if road is None else load_road(road)
    outputs.announce()
    with outputs, ProgressLine() as line:
        found = plan(loaded, surface, speed or SPEEDS, on_progress=line.show)
        found.write(out)
        plan_page(found).write(out / "plan.html")
    console = output()
    rows = [
        (
            wording.effect_at(s.effect, s.place),
            wording.parameter_name(s.effect, s.parameter),
            size_text(s, s.size),
            size_text(s, s.typical),
            "" if s.size is None else wording.channel_name(s.channel),
        )
        for s in found.detectability
    ]
    columns = "fault", "quantity", "shows from", "typical", "first in"
    words = "fault", "quantity", "first in"
    print_table(console, "Faults that these drives could show", columns, rows, words)
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
        print_table(console, "Faults that look alike", columns, pairs, words=(*columns[:2], columns[-1]))
    console.print(f"Written to {out}", markup=False)
