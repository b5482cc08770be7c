# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin road``: roads from numbers, profiles, scans and drives; pictures, meshes, checks."""

from __future__ import annotations

import json
import re
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from suspension_twin.cli.common import (
    Force,
    Outputs,
    ProgressLine,
    Seed,
    TwinFile,
    bundled,
    output,
    print_table,
)
from suspension_twin.errors import InputError

if TYPE_CHECKING:
    from suspension_twin.addons.roads.drives.drives import Part
    from suspension_twin.drive.types import Drive
    from suspension_twin.road.check import RoadCheck

__all__ = ["app"]

app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})

RoadOut = Annotated[
    Path, typer.Option("--out", help="The road to write (OpenCRG).", metavar="ROAD", show_default=False)
]
RoadFile = Annotated[Path, typer.Argument(help="An OpenCRG road.", metavar="ROAD", show_default=False)]


class Up(str, Enum):
    """Which axis of a mesh points up."""

    z = "z"
    y = "y"


class Origin(str, Enum):
    """What a mesh's places count from."""

    map = "map"
    start = "start"


class Smoother(str, Enum):
    """Which surface of a scan is written."""

    edges = "edges"
    gaussian = "gaussian"


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
    _print_figures(checked)


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
        typer.Option(help="z: x east, y north, z up. y: x west, y up, z north, which Unity reads as x east."),
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
    lines = Table.grid(padding=(0, 2, 0, 0))
    for name, fact in checked.facts.items():
        lines.add_row(name, fact)
    for finding in checked.findings:
        lines.add_row("wrong" if finding.fault else "note", finding.text)
    console.print(lines)
    console.print("sound" if checked.sound else "not sound: see the lines that begin with 'wrong'")
    if not checked.sound:
        raise typer.Exit(1)


@app.command()
def make(
    out: RoadOut,
    bump: Annotated[
        list[str] | None,
        typer.Option(
            help="A half sine: LENGTHxHEIGHT@U[:SIDE]. SIDE is left, right or LOW..HIGH (v, m).",
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
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Make a road from numbers: bumps, humps, potholes, ramps, an ISO 8608 class, and sums of them.

    All dimensions in m, each option as often as needed: --bump 0.9x0.05@40 --pothole 0.6x0.07@80:left.
    """
    import math

    from suspension_twin.road.check import check_road
    from suspension_twin.road.crg import write_road
    from suspension_twin.road.recipe import Kind, make_road, parse_feature

    outputs = Outputs(out, force=force)
    asked: tuple[tuple[Kind, list[str] | None], ...] = (
        ("bump", bump),
        ("hump", hump),
        ("pothole", pothole),
        ("ramp", ramp),
    )
    features = [parse_feature(kind, text) for kind, texts in asked for text in texts or []]
    if not features and iso is None:
        raise InputError("road make", "give --iso, or one of --bump, --hump, --pothole and --ramp")
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
        write_road(made, out)
    _print_figures(check_road(made))


@app.command()
def profile(
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
    import math

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
    _print_figures(check_road(made))


@app.command()
def drives(
    drive: Annotated[
        list[str],
        typer.Argument(
            help="Recorded drives over one road in one direction; DRIVE@START..END is a part of one, "
            "in s from its first sample.",
            metavar="DRIVE",
            show_default=False,
        ),
    ],
    twin: TwinFile,
    out: RoadOut,
    joint: Annotated[
        Path | None,
        typer.Option(
            help="The vehicle is not calibrated: estimate it as well, and write its twin file there.",
            metavar="TWIN.YAML",
            show_default=False,
        ),
    ] = None,
    bump: Annotated[
        list[str] | None,
        typer.Option(
            help="A bump that was measured, LENGTHxHEIGHT@U, U within 3 m on the road that is written without it.",
            metavar="SIZE@U",
            show_default=False,
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            help="Of simulation and inverse.  [default: 5, with --joint 10]",
            metavar="N",
            min=1,
            show_default=False,
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw heights and intervals there.", metavar="FILE", show_default=False),
    ] = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Estimate the road under both wheel paths from drives with a calibrated vehicle, or with --joint any.

    Writes the road, and beside it ROAD.json with its uncertainty by wavelength and for every metre.
    """
    from suspension_twin.addons.roads.drives.drives import road_from_drives, write_estimate
    from suspension_twin.addons.roads.drives.estimate import RoadEstimateSettings
    from suspension_twin.files import together
    from suspension_twin.road.crg import record_path
    from suspension_twin.road.recipe import parse_feature
    from suspension_twin.vehicle.twin import load_twin, save_twin

    written = [out, record_path(out), *(p for p in (joint, picture) if p is not None)]
    if joint is not None and joint.resolve() == twin.resolve():
        raise InputError("--joint", f"{joint} is the twin file that is given: give another name")
    outputs = Outputs(*written, force=force)
    loaded = load_twin(twin)
    settings = RoadEstimateSettings(
        iterations=iterations or (5 if joint is None else 10),
        seed=seed,
        joint=joint is not None,
        bumps=tuple(parse_feature("bump", text) for text in bump or ()),
    )
    parts = _parts(drive)
    outputs.announce()
    with outputs, ProgressLine() as line:
        found = road_from_drives(parts, loaded, settings, line.show)
        with together():
            record = write_estimate(found, loaded, out)
            if joint is not None and found.vehicle is not None:
                heading = (
                    f"# {twin.name} with what {out.name} was estimated with, vehicle and road at once.\n"
                )
                save_twin(found.vehicle.twin, joint, heading)
            if picture is not None:
                from suspension_twin.addons.roads.pictures import save_estimate_picture

                save_estimate_picture(found, picture)
    console = output()
    for warning in record["warnings"]:
        console.print(warning, style="yellow", markup=False)
    rows = [
        (
            f"{w['shortest']:.3g} to {w['longest']:.3g}",
            f"{1e3 * w['rms']:.2f}",
            f"{1e3 * w['sigma']:.2f}",
            "seen" if w["known"] > 0.8 else "partly seen" if w["known"] > 0.3 else "not seen",
        )
        for w in record["wavelengths"]
    ]
    columns = ("waves [m]", "height rms [mm]", "uncertainty [mm]", "")
    print_table(console, "Wheel paths by wavelength", columns, rows, words=("waves [m]", ""))
    if "joint" in record:
        _print_vehicle(record["joint"])
    if loaded.datum is None:
        d = record["datum"]
        text = f"{{latitude: {d['latitude']}, longitude: {d['longitude']}, altitude: {d['altitude']}}}"
        console.print(f"The twin file has no datum; this road needs datum: {text}", markup=False)
    console.print(
        "What was the same in all of these drives (an error of the vehicle, of the sensor) is in the road.",
        markup=False,
    )


@app.command()
def scan(
    cloud: Annotated[
        list[Path],
        typer.Argument(help="Point clouds: LAS, LAZ, PLY or text.", metavar="CLOUD", show_default=False),
    ],
    path: Annotated[
        Path,
        typer.Option(
            help="Line of the road: a recorded drive, CSV of x, y (map) or lat, lon, or an OpenCRG reference line.",
            metavar="DRIVE|CSV|CENTRELINE",
            show_default=False,
        ),
    ],
    out: RoadOut,
    twin: Annotated[
        Path | None,
        typer.Option(
            help="The twin that feels the road, and its datum.  [default: the bundled Ford Mondeo]",
            metavar="TWIN.YAML",
            show_default=False,
        ),
    ] = None,
    datum: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Origin of map on WGS 84, deg, deg, m.  [default: of the twin or the drive]",
            metavar="LAT LON ALT",
            show_default=False,
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            help="Coordinate reference system of the clouds, EPSG:25832.  [default: as the file says]",
            metavar="CRS",
            show_default=False,
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of the clouds: m, cm, mm, ft, us-ft.", metavar="UNIT", show_default=False),
    ] = None,
    axes: Annotated[
        str, typer.Option(help="Which of their columns are east, north, up: yxz, x-zy.", metavar="AXES")
    ] = "xyz",
    fit: Annotated[
        bool,
        typer.Option(
            "--fit",
            help="The clouds have coordinates of their own, z up: place them by a rigid fit to the drive.",
        ),
    ] = False,
    width: Annotated[float, typer.Option(help="Width of the road, m.", metavar="M")] = 4.0,
    section: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Part of the path, m from its start.", metavar="FROM TO", show_default=False),
    ] = None,
    step: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Distance of the nodes along and across, m.  [default: after the density of the points]",
            metavar="M M",
            show_default=False,
        ),
    ] = None,
    filter: Annotated[
        Smoother, typer.Option(help="The surface that is written; the other is reported beside it.")
    ] = Smoother.edges,
    sigma: Annotated[float, typer.Option(help="Standard deviation of the Gaussian, m.", metavar="M")] = 0.1,
    fill: Annotated[float, typer.Option(help="Holes up to this width are filled, m.", metavar="M")] = 0.5,
    speed: Annotated[
        float,
        typer.Option(
            help="At which the twin feels it, km/h, if the path is no drive.", metavar="KMH", min=1.0
        ),
    ] = 30.0,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw the road before and after there.", metavar="FILE", show_default=False),
    ] = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Make a road of laser scans: ground, edges kept, holes marked, with its uncertainty.

    Writes the road, beside it ROAD.json with figures and ROAD.npz with the uncertainty of every node.
    """
    from suspension_twin.addons.roads.scan.scan import ScanSettings, cells_path, scan_road
    from suspension_twin.road.crg import record_path

    written = [out, record_path(out), cells_path(out), *([] if picture is None else [picture])]
    outputs = Outputs(*written, force=force)
    settings = ScanSettings(width, filter.value, sigma, fill, section, step, seed)
    outputs.announce()
    with outputs, ProgressLine() as line:
        found, felt, checked, notes = scan_road(
            cloud, path, out, twin if twin is not None else bundled("config", "twins", "ford_mondeo_mk4.yaml"),
            settings, datum=datum, crs=crs, unit=unit, axes=axes, fit=fit, speed=speed / 3.6, picture=picture,
            progress=line.show,
        )  # fmt: skip
    console = output()
    for note in notes:
        console.print(note, markup=False)
    facts = found.facts
    console.print(
        f"points: {facts['points']} read, {facts['points_near_the_path']} along the path, "
        f"{facts['ground_points']} of them ground"
    )
    console.print(
        f"nodes every {facts['step']:g} by {facts['step_across']:.3g} m, "
        f"uncertainty {1e3 * facts['sigma_median']:.2f} mm (median), noise of a point {1e3 * facts['noise']:.1f} mm"
    )
    console.print(
        f"holes: {100 * facts['filled']:.2g} % of the nodes filled, {len(facts['holes'])} holes left open "
        f"({100 * facts['missing']:.2g} %); spikes removed: {facts['spikes_removed']}"
    )
    _print_figures(checked)
    measured = any(f.gap is not None for f in felt)
    columns = ("road", "rms", "peak", "difference", *(["gap to the drive"] if measured else []))
    rows = [
        (
            f.name,
            f"{f.rms:.3f}",
            f"{f.peak:.2f}",
            f"{f.difference:.3f}",
            *([f"{f.gap:.3f}"] if f.gap is not None else []),
        )
        for f in felt
    ]
    if rows:
        print_table(
            console, "What the twin feels, vertical acceleration [m/s²]", columns, rows, words=("road",)
        )
    for finding in checked.findings:
        console.print(f"{'wrong' if finding.fault else 'note'}: {finding.text}", markup=False)


def _print_vehicle(record: dict[str, Any]) -> None:
    """What was found of the vehicle, and what could not be separated."""
    console = output()
    rows = []
    for p in record["parameters"]:
        unit = f" {p['unit']}" if p["unit"] else ""
        left = p["left_of_prior"]
        rows.append(
            (
                p["name"],
                f"{p['value']:+.3f}{unit}" if unit else f"x {p['value']:.2f}",
                "{:.2f} to {:.2f}".format(*p["interval"]),
                "found" if left < 0.4 else "in part from the prior" if left < 0.7 else "from the prior",
            )
        )
    columns = ("vehicle", "change", "90 % interval", "")
    print_table(console, "The vehicle, against the twin file", columns, rows, words=("vehicle", ""))
    for text in record["not_separable"]:
        console.print(text, markup=False)


def _parts(texts: list[str]) -> list[Part]:
    """Drives and parts of drives; one that is named twice is read once."""
    import math

    from suspension_twin.addons.roads.drives.drives import Part
    from suspension_twin.drive.read import read_drive

    known: dict[str, Drive] = {}
    parts = []
    for text in texts:
        name, start, end = text, 0.0, math.inf
        found = re.fullmatch(r"(.+)@(\d+(?:\.\d*)?)\.\.(\d+(?:\.\d*)?)", text)
        if found is not None and not Path(text).exists():
            name, start, end = found[1], float(found[2]), float(found[3])
            if not start < end:
                raise InputError(text, "the part ends before it starts")
        if name not in known:
            known[name] = read_drive(Path(name))
        parts.append(Part(known[name], start, end))
    return parts


def _print_figures(checked: RoadCheck) -> None:
    """What a road is like, in a few lines."""
    console = output()
    for name in ("length", "width", "roughness", "IRI", "events"):
        console.print(f"{name}: {checked.facts[name]}", markup=False)


def _beside(road: Path, suffix: str) -> Path:
    """A result's name where none was given: in the current folder, after the road."""
    path = Path(road.with_suffix(suffix).name)
    if path.resolve() == road.resolve():
        raise InputError(road, "give another name with --out; the default would overwrite the road")
    return path
