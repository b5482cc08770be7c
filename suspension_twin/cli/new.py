# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin new``: a twin file by a few questions, or from a ready one."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, bundled, output
from suspension_twin.errors import InputError, nearest, printable
from suspension_twin.vehicle.twin import Datum, RoadFile, Twin, load_twin, save_twin

if TYPE_CHECKING:
    from suspension_twin.vehicle.new import Sizes

__all__ = ["command"]

_BASE = "ford_mondeo_mk4"


def command(
    *,
    out: Annotated[
        Path, typer.Option("--out", help="The twin file to write.", metavar="TWIN.YAML", show_default=False)
    ],
    base: Annotated[
        str,
        typer.Option(
            "--from", help="Take this twin of config/twins as it is, and ask nothing.", metavar="NAME"
        ),
    ] = "",
    road: Annotated[
        Path | None,
        typer.Option("--road", help="The road file, OpenCRG.  [default: it is asked for]", metavar="ROAD"),
    ] = None,
    drive: Annotated[
        Path | None,
        typer.Option(
            "--drive",
            help="Take the datum, the origin of the road's x and y, from the first fix of this recorded drive.",
            metavar="BAG",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
) -> None:
    """A twin file, by questions about the vehicle's sizes (m, kg) and the phone's place, or from a ready one.

    Springs and dampers are those of a middle-class car, scaled by the mass: the start of a calibration. An empty
    answer takes the value in brackets.
    """
    from suspension_twin.drive.read import read_drive
    from suspension_twin.inference.observation import NO_DATUM, first_fix
    from suspension_twin.vehicle.new import resized

    outputs = Outputs(out, force=force)
    if road is not None and not road.is_file():
        raise InputError(road, "no such file")
    twin = load_twin(_ready(base or _BASE))
    datum = None if drive is None else first_fix(read_drive(drive))
    outputs.announce()
    with outputs:
        if not base:
            sizes, road = _ask(twin, road)
            twin = resized(twin, sizes)
            datum = datum if road is None else datum or _ask_datum()
            twin = twin.model_copy(update={"datum": datum})  # not that of the car it was resized from
        elif datum is not None:
            twin = twin.model_copy(update={"datum": datum})
        if road is not None:
            twin = twin.model_copy(update={"road": RoadFile(file=road.resolve())})
        made = "By suspension-twin new. Springs and dampers are a guess: calibrate them."
        save_twin(twin, out, heading=f"# {f'From {base}.' if base else made}\n")
    lines = [f"Written to {out}: {twin.vehicle.name} ({twin.model})"]
    following = f"run --twin {out} --view"
    if twin.road is None:
        lines.append("It has no road yet: give the road's file with --road.")
        following = f"road make --bump LENGTHxHEIGHT --felt DRIVE --twin {out} --out road.crg"
    elif twin.datum is None:
        lines.append(f"It has {NO_DATUM.text} (--drive takes it from a drive).")
    output().print(*lines, f"Next: suspension-twin {following}", sep="\n", markup=False)


def _ready(name: str) -> Path:
    """The ready twin of that name, or of that path."""
    if os.sep in name or name.endswith(".yaml"):
        return Path(name)
    folder = bundled("config", "twins")
    known = sorted(p.stem for p in folder.glob("*.yaml"))
    if name not in known:
        raise InputError(
            "--from", f"there is no {name} in config/twins{nearest(name, known)} ({', '.join(known)})"
        )
    return folder / f"{name}.yaml"


def _ask(base: Twin, road: Path | None) -> tuple[Sizes, Path | None]:
    """The sizes, and the road if it is not given, by questions on the terminal."""
    from suspension_twin.vehicle.new import Sizes

    old = base.vehicle
    try:
        sizes = Sizes(
            name=typer.prompt("Make and model", default="my car"),
            mass=_number("Mass with everybody on board, kg", old.mass, 300.0, 10_000.0),
            wheelbase=_number("Wheelbase, m", old.wheelbase, 1.0, 8.0),
            front_track=_number("Track in front, m", old.front_track, 0.8, 3.0),
            rear_track=_number("Track at the rear, m", old.rear_track, 0.8, 3.0),
            imu=_place("Phone or IMU", base.imu.position),
            gps=_place("GPS antenna", base.gps.position),
        )
        return sizes, road or _ask_road()
    except typer.Abort:
        if sys.stdin.isatty():
            raise KeyboardInterrupt from None
        raise InputError(
            "new", "asks questions, and the input has ended: --from takes a ready twin"
        ) from None


def _ask_road() -> Path | None:
    """A file that exists, or none."""
    while given := str(typer.prompt("Road file (OpenCRG), empty: none yet", default="", show_default=False)):
        if Path(given).is_file():
            return Path(given)
        typer.echo(f"  {printable(given)}: no such file", err=True)
    return None


def _ask_datum() -> Datum | None:
    """Where the road's x and y are 0, or nothing."""
    question = "Datum, where the road's x and y are 0: latitude, longitude in degrees, empty: none yet"
    try:
        while given := str(typer.prompt(question, default="", show_default=False)):
            try:
                latitude, longitude = map(float, given.replace(",", " ").split())
                if abs(latitude) <= 90.0 and abs(longitude) <= 180.0:
                    return Datum(latitude=latitude, longitude=longitude)
            except ValueError:
                pass
            typer.echo("  two numbers are needed, as 47.4025, 19.2840", err=True)
    except typer.Abort:
        if sys.stdin.isatty():
            raise KeyboardInterrupt from None
    return None  # also where the input has ended: a datum can be added later


def _place(sensor: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Coordinates of a sensor in base_link, m."""
    x = _number(f"{sensor}: m ahead of the rear axle", default[0], -10.0, 20.0)
    y = _number(f"{sensor}: m to the left of the middle", default[1], -5.0, 5.0)
    return x, y, _number(f"{sensor}: m above the ground", default[2], -1.0, 6.0)


def _number(question: str, default: float, low: float, high: float) -> float:
    """A number within bounds; asked again until it is one."""
    while True:
        try:
            value = float(typer.prompt(question, default=f"{default:g}"))
            if low <= value <= high:
                return value
        except ValueError:
            pass
        typer.echo(f"  a number from {low:g} to {high:g} is needed", err=True)
