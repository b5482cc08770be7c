# SPDX-License-Identifier: Apache-2.0
"""The picture of ``multibody.py``: the car and the twin over a bump and a hump, and how much is left, by band."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.report import style

__all__ = ["draw"]

_STRETCHES = (
    ("a bump of 5 cm", 38.5, 47.0),
    ("a hump of 9 cm, under power", 82.0, 98.0),
    ("braking", 129.0, 143.0),
)
_TRACES = (
    ("vertical acceleration", 0, "m/s²", 1.0),
    ("pitch", 0, "mrad", 1e3),
    ("front suspension travel", 0, "mm", 1e3),
    ("front tyre load", 0, "kN", 1e-3),
    ("rear tyre load", 0, "kN", 1e-3),
)
_BARS = (
    "vertical acceleration",
    "roll rate",
    "pitch rate",
    "longitudinal acceleration",
    "lateral acceleration",
    "front suspension travel",
    "rear suspension travel",
    "front tyre load",
    "rear tyre load",
)


def draw(figures: dict[str, Any], shown: dict[str, Any], path: Path) -> None:
    """Write the picture; ``shown`` holds the signals of drive_fast under both twins, and where they were."""
    with style.using():
        fig = style.figure(13.0, 13.5)
        top, bottom = fig.subfigures(2, 1, squeeze=False, height_ratios=[2.2, 1.0])[:, 0]
        axes = top.subplots(
            len(_TRACES), len(_STRETCHES), sharex="col", sharey="row", width_ratios=[1.0, 1.4, 1.2]
        )
        for column, (title, low, high) in enumerate(_STRETCHES):
            axes[0, column].set_title(title)
            axes[-1, column].set_xlabel("front axle along the road, m")
            for row, (name, place, unit, factor) in enumerate(_TRACES):
                _trace(axes[row, column], shown, name, place, factor, low, high)
                if column == 0:
                    axes[row, 0].set_ylabel(
                        f"{name.replace('suspension ', '').replace(' acceleration', '')}, {unit}"
                    )
        handles, labels = axes[0, 0].get_legend_handles_labels()
        top.legend(handles, labels, loc="outside upper right", ncols=3)
        title = "A multibody car and its twin at 40 km/h, on a drive that the calibration has not seen"
        top.suptitle(title, x=0.01, ha="left")
        _shares(bottom.subplots(1, 2, sharey=True), figures)
        style.save(fig, path, dpi=110)


def _trace(
    axes: Any, shown: dict[str, Any], name: str, place: int, factor: float, low: float, high: float
) -> None:
    both, u = shown["calibrated"]
    given, v = shown["given"]
    here, there = (u > low) & (u < high), (v > low) & (v < high)
    truth = both[name].truth[:, place]
    level = np.median(truth)
    axes.plot(
        u[here], factor * (truth[here] - level), color=style.colour("measured"), lw=1.8, label="multibody car"
    )
    old, new = given[name].twin[:, place], both[name].twin[:, place]
    axes.plot(
        v[there],
        factor * (old[there] - np.median(old)),
        color=style.colour("before"),
        lw=0.9,
        ls="--",
        label="twin as given",
    )
    axes.plot(
        u[here],
        factor * (new[here] - np.median(new)),
        color=style.colour("simulated"),
        lw=1.2,
        label="twin, calibrated on another drive",
    )
    axes.margins(x=0)


def _shares(axes: Any, figures: dict[str, Any]) -> None:
    """What is left of every signal as a share of its rms: over all, then by band."""
    rows = figures["drives"]["drive_fast"]
    y = np.arange(len(_BARS))[::-1]
    for offset, label, role in ((0.2, "given", "before"), (-0.2, "calibrated", "simulated")):
        values = [rows[label]["signals"][name]["share"] for name in _BARS]
        axes[0].barh(y + offset, np.minimum(values, 1.5), 0.38, color=style.colour(role))
        for at, value in zip(y + offset, values, strict=True):
            axes[0].text(min(value, 1.5) + 0.01, at, f"{value:.2f}", va="center", fontsize=8)
    axes[0].set_yticks(y, _BARS)
    axes[0].set_title("Share of each signal that is left, given and calibrated")
    axes[0].margins(x=0.08)
    bands = rows["calibrated"]["signals"][_BARS[0]]["bands"]
    table = np.array([[b["share"] for b in rows["calibrated"]["signals"][name]["bands"]] for name in _BARS])
    extent = (-0.5, len(bands) - 0.5, -0.5, len(_BARS) - 0.5)
    axes[1].imshow(table, cmap="YlOrRd", vmin=0, vmax=1, aspect="auto", extent=extent)
    axes[1].set_xticks(range(len(bands)), [f"{b['low_hz']:g} to {b['high_hz']:g} Hz" for b in bands])
    axes[1].grid(False)
    axes[1].set_title("The same, calibrated, by frequency")
    for at, row in zip(y, table, strict=True):
        for k, value in enumerate(row):
            ink = "white" if value > 0.65 else "black"
            axes[1].text(k, at, f"{value:.2f}", ha="center", va="center", fontsize=8.5, color=ink)
