# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis: the answer first, then why, where, how far and what to drive next."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import signal

from suspension_twin.diagnosis.output import values_of
from suspension_twin.diagnosis.request import DiagnosisResult, DriveView
from suspension_twin.report import plots, style
from suspension_twin.report.page import Card, Cell, Mark, Page, Section, Table

__all__ = ["diagnosis_page"]

_VERDICTS: dict[str, tuple[str, Mark]] = {
    "effect": ("a cause is named", "good"),
    "partly": ("a cause is named, a gap beyond it remains", "warn"),
    "no_gap": ("no gap that matters", "good"),
    "unknown": ("there is a gap, nothing in the library explains it", "bad"),
}
_SHOWN_SECONDS = 6.0
_GATES = ("material", "adequate", "plausible")
_REFERENCED = (
    ' What decides is "beyond reference": of all that the recalibrated twin leaves in vertical, roll and pitch above '
    "what the reference drives taught, after the change and before it, the share that the cause takes."
)


def diagnosis_page(result: DiagnosisResult) -> Page:
    """The whole page; ``page.write(path)`` makes the file."""
    d = result.document
    text, mark = _VERDICTS[d["verdict"]]
    page = Page("Diagnosis of the gap", f"{', '.join(v.name for v in result.drives)}")
    lead = d["causes"][0] if d["causes"] else None
    page.cards.append(Card("Verdict", d["verdict"].replace("_", " "), text, mark))
    if d["combination"] and lead is not None:
        share = sum(c["probability"] for c in d["causes"] if c["effect"] in d["combination"])
        names = " + ".join(e.replace("_", " ") for e in d["combination"])
        page.card("Cause", names, f"probability {share:.2f}")
    unit = "rad/s" if d["gap"]["channel"].endswith("rate") else "m/s²"
    page.card(
        "Gap as it stands", f"{d['gap']['rms']:.3g} {unit}", f"floor {d['gap']['noise_rms']:.2g} {unit}"
    )
    page.card(
        "Left unexplained", f"{100 * d['unexplained']:.0f} %", "of the gap above the noise, on unseen road"
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
        f"Recalibration alone, without any effect, takes the gap from {r['gap_before']:.3g} to {r['gap_after']:.3g} "
        f"above the noise ({100 * r['shrink']:.0f} %).",
    ]
    left = f"What is written to twin.yaml misses {100 * b['share_of_motion_left']:.0f} % of the motion's rms"
    if b["share_left_on_reference"] is not None:
        left += (
            f"; on the reference drives the same car is missed by {100 * b['share_left_on_reference']:.0f} %"
        )
    lines.append(left + ".")
    if d["cannot_be_judged"]:
        weak = ", ".join(e.replace("_", " ") for e in d["cannot_be_judged"])
        lines.append(f"**Cannot be judged**, as the drives do not excite them: {weak}.")
    return Section("The answer", "\n\n".join(lines))


def _causes(d: dict[str, Any]) -> Section:
    rows = []
    referenced = d["background"]["share_left_on_reference"] is not None
    tied = any(c["indistinguishable_from"] for c in d["causes"])
    for c in d["causes"]:
        gates = c["gates"]
        low, high = c["shrink_interval"]
        rows.append(
            (
                c["effect"].replace("_", " ") + ("" if c["judged"] else " (cannot be judged)"),
                Cell(round(c["probability"], 3), "good" if c["effect"] in d["combination"] else ""),
                f"{c['shrink']:.2f} ({low:.2f} to {high:.2f})".replace("-", "\N{MINUS SIGN}"),
                round(c["shrink_beyond_recalibration"], 2),
                *([round(c["shrink_beyond_reference"], 2)] if referenced else []),
                *(Cell(round(gates[g], 2), "" if gates[g] > 0.5 else "warn") for g in _GATES),
                values_of(c),
                *([", ".join(e.replace("_", " ") for e in c["indistinguishable_from"])] if tied else []),
            )
        )
    columns = (
        "cause",
        "probability",
        "shrink",
        "beyond recalibration",
        *(["beyond reference"] if referenced else []),
        "material",
        "adequate",
        "plausible",
        "parameters",
        *(["like"] if tied else []),
    )
    for name, key in (("no gap", "no_gap_probability"), ("unknown", "unknown_probability")):
        rows.append((name, Cell(round(d[key], 3)), *[""] * (len(columns) - 2)))
    return Section(
        "Which",
        "Every effect was fitted together with the characteristics, the clocks, the map, the tilt and the biases. A "
        "cause is named if it is material (a tenth of some channel's gap), adequate (what is left is what a sound "
        "model leaves) and plausible (inside its prior and the same on every stretch). The shrinks are of the vertical "
        "acceleration alone, with the calibration and beyond it: what shows in roll or braking may have none."
        + (_REFERENCED if referenced else ""),
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
        "What recalibration leaves, on stretches that it has not seen: places that hold significantly more of it than "
        "their length asks for.",
        *parts,
    )


def _places(items: list[dict[str, Any]], caption: str, **columns: str) -> Table | None:
    """One kind of place as a table, ``columns`` naming heading and key; None where nothing stands out."""
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
    names = {"before": "as it stands", "simulated": "with what was found"}
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
        f, densities, names={"before": "gap as it stands", "residual": "gap with what was found"}
    )
    captions = ("The worst seconds.", "The gap over frequency.")
    return Section(f"Drive {view.name}", "", figure, spectrum, captions=captions)


def _signature(s: dict[str, Any]) -> Section:
    channel = s["channel"].replace("_", " ")
    lines = [f"- band {s['low_hz']} to {s['high_hz']} Hz, strongest at {s['peak_hz']} Hz ({channel})"]
    if "in_space" in s:
        lines.append(f"- the same place on the road on every pass: correlation {s['in_space']}")
    if "goes_with" in s:
        lines.append(f"- goes with {s['goes_with']['what']} (correlation {s['goes_with']['correlation']})")
        lines.append(f"- a loop over travel: {s['hysteresis']} correlated with the sign of the velocity")
    for key, value in s.items():
        if key.startswith("triggers_above"):
            lines.append(f"- appears above a {key.rsplit('_', 1)[1]} of {value['value']} {value['unit']}")
    if "periodic" in s:
        p = s["periodic"]
        every = f"every {p['every_m']:.3g} m of the way" if "every_m" in p else f"at {p['hz']:.3g} Hz"
        channel = p["channel"].replace("_", " ")
        lines.append(f"- comes again {every}: {100 * p['share']:.0f} % of what is left of the {channel}")
    if "stretch" in s:
        there = s["stretch"]
        lines.append(
            f"- on every pass {100 * there['share']:.0f} % of it lies from {there['start_m']:.0f} to "
            f"{there['end_m']:.0f} m of the road, which holds less of the motion: "
            "its file is wrong there, or something acts that only this place sets off"
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
    return Section("What the rest looks like", "\n".join(lines))


def _how(d: dict[str, Any]) -> Section:
    return Section(
        "How this was found",
        "The gap before is that of the twin as it stands, the gap after that of the written twin, its clock, map and "
        "biases as the file has them; both on stretches of road that the fit has not seen. Probabilities come from "
        "held-out stretches weighed anew many times; what the model misses anyway counts as little new evidence from "
        f"sample to sample (factor {d['background']['noise_share_of_the_rest']:.2g}). Seed {d['seed']}.",
    )
