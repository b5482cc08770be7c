# SPDX-License-Identifier: Apache-2.0
"""A picture of a scanned road before and after: cells and surface as maps, a wheel path, and what the twin feels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from suspension_twin.addons.roads.scan.felt import Felt
from suspension_twin.addons.roads.scan.scan import Scanned
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import replacing
from suspension_twin.road.check import wheel_paths
from suspension_twin.road.road import Road

__all__ = ["save_scan_picture", "scan_figure"]

_BEFORE, _AFTER, _GAUSS = "#8a929b", "#1f6fb2", "#d1661c"
_NINETY = 1.645
_ZOOM = 6.0


def save_scan_picture(found: Scanned, felt: Sequence[Felt], path: str | os.PathLike[str]) -> None:
    """Draw :func:`scan_figure` into a file (.png, .svg or .pdf). Raises InputError, WorkError."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".png", ".svg", ".pdf"):
        raise InputError(path, "a picture is written as .png, .svg or .pdf; name the file so")
    with replacing(path) as temporary:
        scan_figure(found, felt).savefig(temporary, dpi=130, facecolor="white", format=suffix[1:])


def scan_figure(found: Scanned, felt: Sequence[Felt]) -> Figure:
    """Cells before and the road after, short waves only; the left wheel path where it is roughest; what is felt."""
    figure = Figure(figsize=(12.0, 10.0), layout="constrained")
    grid = figure.add_gridspec(4, 2, height_ratios=[1.0, 1.0, 1.0, 1.2], width_ratios=[1.5, 1.0])
    before, after, spread = (figure.add_subplot(grid[i, :]) for i in range(3))
    level = _level(found.edges)
    shown = 1e3 * (found.edges.z - level)
    limit = float(np.nanquantile(np.abs(shown), 0.995)) if np.isfinite(shown).any() else 1.0
    for axes, road, title in (
        (before, found.cells, "Before: mean of the ground points about each node, long waves taken out"),
        (after, found.road, "After: what is written"),
    ):
        image = _map(axes, road, 1e3 * (road.z - level), limit, "viridis", title)
        figure.colorbar(image, ax=axes, pad=0.01, label="[mm]")
    sigma = np.where(found.status == 2, np.nan, 1e3 * found.sigma)
    image = _map(spread, found.road, sigma, None, "magma", "Uncertainty (standard deviation); holes are grey")
    figure.colorbar(image, ax=spread, pad=0.01, label="[mm]")
    spread.set_xlabel("u [m]")
    _wheel_path(figure.add_subplot(grid[3, 0]), found)
    _felt(figure.add_subplot(grid[3, 1]), felt)
    return figure


def _level(road: Road) -> Floats:
    """The long waves of a road (nu, 1): the running mean over 5 m of its cross sections."""
    with np.errstate(invalid="ignore"):
        known = np.isfinite(road.z)
        row = np.where(known, road.z, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return uniform_filter1d(row, max(3, round(5.0 / road.u_step)), mode="nearest")[:, None]


def _map(axes: Axes, road: Road, values: Floats, limit: float | None, colours: str, title: str):  # type: ignore[no-untyped-def]
    every = max(1, values.shape[0] // 2400)
    low, high = (-limit, limit) if limit else (0.0, float(np.nanquantile(values, 0.99)))
    axes.set_facecolor("#d5d8db")
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_ylabel("v [m]")
    extent = (road.u_first, road.u_last, float(road.v[0]), float(road.v[-1]))
    return axes.imshow(
        values[::every].T,
        origin="lower",
        aspect="auto",
        extent=extent,
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )


def _wheel_path(axes: Axes, found: Scanned) -> None:
    (left, _), z, _ = wheel_paths(found.edges)
    j = int(np.abs(found.edges.v - left).argmin())
    u = found.edges.u
    rough = uniform_filter1d(
        np.abs(np.gradient(np.nan_to_num(z - z.mean()))), max(3, round(1.0 / found.edges.u_step))
    )
    middle = float(u[int(rough.argmax())])
    k = np.abs(u - middle) < 0.5 * _ZOOM
    lines = {name: 1e3 * getattr(found, name).z[k, j] for name in ("cells", "gaussian", "edges")}
    base = float(np.nanmean(lines["edges"]))
    axes.plot(u[k], lines["cells"] - base, ".", color=_BEFORE, ms=3, label="cells")
    axes.plot(u[k], lines["gaussian"] - base, color=_GAUSS, lw=1.2, label="Gaussian")
    axes.plot(u[k], lines["edges"] - base, color=_AFTER, lw=1.4, label="edge-preserving")
    band = 1e3 * _NINETY * found.sigma[k, j]
    axes.fill_between(
        u[k], lines["edges"] - base - band, lines["edges"] - base + band, color=_AFTER, alpha=0.2, lw=0
    )
    axes.set_title(
        f"Left wheel path, v = {found.edges.v[j]:.2f} m, where it is roughest", loc="left", fontsize=10
    )
    axes.set_xlabel("u [m]")
    axes.set_ylabel("height [mm]")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8)


def _felt(axes: Axes, felt: Sequence[Felt]) -> None:
    axes.set_title("What the twin feels", loc="left", fontsize=10)
    names = [f.name for f in felt]
    at = np.arange(len(felt))
    axes.barh(at + 0.2, [f.rms for f in felt], 0.38, color=_AFTER, label="vertical acceleration, rms")
    axes.barh(
        at - 0.2,
        [f.difference for f in felt],
        0.38,
        color=_GAUSS,
        label="difference from what is written, rms",
    )
    axes.set_yticks(at, names)
    axes.invert_yaxis()
    axes.set_xlabel("[m/s²]")
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.4, -0.2), ncols=1)
    axes.grid(alpha=0.25, axis="x")
