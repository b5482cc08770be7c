# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis: the verdict first, then causes, localisation, residuals and the next experiment."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import signal

from suspension_twin.diagnosis.output import values_of
from suspension_twin.diagnosis.request import DiagnosisResult, DriveView
from suspension_twin.gap.measure import channel_unit
from suspension_twin.report import plots, style
from suspension_twin.report.page import Card, Cell, Mark, Page, Section, Table

__all__ = ["diagnosis_page"]

_VERDICTS: dict[str, tuple[str, Mark]] = {
    "effect": ("a cause is named", "good"),
    "partly": ("a cause is named, a gap beyond it remains", "warn"),
    "no_gap": ("no gap above noise and model discrepancy", "good"),
    "unknown": ("there is a gap, nothing in the library explains it", "bad"),
}
_SHOWN_SECONDS = 6.0


def diagnosis_page(result: DiagnosisResult) -> Page:
    """Make the page of a diagnosis: answer, causes, where, drives, next experiment.

    Parameters
    ----------
    result : DiagnosisResult
        What :func:`~suspension_twin.diagnosis.run.diagnose` returned.

    Returns
    -------
    Page
        ``write(path)`` saves it as one HTML file without scripts and links.

    Examples
    --------
    >>> diagnosis_page(result).write("report.html")  # doctest: +SKIP
    PosixPath('report.html')
    """
    d = result.document
    text, mark = _VERDICTS[d["verdict"]]
    page = Page("Diagnosis of the gap", f"{', '.join(v.name for v in result.drives)}")
    lead = d["causes"][0] if d["causes"] else None
    page.cards.append(Card("Verdict", d["verdict"].replace("_", " "), text, mark))
    if d["combination"] and lead is not None:
        share = sum(c["probability"] for c in d["causes"] if c["effect"] in d["combination"])
        names = " + ".join(e.replace("_", " ") for e in d["combination"])
        page.card("Cause", names, f"probability {share:.2f}")
    unit = channel_unit(d["gap"]["channel"])
    page.card(
        "Gap of the twin as given",
        f"{d['gap']['rms']:.3g} {unit}",
        f"floor {d['gap']['noise_rms']:.2g} {unit}",
    )
    page.card(
        "Unexplained", f"{100 * d['unexplained']:.0f} %", "of the gap above the noise, on held-out road"
    )
    page.add(_answer(d))
    page.add(_causes(d))
    page.add(_where(d))
    for view in result.drives:
        page.add(_drive(view, d))
    page.add(Section("What to drive next", d["next_experiment"]))
    if "signature" in d:
        page.add(_signature(d["signature"]))
    if d["warnings"]:
        page.add(Section("Warnings", "\n".join(f"- {w}" for w in d["warnings"])))
    page.add(_how(d))
    return page


def _answer(d: dict[str, Any]) -> Section:
    r, b = d["recalibration"], d["background"]
    lines = [
        d["message"][0].upper() + d["message"][1:] + ".",
        f"Recalibration alone, without any effect, lowers the gap above the noise from {r['gap_before']:.3g} to "
        f"{r['gap_after']:.3g} ({100 * r['shrink']:.0f} %).",
    ]
    text = f"The residual of the written twin.yaml is {100 * b['share_of_motion_left']:.0f} % of the motion's rms"
    if b["share_left_on_reference"] is not None:
        text += f"; on the reference drives it is {100 * b['share_left_on_reference']:.0f} %"
    lines.append(text + ".")
    if d["cannot_be_judged"]:
        weak = ", ".join(e.replace("_", " ") for e in d["cannot_be_judged"])
        lines.append(f"**Cannot be judged**, as the drives do not excite them: {weak}.")
    return Section("Verdict", "\n\n".join(lines))


def _causes(d: dict[str, Any]) -> Section:
    rows = []
    tied = any(c["indistinguishable_from"] for c in d["causes"])
    for c in d["causes"]:
        low, high = c["shrink_beyond_recalibration_interval"]
        rows.append(
            (
                c["effect"].replace("_", " ") + ("" if c["judged"] else " (cannot be judged)"),
                Cell(round(c["probability"], 3), "good" if c["effect"] in d["combination"] else ""),
                c["channel"].replace("_", " "),
                f"{c['shrink_beyond_recalibration']:.2f} ({low:.2f} to {high:.2f})".replace(
                    "-", "\N{MINUS SIGN}"
                ),
                round(c["shrink"], 2),
                values_of(c),
                *([", ".join(e.replace("_", " ") for e in c["indistinguishable_from"])] if tied else []),
            )
        )
    columns = (
        "cause",
        "probability",
        "channel",
        "shrink beyond recalibration",
        "shrink in all",
        "parameters",
        *(["like"] if tied else []),
    )
    for name, key in (("no gap", "no_gap_probability"), ("unknown", "unknown_probability")):
        rows.append((name, Cell(round(d[key], 3)), *[""] * (len(columns) - 2)))
    return Section(
        "Causes",
        "Every effect was fitted together with the characteristics and the nuisance parameters (clocks, map, tilt, "
        "biases). The channel of a cause is that in which it shrinks the gap most surely; the interval holds 90 %.",
        _bars(d),
        Table(columns, rows),
    )


def _bars(d: dict[str, Any]) -> Figure:
    items = [(c["effect"].replace("_", " "), c["probability"]) for c in d["causes"][:8]]
    items += [("no gap", d["no_gap_probability"]), ("unknown", d["unknown_probability"])]
    with style.using():
        fig = style.figure(9.2, 0.7 + 0.28 * len(items))
        axes = fig.subplots()
        names, values = zip(*reversed(items), strict=True)
        axes.barh(names, values, color=style.colour("simulated"), height=0.6)
        axes.set_xlim(0, 1)
        axes.set_xlabel("probability")
    return fig


def _where(d: dict[str, Any]) -> Section:
    w = d["where"]
    parts = [
        _places(w["time"], "In time", drive="bag", **{"from [s]": "start", "to [s]": "end"}),
        _places(w["road"], "On the road", **{"from [m]": "start_m", "to [m]": "end_m"}),
        _places(w["frequency"], "In frequency", **{"from [Hz]": "low_hz", "to [Hz]": "high_hz"}),
        _places(w["channel"], "By channel, each in units of its noise", channel="name"),
        _places(w["corner"], "By corner", corner="name"),
        _places(
            w["operating_point"],
            "By operating point",
            quantity="quantity",
            **{"from": "low", "to": "high", "": "unit"},
        ),
    ]
    return Section(
        "Where",
        "Where the residual after recalibration is concentrated, on held-out road: each entry holds significantly more "
        "of it than its length does on average.",
        *parts,
    )


def _places(items: list[dict[str, Any]], caption: str, **columns: str) -> Table | None:
    """One kind of entry as a table, ``columns`` naming heading and key; None where there is none."""
    if not items:
        return None
    rows = [[_plain(i[key]) for key in columns.values()] + [i["share"]] for i in items]
    return Table((*columns, "share"), rows, caption)


def _plain(value: object) -> object:
    if isinstance(value, float) and abs(value) > 1e5:
        return f"{value:.2f}"
    return value.replace("_", " ") if isinstance(value, str) else value


def _drive(view: DriveView, d: dict[str, Any]) -> Section:
    rows = np.flatnonzero(view.compared)
    window = max(1, int(_SHOWN_SECONDS * view.rate))
    energy = np.convolve(
        (view.before - view.measured)[rows] ** 2, np.ones(min(window, rows.size)), mode="valid"
    )
    start = int(np.argmax(energy))
    cut = rows[start : start + window]
    label = d["gap"]["channel"].replace("_", " ")
    names = {"before": "twin as given", "simulated": "twin with causes"}
    figure = plots.in_time(
        view.t[cut],
        view.measured[cut],
        view.after[cut],
        before=view.before[cut],
        origin=float(view.t[0]),
        label=label,
        names=names,
    )
    size = min(512, rows.size)
    densities = {}
    for role, series in (
        ("measured", view.measured),
        ("before", view.before - view.measured),
        ("residual", view.after - view.measured),
    ):
        f, densities[role] = signal.welch(series[rows], view.rate, nperseg=size)
    spectrum = plots.in_frequency(
        f, densities, names={"before": "gap, twin as given", "residual": "gap, twin with causes"}
    )
    captions = ("The seconds with the largest gap.", "The gap over frequency.")
    return Section(f"Drive {view.name}", "", figure, spectrum, captions=captions)


def _signature(s: dict[str, Any]) -> Section:
    channel = s["channel"].replace("_", " ")
    lines = [f"- band {s['low_hz']} to {s['high_hz']} Hz, strongest at {s['peak_hz']} Hz ({channel})"]
    if "in_space" in s:
        lines.append(f"- repeats by road position on every pass: correlation {s['in_space']}")
    if "goes_with" in s:
        lines.append(f"- goes with {s['goes_with']['what']} (correlation {s['goes_with']['correlation']})")
        lines.append(f"- a loop over travel: {s['hysteresis']} correlated with the sign of the velocity")
    for key, value in s.items():
        if key.startswith("triggers_above"):
            lines.append(f"- appears above a {key.rsplit('_', 1)[1]} of {value['value']} {value['unit']}")
    if "periodic" in s:
        p = s["periodic"]
        every = f"every {p['every_m']:.3g} m" if "every_m" in p else f"at {p['hz']:.3g} Hz"
        channel = p["channel"].replace("_", " ")
        lines.append(
            f"- periodic {every}: {100 * p['share']:.0f} % of the remaining residual of the {channel}"
        )
    if "stretch" in s:
        there = s["stretch"]
        lines.append(
            f"- on every pass {100 * there['share']:.0f} % of it lies from {there['start_m']:.0f} to "
            f"{there['end_m']:.0f} m of the road, which holds a smaller share of the motion: a local road error, or "
            "something that only this part of the road excites"
        )
        for like in there["resembles"]:
            values = ", ".join(f"{k} {v:.4g}" for k, v in like["parameters"].items())
            lines.append(
                f"- there it is like {like['effect'].replace('_', ' ')} ({values}), which would take "
                f"{100 * like['shrink']:.0f} % of it"
            )
    for like in s.get("resembles", ()):
        values = ", ".join(f"{k} {v:.4g}" for k, v in like["parameters"].items())
        lines.append(
            f"- is like {like['effect'].replace('_', ' ')} ({values}; probability {like['probability']:.2f}): a shape "
            f"that many things have, no cause; with it the gap would shrink by {100 * like['shrink']:.0f} %"
        )
    return Section("Signature of the remaining residual", "\n".join(lines))


def _how(d: dict[str, Any]) -> Section:
    return Section(
        "Method",
        "The gap before is that of the twin as given, the gap after that of the written twin, with the file's clock, "
        "map and biases; both on road that the fit has not used. Probabilities come from cross-validation, its folds "
        "resampled many times. Model discrepancy is correlated from sample to sample: the effective sample size is "
        f"reduced accordingly (factor {d['background']['noise_share_of_residual']:.2g}). Seed {d['seed']}.",
    )
