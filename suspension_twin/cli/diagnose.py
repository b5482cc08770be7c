# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin diagnose``: where twin and car disagree, why, and what closes the gap."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Bags, Force, Outputs, ProgressLine, Seed, TwinFile, print_diagnosis
from suspension_twin.errors import InputError, nearest
from suspension_twin.files import together

__all__ = ["command"]

Reference = Annotated[
    list[Path] | None,
    typer.Option(
        "--reference",
        help="Drives of the same vehicle from before the gap, after those with it.",
        metavar="BAG",
        show_default=False,
    ),
]
Effects = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        help="Try this effect alone; repeatable.",
        metavar="ID",
        show_default=False,
    ),
]
Out = Annotated[
    Path,
    typer.Option("--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False),
]


def command(
    twin: TwinFile,
    bags: Bags,
    out: Out,
    reference: Reference = None,
    effect: Effects = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Where twin and car disagree, why, and what closes the gap.

    Writes DIR/diagnosis.json, DIR/report.html and DIR/twin.yaml, the twin with what was found added.
    """
    page = out / "report.html"
    outputs = Outputs(out / "diagnosis.json", page, out / "twin.yaml", force=force)
    from suspension_twin.diagnosis.output import write
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.request import Progress as Stage
    from suspension_twin.diagnosis.run import diagnose
    from suspension_twin.effects.registry import EFFECTS
    from suspension_twin.report.diagnosis import diagnosis_page
    from suspension_twin.vehicle.twin import load_twin

    for name in effect or ():
        if name not in EFFECTS:
            raise InputError(
                "--effect", name, f"is not an effect{nearest(name, EFFECTS)} ({', '.join(EFFECTS)})"
            )
    request = DiagnosisRequest(
        str(twin),
        tuple(str(b) for b in bags),
        tuple(str(b) for b in reference or ()),
        seed,
        tuple(effect or ()),
    )
    load_twin(twin)
    outputs.announce()
    with outputs, ProgressLine() as line:

        def show(stage: Stage) -> None:
            line.show(f"{stage.stage}: {stage.note}" if stage.note else stage.stage, stage.done)

        result = diagnose(request, show)
        with together():
            write(result, out)
            diagnosis_page(result).write(page)
    print_diagnosis(result.document, out)
