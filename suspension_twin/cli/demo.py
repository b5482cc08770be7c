# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin demo``: the whole way on the bundled drives, with its progress on the terminal."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, final

import typer
from rich.console import Console
from rich.text import Text

from suspension_twin.cli.common import Force, Outputs, ProgressLine, Seed, bundled, output, print_table
from suspension_twin.errors import printable

__all__ = ["command"]


def command(
    *,
    out: Annotated[
        Path,
        typer.Option("--out", help="Folder for the page and the twin files.", metavar="DIR", file_okay=False),
    ] = Path("suspension_twin_demo"),
    seed: Seed = 0,
    force: Force = False,
) -> None:
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
    with outputs, _Steps(console) as steps:
        result = run_demo(bundled("bags"), out, steps, seed=seed)
        steps.begin("Drawing the page")
        demo_page(result).write(page)
        steps.end("")
    rows = [
        (
            title,
            f"{result.after[name].measured_rms:.3f}",
            *(f"{twins[name].rms:.3f}" for twins in (result.before, result.after, result.truth)),
        )
        for name, title in DRIVES.items()
    ]
    columns = "drive", "measured", "at first", "calibrated", "true parameters"
    print_table(console, "Gap: rms of measured minus simulated vertical acceleration, m/s²", columns, rows)
    console.print(f"{result.seconds:.0f} s in all. The calibrated twin is {out / 'twin.yaml'}")
    console.print(f"Look at {page}", style="bold")


@final
class _Steps:
    """A progress line while a step runs, a tick and its outcome once it is done."""

    def __init__(self, console: Console) -> None:
        self._console, self._text, self._running = console, "", ExitStack()

    def __enter__(self) -> _Steps:
        return self

    def __exit__(self, *exception: object) -> None:
        self._running.close()

    def begin(self, text: str) -> None:
        """See suspension_twin.demo.steps.DemoProgress."""
        self._text = text
        self._line = self._running.enter_context(ProgressLine())
        self._line.show(text)

    def share(self, done: float, note: str = "") -> None:
        """See suspension_twin.demo.steps.DemoProgress."""
        self._line.show(note or self._text, done)

    def end(self, text: str) -> None:
        """See suspension_twin.demo.steps.DemoProgress."""
        self._running.close()
        outcome = (f"  {printable(text)}", "dim") if text else ""
        self._console.print(Text.assemble(("✓", "green"), f" {printable(self._text)}", outcome))
