# SPDX-License-Identifier: Apache-2.0
"""The line along which a scan is gridded, and the points of clouds along it in road coordinates.

Where clouds do not cover the line, the error says why: another unit, other axes, another place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from suspension_twin.addons.roads.recording import (
    Observation,
    line_of,
    prepare_drive,
    smoothed_line,
    with_datum,
)
from suspension_twin.addons.roads.scan.clouds import SCAN_UNITS, Cloud, Georeference
from suspension_twin.addons.roads.scan.surface import Points
from suspension_twin.arrays import Floats, runs
from suspension_twin.drive.foreign_files import read_table
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.files import read_bytes, reader
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.crg import load_road
from suspension_twin.road.kernels import xy_to_uv
from suspension_twin.vehicle.twin import Twin

__all__ = ["Gathered", "ScanPath", "gather", "read_path"]

#: Columns of a CSV of points, by their names in a heading.
_COLUMNS = {n: n for n in ("x", "y", "lat", "lon")} | {
    "east": "x",
    "north": "y",
    "latitude": "lat",
    "longitude": "lon",
}
_LARGEST_PATH = 1 << 28  # bytes of a CSV of points
#: Side of the cells that know the nearest point of the line, m, unless the map of them grows too large.
_RASTER, _LARGEST = 0.5, 4_000_000
#: Points of a cloud that are kept to find out why it does not cover the line.
_SAMPLE = 100_000
#: A metre of the line is covered by so many points within the corridor; the line, by this share of its metres.
_COVERED, _ENOUGH = 5, 0.2
#: Cartesian coordinates as far from the origin as this, m, are of a grid of a country or a zone.
_FAR = 100_000.0
#: A unit is in doubt where the cloud covers so much of the line in the other one too; another reading of the
#: coordinates is proposed where it covers this share of the line.
_BOTH, _PROPOSED = 0.95, 0.6
#: Holes up to this, m, are holes of the road; longer ones end it.
_GAP = 5.0


@dataclass(frozen=True, eq=False)
class ScanPath:
    """A ``line`` in ``map``, its ``name``, the ``twin`` with the datum of the map, and the ``drive``, if it is one."""

    name: str
    line: Centreline
    twin: Twin
    drive: Observation | None = None


@reader("a path")
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
        prepared = prepare_drive(drive, twin)
        return ScanPath(drive.name, line_of([prepared.trajectory], step, 0.0), twin, prepared)
    if path.suffix.lower() == ".crg":
        road = load_road(path)
        return ScanPath(path.name, Centreline(road.x, road.y, step), twin)
    return ScanPath(path.name, smoothed_line(*_csv(path, twin), step), twin)


def _csv(path: Path, twin: Twin) -> tuple[Floats, Floats]:
    """x and y in ``map`` of the points of a CSV file."""
    table = read_table(read_bytes(path, _LARGEST_PATH), str(path))
    names = [re.split(r"[ \[(]", name.lower())[0] for name in table.names]
    columns = {_COLUMNS[name]: i for i, name in enumerate(names) if name in _COLUMNS}
    if not names:
        columns = {"x": 0, "y": 1}
    pair = ("lat", "lon") if {"lat", "lon"} <= set(columns) else ("x", "y")
    if not set(pair) <= set(columns):
        raise InputError(path, "heading", "needs x and y, or lat and lon")
    points = table.vector([columns[name] for name in pair])
    if len(points) < 2 or not np.isfinite(points).all():
        raise InputError(path, f"needs two points or more, {pair[0]} and {pair[1]} of each a finite number")
    if pair == ("lat", "lon"):
        if twin.datum is None:
            raise InputError(path, "has lat and lon: give a datum with --datum or a twin file")
        points = LocalMap(twin.datum).to_map(
            points[:, 0], points[:, 1], np.full(len(points), twin.datum.altitude)
        )
    return points[:, 0], points[:, 1]


class _Nearest:
    """Index of the nearest point of a line by a raster; -1 far from it."""

    def __init__(self, line: Centreline, reach: float) -> None:
        x0, y0 = line.x.min() - reach, line.y.min() - reach
        wide, high = line.x.max() + reach - x0, line.y.max() + reach - y0
        self.size = max(_RASTER, float(np.sqrt(wide * high / _LARGEST)))
        self.x0, self.y0 = float(x0), float(y0)
        self.shape = int(wide / self.size) + 1, int(high / self.size) + 1
        x, y = (o + self.size * (np.arange(n) + 0.5) for o, n in zip((x0, y0), self.shape, strict=True))
        cells = np.column_stack([c.ravel() for c in np.meshgrid(x, y, indexing="ij")])
        tree = cKDTree(np.column_stack([line.x, line.y]))
        distance, index = tree.query(cells, distance_upper_bound=reach + self.size)
        self.index = np.where(np.isfinite(distance), index, -1)

    def __call__(self, x: Floats, y: Floats) -> NDArray[np.int64]:
        i, j = np.floor((x - self.x0) / self.size), np.floor((y - self.y0) / self.size)
        inside = (i >= 0) & (i < self.shape[0]) & (j >= 0) & (j < self.shape[1])
        flat = np.where(inside, i * self.shape[1] + j, 0).astype(np.int64)
        return np.where(inside, self.index[flat], -1)


@dataclass(frozen=True, eq=False)
class Gathered:
    """``points`` with z m above ``level`` m, number of points ``read``, and a ``note`` where the unit is in doubt.

    ``resolution``: steps in m of the horizontal coordinates of each cloud along its axes, the larger of the two.
    """

    points: Points
    level: float
    read: int
    note: str | None
    resolution: dict[str, float]


def gather(
    clouds: Sequence[tuple[Cloud, Georeference]],
    line: Centreline,
    half: float,
    path_name: str,
    progress: Callable[[str, float | None], None],
) -> Gathered:
    """Ground or not, all points within ``half`` m of a line, sorted along it.

    Raises InputError where the clouds do not cover the line.
    """
    reach = half + 0.5
    nearest = _Nearest(line, reach)
    flat = road_over(line, np.zeros((line.x.size, 2)), np.array([-half, half]), path_name)
    parts: list[tuple[NDArray[np.float32], ...]] = []
    samples: list[Floats] = []
    level, read = np.nan, 0
    resolution: dict[str, float] = {}
    total = sum(c.count or 0 for c, _ in clouds) if all(c.count for c, _ in clouds) else None
    for cloud, georeference in clouds:
        box = georeference.box(line.x, line.y, reach)
        stride = max(1, (cloud.count or 10 * _SAMPLE) // _SAMPLE)
        for piece in cloud.pieces():
            read += piece.shape[0]
            share = None if total is None else min(1.0, read / total)
            progress(f"reading {cloud.path.name}: {read / 1e6:.1f} million points", share)
            samples.append(piece[::stride])
            own = georeference.within(piece, box)
            points = georeference.to_map(own)
            at = nearest(points[:, 0], points[:, 1])
            name, near = cloud.path.name, own[at >= 0]
            resolution[name] = min(resolution.get(name, np.inf), _resolution(near, georeference))
            x, y, z = np.ascontiguousarray(points[at >= 0].T)
            u, v = np.empty((2, z.size))
            xy_to_uv(flat.line, at[at >= 0], x, y, u, v)
            keep = (np.abs(v) <= half) & (u >= 0.0) & (u <= line.length)
            if np.isnan(level) and keep.any():
                level = float(np.median(z[keep]))
            parts.append(tuple(c[keep].astype(np.float32) for c in (u, v, z - level)))
    along, across, high = (
        np.concatenate([p[k] for p in parts] or [np.zeros(0, dtype=np.float32)]) for k in range(3)
    )
    parts.clear()
    metres = int(np.ceil(line.length))
    covered = np.bincount(along.astype(np.int64), minlength=metres + 1)[:metres] >= _COVERED
    sample = _Sample(clouds[0][1], np.concatenate(samples), line, half)
    if covered.mean() < _ENOUGH:
        raise InputError(clouds[0][0].path, sample.reason(path_name))
    _check_ends(covered, line, path_name)
    order = np.argsort(along, kind="stable")
    note = None
    if sample.fits_in_feet():
        note = f"{clouds[0][0].path.name} is taken for metres, but covers the path in feet too: --unit ft if that is "
        note += "its unit"
    points_along = Points(along[order], across[order], high[order])
    return Gathered(points_along, level, read, note, resolution)


def _resolution(points: Floats, georeference: Georeference) -> float:
    """Step in m of the horizontal coordinates of points (n, 3), the larger of both axes.

    The median distance of neighbouring coordinates: where they are not rounded it is far below that of the points.
    """
    found = []
    for column, _ in georeference.axes[:2]:
        steps = np.diff(np.unique(points[:, column]))
        if steps.size:
            ends = np.repeat(points[:1], 2, axis=0)
            ends[1, column] += np.median(steps)
            found.append(float(np.hypot(*np.diff(georeference.to_map(ends), axis=0)[0, :2])))
    return max(found, default=np.inf)


def _check_ends(covered: NDArray[np.bool_], line: Centreline, path_name: str) -> None:
    """A path may leave the cloud for a few metres, which are a hole, and not for more."""
    gaps = [
        (a, b) for a, b in runs(~covered) if b - a > _GAP or (b - a > 1 and (a == 0 or b == covered.size))
    ]
    if not gaps:
        return
    edges = [0, *[e for gap in gaps for e in gap], covered.size]
    low, high = max(zip(edges[::2], edges[1::2], strict=True), key=lambda r: r[1] - r[0])
    high = min(high, int(line.length))
    raise InputError(
        path_name,
        f"leaves the cloud at {gaps[0][0]} m of its {line.length:.0f} m: --section {low} {high} takes what lies within",
    )


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some ``points`` of a cloud with its ``georeference``, to be compared with a line and ``half`` m to its sides."""

    georeference: Georeference
    points: Floats
    line: Centreline
    half: float

    def share(self, georeference: Georeference) -> float:
        """Share of the line with points near it under another georeference."""
        every = max(1, round(0.5 / self.line.step))
        tree = cKDTree(np.column_stack([self.line.x[::every], self.line.y[::every]]))
        placed = georeference.to_map(self.points)[:, :2]
        index = np.asarray(tree.query(placed, distance_upper_bound=self.half)[1])
        return float(np.unique(index[index < tree.n]).size / tree.n)

    def fits_in_feet(self) -> bool:
        """Whether a cloud that is taken for metres covers the line in feet too."""
        own, foot = self.georeference, SCAN_UNITS["ft"]
        return own.crs is None and own.unit == 1.0 and self.share(replace(own, unit=foot, up=foot)) >= _BOTH

    def reason(self, path_name: str) -> str:
        """Why the cloud does not cover the line: another unit, other axes, another place."""
        own, line = self.georeference, self.line
        tries: list[tuple[Georeference, str]] = []
        for unit, factor in SCAN_UNITS.items():
            if own.crs is None and factor != own.unit and unit != "us-ft":  # two millionths from the foot
                tries.append((replace(own, unit=factor, up=factor), f"in {unit}: --unit {unit}"))
        for order in permutations(range(3)):
            axes = tuple((k, 1.0) for k in order)
            if order == (0, 2, 1):  # y is up
                axes = ((0, 1.0), (2, -1.0), (1, 1.0))
            if axes != own.axes:
                name = "".join(("-" if s < 0 else "") + "xyz"[k] for k, s in axes)
                tries.append((replace(own, axes=axes), f"with other axes: --axes {name}"))
        best, words = max((self.share(georeference), words) for georeference, words in tries)
        if best > _PROPOSED:
            return f"does not cover {path_name} as it is, but does if it is {words}"
        points = own.to_map(self.points)
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        first, last = (np.array([f(line.x), f(line.y)]) for f in (np.min, np.max))
        gap = np.hypot(*np.maximum(0.0, np.maximum(low - last, first - high)))
        far = own.crs is None and gap > _FAR
        hint = ", as coordinates of a national grid are: --crs names it" if far else ""
        return (
            f"is of another place than {path_name}: it lies at x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} to "
            f"{high[1]:.0f} m of map, the path at x {first[0]:.0f} to {last[0]:.0f} m, y {first[1]:.0f} to "
            f"{last[1]:.0f} m, {gap:.0f} m off{hint}"
        )
