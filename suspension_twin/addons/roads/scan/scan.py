# SPDX-License-Identifier: Apache-2.0
"""``road scan``: from point clouds and a line to a road file with the uncertainty of every node beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from suspension_twin.addons.roads.scan.clouds import (
    SCAN_UNITS,
    Cloud,
    Georeference,
    georeference_of,
    open_cloud,
)
from suspension_twin.addons.roads.scan.corridor import ScanPath, gather, read_path
from suspension_twin.addons.roads.scan.ground import ground_cells, ground_points
from suspension_twin.addons.roads.scan.registration import Ambiguous, register
from suspension_twin.addons.roads.scan.response import RoadResponse, road_responses, steady_path
from suspension_twin.addons.roads.scan.surface import Surface, SurfaceGrid, fit_surface
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import Json, replacing, together, write_text
from suspension_twin.models.registry import model_of
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.check import RoadCheck, check_file, enclosed
from suspension_twin.road.crg import record_path, write_road
from suspension_twin.road.road import Road
from suspension_twin.road.smoothing import find_spikes, remove_spikes, smooth
from suspension_twin.vehicle.twin import load_twin

__all__ = [
    "Filter",
    "ScanSettings",
    "ScannedRoad",
    "cells_path",
    "road_from_scan",
    "scan_road",
    "write_scan",
]

Filter = Literal["edges", "gaussian"]
Progress = Callable[[str, float | None], None]
#: Steps along and across, m: the first where a cell holds so many points on average.
_STEPS, _PER_CELL = ((0.025, 0.05), (0.05, 0.1), (0.1, 0.2)), 1.5
#: Points beyond the outermost nodes that are still used, m.
_BESIDE = 0.3
MEASURED, FILLED, HOLE = 0, 1, 2


@dataclass(frozen=True)
class ScanSettings:
    """Settings of :func:`road_from_scan`.

    Parameters
    ----------
    width : float
        m of the road.
    filter : str
        The surface that is written: ``edges`` or ``gaussian``.
    sigma : float
        Standard deviation in m of the Gaussian.
    fill : float
        m, the width up to which a hole is filled.
    section : tuple of float, optional
        m from and to along the path.
    steps : tuple of float, optional
        m along and across; None to fit the density of the points.
    seed : int
        Of the draws.
    """

    width: float = 4.0
    filter: Filter = "edges"
    sigma: float = 0.1
    fill: float = 0.5
    section: tuple[float, float] | None = None
    steps: tuple[float, float] | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ScannedRoad:
    """A road from a scan.

    Parameters
    ----------
    road : Road
        The road that is written: NaN in holes at the borders; OpenCRG allows none between data, where holes are
        bridged.
    edges, gaussian, cells : Road
        The edge-preserving surface, the means of the ground points about each node under a Gaussian window, and
        those means alone.
    surface : Surface
        The fit behind the edge-preserving surface, with its uncertainty.
    status : (nu, nv) array of int
        0 measured, 1 filled, 2 hole.
    facts : dict
        Numbers of points, holes and spikes.
    """

    road: Road
    edges: Road
    gaussian: Road
    cells: Road
    surface: Surface
    status: NDArray[np.int8]
    facts: Json

    def drawn(self, which: int) -> Road:
        """The edge-preserving road with one of the draws of its errors."""
        return replace(self.edges, z=self.edges.z + self.surface.draws[which])


def road_from_scan(
    clouds: Sequence[tuple[Cloud, Georeference]],
    line: Centreline,
    name: str,
    settings: ScanSettings | None = None,
    progress: Progress = lambda text, share: None,
) -> ScannedRoad:
    """Make a road of point clouds along a line.

    Parameters
    ----------
    clouds : sequence of (Cloud, Georeference)
        The clouds, and how each lies in ``map``.
    line : Centreline
        Reference line of the road, with points every 0.025 m.
    name : str
        Of the line, for errors.
    settings : ScanSettings, optional
        Width, steps, filter, holes.
    progress : callable, optional
        Called with a text and the share of its work that is done, None where that is not known.

    Returns
    -------
    ScannedRoad
        The road with its uncertainty; :func:`write_scan` writes it.

    Raises
    ------
    InputError
        The clouds do not cover the line, hold no ground, or are of another place, in another unit or other axes.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.road.build import Centreline
    >>> from suspension_twin.addons.roads.scan.clouds import Cloud, Georeference
    >>> xy = np.random.default_rng(0).uniform([0, -3], [20, 3], (60000, 2))
    >>> points = np.column_stack([xy, 0.01 * np.sin(xy[:, 0])])
    >>> cloud = Cloud(Path("made"), len(points), None, lambda: iter([points]))
    >>> line = Centreline([0.0, 20.0], [0.0, 0.0], 0.025)
    >>> found = road_from_scan([(cloud, Georeference())], line, "line", ScanSettings(width=3.0))
    >>> bool(abs(found.road.heights(7.85, 0.0) - 0.01) < 1e-3)
    True
    """
    chosen = settings or ScanSettings()
    _check(chosen)
    if chosen.section is not None:
        line = _part(line, chosen.section, name)
    half = 0.5 * chosen.width
    gathered = gather(clouds, line, half + _BESIDE, name, progress)
    points, level = gathered.points, gathered.level
    progress("looking for the ground", None)
    cloud_name = clouds[0][0].path.name
    try:
        cells = ground_cells(points, line.length, half + _BESIDE, cloud_name)
    except InputError as error:
        raise InputError("; ".join([str(error), *_coarse(gathered.resolution, *_STEPS[-1])])) from None
    ground = ground_points(points, cells)
    density = ground.u.size / (line.length * 2.0 * (half + _BESIDE))
    fine_enough = (s for s in _STEPS if density * s[0] * s[1] >= _PER_CELL)
    steps = chosen.steps or next(fine_enough, _STEPS[-1])
    line = Centreline(line.x, line.y, steps[0])
    nv = 2 * max(1, round(half / steps[1])) + 1
    grid = SurfaceGrid(line.x.size, nv, steps[0], 2.0 * half / (nv - 1), -half)
    inner = ground[np.abs(ground.v) <= half]
    surface = fit_surface(inner, grid, chosen.seed, lambda share: progress("fitting the surface", share))
    status = _status(surface.count, grid, chosen.fill)
    gone = status == HOLE
    if gone.all():
        raise InputError(cloud_name, "has no ground along the path")

    def made(z: Floats, title: str) -> Road:
        road = road_over(line, np.where(gone, np.nan, z), grid.v, title)
        return road.with_line(z=np.full(line.x.size, level))

    with np.errstate(invalid="ignore"):
        means = grid.sums(inner, inner.z) / grid.sums(inner)
    edges, cell_means = made(surface.z, "edge-preserving"), made(means, "cells")
    gaussian = smooth(made(_bridged(cell_means.z), "Gaussian"), chosen.sigma)
    road = edges if chosen.filter == "edges" else gaussian
    spikes = find_spikes(road)
    if len(spikes):
        road = remove_spikes(road, spikes)
    # OpenCRG has no missing heights between data: there the surface bridges them, and the record names the place.
    between = gone & enclosed(gone)
    road = replace(road, z=np.where(between, surface.z, road.z))
    facts = {
        "points": gathered.read,
        "points_near_the_path": int(points.u.size),
        "ground_points": int(ground.u.size),
        "step": grid.du,
        "step_across": grid.dv,
        "filled": float(np.mean(status == FILLED)),
        "holes": _boxes(gone, edges.u, grid.v),
        "bridged": _boxes(between, edges.u, grid.v),
        "missing": float(np.mean(gone)),
        "cells_with_things": int(cells.objects.sum()),
        "spikes_removed": len(spikes),
        "noise": float(np.sqrt(np.mean(surface.noise[surface.count > 0] ** 2))),
        "sigma_median": float(np.median(surface.sigma[~gone])),
    }
    notes = [*([gathered.note] if gathered.note else []), *_coarse(gathered.resolution, grid.du, grid.dv)]
    if notes:
        facts["note"] = "; ".join(notes)
    return ScannedRoad(replace(road, name=name), edges, gaussian, cell_means, surface, status, facts)


def _coarse(resolution: dict[str, float], du: float, dv: float) -> list[str]:
    """A sentence on each cloud whose coordinates are rounded more coarsely than the nodes lie apart."""
    return [
        f"{file}: coordinates in steps of {size:.2g} m, coarser than the nodes (every {du:g} by {dv:.3g} m): a program "
        "rounded them, save them in double precision or from an origin nearby"
        for file, size in resolution.items()
        if min(du, dv) < size < np.inf
    ]


def _check(s: ScanSettings) -> None:
    if not 0.5 <= s.width <= 40.0:
        raise InputError("--width", f"must lie between 0.5 and 40 m, is {s.width:g}")
    if not 0.0 <= s.fill <= 5.0:
        raise InputError("--fill", f"must lie between 0 and 5 m, is {s.fill:g}")
    if s.steps is not None and not all(0.01 <= step <= 0.5 for step in s.steps):
        raise InputError("--step", "steps must lie between 0.01 and 0.5 m")
    if not 0.0 < s.sigma <= 5.0:
        raise InputError("--sigma", f"must lie between 0 and 5 m, is {s.sigma:g}")


def _part(line: Centreline, section: tuple[float, float], name: str) -> Centreline:
    low, high = (round(e / line.step) for e in section)
    if not 0 <= low < high - 4 or section[1] > line.length + 1.0:
        raise InputError("--section", f"must lie within 0 to {line.length:.1f} m of {name}, from low to high")
    return Centreline(line.x[low : high + 1], line.y[low : high + 1], line.step)


def _status(count: Floats, grid: SurfaceGrid, fill: float) -> NDArray[np.int8]:
    """Whether each node is measured, filled or a hole: holes narrower than ``fill`` m are filled."""
    # A single node without a point among nodes with points is no hole.
    known = np.pad(count > 0, 1, mode="edge")
    measured = ndimage.binary_closing(known, np.ones((3, 3), dtype=np.bool_))[1:-1, 1:-1] | (count > 0)
    if not measured.any():
        return np.full(count.shape, HOLE, dtype=np.int8)
    status = np.where(measured, MEASURED, FILLED).astype(np.int8)
    distance = ndimage.distance_transform_edt(~measured, sampling=(grid.du, grid.dv))
    labels, number = ndimage.label(~measured, structure=np.ones((3, 3)))
    if number:
        widest = ndimage.maximum(distance, labels, np.arange(1, number + 1))
        wide = np.concatenate([[False], 2.0 * np.asarray(widest) > fill + 2.0 * max(grid.du, grid.dv)])
        # Gaps between sparse points are connected: nodes near a point stay filled.
        status[wide[labels] & (distance > 0.5 * fill)] = HOLE
        core = ndimage.distance_transform_edt(status != HOLE, sampling=(grid.du, grid.dv))
        status[~measured & wide[labels] & (core <= 0.5 * fill + 1e-9)] = HOLE
    return status


def _boxes(flags: NDArray[np.bool_], u: Floats, v: Floats) -> list[dict[str, float]]:
    """Boxes in m of the connected pieces of the flagged nodes (nu, nv), the largest first."""
    labels, _ = ndimage.label(flags)
    sizes = np.bincount(labels.ravel())
    boxes: list[Any] = ndimage.find_objects(labels)
    found = [
        {
            "u_low": float(u[rows.start]),
            "u_high": float(u[rows.stop - 1]),
            "v_low": float(v[columns.start]),
            "v_high": float(v[columns.stop - 1]),
            "nodes": int(sizes[k]),
        }
        for k, (rows, columns) in enumerate(boxes, start=1)
    ]
    return sorted(found, key=lambda h: -h["nodes"])


def _bridged(z: Floats) -> Floats:
    """Heights with missing ones interpolated along the road, as far as a line across has any."""
    out = np.array(z)
    rows = np.arange(z.shape[0])
    for column in out.T:
        good = np.isfinite(column)
        if good.any():
            column[:] = np.interp(rows, rows[good], column[good])
    return out


def cells_path(road: Path) -> Path:
    """File of the uncertainty of the nodes of a road file."""
    return road.with_suffix(".npz")


def write_scan(
    found: ScannedRoad,
    path: Path,
    clouds: Sequence[tuple[str, str]],
    scanned_along: ScanPath,
    responses: Sequence[RoadResponse],
) -> Json:
    """Write the road, the record beside it and the uncertainty of its nodes; return the record.

    Parameters
    ----------
    found : ScannedRoad
        From :func:`road_from_scan`.
    path : Path
        The OpenCRG file. Its record is ``.json``; ``.npz`` holds ``u`` (nu,), ``v`` (nv,), and (nu, nv) ``z``,
        NaN in every hole, ``sigma``, ``noise``, ``points`` and ``status``.
    clouds : sequence of (str, str)
        Names of the clouds, and a sentence on the georeference of each.
    scanned_along : ScanPath
        The path.
    responses : sequence of RoadResponse
        Of the twin to its versions.

    Returns
    -------
    dict
        The record.
    """
    datum = scanned_along.twin.datum
    record: Json = {
        "origin": "scan",
        "clouds": [{"name": name, "placing": words} for name, words in clouds],
        "path": scanned_along.name,
        "datum": None if datum is None else datum.model_dump(),
        **found.facts,
        "felt": [vars(response) for response in responses],
    }
    names = ", ".join(name for name, _ in clouds)
    write_road(found.road, path, comment=f"From a scan by suspension_twin: {names}")
    write_text(record_path(path), json.dumps(record, indent=1) + "\n")
    with replacing(cells_path(path)) as temporary:
        np.savez_compressed(
            temporary,
            u=found.road.u,
            v=found.road.v,
            z=np.where(found.status == HOLE, np.nan, found.road.heights_grid),
            sigma=found.surface.sigma.astype(np.float32),
            noise=found.surface.noise.astype(np.float32),
            points=found.surface.count.astype(np.float32),
            status=found.status,
        )
    return record


def scan_road(
    clouds: Sequence[Path],
    path: Path,
    out: Path,
    twin: Path,
    settings: ScanSettings,
    *,
    datum: tuple[float, float, float] | None = None,
    crs: str | None = None,
    unit: str | None = None,
    axes: str = "xyz",
    fit: bool = False,
    speed: float = 30.0 / 3.6,
    picture: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> tuple[ScannedRoad, list[RoadResponse], RoadCheck, list[str]]:
    """Make a road file of point clouds; see the command line.

    Returns the road, the twin's responses to it, its check, and notes. Raises InputError for files that cannot be used.
    """
    car = load_twin(twin)
    if model_of(car).recordings != "drive":
        raise InputError(
            twin, "model", f"a road is felt by a vehicle that drives on one, {car.model} does not"
        )
    changes: dict[str, object] = {"road": None}
    if datum is not None:
        changes["datum"] = dict(zip(("latitude", "longitude", "altitude"), datum, strict=True))
    car = car.with_changes(changes)
    opened = [open_cloud(cloud) for cloud in clouds]
    progress(f"reading {path.name}", None)
    along = read_path(path, car, _STEPS[0][0])
    if fit:
        if crs is not None:
            raise InputError("--fit", "cannot be given with --crs: it places clouds that have none")
        own = [georeference_of(c.path, None, None, axes, unit, None)[0] for c in opened]
        placed = _fitted(list(zip(opened, own, strict=True)), along, unit is None, progress)
    else:
        placed = [georeference_of(c.path, c.crs, crs, axes, unit, along.twin.datum) for c in opened]
    sources = [(c, g) for c, (g, _) in zip(opened, placed, strict=True)]
    found = road_from_scan(sources, along.line, along.name, settings, progress)
    progress("driving the twin over it", None)
    named = [(c.path.name, words) for c, (_, words) in zip(opened, placed, strict=True)]
    notes = [f"{name}: {words}" for name, words in named]
    notes += [found.facts["note"]] if "note" in found.facts else []
    gaussian = f"Gaussian, {settings.sigma:g} m"
    roads = {
        "edge-preserving": found.edges,
        gaussian: found.gaussian,
        "cells, not smoothed": found.cells,
        "another draw within its uncertainty": found.drawn(0),
    }
    responses: list[RoadResponse] = []
    try:
        drive = along.drive if along.drive is not None else steady_path(found.road, along.twin, speed)
        written = "edge-preserving" if settings.filter == "edges" else gaussian
        responses = road_responses(roads, written, along.twin, drive)
    except (InputError, WorkError) as error:  # too short to drive over, or too rough
        notes.append(f"what the twin feels is left out: {error}")
    with together():
        write_scan(found, out, named, along, responses)
        if picture is not None:
            from suspension_twin.addons.roads.pictures import save_picture, scan_figure

            save_picture(scan_figure(found, responses), picture)
    return found, responses, check_file(out), notes


def _fitted(
    clouds: Sequence[tuple[Cloud, Georeference]], along: ScanPath, metres: bool, progress: Progress
) -> list[tuple[Georeference, str]]:
    """Georeferences by a rigid fit to the drive of clouds in one common frame, and a sentence on each.

    Where ``metres`` are assumed and clouds fit nowhere, an error says whether they would in feet.
    """
    drive = along.drive
    if drive is None:
        raise InputError("--fit", f"needs a recorded drive as the path, {along.name} is none")
    try:
        found = register(clouds, drive, along.twin, progress)
    except Ambiguous:
        raise
    except InputError as error:
        foot, fits = SCAN_UNITS["ft"], False
        feet = [(c, replace(g, unit=foot, up=foot)) for c, g in clouds]
        with suppress(InputError):
            fits = metres and bool(register(feet, drive, along.twin, progress))
        if not fits:
            raise
        text = f"fits the drive {drive.name} in feet and not in metres: give --unit ft"
        raise InputError(clouds[0][0].path, text) from error
    return [(replace(g, turn=found.turn, move=found.move), str(found)) for _, g in clouds]
