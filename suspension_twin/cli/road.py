# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin road``: roads from numbers and profiles; pictures, meshes, checks; roads by way of add-ons."""

from __future__ import annotations

import json
import math
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.table import Column, Table
from typer.core import TyperCommand

from suspension_twin.cli.common import Force, Outputs, Seed, output
from suspension_twin.errors import InputError
from suspension_twin.registry import Registry

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from suspension_twin.inference.felt_passes import FeltRoad
    from suspension_twin.road.check import RoadCheck
    from suspension_twin.road.recipe import Feature
    from suspension_twin.vehicle.twin import Datum

__all__ = ["RoadOut", "app", "datum_line", "print_figures"]

app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})

RoadOut = Annotated[
    Path, typer.Option("--out", help="The road to write (OpenCRG).", metavar="ROAD", show_default=False)
]
RoadFile = Annotated[Path, typer.Argument(help="An OpenCRG road.", metavar="ROAD", show_default=False)]


class _Placed(TyperCommand):
    """A command whose ``--at`` is a place on WGS 84 where it is written with commas."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """See click, of which some releases of typer have a copy."""
        for i, (word, value) in enumerate(zip(args, [*args[1:], ""], strict=True)):
            if word == "--at" and "," in value:
                args[i] = "--at-latlon"
        return super().parse_args(ctx, args)


class Up(str, Enum):
    """Which axis of a mesh points up."""

    z = "z"
    y = "y"


class Origin(str, Enum):
    """Origin of the coordinates of a mesh."""

    map = "map"
    start = "start"


@app.command()
def show(
    road: RoadFile,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The picture: .png, .svg or .pdf.  [default: ROAD.png]", metavar="FILE", show_default=False
        ),
    ] = None,
    track: Annotated[
        float, typer.Option(help="Distance of the two wheel paths, m.", metavar="M", min=0.1)
    ] = 1.5,
    force: Force = False,
) -> None:
    """Draw a road: height map, wheel paths, spectrum beside the ISO 8608 classes, place in map."""
    from suspension_twin.road.check import check_file
    from suspension_twin.road.plots import save_road_picture

    path = _beside(road, ".png") if out is None else out
    outputs = Outputs(path, force=force)
    checked = check_file(road)
    outputs.announce()
    with outputs:
        save_road_picture(checked, path, track)
    print_figures(checked)


@app.command()
def mesh(
    road: RoadFile,
    out: Annotated[
        Path | None,
        typer.Option(help="The mesh: .stl or .obj.  [default: ROAD.obj]", metavar="FILE", show_default=False),
    ] = None,
    spacing: Annotated[
        float,
        typer.Option(help="Leave out points closer than this, m; 0 keeps every one.", metavar="M", min=0.0),
    ] = 0.0,
    up: Annotated[
        Up,
        typer.Option(
            help="z: x east, y north, z up. y: x north, y up, z east; Unity mirrors x when it reads the file, "
            "and the road lies where the twin's poses do."
        ),
    ] = Up.z,
    origin: Annotated[
        Origin,
        typer.Option(help="Count places from the map's origin, or from the road's start (far-off roads)."),
    ] = Origin.map,
    force: Force = False,
) -> None:
    """Write a road as triangles for a game engine: binary STL, or OBJ with normals and tiles."""
    from suspension_twin.road.crg import load_road
    from suspension_twin.road.mesh import write_mesh

    path = _beside(road, ".obj") if out is None else out
    outputs = Outputs(path, force=force)
    surface = load_road(road)
    shift = (0.0, 0.0, 0.0)
    if origin is Origin.start:
        shift = float(surface.x[0]), float(surface.y[0]), float(surface.ref_z[0])
    outputs.announce()
    with outputs:
        count = write_mesh(surface, path, spacing=spacing, up=up.value, shift=shift)
    place = (
        "" if origin is Origin.map else ", start of the road at {:.3f} {:.3f} {:.3f} in map".format(*shift)
    )
    output().print(f"{path}: {count} triangles{place}")


@app.command()
def check(
    road: RoadFile,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write the figures and findings there as JSON.", metavar="FILE", show_default=False
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Say what a road is like and what is wrong with it.

    Exit status 0: nothing is wrong. 1: it can be driven, but something would spoil a simulation.
    2: it cannot be read.
    """
    from suspension_twin.files import write_text
    from suspension_twin.road.check import check_file

    outputs = Outputs(*([] if out is None else [out]), force=force)
    checked = check_file(road)
    outputs.announce()
    if out is not None:
        record = {
            "road": checked.road.name,
            "sound": checked.sound,
            "facts": checked.facts,
            "wheel_paths": [p.as_record() for p in checked.wheel_paths],
            "findings": [{"text": f.text, "fault": f.fault} for f in checked.findings],
            "spikes": [vars(s) for s in checked.spikes.found],
        }
        write_text(out, json.dumps(record, indent=2) + "\n")
    console = output()
    lines = [*checked.facts.items(), *(("wrong" if f.fault else "note", f.text) for f in checked.findings)]
    width = max(len(name) for name, _ in lines)
    for line in lines:  # each by itself, or all of them end in spaces up to the end of the longest
        row = Table.grid(Column(width=width), Column(), padding=(0, 2, 0, 0))
        row.add_row(*line)
        console.print(row)
    console.print("sound" if checked.sound else "not sound: see the lines that begin with 'wrong'")
    if not checked.sound:
        raise typer.Exit(1)


@app.command(cls=_Placed)
def make(
    *,
    out: RoadOut,
    bump: Annotated[
        list[str] | None,
        typer.Option(
            help="A half sine: LENGTHxHEIGHT[@U][:SIDE]. SIDE is left, right or LOW..HIGH (v, m).",
            metavar="SIZE@U",
            show_default=False,
        ),
    ] = None,
    hump: Annotated[
        list[str] | None,
        typer.Option(
            help="A round top, LENGTHxHEIGHT@U, or a level one, LENGTHxHEIGHTxTOP@U.",
            metavar="SIZE@U",
            show_default=False,
        ),
    ] = None,
    plank: Annotated[
        list[str] | None,
        typer.Option(help="A plank across the road: LENGTHxHEIGHT@U.", metavar="SIZE@U", show_default=False),
    ] = None,
    pothole: Annotated[
        list[str] | None,
        typer.Option(help="A hole: LENGTHxDEPTH@U[:SIDE].", metavar="SIZE@U", show_default=False),
    ] = None,
    ramp: Annotated[
        list[str] | None,
        typer.Option(help="A lasting change of height: LENGTHxRISE@U.", metavar="SIZE@U", show_default=False),
    ] = None,
    iso: Annotated[
        str | None,
        typer.Option(help="A random profile of this ISO 8608 class, A to H.", metavar="A..H"),
    ] = None,
    length: Annotated[float, typer.Option(help="Length, m.", metavar="M")] = 200.0,
    width: Annotated[float, typer.Option(help="Width, m.", metavar="M")] = 6.0,
    step: Annotated[float, typer.Option(help="Distance of the cross sections, m.", metavar="M")] = 0.02,
    at: Annotated[
        tuple[float, float, float],
        typer.Option(help="Start of the road in map, m, and its heading from east, deg.", metavar="X Y DEG"),
    ] = (0.0, 0.0, 0.0),
    latlon: Annotated[
        str | None,
        typer.Option(
            "--at-latlon",
            help="Start of the road on WGS 84, degrees, and its heading from east, deg; --at with commas is the same.",
            metavar="LAT,LON,HEADING",
            show_default=False,
        ),
    ] = None,
    felt: Annotated[
        Path | None,
        typer.Option(
            help="Lay the road where this recorded drive felt its bumps; they need no @U, and come in that order.",
            metavar="BAG",
            show_default=False,
        ),
    ] = None,
    twin: Annotated[
        Path | None,
        typer.Option(
            help="The vehicle of --felt: its wheelbase, how its sensor lies, its datum.",
            metavar="TWIN.YAML",
            show_default=False,
        ),
    ] = None,
    tape: Annotated[
        float | None,
        typer.Option(
            help="Accuracy of the sizes, m, the errors of which a calibration finds with the vehicle; 0: surveyed.  "
            "[default: 0.005]",
            metavar="M",
            min=0.0,
            show_default=False,
        ),
    ] = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Make a road from numbers: bumps, humps, planks, potholes, ramps, an ISO 8608 class, and sums of them.

    All dimensions in m, each option as often as needed: --bump 0.9x0.05@40 --pothole 0.6x0.07@80:left.
    """
    from suspension_twin.pose.local_map import LocalMap
    from suspension_twin.road.check import check_road
    from suspension_twin.road.crg import write_road
    from suspension_twin.road.recipe import TAPE, TAPED_PLACE, Kind, Taped, make_road, parse_feature
    from suspension_twin.vehicle.twin import Datum

    outputs = Outputs(out, force=force)
    asked: tuple[tuple[Kind, list[str] | None], ...] = (
        ("bump", bump),
        ("hump", hump),
        ("plank", plank),
        ("pothole", pothole),
        ("ramp", ramp),
    )
    features = [
        parse_feature(kind, text, placed=felt is None) for kind, texts in asked for text in texts or []
    ]
    if not features and iso is None:
        raise InputError("road make", "give --iso, or one of --bump, --hump, --plank, --pothole and --ramp")
    datum, places, sizes = None, TAPED_PLACE, TAPE if tape is None else tape
    if felt is not None:
        found, datum = _felt(felt, twin, features)
        at = found.x, found.y, math.degrees(found.heading)
        features, places = list(found.features), max(found.places, places)
    if latlon is not None:
        latitude, longitude, heading = _latlon(latlon)
        at, datum = (0.0, 0.0, heading), Datum(latitude=latitude, longitude=longitude)
    made = make_road(
        length,
        width,
        features=features,
        iso=iso,
        seed=seed,
        step=step,
        x=at[0],
        y=at[1],
        heading=math.radians(at[2]),
        name=out.stem,
    )
    outputs.announce()
    with outputs:
        measured = features and iso is None and sizes
        write_road(made, out, Taped(tuple(features), sizes, places).comment if measured else "")
    print_figures(check_road(made))
    if datum is not None:
        if latlon is None:  # the receiver's metres are found with the vehicle
            output().print("where the drive felt it, as accurate as its receiver:", markup=False)
        for name, u in [("start of the road", 0.0), *((f"{f.kind} at u {f.at:g} m", f.at) for f in features)]:
            x, y = made.uv_to_xy(u, 0.0)
            latitude, longitude, _ = LocalMap(datum).to_geodetic([float(x), float(y), 0.0])
            output().print(f"{name}: {latitude:.7f}, {longitude:.7f}", markup=False)
        output().print(
            f"it runs at a bearing of {(90.0 - at[2]) % 360.0:.1f} deg (0 north, 90 east)", markup=False
        )
        output().print(f"The twin file of this road needs {datum_line(datum)}", markup=False)


def _felt(bag: Path, given: Path | None, features: Sequence[Feature]) -> tuple[FeltRoad, Datum | None]:
    """The road as a drive felt it, and the datum of its map; None without positions."""
    from suspension_twin.drive.read import read_drive
    from suspension_twin.inference.felt_passes import felt_road
    from suspension_twin.inference.observation import origin_of
    from suspension_twin.vehicle.twin import load_twin

    if not features:
        raise InputError("--felt", "needs the size of a bump: --bump, --hump, --plank or --pothole")
    if given is None:
        raise InputError("--felt", "needs --twin: the vehicle's wheelbase and how its sensor lies")
    drive, twin = read_drive(bag), load_twin(given)
    datum = origin_of(twin, drive) if len(drive.fix) else None
    found = felt_road(drive, twin, features, datum)
    for one in found.passes:
        after = one.t - float(drive.imu.t[0])
        output().print(f"felt {after:.1f} s after the start, at {3.6 * one.speed:.0f} km/h", markup=False)
    return found, datum


def _latlon(text: str) -> tuple[float, float, float]:
    """Latitude, longitude and heading in degrees of the text ``LAT,LON,HEADING``."""
    try:
        latitude, longitude, heading = (float(part) for part in text.split(","))
        fits = abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(heading) <= 360.0
    except ValueError:
        fits = False
    if not fits:
        raise InputError("--at", f"{text!r} is no LAT,LON,HEADING in degrees such as 47.4025,19.284,90")
    return latitude, longitude, heading


def datum_line(datum: Datum) -> str:
    """The line of a twin file that puts ``map`` at a datum."""
    numbers = ", ".join(f"{key}: {value}" for key, value in datum.model_dump().items())
    return f"datum: {{{numbers}}}"


@app.command()
def profile(
    *,
    files: Annotated[
        list[Path],
        typer.Argument(
            help="ERD or CSV files (several: one line each), or one OpenDRIVE file.",
            metavar="FILE",
            show_default=False,
        ),
    ],
    out: RoadOut,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of heights in a CSV that names none.  [default: m]", metavar="UNIT", show_default=False
        ),
    ] = None,
    v: Annotated[
        str | None,
        typer.Option(
            help="Place of each line across, m, left positive: 0.75,0,-0.75.",
            metavar="V,V",
            show_default=False,
        ),
    ] = None,
    track: Annotated[float, typer.Option(help="Distance of two wheel paths, m.", metavar="M", min=0.1)] = 1.5,
    width: Annotated[float, typer.Option(help="Width of the road, m.", metavar="M", min=0.1)] = 4.0,
    road: Annotated[
        str | None,
        typer.Option(help="Id of the road in an OpenDRIVE file.", metavar="ID", show_default=False),
    ] = None,
    at: Annotated[
        tuple[float, float, float],
        typer.Option(help="Start of the road in map, m, and its heading from east, deg.", metavar="X Y DEG"),
    ] = (0.0, 0.0, 0.0),
    force: Force = False,
) -> None:
    """Make a road of a profiler's file: ERD, CSV of one to many lines, OpenDRIVE with OpenCRG surfaces."""
    from suspension_twin.road.check import check_road
    from suspension_twin.road.crg import write_road
    from suspension_twin.road.opendrive import read_opendrive
    from suspension_twin.road.profile import profile_road, read_profile, together

    outputs = Outputs(out, force=force)
    if files[0].suffix.lower() == ".xodr":
        if len(files) > 1:
            raise InputError(files[1], "an OpenDRIVE file is read alone")
        made = read_opendrive(files[0], road)
    else:
        lines = together([read_profile(file, unit) for file in files])
        places = None
        if v is not None:
            try:
                places = [float(part) for part in v.split(",")]
            except ValueError:
                raise InputError("--v", f"{v!r} are not numbers with commas between") from None
        made = profile_road(
            lines, track=track, width=width, v=places, x=at[0], y=at[1], heading=math.radians(at[2])
        )
    outputs.announce()
    with outputs:
        write_road(made, out)
    print_figures(check_road(made))


def print_figures(checked: RoadCheck) -> None:
    """Print length, width, roughness and events of a road."""
    console = output()
    for name in ("length", "width", "roughness", "IRI", "events"):
        console.print(f"{name}: {checked.facts[name]}", markup=False)


def _beside(road: Path, suffix: str) -> Path:
    """A result's name where none was given: in the current folder, after the road."""
    path = Path(road.with_suffix(suffix).name)
    if path.resolve() == road.resolve():
        raise InputError(road, "give another name with --out; the default would overwrite the road")
    return path


_ADDED: Final[Registry[Callable[..., None]]] = Registry("road_commands", attribute="command")
for _name, _command in _ADDED.items():
    app.command(_name)(_command)
