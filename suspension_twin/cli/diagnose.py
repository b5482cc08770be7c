# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin diagnose``: where twin and car disagree, why, and what closes the gap."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from suspension_twin.cli.common import Bags, Seed, TwinFile

__all__ = ["command"]

Reference = Annotated[
    list[Path] | None,
    typer.Option(
        "--reference", help="A drive of the same vehicle from before the gap; may be given more than once.",
        metavar="BAG", show_default=False,
    ),
]  # fmt: skip
Out = Annotated[
    Path, typer.Option("--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False)
]


def command(twin: TwinFile, bags: Bags, out: Out, reference: Reference = None, seed: Seed = 0) -> None:
    """Where twin and car disagree, why, and what closes the gap.

    Writes DIR/diagnosis.json, DIR/report.html and DIR/twin.yaml, the twin with what was found added.
    """
    from suspension_twin.cli._tracked import diagnose_runs, is_tracked

    if is_tracked(twin):
        diagnose_runs(twin, bags, list(reference or ()), out, seed)
        return
    from suspension_twin.diagnosis.output import write
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.request import Progress as Stage
    from suspension_twin.diagnosis.run import diagnose
    from suspension_twin.report.diagnosis import diagnosis_page

    request = DiagnosisRequest(
        str(twin), tuple(str(b) for b in bags), tuple(str(b) for b in reference or ()), seed
    )
    errors = Console(stderr=True)
    columns = TextColumn("{task.description:<44}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=errors, disable=not errors.is_terminal, transient=True) as bar:
        task = bar.add_task("reading", total=1.0)

        def show(stage: Stage) -> None:
            text = f"{stage.stage}: {stage.note}" if stage.note else stage.stage
            bar.update(task, completed=stage.done, description=text[:44])

        result = diagnose(request, show)
    write(result, out)
    diagnosis_page(result).write(out / "report.html")
    _print(result.document, out)


def _print(document: dict[str, object], out: Path) -> None:
    console = Console(highlight=False, soft_wrap=True)
    for warning in document["warnings"]:  # type: ignore[attr-defined]
        console.print(f"[yellow]{warning}[/]")
    console.print(f"[bold]{document['verdict']}[/]: {document['message']}")
    table = Table()
    for name in ("cause", "probability", "shrink", "interval", "parameters"):
        table.add_column(name)
    for cause in document["causes"][:5]:  # type: ignore[index]
        low, high = cause["shrink_interval"]
        values = ", ".join(f"{k} {v:.4g}" for k, v in cause["parameters"].items())
        table.add_row(
            cause["effect"], f"{cause['probability']:.3f}", f"{cause['shrink']:.2f}", f"{low:.2f} to {high:.2f}", values
        )
    console.print(table)
    console.print(
        f"no gap {document['no_gap_probability']:.3f}, unknown {document['unknown_probability']:.3f}. "
        f"{document['next_experiment']}"
    )
    console.print(f"Written to {out}")
