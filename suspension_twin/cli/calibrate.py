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

Out = Annotated[
    Path, typer.Option("--out", help="The twin file to write.", metavar="CALIBRATED.YAML", dir_okay=False)
]
Preset = Annotated[
    str,
    typer.Option(
        "--preset",
        help="fast; paper: the car paper's section 4.3 exactly; tracked_paper: the tracked paper's search.",
        metavar="NAME",
    ),
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report", help="Folder for report.html, a page with plots.", metavar="DIR", file_okay=False
    ),
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
        help="euclidean, mse, correlation, spectral, iso18571 or a sum such as mse+0.5*spectral.  "
        "[default: the preset's]",
        metavar="NAME",
        show_default=False,
    ),
]
Channel = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        help="Compare this channel, weighted by its noise or as given; repeatable.  [default: the preset's]",
        metavar="NAME[=WEIGHT]",
    ),
]
Generations = Annotated[
    int,
    typer.Option(
        "--max-generations",
        help="Stop the search after so many.  [default: as many as the preset says]",
        metavar="N",
        min=0,
        show_default=False,
    ),
]
KeepSensor = Annotated[
    bool, typer.Option("--keep-sensor", help="Leave latency and mounting of the IMU as the file has them.")
]
StateFolder = Annotated[
    Path | None,
    typer.Option(
        "--state",
        help="Folder for the state of the search, from which an interrupted one goes on.  [default: beside --out]",
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
    keep_sensor: KeepSensor = False,
    force: Force = False,
) -> None:
    """Find a twin's characteristics from recorded drives over a known road.

    Writes the calibrated twin, beside it CALIBRATED.calibration.yaml with intervals, nuisance parameters and which
    parameters the drives identify, and with --report a page with plots. After an interruption the same command goes on
    where it was.
    """
    from suspension_twin.calibration.output import details_path

    page = () if report is None else (report / "report.html",)
    from suspension_twin.calibration.output import write_result
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate
    from suspension_twin.inference.checkpoint import Checkpoint
    from suspension_twin.vehicle.twin import load_twin

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
        keep_sensor=keep_sensor,
    )
    outputs = Outputs(out, details_path(out), *page, force=force, resumed_from=folder)
    store = Checkpoint(folder, "")  # refuses a folder that is no state's
    load_twin(twin)
    outputs.announce()
    with outputs, ProgressLine() as line:
        result = calibrate(request, lambda step: show_progress(line, step))
        with together():
            write_result(result, out)
            for path in page:
                from suspension_twin.report.calibration import calibration_page

                line.show("drawing the page")
                calibration_page(result).write(path)
        store.remove()
    console = output()
    for warning in result.warnings:
        console.print(warning, style="yellow")
    print_result(console, result)
    console.print(f"Written to {out} and {details_path(out)}" + "".join(f", page {path}" for path in page))


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


def show_progress(line: ProgressLine, step: Progress) -> None:
    """What a calibration reports, in words."""
    if step.stage in ("reading", "writing"):
        line.show(step.note or step.stage)
        return
    text = f"{step.stage}: generation {step.generation}, cost {step.best_cost:.4g}"
    if math.isfinite(step.mean_cost) and step.mean_cost != step.best_cost:
        text += f", mean {step.mean_cost:.4g}"
    total = line.elapsed + step.seconds_left
    line.show(text, line.elapsed / total if total < math.inf else None)


def print_result(console: Console, result: CalibrationResult) -> None:
    """Parameters, properties of the sensor, and the gap of each drive before and after."""
    from suspension_twin.calibration.labels import parameter_label, parameter_unit
    from suspension_twin.inference.gap import channel_unit

    rows: list[tuple[str | Text, ...]] = []
    for e in result.estimates:
        interval = f"{_number(e.low)} to {_number(e.high)}" if math.isfinite(e.low) else ""
        name, unit = parameter_label(result.twin, e.key), parameter_unit(e.key)
        note = Text(f"{e.on_bound} bound", style="bold red") if e.on_bound else e.status
        rows.append((name, unit, _number(e.start), _number(e.value), interval, note))
    columns = "parameter", "unit", "start", "found", "90 % interval", "status"
    print_table(console, "What was found", columns, rows, words=("parameter", "unit", "status"))
    sensor = []
    for s in result.sensor:
        factor, unit = (1e3, "ms") if s.unit == "s" else (math.degrees(1.0), "°")
        start, value, low, high = (f"{factor * v:.2f}" for v in (s.start, s.value, s.low, s.high))
        sensor.append((s.key, unit, start, value, f"{low} to {high}", "written" if s.written else "kept"))
    if sensor:
        print_table(
            console, "Sensor", ("property", *columns[1:]), sensor, words=("property", "unit", "status")
        )
    gaps = []
    for d in result.drives:
        values = (d.gap_before.rms, d.gap_after.rms, d.nuisance_free, d.gap_after.noise_rms)
        gaps.append((d.name, *(f"{v:.4f}" if math.isfinite(v) else "" for v in values)))
    channel = result.drives[0].channel if result.drives else ""
    title = f"Gap: rms of measured minus simulated {channel.replace('_', ' ')}, {channel_unit(channel)}"
    print_table(console, title, ("drive", "before", "after", "nuisances removed", "sensor noise"), gaps)
    console.print(f"{result.message}; {result.seconds:.1f} s")


def _number(value: float) -> str:
    """Four digits, and no powers of ten for a stiffness in N/m."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
