# SPDX-License-Identifier: Apache-2.0
"""All of ``road scan``: clouds and a path in, a road, its record and a picture out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from suspension_twin.addons.roads.scan.clouds import Cloud, open_cloud
from suspension_twin.addons.roads.scan.felt import Felt, feel, steady_path
from suspension_twin.addons.roads.scan.path import ScanPath, read_path
from suspension_twin.addons.roads.scan.placing import SCAN_UNITS, Placing, placing_of
from suspension_twin.addons.roads.scan.registration import Ambiguous, register
from suspension_twin.addons.roads.scan.scan import FINEST, Scanned, ScanSettings, road_from_scan, write_scan
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import together
from suspension_twin.inference.observation import Observation
from suspension_twin.models.registry import model_of
from suspension_twin.road.check import RoadCheck, check_file
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["scan_road"]


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
    progress: Callable[[str, float | None], None] = lambda text, share: None,
) -> tuple[Scanned, list[Felt], RoadCheck, list[str]]:
    """Make a road file of point clouds; see the command line.

    Returns the road, what the twin feels of it, its check, and notes. Raises InputError for what cannot be used.
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
    along = read_path(path, car, FINEST)
    if fit:
        placed = _fitted(opened, along, crs, axes, unit, progress)
    else:
        placed = [placing_of(c.path, c.crs, crs, axes, unit, along.twin.datum) for c in opened]
    found = road_from_scan(
        [(c, p) for c, (p, _) in zip(opened, placed, strict=True)], along.line, along.name, settings, progress
    )
    progress("driving the twin over it", None)
    notes = [f"{c.path.name}: {words}" for c, (_, words) in zip(opened, placed, strict=True)]
    notes += [found.facts["note"]] if "note" in found.facts else []
    felt: list[Felt] = []
    roads = {
        "edge-preserving": found.edges,
        f"Gaussian, {settings.sigma:g} m": found.gaussian,
        "cells, not smoothed": found.cells,
        "another draw within its uncertainty": found.drawn(0),
    }
    written = "edge-preserving" if settings.filter == "edges" else f"Gaussian, {settings.sigma:g} m"
    try:
        drive = along.drive if along.drive is not None else steady_path(found.road, along.twin, speed)
        felt = feel(roads, written, along.twin, drive)
    except (InputError, WorkError) as error:  # too short to drive over, or too rough
        notes.append(f"what the twin feels is left out: {error}")
    with together():
        write_scan(found, out, [c.path.name for c in opened], along, felt, [words for _, words in placed])
        if picture is not None:
            from suspension_twin.addons.roads.scan.picture import save_scan_picture

            save_scan_picture(found, felt, picture)
    return found, felt, check_file(out), notes


def _fitted(
    clouds: Sequence[Cloud],
    along: ScanPath,
    crs: str | None,
    axes: str,
    unit: str | None,
    progress: Callable[[str, float | None], None],
) -> list[tuple[Placing, str]]:
    """How clouds in one common frame of their own lie in ``map``, by a rigid fit to the drive, and that in words."""
    if along.drive is None:
        raise InputError("--fit", f"needs a recorded drive as the path, {along.name} is none")
    if crs is not None:
        raise InputError("--fit", "cannot be given with --crs: it places clouds that have none")
    own = [placing_of(c.path, None, None, axes, unit, None)[0] for c in clouds]
    drive, twin = along.drive, along.twin
    try:
        found = register(list(zip(clouds, own, strict=True)), drive, twin, progress)
    except InputError as error:
        if (
            unit is not None
            or isinstance(error, Ambiguous)
            or not _fits_in_feet(clouds, own, drive, twin, progress)
        ):
            raise
        text = f"fits the drive {drive.name} in feet and not in metres: give --unit ft"
        raise InputError(clouds[0].path, text) from error
    return [(found.placed(p), found.words) for p in own]


def _fits_in_feet(
    clouds: Sequence[Cloud],
    own: Sequence[Placing],
    drive: Observation,
    twin: Twin,
    progress: Callable[[str, float | None], None],
) -> bool:
    """Whether clouds that fit nowhere in metres fit in feet."""
    foot = SCAN_UNITS["ft"]
    try:
        register(
            [(c, p.altered(unit=foot, up=foot)) for c, p in zip(clouds, own, strict=True)],
            drive,
            twin,
            progress,
        )
    except InputError:
        return False
    return True
