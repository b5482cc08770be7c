# SPDX-License-Identifier: Apache-2.0
"""From point clouds to a road file with the uncertainty of every node beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from suspension_twin.addons.roads.scan.clouds import Cloud
from suspension_twin.addons.roads.scan.corridor import gather
from suspension_twin.addons.roads.scan.felt import Felt
from suspension_twin.addons.roads.scan.ground import ground_cells, ground_points
from suspension_twin.addons.roads.scan.path import ScanPath
from suspension_twin.addons.roads.scan.placing import Placing
from suspension_twin.addons.roads.scan.surface import Grid, Points, fit_surface
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import replacing, write_text
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.check import enclosed
from suspension_twin.road.crg import record_path, write_road
from suspension_twin.road.road import Road
from suspension_twin.road.smoothing import find_spikes, remove_spikes, smooth

__all__ = ["FINEST", "Filter", "ScanSettings", "Scanned", "cells_path", "road_from_scan", "write_scan"]

Filter = Literal["edges", "gaussian"]
#: Steps along and across, m: the first where a cell holds so many points on average.
_STEPS, _PER_CELL = ((0.025, 0.05), (0.05, 0.1), (0.1, 0.2)), 1.5
FINEST = _STEPS[0][0]
#: Points beyond the outermost nodes that are still used, m.
_BESIDE = 0.3
MEASURED, FILLED, HOLE = 0, 1, 2


@dataclass(frozen=True)
class ScanSettings:
    """``width`` m of the road; ``filter`` what is written; ``sigma`` m of the Gaussian one; ``fill`` m, the width up to
    which a hole is filled; ``section`` m from and to along the path; ``steps`` along and across, m, None to fit the
    density of the points; ``seed`` of the draws."""

    width: float = 4.0
    filter: Filter = "edges"
    sigma: float = 0.1
    fill: float = 0.5
    section: tuple[float, float] | None = None
    steps: tuple[float, float] | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Scanned:
    """A road from a scan.

    Parameters
    ----------
    road : Road
        What is written: NaN in holes at the borders; OpenCRG allows none between data, where holes are bridged.
    edges, gaussian, cells : Road
        The edge-preserving surface, the means of the ground points about each node under a Gaussian window, and
        those means alone.
    sigma : (nu, nv) array
        Standard deviation of the edge-preserving heights in m.
    draws : (2, nu, nv) array
        Two draws of their error in m.
    noise : (nu, nv) array
        Scale of the noise of single points in m.
    count : (nu, nv) array
        Ground points about each node.
    status : (nu, nv) array of int
        0 measured, 1 filled, 2 hole.
    facts : dict
        Numbers of points, holes and spikes.
    """

    road: Road
    edges: Road
    gaussian: Road
    cells: Road
    sigma: Floats
    draws: Floats
    noise: Floats
    count: Floats
    status: NDArray[np.int8]
    facts: dict[str, Any]

    def drawn(self, which: int) -> Road:
        """The edge-preserving road with one of its draws of errors."""
        return replace(self.edges, z=self.edges.z + self.draws[which])


def road_from_scan(
    clouds: Sequence[tuple[Cloud, Placing]],
    line: Centreline,
    name: str,
    settings: ScanSettings | None = None,
    progress: Callable[[str, float | None], None] = lambda text, share: None,
) -> Scanned:
    """Make a road of point clouds along a line.

    Parameters
    ----------
    clouds : sequence of (Cloud, Placing)
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
    Scanned
        The road with its uncertainty; :func:`write_scan` writes it.

    Raises
    ------
    InputError
        The clouds do not cover the line, hold no ground, or are of another place, in another unit or other axes.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.road.build import Centreline
    >>> from suspension_twin.addons.roads.scan.clouds import Cloud
    >>> from suspension_twin.addons.roads.scan.placing import Placing
    >>> xy = np.random.default_rng(0).uniform([0, -3], [20, 3], (60000, 2))
    >>> points = np.column_stack([xy, 0.01 * np.sin(xy[:, 0])])
    >>> cloud = Cloud(Path("made"), len(points), None, lambda: iter([points]))
    >>> line = Centreline([0.0, 20.0], [0.0, 0.0], 0.025)
    >>> found = road_from_scan([(cloud, Placing())], line, "line", ScanSettings(width=3.0))
    >>> bool(abs(found.road.heights(7.85, 0.0) - 0.01) < 1e-3)
    True
    """
    chosen = settings or ScanSettings()
    _check(chosen, line)
    if chosen.section is not None:
        line = _part(line, chosen.section, name)
    half = 0.5 * chosen.width
    gathered = gather(clouds, line, half + _BESIDE, name, progress)
    points, level = gathered.points, gathered.level
    progress("looking for the ground", None)
    cloud_name = clouds[0][0].path.name
    cells = ground_cells(points, line.length, half + _BESIDE, cloud_name)
    ground = ground_points(points, cells)
    near = points.u.size
    steps = chosen.steps or _steps_for(ground.u.size / (line.length * 2.0 * (half + _BESIDE)))
    line = Centreline(line.x, line.y, steps[0])
    nv = 2 * max(1, round(half / steps[1])) + 1
    grid = Grid(line.x.size, nv, steps[0], 2.0 * half / (nv - 1), -half)
    within = np.abs(ground.v) <= half
    inner = Points(ground.u[within], ground.v[within], ground.z[within])
    fitted = fit_surface(inner, grid, chosen.seed, lambda share: progress("fitting the surface", share))
    v: Floats = grid.v0 + grid.dv * np.arange(grid.nv, dtype=np.float64)
    status = _status(fitted.count, grid, chosen.fill)
    if (status == HOLE).all():
        raise InputError(cloud_name, "has no ground along the path")

    def made(z: Floats, title: str) -> Road:
        road = road_over(line, z, v, title)
        return road.with_line(z=np.full(line.x.size, level))

    gone = status == HOLE
    edges = made(np.where(gone, np.nan, fitted.z), "edge-preserving")
    means = made(np.where(gone, np.nan, _means(inner, grid)), "cells")
    gaussian = smooth(made(np.where(gone, np.nan, _bridged(means.z, gone)), "Gaussian"), chosen.sigma)
    road = edges if chosen.filter == "edges" else gaussian
    spikes = find_spikes(road)
    if len(spikes):
        road = remove_spikes(road, spikes)
    # OpenCRG has no missing heights between data: there the surface bridges them, and the record names the place.
    between = gone & enclosed(gone)
    road = replace(road, z=np.where(between, fitted.z, road.z))
    facts = {
        "points": gathered.read,
        "points_near_the_path": int(near),
        "ground_points": int(ground.u.size),
        "step": grid.du,
        "step_across": grid.dv,
        "filled": float(np.mean(status == FILLED)),
        "holes": _boxes(gone, edges.u, v),
        "bridged": _boxes(between, edges.u, v),
        "missing": float(np.mean(gone)),
        "cells_with_things": int(cells.things.sum()),
        "spikes_removed": len(spikes),
        "noise": float(np.sqrt(np.mean(fitted.noise[fitted.count > 0] ** 2))),
        "sigma_median": float(np.median(fitted.sigma[~gone])),
    }
    if gathered.note is not None:
        facts["note"] = gathered.note
    return Scanned(
        replace(road, name=name), edges, gaussian, means, fitted.sigma, fitted.draws, fitted.noise, fitted.count,
        status, facts,
    )  # fmt: skip


def _check(s: ScanSettings, line: Centreline) -> None:
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


def _steps_for(density: float) -> tuple[float, float]:
    return next((s for s in _STEPS if density * s[0] * s[1] >= _PER_CELL), _STEPS[-1])


def _status(count: Floats, grid: Grid, fill: float) -> NDArray[np.int8]:
    """What is known of each node: holes narrower than ``fill`` m are filled."""
    # A single node without a point among nodes with points is no hole.
    known = np.pad(count > 0, 1, mode="edge")
    measured = ndimage.binary_closing(known, np.ones((3, 3), dtype=np.bool_))[1:-1, 1:-1] | (count > 0)
    status = np.where(measured, MEASURED, FILLED).astype(np.int8)
    if not measured.any():
        status[:] = HOLE
        return status
    distance = ndimage.distance_transform_edt(~measured, sampling=(grid.du, grid.dv))
    labels, number = ndimage.label(~measured, structure=np.ones((3, 3)))
    if number:
        widest = ndimage.maximum(distance, labels, np.arange(1, number + 1))
        wide = np.concatenate([[False], 2.0 * np.asarray(widest) > fill + 2.0 * max(grid.du, grid.dv)])
        # Of sparse points the gaps hang together: what is near a point stays filled.
        status[wide[labels] & (distance > 0.5 * fill)] = HOLE
        core = ndimage.distance_transform_edt(status != HOLE, sampling=(grid.du, grid.dv))
        status[~measured & wide[labels] & (core <= 0.5 * fill + 1e-9)] = HOLE
    return status


def _boxes(flags: NDArray[np.bool_], u: Floats, v: Floats) -> list[dict[str, float]]:
    """Boxes in m of what hangs together among the nodes (nu, nv), the largest first."""
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


def _means(points: Points, grid: Grid) -> Floats:
    """Mean height of the points about each node (nu, nv), NaN where there are none."""
    at = np.clip(np.rint(points.u / grid.du), 0, grid.nu - 1).astype(np.int64) * grid.nv
    at += np.clip(np.rint((points.v - grid.v0) / grid.dv), 0, grid.nv - 1).astype(np.int64)
    size = grid.nu * grid.nv
    count = np.bincount(at, minlength=size)
    with np.errstate(invalid="ignore"):
        return (np.bincount(at, points.z, minlength=size) / count).reshape(grid.nu, grid.nv)


def _bridged(z: Floats, gone: NDArray[np.bool_]) -> Floats:
    """Heights with those missing within small holes taken from their neighbours along the road."""
    out = np.array(z)
    rows = np.arange(z.shape[0])
    for j in range(z.shape[1]):
        good = np.isfinite(z[:, j])
        if good.any():
            out[:, j] = np.interp(rows, rows[good], z[good, j])
    return np.where(gone, np.nan, out)


def cells_path(road: Path) -> Path:
    """Where the uncertainty of the nodes of a road file lies."""
    return road.with_suffix(".npz")


def write_scan(
    found: Scanned,
    path: Path,
    clouds: Sequence[str],
    scanned_along: ScanPath,
    felt: Sequence[Felt],
    how: Sequence[str],
) -> dict[str, Any]:
    """Write the road, the record beside it and the uncertainty of its nodes; return the record.

    Parameters
    ----------
    found : Scanned
        From :func:`road_from_scan`.
    path : Path
        The OpenCRG file. Its record is ``.json``; ``.npz`` holds ``u`` (nu,), ``v`` (nv,), and (nu, nv) ``z``,
        NaN in every hole, ``sigma``, ``noise``, ``points`` and ``status``.
    clouds : sequence of str
        Names of the clouds.
    scanned_along : ScanPath
        The path.
    felt : sequence of Felt
        What the twin feels of its versions.
    how : sequence of str
        How each cloud lies in ``map``, in words.

    Returns
    -------
    dict
        What the record holds.
    """
    datum = scanned_along.twin.datum
    record: dict[str, Any] = {
        "origin": "scan",
        "clouds": [{"name": n, "placing": h} for n, h in zip(clouds, how, strict=True)],
        "path": scanned_along.name,
        "datum": None if datum is None else datum.model_dump(),
        **found.facts,
        "felt": [vars(f) for f in felt],
    }
    write_road(found.road, path, comment=f"From a scan by suspension_twin: {', '.join(clouds)}")
    write_text(record_path(path), json.dumps(record, indent=1) + "\n")
    with replacing(cells_path(path)) as temporary:
        np.savez_compressed(
            temporary,
            u=found.road.u,
            v=found.road.v,
            z=np.where(found.status == HOLE, np.nan, found.road.heights_grid),
            sigma=found.sigma.astype(np.float32),
            noise=found.noise.astype(np.float32),
            points=found.count.astype(np.float32),
            status=found.status,
        )
    return record
