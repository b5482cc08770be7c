# SPDX-License-Identifier: Apache-2.0
"""Pictures and pages of a tracked vehicle: Figs 7 to 13 of the tracked paper, calibration and diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from suspension_twin.arrays import Floats
from suspension_twin.calibration.tracked_paper import PUBLISHED, PUBLISHED_CORRELATION, TrackedResult, compare
from suspension_twin.diagnosis.tracked import TrackedDiagnosis
from suspension_twin.gap.marker_runs import MARKERS, MarkerRun
from suspension_twin.report import style
from suspension_twin.report.page import Cell, Mark, Page, Section, Table

__all__ = ["calibration_page", "damping_picture", "diagnosis_page", "marker_figure", "marker_pictures"]

_KINDS = (
    ("markers", "displacement, mm", 1e3),
    ("velocity", "velocity, m/s", 1.0),
    ("acceleration", "acceleration, m/s²", 1.0),
)
_ROLES = ("simulated", "mark", "before", "extra")


def marker_figure(measured: MarkerRun, simulated: Mapping[str, MarkerRun], kind: str, marker: int) -> Figure:
    """One of Figs 7 to 12: ``kind`` "markers", "velocity" or "acceleration" of marker 0 (A), 1 (B) or 2 (C)."""
    _, label, unit = next(k for k in _KINDS if k[0] == kind)
    with style.using():
        fig = style.figure(7.2, 3.2)
        axes = fig.subplots()
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
    with style.using():
        fig = style.figure(8.0, 4.6)
        axes = fig.subplots()
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


def calibration_page(
    result: TrackedResult, runs: Sequence[MarkerRun], told: Sequence[MarkerRun], shown: int
) -> Page:
    """The preset's page: what was found, each run's figures, and Figs 7 to 12 of the run number ``shown``."""
    page = Page("Calibration of a tracked vehicle", f"{result.vehicle.name}, objective {result.objective}")
    worth = [compare(a, b) for a, b in zip(runs, told, strict=True)]
    last = worth[shown]
    page.card(
        "Correlation A, B",
        " and ".join(f"{v:.3f}" for v in last.correlation),
        f"{runs[shown].name}; the paper {PUBLISHED_CORRELATION[0]} and {PUBLISHED_CORRELATION[1]}",
    )
    page.card("Residual A, B", " and ".join(f"{100 * v:.1f} %" for v in last.residual), "of the measured rms")
    page.card(
        "Simulated over measured", " and ".join(f"{v:.3f}" for v in last.gain), "rms: what correlation misses"
    )
    rows = [(key, value, PUBLISHED[key]) for key, value in result.values.items()]
    page.add(Section("What was found", "", Table(("parameter", "found", "the paper's"), rows)))
    lines = [
        (r.name, f"{3.6 * r.speed:.1f}", *(float(v) for v in (*w.correlation, *w.residual, *w.gain)), w.late)
        for r, w in zip(runs, worth, strict=True)
    ]
    columns = (
        "run",
        "km/h",
        "corr. A",
        "corr. B",
        "resid. A",
        "resid. B",
        "gain A",
        "gain B",
        "clock offset [s]",
    )
    text = "Correlation does not see amplitude: twice the motion correlates as well. The residual and the gain do."
    page.add(Section("Run by run", text, Table(columns, lines)))
    figures = [
        marker_figure(runs[shown], {"simulated": told[shown]}, kind[0], marker)
        for kind in _KINDS
        for marker in (0, 1)
    ]
    captions = [f"As the paper's Fig. {7 + i}." for i in range(6)]
    return page.add(Section("In time", "", *figures, captions=captions))


_VERDICTS: dict[str, tuple[str, Mark]] = {
    "effect": ("a cause is named", "good"),
    "partly": ("a cause is named, a gap beyond it remains", "warn"),
    "no_gap": ("no gap above noise and model discrepancy", "good"),
    "unknown": ("there is a gap, nothing in the library explains it", "bad"),
}


def diagnosis_page(result: TrackedDiagnosis) -> Page:
    """The answer first, then why, where and each run."""
    d = result.document
    text, mark = _VERDICTS[d["verdict"]]
    page = Page("Diagnosis of a tracked vehicle", ", ".join(r.name for r in result.runs))
    page.card("Verdict", d["verdict"].replace("_", " "), text, mark)
    if d["combination"]:
        page.card("Cause", " + ".join(e.replace("_", " ") for e in d["combination"]))
    page.card("Unexplained", f"{100 * d['unexplained']:.0f} %", "of the gap above the noise")
    page.add(Section("Verdict", f"{d['message'][0].upper()}{d['message'][1:]}.\n\n{d['next_experiment']}"))
    rows = [
        (
            c["effect"].replace("_", " ") + ("" if c["judged"] else " (cannot be judged)"),
            Cell(round(c["probability"], 3), "good" if c["effect"] in d["combination"] else ""),
            f"{c['shrink']:.2f} ({c['shrink_interval'][0]:.2f} to {c['shrink_interval'][1]:.2f})",
            ", ".join(f"{k} {v:.4g}" for k, v in c["parameters"].items()),
            ", ".join(n.replace("_", " ") for n in c["indistinguishable_from"]),
        )
        for c in d["causes"]
    ]
    rows += [
        (name, Cell(round(d[f"{name.replace(' ', '_')}_probability"], 3)), "", "", "")
        for name in ("no gap", "unknown")
    ]
    page.add(Section("Causes", "", Table(("cause", "probability", "shrink", "parameters", "like"), rows)))
    places = [(i["bag"], i["start"], i["end"], i["share"]) for i in d["where"]["time"]]
    if places:
        page.add(Section("Where", "", Table(("run", "from [s]", "to [s]", "share"), places)))
    for run, before, after in zip(result.runs, result.before, result.after, strict=True):
        page.add(Section(f"Run {run.name}", "", _rest(run, before * result.sigma, after * result.sigma)))
    return page


def _rest(run: MarkerRun, before: Floats, after: Floats) -> Figure:
    """The residual of the velocities of A, B and C before and after, m/s."""
    with style.using():
        fig = style.figure(9.2, 4.2)
        rows = fig.subplots(3, 1, sharex=True)
        for k, axes in enumerate(rows):
            axes.plot(run.t, before[:, 3 + k], color=style.colour("before"), label="twin as given")
            axes.plot(run.t, after[:, 3 + k], color=style.colour("simulated"), label="twin with causes")
            axes.set_ylabel(f"{MARKERS[k]}, m/s")
        rows[0].legend(ncols=2)
        rows[2].set_xlabel("time, s")
        rows[0].set_title("Residual of the markers' velocities")
    return fig
