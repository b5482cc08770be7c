# SPDX-License-Identifier: Apache-2.0
"""A picture of a road from drives: both wheel paths with their 90 % intervals, and the uncertainty by wavelength."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from suspension_twin.addons.roads.drives.alignment import banded
from suspension_twin.addons.roads.drives.estimate import SEEN_BAND, STEP, Estimate
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import replacing

__all__ = ["estimate_figure", "save_estimate_picture"]

_LEFT, _RIGHT, _TRUTH = "#1f6fb2", "#d1661c", "#22262b"
_NINETY = 1.645  # standard deviations of a 90 % interval


def save_estimate_picture(found: Estimate, path: str | os.PathLike[str], truth: Floats | None = None) -> None:
    """Draw :func:`estimate_figure` into a file (.png, .svg or .pdf). Raises InputError, WorkError."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".png", ".svg", ".pdf"):
        raise InputError(path, "a picture is written as .png, .svg or .pdf; name the file so")
    with replacing(path) as temporary:
        estimate_figure(found, truth).savefig(temporary, dpi=130, facecolor="white", format=suffix[1:])


def estimate_figure(found: Estimate, truth: Floats | None = None) -> Figure:
    """Heights of the waves between 0.5 and 10 m, and errors by wavelength; ``truth`` (2, n) m, if it is known."""
    figure = Figure(figsize=(12.0, 7.5), layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=[1.0, 1.0, 1.1])
    k = found.covered
    u = found.u[k] - found.u[k][0]
    heights, sigma = banded(found.heights, STEP, *SEEN_BAND)[:, k], found.sigma()[:, k]
    true = None if truth is None else banded(truth, STEP, *SEEN_BAND)[:, k]
    for i, (side, colour) in enumerate((("left", _LEFT), ("right", _RIGHT))):
        axes = figure.add_subplot(grid[i])
        axes.fill_between(
            u,
            1e3 * (heights[i] - _NINETY * sigma[i]),
            1e3 * (heights[i] + _NINETY * sigma[i]),
            color=colour,
            alpha=0.25,
            lw=0,
        )
        axes.plot(u, 1e3 * heights[i], color=colour, lw=1.0, label="from drives, with its 90 % interval")
        if true is not None:
            axes.plot(u, 1e3 * true[i], color=_TRUTH, lw=0.7, label="truth")
        axes.set_title(f"{side.capitalize()} wheel path, waves between 0.5 and 10 m", loc="left", fontsize=10)
        axes.set_ylabel("height [mm]")
        axes.margins(x=0.0)
        axes.grid(alpha=0.25)
        axes.legend(loc="upper right", frameon=False, fontsize=8)
    axes.set_xlabel("u [m]")
    bars = figure.add_subplot(grid[2])
    bands = found.by_wavelength()
    at = np.arange(len(bands))
    bars.bar(at - 0.2, [1e3 * b["rms"] for b in bands], 0.4, color="#8a929b", label="height rms")
    bars.bar(at + 0.2, [1e3 * b["sigma"] for b in bands], 0.4, color="#c2185b", label="its uncertainty")
    bars.set_yscale("log")
    bars.set_xticks(at, [f"{b['shortest']:.3g} to {b['longest']:.3g} m" for b in bands])
    bars.set_ylabel("[mm]")
    bars.set_title("By wavelength", loc="left", fontsize=10)
    bars.legend(frameon=False, fontsize=8)
    bars.grid(alpha=0.25, axis="y")
    return figure
