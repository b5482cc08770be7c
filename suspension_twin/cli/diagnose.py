# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin diagnose``: where twin and car disagree, why, and what closes the gap."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, ProgressLine, Seed, print_diagnosis
from suspension_twin.errors import InputError, nearest
from suspension_twin.files import together

if TYPE_CHECKING:
    from suspension_twin.diagnosis.decision import Costs
    from suspension_twin.diagnosis.request import DiagnosisProgress

__all__ = ["command"]

Effects = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        help="Try this effect alone of the library; repeatable.",
        metavar="ID",
        show_default=False,
    ),
]


def command(
    *,
    twin: Annotated[
        Path | None, typer.Option("--twin", help="The twin file.", metavar="TWIN.YAML", show_default=False)
    ] = None,
    bags: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Recorded drives: rosbag2 folders or bare files.", metavar="BAG", show_default=False
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False
        ),
    ] = None,
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            "--reference",
            help="Drives of the same vehicle from before the gap; name them behind those that show it.",
            metavar="BAG",
            show_default=False,
        ),
    ] = None,
    effect: Effects = None,
    from_evidence: Annotated[
        Path | None,
        typer.Option(
            "--from-evidence",
            help="Decide anew from the evidence that an earlier diagnosis left in this folder.",
            metavar="DIR",
            file_okay=False,
            show_default=False,
        ),
    ] = None,
    add: Annotated[
        list[Path] | None,
        typer.Option(
            "--add",
            help="Go on with the diagnosis in --out, with this drive that shows the gap beside the others; repeatable.",
            metavar="BAG",
            show_default=False,
        ),
    ] = None,
    costs: Annotated[
        str,
        typer.Option(
            "--costs",
            help="Costs of a wrong name, a missed cause, unknown and vague answers: "
            "wrong=4,missed=1,unknown=1,vague=0.5; or a use, workshop or release.",
            metavar="TABLE",
            show_default=False,
        ),
    ] = "",
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Where twin and car disagree, why, and what closes the gap.

    Writes DIR/diagnosis.json, DIR/evidence.json, DIR/report.html and DIR/twin.yaml, the twin with what was found
    added. With --add it goes on with the diagnosis in DIR, one drive more. With --from-evidence alone it prints the
    answer; with --out it writes diagnosis.json and twin.yaml, too. After an interruption the same command goes on where
    it was.
    """
    from suspension_twin.diagnosis.decision import Costs

    table = Costs.parsed(costs)
    kept = "--add" if add else "--from-evidence"
    if (add or from_evidence is not None) and (
        twin or bags or reference or (add and from_evidence is not None)
    ):
        raise InputError(kept, "takes neither --twin nor other drives: they are those of the diagnosis")
    if from_evidence is not None:
        _anew(from_evidence, table, out, force)
        return
    if not add and (twin is None or not bags):
        raise InputError("--twin" if twin is None else "BAG", "is missing")
    if out is None:
        raise InputError("--out", "is missing")
    folder = out / ".state"
    page, *others = (out / name for name in ("report.html", "diagnosis.json", "evidence.json", "twin.yaml"))
    outputs = Outputs(*others, page, force=force or bool(add), resumed_from=folder)
    from suspension_twin.diagnosis.answer import continued, write
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.run import diagnose
    from suspension_twin.inference.checkpoint import Checkpoint
    from suspension_twin.report.diagnosis import diagnosis_page
    from suspension_twin.vehicle.twin import load_twin

    earlier = None
    if add:
        request, earlier = continued(out, add, table)
        request = replace(request, state=str(folder))
    else:
        request = DiagnosisRequest(
            str(twin),
            tuple(map(str, bags or ())),
            tuple(map(str, reference or ())),
            seed,
            checked_effects(effect),
            costs=table,
            state=str(folder),
        )
    store = Checkpoint(folder, "", "a diagnosis")  # refuses a folder that holds no checkpoints
    load_twin(request.twin)
    with outputs, ProgressLine() as line:

        def show(step: DiagnosisProgress) -> None:
            if step.stage != "reading":
                outputs.announce()
            line.show(": ".join(filter(None, (step.stage, step.note))), step.done)

        result = diagnose(request, show)
        if earlier is not None:
            result.document["earlier"] = earlier
        with together():
            write(result, out)
            diagnosis_page(result).write(page)
        store.remove()
    print_diagnosis(result.document, out)


def checked_effects(names: list[str] | None) -> tuple[str, ...]:
    """The ids given with ``--effect``; raises InputError for one that is no effect."""
    from suspension_twin.effects.registry import EFFECTS

    for name in names or ():
        if name not in EFFECTS:
            raise InputError(
                "--effect", name, f"is not an effect{nearest(name, EFFECTS)} ({', '.join(EFFECTS)})"
            )
    return tuple(names or ())


def _anew(folder: Path, costs: Costs, out: Path | None, force: bool) -> None:
    """Decide anew from kept evidence; ``out`` receives diagnosis.json, and twin.yaml if the twin file still exists."""
    from suspension_twin.diagnosis.answer import decided_anew, write_anew

    document, twin = decided_anew(folder, costs)
    if out is not None:
        outputs = Outputs(out / "diagnosis.json", out / "twin.yaml", force=force)
        outputs.announce()
        with outputs:
            write_anew(document, twin, folder, out)
    print_diagnosis(document, out)
