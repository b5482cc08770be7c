# SPDX-License-Identifier: Apache-2.0
"""The page of a plan: smallest sizes of effects that a set-up could show, and pairs that it could not separate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from suspension_twin.addons.plan.plan import APART, DETECTABLE, Detectability, Pair, Plan
from suspension_twin.diagnosis import wording
from suspension_twin.report import style
from suspension_twin.report.page import Cell, Lead, Mark, Page, Section, Table
from suspension_twin.report.style import COLOURS
from suspension_twin.vehicle.corners import WHEELS

__all__ = ["plan_page", "size_text", "sizes_picture"]

_NEVER = "never"
#: Sizes of two places are shown as one up to this factor.
_NEAR = 1.25


def plan_page(plan: Plan) -> Page:
    """Make the page of a plan: smallest sizes that show, pairs that look alike, and changes that would separate them.

    Parameters
    ----------
    plan : Plan
        Result of :func:`~suspension_twin.addons.plan.plan.plan`.

    Returns
    -------
    Page
        ``write(path)`` saves it as one HTML file without scripts and links.

    Examples
    --------
    >>> plan_page(found).write("plan.html")  # doctest: +SKIP
    PosixPath('plan.html')
    """
    drives = wording.listed([f"{kmh:g} km/h" for kmh in plan.speeds])
    name = getattr(plan.twin.vehicle, "name", "") or "the vehicle"
    page = Page("What these drives could show", f"{name}, {plan.road} at {drives}")
    hidden = [s for s in plan.detectability if s.size is None]
    seen = len(plan.detectability) - len(hidden)
    remarks = []
    if hidden:
        names = list(dict.fromkeys(wording.effect_name(s.effect) for s in hidden))
        remarks.append(f"Not at any plausible size: {wording.listed(names)}.")
    never = [
        f"{wording.effect_name(p.effect)} from {wording.effect_name(p.rival)}"
        for p in plan.pairs
        if p.size is None
    ]
    if never:
        remarks.append(f"Never told apart: {'; '.join(never)}.")
    page.lead = Lead(
        f"{seen} of {len(plan.detectability)} faults would show; {len(plan.pairs)} pairs of causes are easily taken "
        "for each other.",
        remarks,
    )
    page.add(
        Section(
            "From which size on",
            "The smallest size that a diagnosis would name, beside the typical size of the fault. Left of the line, "
            "less than a typical fault is enough.",
            sizes_picture(plan.detectability),
        )
    )
    page.add(_pairs(plan))
    page.add(
        Section(
            "How alike they are",
            "Degrees between the residual of a cause (row) after recalibration and the nearest response of a rival "
            "(column): 90 is nothing in common, below about 20 they look alike.",
            _matrix(plan),
        )
    )
    columns = ("fault", "quantity", "shows from", "typical", "first in")
    page.add(Section("Every size", "", Table(columns, [_row(s) for s in plan.detectability]), folded=True))
    page.add(_method(plan))
    return page


def size_text(shown: Detectability, size: float | None) -> str:
    """A size with its unit; ``never`` for None. A change from neutral has a sign, a value has none."""
    if size is None:
        return _NEVER
    text = wording.parameter_value(shown.effect, shown.parameter, size)
    if shown.largest < shown.typical:
        return f"{text} and below"
    return text


def _row(s: Detectability) -> tuple[object, ...]:
    mark: Mark = "bad" if s.size is None else "good" if _less(s) <= 0.0 else "warn"
    return (
        wording.capital(wording.effect_at(s.effect, s.place)),
        wording.parameter_name(s.effect, s.parameter),
        Cell(size_text(s, s.size), mark),
        size_text(s, s.typical),
        "" if s.size is None else wording.channel_name(s.channel),
    )


def _less(s: Detectability) -> float:
    """Decades by which the smallest size is more severe than a typical one."""
    assert s.size is not None
    return float(np.log10(s.size / s.typical)) * (1.0 if s.largest >= s.typical else -1.0)


def _alike(shown: Sequence[Detectability]) -> list[list[Detectability]]:
    """Places of one effect at which it shows from about the same size on, the one that shows least first."""
    groups: list[list[Detectability]] = []
    for s in sorted(shown, key=lambda s: (s.effect, s.parameter, s.size is None, -(s.size or 0.0))):
        last = groups[-1][0] if groups else None
        same = last is not None and (last.effect, last.parameter) == (s.effect, s.parameter)
        near = same and last is not None and (last.size is None) == (s.size is None)
        if near and last is not None and (last.size is None or s.size is None or last.size <= _NEAR * s.size):
            groups[-1].append(s)
        else:
            groups.append([s])
    return groups


def _places(group: Sequence[Detectability]) -> str:
    """Name of an effect with those of its places."""
    if len(group) >= len(WHEELS):
        return f"{wording.effect_name(group[0].effect)}, any wheel"
    names = [wording.effect_at(s.effect, s.place).partition(", ")[2] for s in group]
    return wording.effect_name(group[0].effect) + (f", {wording.listed(names)}" if names[0] else "")


def sizes_picture(shown: Sequence[Detectability]) -> Figure:
    """Draw a row for every fault: the smallest size over the typical one; places of about one size share a row."""
    groups = sorted(
        _alike(shown), key=lambda g: (g[0].size is None, 0.0 if g[0].size is None else _less(g[0]))
    )
    rows = [group[0] for group in groups]
    with style.drawing(9.2, 0.9 + 0.2 * len(rows)) as (fig, axes):
        values = [10.0 ** _less(s) if s.size is not None else np.nan for s in rows]
        known = [v for v in values if np.isfinite(v)]
        right = 2.0 * max([*known, 3.0])
        left = 0.5 * min([*known, 0.3])
        for place, (s, value) in enumerate(zip(rows, values, strict=True)):
            if s.size is None:
                axes.plot(right / 1.3, place, marker="x", color=COLOURS["simulated"], markersize=6)
                continue
            role = "truth" if value <= 1.0 else "mark"
            axes.hlines(place, left, value, color=COLOURS["grid"], linewidth=1.2, zorder=1)
            axes.plot(value, place, marker="o", color=COLOURS[role], markersize=5.5)
            axes.annotate(
                size_text(s, s.size),
                (value, place),
                xytext=(7, 0),
                textcoords="offset points",
                va="center",
                fontsize=7.5,
                color=COLOURS["soft"],
            )
        axes.axvline(1.0, color=COLOURS["soft"], linewidth=0.9, linestyle=":")
        names = [f"{_places(g)}: {wording.parameter_name(g[0].effect, g[0].parameter)}" for g in groups]
        axes.set_yticks(range(len(rows)), names, fontsize=8)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xscale("log")
        axes.set_xlim(left, right)
        axes.set_xlabel("smallest size that shows, over the typical size (cross: never)")
        axes.grid(visible=False, axis="y")
    return fig


def _pairs(plan: Plan) -> Section:
    rows = [
        (
            wording.capital(wording.effect_name(p.effect)),
            wording.effect_name(p.rival),
            round(p.angle),
            Cell(size_text(p.shown, p.size), "bad" if p.size is None else "warn"),
            size_text(p.shown, p.shown.size),
            _remedy(p),
        )
        for p in plan.pairs
    ]
    text = (
        "Each cause on the left shows from the size in the fifth column on, but up to the size in the fourth one it "
        "may be called the cause beside it. Other speeds, places of the sensor and obstacles were tried."
    )
    if not rows:
        return Section(
            "What looks alike", "Whatever shows can be distinguished from every other cause in the library."
        )
    columns = ("cause", "taken for", "angle [°]", "told apart from", "shows from", "what separates them")
    return Section("What looks alike", text, Table(columns, rows))


def _remedy(p: Pair) -> str:
    if not p.remedy:
        return "nothing that was tried"
    if p.remedy_size == p.shown.size:
        return f"{p.remedy}: as soon as it shows"
    return f"{p.remedy}: from {size_text(p.shown, p.remedy_size)}"


def _matrix(plan: Plan) -> Figure:
    """The angles as a picture, without effects that do not show."""
    rows = [i for i, row in enumerate(plan.angles) if np.isfinite(row).any()]
    with style.drawing(9.2, 2.2 + 0.24 * len(rows)) as (fig, axes):
        angles = plan.angles[rows]
        image = axes.imshow(angles, cmap="RdYlGn", vmin=0.0, vmax=90.0, aspect="auto")
        for y, row in enumerate(angles):
            for x, value in enumerate(row):
                if np.isfinite(value) and value < 45.0:
                    axes.text(x, y, f"{value:.0f}", ha="center", va="center", fontsize=7, color="#1C2128")
        names = [wording.effect_name(e) for e in plan.effects]
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7.5)
        axes.set_yticks(range(len(rows)), [names[i] for i in rows], fontsize=7.5)
        axes.grid(visible=False)
        fig.colorbar(image, ax=axes, label="angle [°]", shrink=0.8, pad=0.01)
    return fig


def _method(plan: Plan) -> Section:
    seconds = wording.listed(
        [f"{s:.0f} s at {v:g} km/h" for s, v in zip(plan.seconds, plan.speeds, strict=True)]
    )
    return Section(
        "Method",
        f"Nothing was measured. The twin was simulated over the road ({seconds}) with a phone's noise and an RTK "
        "receiver, and so were small and large sizes of every effect. The part that the parameters of the "
        "vehicle and the nuisance parameters (clock, map, mount, biases) can compensate is projected off; the rest "
        "counts in units of noise and model discrepancy, in the channel and drive where it is largest.\n\n"
        f"A fault shows from {DETECTABLE:g} of these units on, and a pair is distinguished where the rival leaves "
        f"{APART:g}: figures learnt on diagnoses with sealed labels (`benchmarks/plan_confusion.py`). They hold for "
        "single faults on a road like those; a real diagnosis says what its own drives could show.",
        folded=True,
    )
