# SPDX-License-Identifier: Apache-2.0
"""Pictures of estimated roads: of one from drives with its intervals, and of one from a scan before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from suspension_twin.addons.roads.drives.estimate import SEEN_BAND, STEP, RoadEstimate
from suspension_twin.addons.roads.drives.passes import banded
from suspension_twin.addons.roads.scan.response import RoadResponse
from suspension_twin.addons.roads.scan.scan import HOLE, ScannedRoad
from suspension_twin.arrays import Floats
from suspension_twin.report import style
from suspension_twin.road.check import wheel_paths
from suspension_twin.road.plots import check_picture
from suspension_twin.road.road import Road

__all__ = ["estimate_figure", "save_picture", "scan_figure"]

_BLUE, _ORANGE, _GREY, _TRUTH = "#1f6fb2", "#d1661c", "#8a929b", "#22262b"
_NINETY = 1.645  # standard deviations of a 90 % interval
_ZOOM = 6.0  # m of a wheel path that are shown
_SMALL = {"frameon": False, "fontsize": 8}


def save_picture(figure: Figure, path: str | Path) -> None:
    """Write a figure as .png, .svg or .pdf. Raises InputError, WorkError."""
    check_picture(path)
    style.save(figure, path, dpi=130)


def _label(axes: Axes, title: str, x: str = "", y: str = "") -> None:
    """Title, labels and grid."""
    axes.set_title(title, loc="left", fontsize=10)
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.25)


def _banded_line(axes: Axes, u: Floats, z: Floats, sigma: Floats, colour: str, label: str) -> None:
    """Heights in mm with their 90 % interval."""
    band = _NINETY * sigma
    axes.fill_between(u, 1e3 * (z - band), 1e3 * (z + band), color=colour, alpha=0.25, lw=0)
    axes.plot(u, 1e3 * z, color=colour, lw=1.0, label=label)


def estimate_figure(found: RoadEstimate, truth: Floats | None = None) -> Figure:
    """Heights of the waves between 0.5 and 10 m, and errors by wavelength; ``truth`` (2, n) m, if it is known."""
    figure = Figure(figsize=(12.0, 7.5), layout="constrained")
    left, right, bars = figure.subplots(3, 1, height_ratios=[1.0, 1.0, 1.1])
    k = found.covered
    u = found.profiles.u[k] - found.profiles.u[k][0]
    heights, sigma = banded(found.profiles.middle, STEP, *SEEN_BAND)[:, k], found.sigma()[:, k]
    true = None if truth is None else banded(truth, STEP, *SEEN_BAND)[:, k]
    for i, (side, axes, colour) in enumerate((("Left", left, _BLUE), ("Right", right, _ORANGE))):
        _banded_line(axes, u, heights[i], sigma[i], colour, "from drives, with its 90 % interval")
        if true is not None:
            axes.plot(u, 1e3 * true[i], color=_TRUTH, lw=0.7, label="truth")
        _label(axes, f"{side} wheel path, waves between 0.5 and 10 m", "u [m]" if i else "", "height [mm]")
        axes.margins(x=0.0)
        axes.legend(loc="upper right", **_SMALL)
    bands = found.by_wavelength()
    at = np.arange(len(bands))
    bars.bar(at - 0.2, [1e3 * b["rms"] for b in bands], 0.4, color=_GREY, label="height rms")
    bars.bar(at + 0.2, [1e3 * b["sigma"] for b in bands], 0.4, color="#c2185b", label="its uncertainty")
    bars.set_yscale("log")
    bars.set_xticks(at, [f"{b['shortest']:.3g} to {b['longest']:.3g} m" for b in bands])
    _label(bars, "By wavelength", y="[mm]")
    bars.legend(**_SMALL)
    return figure


def scan_figure(found: ScannedRoad, responses: Sequence[RoadResponse]) -> Figure:
    """Cells before and the road after, short waves only; the left wheel path where it is roughest; the responses."""
    figure = Figure(figsize=(12.0, 10.0), layout="constrained")
    grid = figure.add_gridspec(4, 2, height_ratios=[1.0, 1.0, 1.0, 1.2], width_ratios=[1.5, 1.0])
    level = _level(found.edges)
    shown = 1e3 * (found.edges.z - level)
    limit = float(np.nanquantile(np.abs(shown), 0.995)) if np.isfinite(shown).any() else 1.0
    sigma = np.where(found.status == HOLE, np.nan, 1e3 * found.surface.sigma)
    most = float(np.nanquantile(sigma, 0.99))
    before = "Before: mean of the ground points about each node, long waves taken out"
    spread = "Uncertainty (standard deviation); holes are grey"
    for i, (values, limits, colours, title) in enumerate(
        (
            (1e3 * (found.cells.z - level), (-limit, limit), "viridis", before),
            (1e3 * (found.road.z - level), (-limit, limit), "viridis", "After: the road that is written"),
            (sigma, (0.0, most), "magma", spread),
        )
    ):
        axes = figure.add_subplot(grid[i, :])
        axes.set_facecolor("#d5d8db")
        axes.set_title(title, loc="left", fontsize=10)
        axes.set(ylabel="v [m]", xlabel="u [m]" if i == 2 else "")
        road = found.road
        image = axes.imshow(
            values[:: max(1, values.shape[0] // 2400)].T,
            origin="lower",
            aspect="auto",
            extent=(road.u_first, road.u_last, float(road.v[0]), float(road.v[-1])),
            cmap=colours,
            vmin=limits[0],
            vmax=limits[1],
            interpolation="nearest",
        )
        figure.colorbar(image, ax=axes, pad=0.01, label="[mm]")
    _wheel_path(figure.add_subplot(grid[3, 0]), found)
    bars = figure.add_subplot(grid[3, 1])
    at = np.arange(len(responses))
    for offset, name, colour, label in (
        (0.2, "rms", _BLUE, "vertical acceleration, rms"),
        (-0.2, "difference", _ORANGE, "difference from what is written, rms"),
    ):
        bars.barh(at + offset, [getattr(r, name) for r in responses], 0.38, color=colour, label=label)
    bars.set_yticks(at, [r.name for r in responses])
    bars.invert_yaxis()
    _label(bars, "Response of the twin", "[m/s²]")
    bars.legend(loc="upper center", bbox_to_anchor=(0.4, -0.2), ncols=1, **_SMALL)
    return figure


def _level(road: Road) -> Floats:
    """The long waves of a road (nu, 1): the running mean over 5 m of its cross sections."""
    known = np.isfinite(road.z)
    row = np.where(known, road.z, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return uniform_filter1d(row, max(3, round(5.0 / road.u_step)), mode="nearest")[:, None]


def _wheel_path(axes: Axes, found: ScannedRoad) -> None:
    """The left wheel path where it is roughest, under each filter."""
    (left, _), z, _ = wheel_paths(found.edges)
    j, u = int(np.abs(found.edges.v - left).argmin()), found.edges.u
    slope = np.abs(np.gradient(np.nan_to_num(z - z.mean())))
    rough = uniform_filter1d(slope, max(3, round(1.0 / found.edges.u_step)))
    k = np.abs(u - float(u[int(rough.argmax())])) < 0.5 * _ZOOM
    edges, gaussian, cells = (road.z[k, j] for road in (found.edges, found.gaussian, found.cells))
    base = float(np.nanmean(edges))
    axes.plot(u[k], 1e3 * (cells - base), ".", color=_GREY, ms=3, label="cells")
    axes.plot(u[k], 1e3 * (gaussian - base), color=_ORANGE, lw=1.2, label="Gaussian")
    _banded_line(axes, u[k], edges - base, found.surface.sigma[k, j], _BLUE, "edge-preserving")
    title = f"Left wheel path, v = {found.edges.v[j]:.2f} m, where it is roughest"
    _label(axes, title, "u [m]", "height [mm]")
    axes.legend(**_SMALL)
