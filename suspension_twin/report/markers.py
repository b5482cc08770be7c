# SPDX-License-Identifier: Apache-2.0
"""Pictures of marker runs: Figs 7 to 13 of the tracked paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from suspension_twin.arrays import Floats
from suspension_twin.inference.marker_runs import MARKERS, MarkerRun
from suspension_twin.report import style

__all__ = ["damping_picture", "marker_figure", "marker_pictures"]

_KINDS = (
    ("markers", "displacement, mm", 1e3),
    ("velocity", "velocity, m/s", 1.0),
    ("acceleration", "acceleration, m/s²", 1.0),
)
_ROLES = ("simulated", "mark", "before", "extra")


def marker_figure(measured: MarkerRun, simulated: Mapping[str, MarkerRun], kind: str, marker: int) -> Figure:
    """One of Figs 7 to 12: ``kind`` "markers", "velocity" or "acceleration" of marker 0 (A), 1 (B) or 2 (C)."""
    _, label, unit = next(k for k in _KINDS if k[0] == kind)
    with style.drawing(7.2, 3.2) as (fig, axes):
        values = unit * getattr(measured, kind)[:, marker]
        axes.plot(measured.t, values, color=style.colour("measured"), label="measured")
        for role, (name, run) in zip(_ROLES, simulated.items(), strict=False):
            axes.plot(
                run.t,
                unit * getattr(run, kind)[:, marker],
                color=style.colour(role),
                linewidth=1.3,
                label=name,
            )
        axes.set(
            xlabel="time, s",
            ylabel=label,
            title=f"Marker {MARKERS[marker]} at {3.6 * measured.speed:.0f} km/h",
        )
        axes.legend()
    return fig


def marker_pictures(measured: MarkerRun, simulated: Mapping[str, MarkerRun], folder: Path) -> list[Path]:
    """Figs 7 to 12 as ``fig07.png`` to ``fig12.png`` in ``folder``, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, (kind, marker) in enumerate((kind[0], marker) for kind in _KINDS for marker in (0, 1)):
        paths.append(folder / f"fig{7 + i:02d}.png")
        style.save(marker_figure(measured, simulated, kind, marker), paths[-1])
    return paths


def damping_picture(speeds: Sequence[float], dampings: Sequence[float], table: Floats) -> Figure:
    """Fig. 13: variance of the pitch (dampings, speeds) in rad² over km/h; logarithmic, since the undamped
    curve lies far above the others."""
    with style.drawing(8.0, 4.6) as (fig, axes):
        for i, damping in enumerate(dampings):
            label = f"{i + 1}: {damping:,.0f}".replace(",", " ")
            axes.plot(
                speeds,
                1e4 * table[i],
                marker="o",
                markersize=3,
                linewidth=2.4 if i == 3 else 1.2,
                color=style.colour("ink") if i == 6 else None,
                label=label,
            )
        axes.set_yscale("log")
        low, high = 1e4 * np.nanmin(table), 1e4 * np.nanmax(table)
        ticks = [t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if 0.7 * low < t < 1.5 * high]
        axes.set_yticks(ticks, [f"{v:g}" for v in ticks])
        axes.minorticks_off()
        axes.set(
            xlabel="speed, km/h",
            ylabel="variance of the pitch, 10⁻⁴ rad²",
            title="Variance of the pitch over speed, by damping in N m s/rad",
        )
        axes.legend(ncols=2)
    return fig
