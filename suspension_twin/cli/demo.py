# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin demo``: the whole way on the bundled drives, with its progress on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from suspension_twin.cli.common import Force, Outputs, Seed, bundled, output, print_table

__all__ = ["command"]

Out = Annotated[
    Path,
    typer.Option("--out", help="Folder for the page and the twin files.", metavar="DIR", file_okay=False),
]


def command(out: Out = Path("suspension_twin_demo"), seed: Seed = 0, force: Force = False) -> None:
    """The whole way, live to calibrated, on the bundled drive.

    Replays a drive over a speed bump through the four nodes, calibrates the twin on it by the
    calibrate action, validates it on a second drive, and writes a page with plots (index.html),
    the calibrated twin (twin.yaml) and the files that they refer to.
    """
    from suspension_twin.demo.page import demo_page
    from suspension_twin.demo.steps import DRIVES, run_demo, written_files

    page = out / "index.html"
    outputs = Outputs(page, *written_files(out), force=force)
    outputs.announce()
    console = output()
    progress = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", style="dim"),
        console=console,
        transient=True,
    )
    with outputs, progress:
        steps = _Steps(console, progress)
        result = run_demo(bundled("bags"), out, steps, seed=seed)
        steps.begin("Drawing the page")
        demo_page(result).write(page)
        steps.end("")
    rows = []
    for name, title in DRIVES.items():
        before, after, truth = result.before[name], result.after[name], result.truth[name]
        cells = (after.measured_rms, before.rms, after.rms, truth.rms)
        rows.append((title, *(f"{v:.3f}" for v in cells)))
    columns = "drive", "measured", "at first", "calibrated", "true parameters"
    print_table(console, "Gap: rms of measured minus simulated vertical acceleration, m/s²", columns, rows)
    console.print(f"{result.seconds:.0f} s in all. The calibrated twin is {out / 'twin.yaml'}")
    console.print(f"Look at [bold]{page}[/bold]")


class _Steps:
    """One line a step: a bar while it runs, a tick and what came out once it is done."""

    def __init__(self, console: Console, progress: Progress) -> None:
        self._console = console
        self._progress = progress
        self._task: TaskID | None = None
        self._text = ""

    def begin(self, text: str) -> None:
        """See suspension_twin.demo.steps.Progress."""
        self._text = text
        self._task = self._progress.add_task(text, total=1.0, note="")

    def share(self, done: float, note: str = "") -> None:
        """See suspension_twin.demo.steps.Progress."""
        if self._task is not None:
            self._progress.update(self._task, completed=done, note=note)

    def end(self, text: str) -> None:
        """See suspension_twin.demo.steps.Progress."""
        if self._task is not None:
            self._progress.remove_task(self._task)
            self._task = None
        outcome = f"  [dim]{text}[/dim]" if text else ""
        self._console.print(f"[green]✓[/green] {self._text}{outcome}")
