# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin calibrate``: a twin's characteristics from recorded drives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import Progress as Bar
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from suspension_twin.cli.common import Bags, Seed, TwinFile
from suspension_twin.errors import InputError

if TYPE_CHECKING:
    from suspension_twin.calibration.request import CalibrationResult, Progress

__all__ = ["command"]

Out = Annotated[
    Path, typer.Option("--out", help="The twin file to write.", metavar="CALIBRATED.YAML", dir_okay=False)
]
Preset = Annotated[
    str,
    typer.Option(
        "--preset",
        help="fast; paper: the car paper's section 4.3 exactly; tracked_paper: the tracked paper's search.",
    ),
]
Report = Annotated[
    Path | None,
    typer.Option("--report", help="Folder for a page with plots.", metavar="DIR", file_okay=False),
]
Free = Annotated[
    list[str] | None,
    typer.Option(
        "--free",
        help="Search this key (or characteristic) instead of the preset's; repeatable.",
        metavar="KEY",
    ),
]
Also = Annotated[
    list[str] | None, typer.Option("--also", help="Search this key as well; repeatable.", metavar="KEY")
]
Freeze = Annotated[
    list[str] | None,
    typer.Option(
        "--freeze",
        help="Leave this key as it is (nuisances.gain, nuisances.map_position, ... too); repeatable.",
        metavar="KEY",
    ),
]
Bound = Annotated[
    list[str] | None, typer.Option("--bound", help="Bounds of a key; repeatable.", metavar="KEY=LOW:HIGH")
]
Objective = Annotated[
    str,
    typer.Option(
        "--objective",
        help="euclidean, mse, correlation, spectral, iso18571 or a sum such as mse+0.5*spectral; empty: the preset's.",
        show_default=False,
    ),
]
Channel = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        help="Compare this channel, weighed by its noise or as given; repeatable. Empty: the preset's.",
        metavar="NAME[=WEIGHT]",
    ),
]
Generations = Annotated[int, typer.Option("--max-generations", help="0: as many as the preset says.", min=0)]
StateFolder = Annotated[
    Path | None,
    typer.Option(
        "--state",
        help="Folder for the state of the search, to go on from after an interruption. [default: beside --out]",
        metavar="DIR",
        file_okay=False,
        show_default=False,
    ),
]


def command(
    twin: TwinFile,
    bags: Bags,
    out: Out = Path("calibrated.yaml"),
    preset: Preset = "fast",
    report: Report = None,
    seed: Seed = 0,
    free: Free = None,
    also: Also = None,
    freeze: Freeze = None,
    bound: Bound = None,
    objective: Objective = "",
    channel: Channel = None,
    max_generations: Generations = 0,
    state: StateFolder = None,
) -> None:
    """Find a twin's characteristics from recorded drives over a known road.

    Writes the calibrated twin, beside it CALIBRATED.calibration.yaml with intervals, nuisances and which parameters the
    drives identify, and with --report a page with plots. Interrupted, it goes on where it was when started again.
    """
    from suspension_twin.cli._tracked import calibrate_runs, is_tracked

    if is_tracked(twin):
        calibrate_runs(twin, bags, out, preset, report, seed, objective, max_generations)
        return
    from suspension_twin.calibration.output import write_result
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate

    folder = state or out.with_name(f".{out.name}.state")
    request = CalibrationRequest(
        twin=str(twin),
        bags=tuple(str(b) for b in bags),
        preset=preset,
        seed=seed,
        free=tuple(free or ()),
        also=tuple(also or ()),
        freeze=tuple(freeze or ()),
        bounds=tuple(_bound(text) for text in bound or ()),
        objective=objective,
        channels=tuple(_channel(text) for text in channel or ()),
        max_generations=max_generations,
        state=str(folder),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    console = Console(highlight=False, soft_wrap=True)
    with _Display(Console(stderr=True)) as display:
        result = calibrate(request, display.show)
        written, details = write_result(result, out)
        if report is not None:
            from suspension_twin.report.calibration import calibration_page

            display.note("drawing the page")
            page = calibration_page(result).write(report / "report.html")
    _forget(folder)
    for warning in result.warnings:
        console.print(f"[yellow]{warning}[/]")
    _print_result(console, result)
    console.print(f"Written to {written} and {details}" + (f", page {page}" if report is not None else ""))


def _bound(text: str) -> tuple[str, float, float]:
    key, _, values = text.partition("=")
    low, _, high = values.partition(":")
    try:
        return key, float(low), float(high)
    except ValueError:
        raise InputError("--bound", text, "must read KEY=LOW:HIGH") from None


def _channel(text: str) -> tuple[str, float]:
    name, _, weight = text.partition("=")
    try:
        return name, float(weight) if weight else 0.0
    except ValueError:
        raise InputError("--channel", text, "must read NAME or NAME=WEIGHT") from None


def _forget(folder: Path) -> None:
    """Remove a finished search's state, and nothing but that."""
    from suspension_twin.calibration.checkpoint import Checkpoint

    if folder.is_dir():
        Checkpoint(folder, "").remove()


class _Display:
    """One line that follows the search, gone when it is over."""

    def __init__(self, console: Console) -> None:
        columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        self._bar = Bar(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("starting", total=None)

    def __enter__(self) -> _Display:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def note(self, text: str) -> None:
        self._bar.update(self._task, description=text)

    def show(self, progress: Progress) -> None:
        """What a calibration reports, in words."""
        if progress.stage in ("reading", "writing"):
            self.note(progress.note or progress.stage)
            return
        text = f"{progress.stage}: generation {progress.generation}, {progress.evaluations} evaluations"
        text += f", best {progress.best_cost:.4g}"
        if math.isfinite(progress.mean_cost) and progress.mean_cost != progress.best_cost:
            text += f", mean {progress.mean_cost:.4g}"
        if math.isfinite(progress.seconds_left):
            text += f", about {progress.seconds_left:.0f} s left"
        self.note(text)


def _print_result(console: Console, result: CalibrationResult) -> None:
    table = Table(title="What was found", title_justify="left", title_style="bold")
    table.add_column("parameter")
    for name in ("start", "found", "90 % interval"):
        table.add_column(name, justify="right")
    table.add_column("")
    for e in result.estimates:
        interval = f"{e.low:.4g} to {e.high:.4g}" if math.isfinite(e.low) else ""
        mark = f"[bold red]on its {e.on_bound} bound[/]" if e.on_bound else e.status
        style = "" if e.status == "identified" or e.on_bound else "dim"
        table.add_row(
            e.key.removeprefix("vehicle."),
            f"{e.start:.4g}",
            f"{e.value:.4g}",
            interval,
            mark,
            style=style,
        )
    console.print(table)
    gaps = Table(
        title="Gap, rms of the vertical acceleration in m/s²", title_justify="left", title_style="bold"
    )
    gaps.add_column("drive")
    for name in ("before", "after", "without nuisances", "floor"):
        gaps.add_column(name, justify="right")
    for d in result.drives:
        values = (d.gap_before.rms, d.gap_after.rms, d.nuisance_free, d.gap_after.noise_rms)
        gaps.add_row(d.name, *(f"{v:.4f}" for v in values))
    console.print(gaps)
    console.print(f"{result.message}; {result.seconds:.1f} s")
