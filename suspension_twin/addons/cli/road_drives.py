# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin road drives``: the road under the wheel paths, from recorded drives."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, ProgressLine, Seed, TwinFile, output, print_table
from suspension_twin.cli.road import RoadOut, datum_line
from suspension_twin.errors import InputError
from suspension_twin.files import Json, together

if TYPE_CHECKING:
    from suspension_twin.addons.roads.drives.drives import DrivenPart
    from suspension_twin.drive.types import Drive

__all__ = ["command"]


def command(
    *,
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
    from suspension_twin.road.crg import record_path
    from suspension_twin.road.recipe import parse_feature
    from suspension_twin.vehicle.twin import Datum, load_twin, save_twin

    if joint is not None and iterations is not None and iterations < 3:
        raise InputError("--iterations", "the vehicle of --joint is estimated from the third one on")
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
                from suspension_twin.addons.roads.pictures import estimate_figure, save_picture

                save_picture(estimate_figure(found), picture)
    _print_estimate(record)
    if loaded.datum is None:
        text = datum_line(Datum(**record["datum"]))
        output().print(f"The twin file has no datum; this road needs {text}", markup=False)
    output().print(
        "What was the same in all of these drives (an error of the vehicle, of the sensor) is in the road.",
        markup=False,
    )


def _print_estimate(record: Json) -> None:
    """Warnings, heights by wavelength, and the vehicle where it was estimated as well."""
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


def _print_vehicle(record: Json) -> None:
    """Estimated parameters of the vehicle, and those that could not be separated."""
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


def _parts(texts: list[str]) -> list[DrivenPart]:
    """Drives and parts of drives; one that is named twice is read once."""
    from suspension_twin.addons.roads.drives.drives import DrivenPart
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
        parts.append(DrivenPart(known[name], start, end))
    return parts
