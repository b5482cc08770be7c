# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin road scan``: a road of laser scans."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from suspension_twin.cli.common import (
    Force,
    Outputs,
    ProgressLine,
    Seed,
    bundled,
    output,
    print_table,
)
from suspension_twin.cli.options import grouped
from suspension_twin.cli.road import RoadOut, print_figures
from suspension_twin.files import Json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from suspension_twin.addons.roads.scan.response import RoadResponse

__all__ = ["command"]


class Smoother(str, Enum):
    """The surface of a scan that is written."""

    edges = "edges"
    gaussian = "gaussian"


@dataclass(frozen=True)
class CloudSettings:
    """How the coordinates of the clouds are to be read."""

    datum: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Origin of map on WGS 84, deg, deg, m.  [default: of the twin or the drive]",
            metavar="LAT LON ALT",
            show_default=False,
        ),
    ] = None
    crs: Annotated[
        str | None,
        typer.Option(
            help="Coordinate reference system of the clouds, EPSG:25832.  [default: as the file says]",
            metavar="CRS",
            show_default=False,
        ),
    ] = None
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of the clouds: m, cm, mm, ft, us-ft.", metavar="UNIT", show_default=False),
    ] = None
    axes: Annotated[
        str, typer.Option(help="Which of their columns are east, north, up: yxz, x-zy.", metavar="AXES")
    ] = "xyz"
    fit: Annotated[
        bool,
        typer.Option(
            "--fit",
            help="The clouds have coordinates of their own, z up: place them by a rigid fit to the drive.",
        ),
    ] = False


@dataclass(frozen=True)
class SurfaceSettings:
    """The strip that is made into a road, its grid, and its smoothing."""

    width: Annotated[float, typer.Option(help="Width of the road, m.", metavar="M")] = 4.0
    section: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Part of the path, m from its start.", metavar="FROM TO", show_default=False),
    ] = None
    step: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Distance of the nodes along and across, m.  [default: after the density of the points]",
            metavar="M M",
            show_default=False,
        ),
    ] = None
    filter: Annotated[
        Smoother, typer.Option(help="The surface that is written; the other is reported beside it.")
    ] = Smoother.edges
    sigma: Annotated[float, typer.Option(help="Standard deviation of the Gaussian, m.", metavar="M")] = 0.1
    fill: Annotated[float, typer.Option(help="Holes up to this width are filled, m.", metavar="M")] = 0.5
    seed: Seed = 0


@dataclass(frozen=True)
class DrivenSettings:
    """The twin that is driven over the road to compare its surfaces."""

    twin: Annotated[
        Path | None,
        typer.Option(
            help="The twin that feels the road, and its datum.  [default: the bundled Ford Mondeo]",
            metavar="TWIN.YAML",
            show_default=False,
        ),
    ] = None
    speed: Annotated[
        float,
        typer.Option(
            help="At which the twin feels it, km/h, if the path is no drive.", metavar="KMH", min=1.0
        ),
    ] = 30.0


@grouped
def command(
    *,
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
    clouds: CloudSettings,
    surface: SurfaceSettings,
    driven: DrivenSettings,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw the road before and after there.", metavar="FILE", show_default=False),
    ] = None,
    force: Force = False,
) -> None:
    """Make a road of laser scans: ground, edges kept, holes marked, with its uncertainty.

    Writes the road, beside it ROAD.json with figures and ROAD.npz with the uncertainty of every node.
    """
    from suspension_twin.addons.roads.scan.scan import ScanSettings, cells_path, scan_road
    from suspension_twin.road.crg import record_path

    written = [out, record_path(out), cells_path(out), *([] if picture is None else [picture])]
    outputs = Outputs(*written, force=force)
    settings = ScanSettings(
        width=surface.width,
        filter=surface.filter.value,
        sigma=surface.sigma,
        fill=surface.fill,
        section=surface.section,
        steps=surface.step,
        seed=surface.seed,
    )
    twin = driven.twin if driven.twin is not None else bundled("config", "twins", "ford_mondeo_mk4.yaml")
    outputs.announce()
    with outputs, ProgressLine() as line:
        found, felt, checked, notes = scan_road(
            cloud,
            path,
            out,
            twin,
            settings,
            **vars(clouds),
            speed=driven.speed / 3.6,
            picture=picture,
            progress=line.show,
        )
    console = output()
    for note in notes:
        console.print(note, markup=False)
    for text in _facts(found.facts):
        console.print(text)
    print_figures(checked)
    _print_accelerations(felt)
    for finding in checked.findings:
        console.print(f"{'wrong' if finding.fault else 'note'}: {finding.text}", markup=False)


def _facts(facts: Json) -> list[str]:
    """Points, grid and holes of a scanned road, a line each."""
    return [
        f"points: {facts['points']} read, {facts['points_near_the_path']} along the path, "
        f"{facts['ground_points']} of them ground",
        f"nodes every {facts['step']:g} by {facts['step_across']:.3g} m, "
        f"uncertainty {1e3 * facts['sigma_median']:.2f} mm (median), noise of a point {1e3 * facts['noise']:.1f} mm",
        f"holes: {100 * facts['filled']:.2g} % of the nodes filled, {len(facts['holes'])} holes left open "
        f"({100 * facts['missing']:.2g} %); spikes removed: {facts['spikes_removed']}",
    ]


def _print_accelerations(felt: Sequence[RoadResponse]) -> None:
    """Vertical acceleration of the twin on each surface, and its gap to the drive if there is one."""
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
        title = "What the twin feels, vertical acceleration [m/s²]"
        print_table(output(), title, columns, rows, words=("road",))
