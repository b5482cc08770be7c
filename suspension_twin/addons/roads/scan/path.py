# SPDX-License-Identifier: Apache-2.0
"""The line along which a scan is gridded: of a recorded drive, a CSV of points, or another road's reference line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from suspension_twin.addons.roads.drives.drives import with_datum
from suspension_twin.addons.roads.drives.passes import line_of, smoothed_line
from suspension_twin.arrays import Floats
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.files import reading
from suspension_twin.inference.observation import Observation, ObserveSettings, observe
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road.build import Centreline, flat_road
from suspension_twin.road.crg import load_road
from suspension_twin.vehicle.twin import Twin

__all__ = ["ScanPath", "read_path"]

_PLACES = {"east": "x", "north": "y", "latitude": "lat", "longitude": "lon"} | {
    n: n for n in ("x", "y", "lat", "lon")
}


@dataclass(frozen=True, eq=False)
class ScanPath:
    """A ``line`` in ``map``, its ``name``, the ``twin`` with the datum of the map, and the ``drive``, if it is one."""

    name: str
    line: Centreline
    twin: Twin
    drive: Observation | None = None


def read_path(path: Path, twin: Twin, step: float) -> ScanPath:
    """Read the line of a scan.

    Parameters
    ----------
    path : Path
        A recorded drive (a folder, or an ``.mcap`` or ``.db3`` file), an OpenCRG road, of which the reference line is
        taken, or CSV with the columns x, y in ``map`` or lat, lon in degrees.
    twin : Twin
        Places of the sensors, and the datum. Without one ``map`` starts at the first fix of the drive.
    step : float
        m between the points of the line.

    Returns
    -------
    ScanPath
        The line, smoothed over about 1.5 m where it is not a road's.

    Raises
    ------
    InputError
        It cannot be read, or is no line.
    """
    if path.is_dir() or path.suffix.lower() in (".mcap", ".db3"):
        drive = read_drive(path)
        twin = with_datum(twin, drive)
        prepared = observe(drive, twin, flat_road(), ObserveSettings())
        return ScanPath(drive.name, line_of([prepared.trajectory], step, 0.0), twin, prepared)
    if path.suffix.lower() == ".crg":
        road = load_road(path)
        return ScanPath(path.name, Centreline(road.x, road.y, step), twin)
    x, y = _csv(path, twin)
    return ScanPath(path.name, smoothed_line(x, y, step), twin)


def _csv(path: Path, twin: Twin) -> tuple[Floats, Floats]:
    with reading(path, "a path"):
        text = path.read_text(encoding="utf-8-sig")
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(path, "is empty")
    mark = next((m for m in (";", "\t", ",") if m in lines[0]), None)
    words = [w.strip().lower() for w in lines[0].split(mark)]
    names = [re.split(r"[ \[(]", word)[0] for word in words]
    places = {_PLACES[name]: i for i, name in enumerate(names) if name in _PLACES}
    if places:
        lines = lines[1:]
    else:
        places = {"x": 0, "y": 1}
    pair = ("lat", "lon") if {"lat", "lon"} <= set(places) else ("x", "y")
    if not set(pair) <= set(places):
        raise InputError(path, "heading", "needs x and y, or lat and lon")
    rows = []
    for i, line in enumerate(lines, start=1):
        cells = line.split(mark)
        try:
            rows.append([float(cells[places[name]]) for name in pair])
        except (ValueError, IndexError):
            raise InputError(path, f"point {i}", f"{line[:40]!r} has no {pair[0]} and {pair[1]}") from None
    points = np.array(rows, dtype=np.float64).reshape(-1, 2)
    if points.shape[0] < 2 or not np.isfinite(points).all():
        raise InputError(path, "needs two points or more, all finite")
    if pair == ("x", "y"):
        return points[:, 0], points[:, 1]
    if twin.datum is None:
        raise InputError(path, "has lat and lon: give a datum with --datum or a twin file")
    xyz = LocalMap(twin.datum).to_map(
        points[:, 0], points[:, 1], np.full(points.shape[0], twin.datum.altitude)
    )
    return xyz[:, 0], xyz[:, 1]
