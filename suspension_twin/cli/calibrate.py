# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin calibrate``: a twin's characteristics from recorded drives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from suspension_twin.cli.common import Bags, Force, Outputs, ProgressLine, Seed, TwinFile, output, print_table
from suspension_twin.errors import InputError
from suspension_twin.files import together

if TYPE_CHECKING:
    from suspension_twin.calibration.request import CalibrationResult, Progress

__all__ = ["command", "print_result", "show_progress"]

Preset = Annotated[
    str,
    typer.Option(
        "--preset",
        help="The search: fast (Gauss-Newton), paper (the car paper's genetic algorithm), tracked_paper.",
        metavar="NAME",
    ),
]
Also = Annotated[
    list[str] | None,
    typer.Option("--also", help="Search this key of the twin file as well; repeatable.", metavar="KEY"),
]
Freeze = Annotated[
    list[str] | None,
    typer.Option(
        "--freeze",
        help="Keep this key, or nuisance parameter (nuisances.gain, ...), at its value; repeatable.",
        metavar="KEY",
    ),
]
Generations = Annotated[
    int,
    typer.Option(
        "--max-generations",
        help="End the search after so many iterations (generations of paper).  [default: as many as the preset says]",
        metavar="N",
        min=0,
        show_default=False,
    ),
]


def command(
    twin: TwinFile,
    bags: Bags,
    *,
    out: Annotated[
        Path, typer.Option("--out", help="The twin file to write.", metavar="CALIBRATED.YAML", dir_okay=False)
    ] = Path("calibrated.yaml"),
    preset: Preset = "fast",
    report: Annotated[
        Path | None,
        typer.Option(
            "--report", help="Folder for report.html, a page with plots.", metavar="DIR", file_okay=False
        ),
    ] = None,
    seed: Seed = 0,
    free: Annotated[
        list[str] | None,
        typer.Option(
            "--free",
            help="Search this key, or whole characteristic, in place of the preset's; repeatable.",
            metavar="KEY",
        ),
    ] = None,
    also: Also = None,
    freeze: Freeze = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(
            "--bound", help="Bounds of a key in the twin file's SI units; repeatable.", metavar="KEY=LOW:HIGH"
        ),
    ] = None,
    objective: Annotated[
        str,
        typer.Option(
            "--objective",
            help="euclidean, mse, correlation, spectral, iso18571 or a sum such as mse+0.5*spectral.  "
            "[default: the preset's]",
            metavar="NAME",
            show_default=False,
        ),
    ] = "",
    channel: Annotated[
        list[str] | None,
        typer.Option(
            "--channel",
            help="Compare this channel, weighted by its noise or as given; repeatable.  [default: the preset's]",
            metavar="NAME[=WEIGHT]",
        ),
    ] = None,
    max_generations: Generations = 0,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state",
            help="Folder for checkpoints, from which an interrupted search goes on.  [default: beside --out]",
            metavar="DIR",
            file_okay=False,
            show_default=False,
        ),
    ] = None,
    keep_sensor: Annotated[
        bool,
        typer.Option(
            "--keep-sensor", help="Keep latency (s) and mounting (rad) of the IMU as the file has them."
        ),
    ] = False,
    no_position: Annotated[
        bool,
        typer.Option(
            "--no-position",
            help="Leave positions out: passes over the bump are found by what was felt, forward along the road.",
        ),
    ] = False,
    force: Force = False,
) -> None:
    """Find a twin's characteristics from recorded drives over a known road.

    Writes the calibrated twin, beside it CALIBRATED.calibration.yaml with intervals, nuisance parameters and the
    status of each parameter, and with --report a page with plots. After an interruption the same command goes on
    where it was.
    """
    from suspension_twin.calibration.output import details_path, write_result
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate
    from suspension_twin.inference.checkpoint import Checkpoint
    from suspension_twin.vehicle.twin import load_twin

    pages = [] if report is None else [report / "report.html"]
    folder = state or out.with_name(f".{out.name}.state")
    request = CalibrationRequest(
        twin=str(twin),
        bags=tuple(map(str, bags)),
        preset=preset,
        seed=seed,
        free=tuple(free or ()),
        also=tuple(also or ()),
        freeze=tuple(freeze or ()),
        bounds=tuple(map(_bound, bound or ())),
        objective=objective,
        channels=tuple(map(_channel, channel or ())),
        max_generations=max_generations,
        state=str(folder),
        keep_sensor=keep_sensor,
        no_position=no_position,
    )
    outputs = Outputs(out, details_path(out), *pages, force=force, resumed_from=folder)
    store = Checkpoint(folder, "")  # refuses a folder that holds no checkpoints
    load_twin(twin)
    with outputs, ProgressLine() as line:

        def show(step: Progress) -> None:
            if step.stage != "reading":
                outputs.announce()
            show_progress(line, step)

        result = calibrate(request, show)
        with together():
            write_result(result, out)
            for path in pages:
                from suspension_twin.report.calibration import calibration_page

                line.show("drawing the page")
                calibration_page(result).write(path)
        store.remove()
    console = output()
    if result.yardstick is not None:
        lost = result.yardstick.lost
        words = (
            f"worse than a linear model of the same data: {result.yardstick}"
            if lost
            else str(result.yardstick)
        )
        console.print(words, style="bold red" if lost else "")
    for warning in result.warnings:
        console.print(warning, style="yellow")
    print_result(console, result)
    written = " and ".join(map(str, (out, details_path(out))))
    console.print(f"Written to {written}" + "".join(f", page {path}" for path in pages))


def _bound(text: str) -> tuple[str, float, float]:
    key, _, values = text.partition("=")
    try:
        low, high = map(float, values.split(":"))
    except ValueError:
        raise InputError("--bound", text, "must read KEY=LOW:HIGH") from None
    return key, low, high


def _channel(text: str) -> tuple[str, float]:
    name, _, weight = text.partition("=")
    try:
        return name, float(weight or 0.0)
    except ValueError:
        raise InputError("--channel", text, "must read NAME or NAME=WEIGHT") from None


def show_progress(line: ProgressLine, step: Progress) -> None:
    """Show the stage of a calibration, its cost, and the share that is done."""
    if step.stage in ("reading", "writing"):
        line.show(step.note or step.stage)
        return
    means = math.isfinite(step.mean_cost) and step.mean_cost != step.best_cost
    mean = f", mean {step.mean_cost:.4g}" if means else ""
    total = line.elapsed + step.seconds_left
    line.show(
        f"{step.stage}: iteration {step.generation}, cost {step.best_cost:.4g}{mean}",
        line.elapsed / total if total < math.inf else None,
    )


def print_result(console: Console, result: CalibrationResult) -> None:
    """Print parameters, properties of the sensor, and the gap of each drive before and after."""
    from suspension_twin.calibration.labels import parameter_label, parameter_unit
    from suspension_twin.inference.gap import channel_unit

    columns = "parameter", "unit", "start", "found", "90 % interval", "status"
    words = "parameter", "property", "unit", "status"
    parameters = [
        (
            parameter_label(result.twin, e.key),
            parameter_unit(e.key),
            _number(e.start),
            _number(e.value),
            f"{_number(e.low)} to {_number(e.high)}" if math.isfinite(e.low) else "",
            Text(f"{e.on_bound} bound", style="bold red") if e.on_bound else e.status,
        )
        for e in result.estimates
    ]
    print_table(console, "Parameters found", columns, parameters, words)
    sensor = []
    for s in result.sensor:
        factor, unit = (1e3, "ms") if s.unit == "s" else (math.degrees(1.0), "°")
        start, value, low, high = (f"{factor * v:.2f}" for v in (s.start, s.value, s.low, s.high))
        sensor.append((s.key, unit, start, value, f"{low} to {high}", "written" if s.written else "kept"))
    if sensor:
        print_table(console, "Sensor", ("property", *columns[1:]), sensor, words)
    gaps = [
        (
            d.name,
            *(
                f"{v:.4f}" if math.isfinite(v) else ""
                for v in (d.gap_before.rms, d.gap_after.rms, d.nuisance_free, d.gap_after.noise_rms)
            ),
        )
        for d in result.drives
    ]
    channel = result.drives[0].channel if result.drives else ""
    title = f"Gap: rms of measured minus simulated {channel.replace('_', ' ')}, {channel_unit(channel)}"
    print_table(console, title, ("drive", "before", "after", "nuisances removed", "sensor noise"), gaps)
    console.print(f"{result.message}; {result.seconds:.1f} s")


def _number(value: float) -> str:
    """Four digits, and no powers of ten for a stiffness in N/m."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
