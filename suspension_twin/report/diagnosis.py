# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis, in the order in which it is asked for.

What is wrong and how sure; what closes the gap, before and after; where it is, in pictures; the likeliest causes; what
to drive next. Everything else is folded away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import signal

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import wording
from suspension_twin.diagnosis.request import DiagnosisResult, DriveView
from suspension_twin.inference.gap import channel_unit
from suspension_twin.report import plots
from suspension_twin.report.car import from_above
from suspension_twin.report.page import Cell, Html, Lead, Mark, Page, Row, Section, Table
from suspension_twin.report.style import COLOURS
from suspension_twin.vehicle.corners import CORNERS

__all__ = ["diagnosis_page"]

_MARKS: dict[str, Mark] = {"effect": "warn", "partly": "warn", "no_gap": "good", "unknown": "bad"}
_SHOWN_SECONDS, _SHOWN_CAUSES = 6.0, 5
_GATES = ("material", "adequate", "plausible")
_REFERENCED = (
    ' The decision uses "beyond reference": the share by which the cause lowers the residual of the recalibrated twin '
    "in vertical acceleration, roll and pitch rate, above the model discrepancy found on the reference drives."
)
_MINUS = "\N{MINUS SIGN}"


def diagnosis_page(result: DiagnosisResult) -> Page:
    """Make the page of a diagnosis: answer, before and after, where, likeliest causes, next drive; details folded.

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
    drives = wording.listed([v.name for v in result.drives] or ["no drive"])
    name = getattr(result.twin.vehicle, "name", "") or "the vehicle"
    page = Page("Diagnosis", f"{name}, {drives}")
    page.lead = Lead(wording.answer(d), wording.remarks(d), _MARKS.get(d["verdict"], ""))
    page.add(_before_and_after(result))
    page.add(_where(result))
    page.add(_likeliest(d))
    page.add(_next(d))
    if d.get("warnings"):
        page.add(Section("Warnings", "\n".join(f"- {w}" for w in d["warnings"])))
    page.add(_all_causes(d))
    page.add(_places(result))
    page.add(_drives(result))
    if "signature" in d:
        page.add(_signature(d["signature"]))
    page.add(_how(d))
    return page


def _channel(view: DriveView, d: Mapping[str, Any]) -> str:
    return view.channel or str(d["gap"]["channel"])


def _closing(d: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The most probable of the causes that the answer names."""
    named = [c for c in d["causes"] if c["effect"] in d["combination"]]
    return max(named, key=lambda c: float(c["probability"]), default=None)


# -- before and after --------------------------------------------------------------------------------


def _before_and_after(result: DiagnosisResult) -> Section:
    d, lead = result.document, _closing(result.document)
    channel = wording.channel_of(d, lead)
    after = "with the cause in it" if lead else "recalibrated"
    if len(d["combination"]) > 1:
        after = "with the causes in it"
    text = (
        f"The gap between twin and car in **{wording.channel_name(channel)}**, above the noise, on road that no fit "
        "has used; and the seconds in which the twin as given is worst."
    )
    bars = _bars(d, lead, channel, after)
    worst = _worst(result.drives)
    if worst is None:
        return Section("Before and after", text, bars)
    view, cut = worst
    drawn = plots.in_time(
        view.t[cut],
        view.measured[cut],
        view.after[cut],
        before=view.before[cut],
        origin=float(view.t[0]),
        label=f"{wording.channel_name(_channel(view, d))} [{channel_unit(_channel(view, d))}]",
        names={"before": "twin as given", "simulated": f"twin {after}"},
    )
    start = float(view.t[cut.start] - view.t[0])
    caption = f"The worst {_SHOWN_SECONDS:.0f} seconds: {view.name}, from {start:.0f} s after its start."
    return Section("Before and after", text, bars, drawn, captions=(caption,))


def _bars(d: Mapping[str, Any], lead: Mapping[str, Any] | None, channel: str, after: str) -> Html:
    """The gap of the twin as given, recalibrated, and with what was found, as bars."""
    r = d["recalibration"]
    before = lead["gap_before"] if lead else r["gap_before"]
    rows = [("twin as given", before, "before")]
    if channel == r.get("channel", d["gap"]["channel"]):
        rows.append(("twin recalibrated", r["gap_after"], "measured" if lead else "simulated"))
    if lead:
        several = len(d["combination"]) > 1
        rows.append(
            (f"twin {after}", before * d["unexplained"] if several else lead["gap_after"], "simulated")
        )
    most = max(max(value for _, value, _ in rows), 1e-12)
    lines = [
        f'<span class="label">{name}</span><span class="track"><span style="width:{100 * max(v, 0.0) / most:.1f}%;'
        f'background:var(--{role})"></span></span><span class="n">{v:.2g} {channel_unit(channel)}</span>'
        for name, v, role in rows
    ]
    return Html(f'<div class="bars">{"".join(lines)}</div>')


def _worst(drives: Sequence[DriveView]) -> tuple[DriveView, slice] | None:
    """The drive and the seconds with the largest gap of the twin as given."""
    best: tuple[float, DriveView, slice] | None = None
    for view in drives:
        rows = np.flatnonzero(view.compared)
        if not rows.size:
            continue
        error = np.zeros(view.t.size)
        error[rows] = (view.before - view.measured)[rows] ** 2
        window = min(max(1, int(_SHOWN_SECONDS * view.rate)), error.size)
        energy = np.convolve(error, np.ones(window), mode="valid")
        start = int(np.argmax(energy))
        if best is None or energy[start] > best[0]:
            best = float(energy[start]), view, slice(start, start + window)
    return None if best is None else best[1:]


# -- where -------------------------------------------------------------------------------------------


def _where(result: DiagnosisResult) -> Section:
    figures: list[Figure | Row] = []
    captions = []
    road = _road_strip(result)
    if road is not None:
        figures.append(road)
        captions.append("Along the road, all drives together; shaded where the gap is concentrated.")
    small, notes = [], []
    spectrum = _spectrum(result)
    if spectrum is not None:
        small.append(spectrum)
        notes.append("By frequency; shaded where the gap is concentrated.")
    car = _car(result)
    if car is not None:
        small.append(car)
        notes.append("By wheel: the share of the gap that goes with its motion.")
    if small:
        figures.append(Row(small, notes))
    return Section("Where the gap is", _sentence(result), *figures, captions=captions)


def _sentence(result: DiagnosisResult) -> str:
    """The largest entry of each kind in words."""
    w, parts = result.document["where"], []
    starts = {v.name: float(v.t[0]) for v in result.drives}
    if w["channel"]:
        first = w["channel"][0]
        name, share = wording.channel_name(first["name"]), wording.percent(first["share"])
        parts.append(f"in {name} ({share} of it, each channel in units of its noise)")
    if w["road"]:
        first = w["road"][0]
        parts.append(f"from {first['start_m']:.0f} to {first['end_m']:.0f} m of the road")
    if w["frequency"]:
        first = w["frequency"][0]
        parts.append(f"between {first['low_hz']:.2g} and {first['high_hz']:.2g} Hz")
    if w["time"]:
        first = w["time"][0]
        since = first["start"] - starts.get(first["bag"], 0.0)
        parts.append(f"{since:.0f} s after the start of {first['bag']}")
    if not parts:
        return "The gap is spread evenly over time, road and frequency."
    return f"What recalibration leaves of the gap is largest {wording.listed(parts)}."


def _road_strip(result: DiagnosisResult) -> Figure | None:
    d = result.document
    if result.twin.road is None or not result.drives:
        return None
    rows = [np.flatnonzero(v.compared) for v in result.drives]
    pairs = list(zip(result.drives, rows, strict=True))
    place = np.concatenate([v.position[r] for v, r in pairs])
    before = np.concatenate([(v.before - v.measured)[r] for v, r in pairs])
    after = np.concatenate([(v.after - v.measured)[r] for v, r in pairs])
    if place.size < 2 or np.ptp(place) < 2.0:
        return None
    channel = _channel(result.drives[0], d)
    fig = plots.residual_by_road(
        place,
        after,
        before=before,
        label=f"gap in {wording.channel_name(channel)},\nrms [{channel_unit(channel)}]",
        names={"before": "twin as given", "residual": "twin as written"},
    )
    _shaded(fig, [(i["start_m"], i["end_m"]) for i in d["where"]["road"]])
    return fig


def _shaded(fig: Figure, spans: Sequence[tuple[float, float]]) -> None:
    for low, high in spans:
        fig.axes[0].axvspan(low, high, color=COLOURS["mark"], alpha=0.16, linewidth=0, zorder=0)


def _spectrum(result: DiagnosisResult) -> Figure | None:
    """The gap over frequency, of all drives."""
    d = result.document
    total: dict[str, Floats] = {}
    frequency: Floats = np.empty(0)
    size = min((int(np.count_nonzero(v.compared)) for v in result.drives), default=0)
    if size < 32:
        return None
    for view in result.drives:
        rows = np.flatnonzero(view.compared)
        for role, series in (
            ("measured", view.measured),
            ("before", view.before - view.measured),
            ("residual", view.after - view.measured),
        ):
            frequency, power = signal.welch(series[rows], view.rate, nperseg=min(512, size))
            weight = rows.size / sum(np.count_nonzero(v.compared) for v in result.drives)
            known = total.get(role)
            if known is None or known.shape == power.shape:
                total[role] = weight * power + (0.0 if known is None else known)
    unit = channel_unit(_channel(result.drives[0], d))
    fig = plots.in_frequency(
        frequency,
        total,
        unit=f"({unit})²/Hz",
        names={"measured": "motion", "before": "gap, as given", "residual": "gap, as written"},
        width=4.6,
    )
    _shaded(fig, [(i["low_hz"], i["high_hz"]) for i in d["where"]["frequency"]])
    return fig


def _car(result: DiagnosisResult) -> Figure | None:
    """The car from above, where the vehicle has four wheels and the gap has corners."""
    d, twin = result.document, result.twin
    shares = {i["name"]: float(i["share"]) for i in d["where"]["corner"] if i["name"] in CORNERS}
    wheels = getattr(twin.vehicle, "wheel_positions", None)
    marked = [
        CORNERS[round(c["parameters"]["corner"])]
        for c in d["causes"]
        if c["effect"] in d["combination"] and 0 <= c["parameters"].get("corner", -1) < len(CORNERS)
    ]
    if wheels is None or wheels.shape != (len(CORNERS), 2) or not (shares or marked):
        return None
    x, y, _ = twin.imu.position
    return from_above(wheels, shares, marked=marked, sensor=(x, y))


def _channels(d: Mapping[str, Any]) -> Table:
    rows = [
        (
            wording.channel_name(name),
            f"{rms:.2g} {channel_unit(name)}",
            next((wording.percent(i["share"]) for i in d["where"]["channel"] if i["name"] == name), ""),
        )
        for name, rms in d["gap"]["channels"].items()
    ]
    columns = ("channel", "gap of the twin as given, rms", "share of what recalibration leaves")
    return Table(columns, rows, "By channel, the share in units of its noise")


# -- causes ------------------------------------------------------------------------------------------


def _likeliest(d: Mapping[str, Any]) -> Section:
    rows = []
    for c in d["causes"][:_SHOWN_CAUSES]:
        low, high = c["shrink_interval"]
        name = wording.capital(wording.finding(c["effect"], c["parameters"]))
        rows.append(
            (
                name + ("" if c.get("judged", True) else " (these drives do not show it)"),
                _chance(float(c["probability"]), c["effect"] in d["combination"]),
                wording.channel_name(wording.channel_of(d, c)),
                f"{wording.percent(c['shrink'])} ({wording.percent(low)} to {wording.percent(high)})",
                "; ".join(f"{name} {value}" for name, value in wording.parameters_of(c)),
            )
        )
    for name, key in ((wording.NOTHING, "no_gap"), (wording.UNKNOWN, "unknown")):
        cell = _chance(float(d[f"{key}_probability"]), d["verdict"] == key)
        rows.append((wording.capital(name), cell, "", "", ""))
    columns = ("cause", "probability", "closes the gap in", "by (90 % interval)", "parameters")
    return Section(
        "The likeliest causes",
        "By how much the gap would close with each cause in the twin, recalibration included, on road that the fit has "
        "not used.",
        Table(columns, rows),
    )


def _chance(probability: float, named: bool) -> Cell:
    bar = f'<span class="bar" style="width:{4.0 * probability:.2f}em"></span>'
    return Cell(Html(f"{wording.chance(probability)}{bar}"), "good" if named else "")


def _next(d: Mapping[str, Any]) -> Section:
    lines = [d["next_experiment"]]
    weak = d.get("cannot_be_judged", ())
    if weak:
        names = ", ".join(wording.effect_name(e) for e in weak)
        lines.append(f"**Cannot be judged**, as these drives do not show them: {names}.")
    return Section("What to drive next", "\n\n".join(lines))


# -- folded ------------------------------------------------------------------------------------------


def _all_causes(d: Mapping[str, Any]) -> Section:
    referenced = any(c.get("shrink_beyond_reference") is not None for c in d["causes"])
    tied = any(c.get("indistinguishable_from") for c in d["causes"])
    gates = [g for g in _GATES if any(g in c.get("gates", {}) for c in d["causes"])]
    rows = []
    for c in d["causes"]:
        low, high = c["shrink_interval"]
        likes = ", ".join(wording.effect_name(e) for e in c.get("indistinguishable_from", ()))
        values = [c.get("gates", {}).get(g) for g in gates]
        rows.append(
            (
                c["effect"].replace("_", " ") + ("" if c.get("judged", True) else " (cannot be judged)"),
                Cell(round(c["probability"], 3), "good" if c["effect"] in d["combination"] else ""),
                wording.channel_name(wording.channel_of(d, c)),
                f"{c['shrink']:.2f} ({low:.2f} to {high:.2f})".replace("-", _MINUS),
                _rounded(c.get("shrink_beyond_recalibration")),
                *([_rounded(c.get("shrink_beyond_reference"))] if referenced else []),
                *(Cell(_rounded(v), "" if v is None or v > 0.5 else "warn") for v in values),
                "; ".join(f"{name} {value}" for name, value in wording.parameters_of(c)),
                *([likes] if tied else []),
            )
        )
    columns = (
        "cause",
        "probability",
        "channel",
        "shrink",
        "beyond recalibration",
        *(["beyond reference"] if referenced else []),
        *gates,
        "parameters",
        *(["like"] if tied else []),
    )
    explained = (
        " A cause is named if it is material (a tenth of some channel's gap), adequate (the remaining residual is "
        "within the model discrepancy) and plausible (within its prior and the same in every fold)."
    )
    return Section(
        "Every cause that was tried",
        "Every effect was fitted together with the characteristics and the nuisance parameters (clocks, map, tilt, "
        f"biases).{explained if gates else ''} The shrinks are of the channel named beside them."
        + (_REFERENCED if referenced else ""),
        Table(columns, rows),
        folded=True,
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _places(result: DiagnosisResult) -> Section:
    w = result.document["where"]
    starts = {v.name: float(v.t[0]) for v in result.drives}
    first = min(starts.values(), default=0.0)
    times = [
        {
            **i,
            "start": i["start"] - starts.get(i["bag"], first),
            "end": i["end"] - starts.get(i["bag"], first),
        }
        for i in w["time"]
    ]
    parts = [
        _table(
            times,
            "In time, from the start of the drive",
            drive="bag",
            **{"from [s]": "start", "to [s]": "end"},
        ),
        _table(w["road"], "On the road", **{"from [m]": "start_m", "to [m]": "end_m"}),
        _table(w["frequency"], "In frequency", **{"from [Hz]": "low_hz", "to [Hz]": "high_hz"}),
        _channels(result.document),
        _table(w["corner"], "By wheel", wheel="name"),
        _table(
            w["operating_point"],
            "By operating point",
            quantity="quantity",
            **{"from": "low", "to": "high", "": "unit"},
        ),
    ]
    return Section(
        "Where, in figures",
        "Where the residual after recalibration is concentrated, on held-out road: each entry holds significantly more "
        "of it than its length does on average.",
        *parts,
        folded=True,
    )


def _table(items: Sequence[Mapping[str, Any]], caption: str, **columns: str) -> Table | None:
    """One kind of entry as a table, ``columns`` naming heading and key; None where there is none."""
    if not items:
        return None
    rows = [[_plain(i[key]) for key in columns.values()] + [wording.percent(i["share"])] for i in items]
    return Table((*columns, "share"), rows, caption)


def _plain(value: object) -> object:
    if isinstance(value, float):
        return round(value, 2)
    return wording.place_name(value) if isinstance(value, str) else value


def _drives(result: DiagnosisResult) -> Section:
    figures = []
    for view in result.drives:
        channel = _channel(view, result.document)
        drawn = plots.in_time(
            view.t,
            view.measured,
            view.after,
            before=view.before,
            origin=float(view.t[0]),
            label=f"{wording.channel_name(channel)} [{channel_unit(channel)}]",
            names={"before": "twin as given", "simulated": "twin as written"},
        )
        figures.append(drawn)
    captions = [f"{view.name}, all of it." for view in result.drives]
    return Section("Every drive", "", *figures, captions=captions, folded=True)


def _signature(s: Mapping[str, Any]) -> Section:
    channel = wording.channel_name(s["channel"])
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
        lines.append(
            f"- periodic {every}: {wording.percent(p['share'])} of the remaining residual of the "
            f"{wording.channel_name(p['channel'])}"
        )
    if "stretch" in s:
        there = s["stretch"]
        lines.append(
            f"- on every pass {wording.percent(there['share'])} of it lies from {there['start_m']:.0f} to "
            f"{there['end_m']:.0f} m of the road, which holds a smaller share of the motion: a local road error, or "
            "something that only this part of the road excites"
        )
        for like in there["resembles"]:
            lines.append(
                f"- there it is like {_like(like)}, which would take {wording.percent(like['shrink'])} of it"
            )
    for like in s.get("resembles", ()):
        lines.append(
            f"- is like {_like(like, like['probability'])}: a shape that many things have, no cause; with it the gap "
            f"would shrink by {wording.percent(like['shrink'])}"
        )
    return Section("What remains unexplained looks like this", "\n".join(lines), folded=True)


def _like(like: Mapping[str, Any], probability: float | None = None) -> str:
    """An effect with its parameters, and how probable it is."""
    values = [f"{name} {value}" for name, value in wording.parameters_of(like)]
    more = [] if probability is None else [f"probability {wording.chance(probability)}"]
    return f"{like['effect'].replace('_', ' ')} ({'; '.join([*values, *more])})"


def _how(d: Mapping[str, Any]) -> Section:
    r, b = d["recalibration"], d["background"]
    text = f"The residual of the written twin.yaml is {wording.percent(b['share_of_motion_left'])} of the motion's rms"
    if b.get("share_left_on_reference") is not None:
        text += f"; on the reference drives it is {wording.percent(b['share_left_on_reference'])}"
    noise = b.get("noise_share_of_residual")
    counted = (
        ""
        if noise is None
        else " Model discrepancy is correlated from sample to sample: the effective sample size is reduced accordingly "
        f"(factor {noise:.2g})."
    )
    unit = channel_unit(d["gap"]["channel"])
    lines = [
        f"Of {wording.channel_name(d['gap']['channel'])}, {d['gap']['rms']:.3g} {unit} rms are the gap of the twin as "
        f"given, at a noise of {d['gap']['noise_rms']:.2g}. Recalibration alone, without any effect, lowers it above "
        f"the noise from {r['gap_before']:.3g} to {r['gap_after']:.3g} {unit}. {text}.",
        "The gap before is that of the twin as given, the gap after that of the written twin, with the file's clock, "
        "map and biases; both on road that the fit has not used. Probabilities come from cross-validation, its folds "
        f"resampled many times.{counted} Seed {d['seed']}.",
    ]
    return Section("Method", "\n\n".join(lines), folded=True)
