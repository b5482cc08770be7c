# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis, in the order in which it is asked for.

The cause and its probability; the gap before and after; where it is, in pictures; the likeliest causes; the next drive.
Everything else is folded away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from scipy import signal

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import wording
from suspension_twin.diagnosis.request import DiagnosisResult, DriveView
from suspension_twin.diagnosis.wording import Document
from suspension_twin.inference.gap import channel_unit
from suspension_twin.report import plots
from suspension_twin.report.characteristics import characteristics
from suspension_twin.report.page import Cell, Html, Lead, Mark, Page, Row, Section, Table
from suspension_twin.report.style import COLOURS
from suspension_twin.units import plain
from suspension_twin.vehicle.corners import CORNERS

__all__ = ["VERDICT_MARKS", "diagnosis_page"]

VERDICT_MARKS: dict[str, Mark] = {
    "effect": "warn",
    "partly": "warn",
    "suspected": "warn",
    "recalibration": "warn",
    "no_gap": "good",
    "unknown": "bad",
}
_SAID = {"no_gap": ("no_gap", "recalibration"), "unknown": ("unknown",)}
_SHOWN_SECONDS, _SHOWN_CAUSES = 6.0, 5


def diagnosis_page(result: DiagnosisResult) -> Page:
    """Make the page of a diagnosis: answer, before and after, where, likeliest causes, next drive; details folded.

    Parameters
    ----------
    result : DiagnosisResult
        Result of :func:`~suspension_twin.diagnosis.run.diagnose`.

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
    page = Page("Diagnosis", f"{getattr(result.twin.vehicle, 'name', '') or 'the vehicle'}, {drives}")
    page.lead = Lead(wording.answer(d), wording.remarks(d), VERDICT_MARKS.get(d["verdict"], ""))
    for section in (
        _before_and_after(result),
        _recalibrated(result),
        _where(result),
        _likeliest(d),
        Section("What to drive next", _next_drive(d)),
    ):
        if section is not None:
            page.add(section)
    if d["warnings"]:
        page.add(Section("Warnings", "\n".join(f"- {w}" for w in d["warnings"])))
    for section in (_all_causes(d), _places(result), _drives(result)):
        page.add(section)
    if "signature" in d:
        page.add(_signature(d["signature"]))
    page.add(_method(d))
    return page


def _interval(ends: Sequence[float]) -> str:
    return f"({wording.percent(ends[0])} to {wording.percent(ends[1])})"


# -- before and after --------------------------------------------------------------------------------


def _next_drive(d: Document) -> str:
    """The proposal, and how to go on with a drive over the twin's own road."""
    drive = d.get("next_drive")
    more = "\n\nThen: `suspension-twin diagnose --add DRIVE`, with the `--out` of this one."
    return f"{d['next_experiment']}{more if drive and 'road' not in drive else ''}"


def _before_and_after(result: DiagnosisResult) -> Section:
    d, lead = result.document, wording.leading(result.document)
    channel = wording.channel_of(d, lead)
    plural = "s" if len(d["combination"]) > 1 else ""
    after = f"with the cause{plural} in it" if lead else "recalibrated"
    shown = "handed back as it came" if result.twin == result.given else after
    text = (
        f"The gap between twin and car in **{wording.channel_name(channel)}**, above the noise, on stretches that no "
        "fit has used; and the seconds in which the twin as given is worst."
    )
    bars = _bars(d, lead, channel, after)
    worst = _worst(result.drives)
    if worst is None:
        return Section("Before and after", text, bars)
    view, cut = worst
    drawn = _in_time(view, f"twin {shown}", cut)
    start = float(view.t[cut.start] - view.t[0])
    caption = f"The worst {_SHOWN_SECONDS:.0f} seconds: {view.name}, from {start:.0f} s after its start."
    return Section("Before and after", text, bars, drawn, captions=(caption,))


def _in_time(view: DriveView, simulated: str, cut: slice = slice(None)) -> Figure:
    """The measured signal and those of the twin as given and as ``simulated``."""
    return plots.in_time(
        view.t[cut],
        view.measured[cut],
        view.simulated["after"][cut],
        before=view.simulated["before"][cut],
        origin=float(view.t[0]),
        label=f"{wording.channel_name(view.channel)} [{channel_unit(view.channel)}]",
        names={"before": "twin as given", "simulated": simulated},
    )


def _bars(d: Document, lead: Document | None, channel: str, after: str) -> Html:
    """The gap of the twin as given, recalibrated, and with the named causes, as bars."""
    r = d["recalibration"]
    before = lead["gap_before"] if lead else r["gap_before"]
    rows = [("twin as given", before, "before")]
    if channel == d["gap"]["channel"]:
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
    found = []
    for view in drives:
        if view.compared.any():
            error = np.where(view.compared, (view.simulated["before"] - view.measured) ** 2, 0.0)
            window = min(max(1, int(_SHOWN_SECONDS * view.rate)), error.size)
            energy = np.convolve(error, np.ones(window), mode="valid")
            start = int(np.argmax(energy))
            found.append((float(energy[start]), view, slice(start, start + window)))
    return max(found, key=lambda each: each[0])[1:] if found else None


# -- recalibration -----------------------------------------------------------------------------------


def _recalibrated(result: DiagnosisResult) -> Section | None:
    """Values that recalibration moved beyond their uncertainty, and the curves of a recalibrated twin."""
    moved = result.document.get("recalibrated", [])
    if not moved:
        return None
    rows = [
        (
            wording.capital(one["characteristic"]),
            *(plain(one[k], one["unit"], 3) if one["unit"] else f"{one[k]:.2g}" for k in ("before", "after")),
            wording.moved_words(one).partition(": ")[2],
            wording.percent(one["share"]),
        )
        for one in moved
    ]
    columns = ("of the vehicle", "in the file", "recalibrated", "change (90 % interval)", "closes alone")
    text = (
        "Values that a calibration to these drives moves beyond their uncertainty, without any effect. Forces, rates "
        "are means over what the drives reached. The last column: the share of what recalibration closes of the gap."
    )
    figure, given = None, result.given
    if result.verdict == "recalibration" and given is not None and getattr(given.vehicle, "axles", None):
        figure = characteristics(
            {"before": given.vehicle, "simulated": result.twin.vehicle},
            names={"before": "as given", "simulated": "recalibrated"},
            from_rest=True,
        )
    return Section("What recalibration changes", text, Table(columns, rows), figure)


# -- where -------------------------------------------------------------------------------------------


def _where(result: DiagnosisResult) -> Section:
    road, small, notes = _by_road(result), list[Figure](), list[str]()
    for figure, note in (
        (_spectrum(result), "By frequency; shaded where the gap is concentrated."),
        (_car(result), "By wheel: the share of the gap that goes with its motion."),
    ):
        if figure is not None:
            small.append(figure)
            notes.append(note)
    captions = ("Along the road, all drives together; shaded where the gap is concentrated.",)
    row = Row(small, notes) if small else None
    return Section("Where the gap is", _sentence(result), road, row, captions=captions if road else ())


def _sentence(result: DiagnosisResult) -> str:
    """The largest entry of each kind in words."""
    w, parts = result.document["where"], []
    starts = {v.name: float(v.t[0]) for v in result.drives}
    for first in w["channel"][:1]:
        name, share = wording.channel_name(first["name"]), wording.percent(first["share"])
        parts.append(f"in {name} ({share} of it, each channel in units of its noise)")
    for first in w["road"][:1]:
        parts.append(f"from {first['start_m']:.0f} to {first['end_m']:.0f} m of the road")
    for first in w["frequency"][:1]:
        parts.append(f"between {first['low_hz']:.2g} and {first['high_hz']:.2g} Hz")
    for first in w["time"][:1]:
        since = first["start"] - starts.get(first["bag"], 0.0)
        parts.append(f"{since:.0f} s after the start of {first['bag']}")
    if not parts:
        return "The gap is spread evenly over time, road and frequency."
    return f"The gap after recalibration is largest {wording.listed(parts)}."


def _by_road(result: DiagnosisResult) -> Figure | None:
    views = result.drives
    if result.twin.road is None or not views:
        return None
    position = np.concatenate([v.position[v.compared] for v in views])
    before, after = (
        np.concatenate([(v.simulated[which] - v.measured)[v.compared] for v in views])
        for which in ("before", "after")
    )
    if position.size < 2 or np.ptp(position) < 2.0:
        return None
    channel = views[0].channel
    fig = plots.residual_by_road(
        position,
        after,
        before=before,
        label=f"gap in {wording.channel_name(channel)},\nrms [{channel_unit(channel)}]",
        names={"before": "twin as given", "residual": "twin as written"},
    )
    _shaded(fig, [(i["start_m"], i["end_m"]) for i in result.document["where"]["road"]])
    return fig


def _shaded(fig: Figure, spans: Sequence[tuple[float, float]]) -> None:
    for low, high in spans:
        fig.axes[0].axvspan(low, high, color=COLOURS["mark"], alpha=0.16, linewidth=0, zorder=0)


def _spectrum(result: DiagnosisResult) -> Figure | None:
    """The gap over frequency, of all drives."""
    counts = [int(np.count_nonzero(v.compared)) for v in result.drives]
    if min(counts, default=0) < 32:
        return None
    size, total = min(512, *counts), dict[str, Floats]()
    for role, which in (("measured", None), ("before", "before"), ("residual", "after")):
        densities = []
        for view in result.drives:
            series = view.measured if which is None else view.simulated[which] - view.measured
            frequency, power = signal.welch(series[view.compared], view.rate, nperseg=size)
            densities.append(power)
        total[role] = np.average(densities, axis=0, weights=counts)
    unit = channel_unit(result.drives[0].channel)
    fig = plots.in_frequency(
        frequency,
        total,
        unit=f"({unit})²/Hz",
        names={"measured": "motion", "before": "gap, as given", "residual": "gap, as written"},
        width=4.6,
    )
    _shaded(fig, [(i["low_hz"], i["high_hz"]) for i in result.document["where"]["frequency"]])
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
    return plots.car_from_above(wheels, shares, marked=marked, sensor=(x, y))


# -- causes ------------------------------------------------------------------------------------------


def _likeliest(d: Document) -> Section:
    rows: list[tuple[object, ...]] = []
    for c in d["causes"][:_SHOWN_CAUSES]:
        name = wording.capital(wording.finding(c["effect"], c["parameters"]))
        rows.append(
            (
                name + ("" if c["judged"] else " (these drives do not show it)"),
                _chance(float(c.get("presence", c["probability"])), c["effect"] in d["combination"]),
                wording.channel_name(c["channel"]),
                f"{wording.percent(c['shrink'])} {_interval(c['shrink_interval'])}",
                _parameters(c),
            )
        )
    for name, key in ((wording.NOTHING, "no_gap"), (wording.UNKNOWN, "unknown")):
        cell = _chance(float(d[f"{key}_probability"]), d["verdict"] in _SAID[key])
        rows.append((wording.capital(name), cell, "", "", ""))
    columns = (
        "cause",
        "probability",
        "closes the gap in",
        "by (90 % interval, one more drive)",
        "parameters",
    )
    return Section(
        "The likeliest causes",
        "By how much the gap would close with each cause in the twin, recalibration included, on stretches that the "
        "fit has not used.",
        Table(columns, rows),
    )


def _chance(probability: float, named: bool) -> Cell:
    bar = f'<span class="bar" style="width:{4.0 * probability:.2f}em"></span>'
    return Cell(Html(f"{wording.chance(probability)}{bar}"), "good" if named else "")


def _parameters(cause: Document) -> str:
    return "; ".join(f"{name} {value}" for name, value in wording.parameters_of(cause))


# -- folded ------------------------------------------------------------------------------------------


def _all_causes(d: Document) -> Section:
    tied = any(c["indistinguishable_from"] for c in d["causes"])
    rows = [
        (
            Cell(
                wording.capital(wording.effect_name(c["effect"]))
                + ("" if c["judged"] else " (cannot be judged)"),
                note=c["effect"].replace("_", " "),
            ),
            Cell(round(c["probability"], 3), "good" if c["effect"] in d["combination"] else ""),
            wording.channel_name(c["channel"]),
            f"{wording.percent(c['shrink'])} {_interval(c['shrink_interval'])}",
            f"{wording.percent(c['shrink_beyond_recalibration'])} "
            + _interval(c["shrink_beyond_recalibration_interval"]),
            _parameters(c),
            *([", ".join(map(wording.effect_name, c["indistinguishable_from"]))] if tied else []),
        )
        for c in d["causes"]
    ]
    columns = ("cause", "probability", "channel", "shrink", "beyond recalibration", "parameters")
    return Section(
        "Every cause that was tried",
        "Every effect was fitted together with the characteristics and the nuisance parameters (clocks, map, tilt, "
        "biases). The shrinks are of the channel named beside them: from the twin as given, with the interval on one "
        "more drive, and beyond what recalibration closes, with the interval on these drives alone.",
        Table((*columns, "like") if tied else columns, rows),
        folded=True,
    )


def _places(result: DiagnosisResult) -> Section:
    d, w = result.document, result.document["where"]
    starts = {v.name: float(v.t[0]) for v in result.drives}
    first = min(starts.values(), default=0.0)
    times = [
        {**i, **{k: round(i[k] - starts.get(i["bag"], first), 2) for k in ("start", "end")}}
        for i in w["time"]
    ]
    tables = (
        (
            times,
            "In time, from the start of the drive",
            {"drive": "bag", "from [s]": "start", "to [s]": "end"},
        ),
        (w["road"], "On the road", {"from [m]": "start_m", "to [m]": "end_m"}),
        (w["frequency"], "In frequency", {"from [Hz]": "low_hz", "to [Hz]": "high_hz"}),
        (w["corner"], "By wheel", {"wheel": "name"}),
        (
            w["operating_point"],
            "By operating point",
            {"quantity": "quantity", "from": "low", "to": "high", "": "unit"},
        ),
    )
    return Section(
        "Where, in figures",
        "Where the residual after recalibration is concentrated, on held-out road: each entry holds significantly more "
        "of it than its length does on average.",
        _channels(d),
        *(_table(*table) for table in tables),
        folded=True,
    )


def _channels(d: Document) -> Table:
    shares = {i["name"]: wording.percent(i["share"]) for i in d["where"]["channel"]}
    rows = [
        (wording.channel_name(name), f"{rms:.2g} {channel_unit(name)}", shares.get(name, ""))
        for name, rms in d["gap"]["channels"].items()
    ]
    columns = ("channel", "gap of the twin as given, rms", "share of the gap after recalibration")
    return Table(columns, rows, "By channel, the share in units of its noise")


def _table(items: Sequence[Document], caption: str, columns: dict[str, str]) -> Table | None:
    """One kind of entry as a table, ``columns`` mapping headings to keys; None where there is none."""

    rows = [
        [
            *(wording.place_name(i[key]) if key == "name" else i[key] for key in columns.values()),
            wording.percent(i["share"]),
        ]
        for i in items
    ]
    return Table((*columns, "share"), rows, caption) if rows else None


def _drives(result: DiagnosisResult) -> Section:
    figures = [_in_time(view, "twin as written") for view in result.drives]
    captions = [f"{view.name}, all of it." for view in result.drives]
    return Section("Every drive", "", *figures, captions=captions, folded=True)


def _signature(s: Document) -> Section:
    channel = wording.channel_name(s["channel"])
    lines = [f"band {s['low_hz']} to {s['high_hz']} Hz, strongest at {s['peak_hz']} Hz ({channel})"]
    if "in_space" in s:
        lines.append(f"repeats by road position on every pass: correlation {s['in_space']}")
    if "goes_with" in s:
        lines.append(f"goes with {s['goes_with']['what']} (correlation {s['goes_with']['correlation']})")
        lines.append(f"hysteresis over travel: correlation {s['hysteresis']} with the sign of the velocity")
    for key, value in s.items():
        if key.startswith("triggers_above"):
            lines.append(f"appears above a {key.rsplit('_', 1)[1]} of {value['value']} {value['unit']}")
    if "periodic" in s:
        p = s["periodic"]
        every = f"every {p['every_m']:.3g} m" if "every_m" in p else f"at {p['hz']:.3g} Hz"
        lines.append(
            f"periodic {every}: {wording.percent(p['share'])} of the remaining residual of the "
            f"{wording.channel_name(p['channel'])}"
        )
    if "stretch" in s:
        there = s["stretch"]
        lines.append(
            f"on every pass {wording.percent(there['share'])} of it lies from {there['start_m']:.0f} to "
            f"{there['end_m']:.0f} m of the road, which holds a smaller share of the motion: a local road error, or "
            "something that only this part of the road excites"
        )
        for like in there["resembles"]:
            share = wording.percent(like["shrink"])
            lines.append(
                f"there it is like {wording.effect_name(like['effect'])} ({_parameters(like)}), which would take "
                f"{share} of it"
            )
    for like in s["resembles"]:
        chance, share = wording.chance(like["probability"]), wording.percent(like["shrink"])
        lines.append(
            f"is like {wording.effect_name(like['effect'])} ({_parameters(like)}; probability {chance}): a shape that "
            f"many things have, no cause; with it the gap would shrink by {share}"
        )
    text = "\n".join(f"- {line}" for line in lines)
    return Section("The unexplained gap", text, folded=True)


def _method(d: Document) -> Section:
    r, b, unit = d["recalibration"], d["background"], channel_unit(d["gap"]["channel"])
    text = f"The residual of the written twin.yaml is {wording.percent(b['share_of_motion_left'])} of the motion's rms"
    if b["share_left_on_reference"] is not None:
        text += f"; on the reference drives it is {wording.percent(b['share_left_on_reference'])}"
    lines = [
        f"In {wording.channel_name(d['gap']['channel'])} the gap of the twin as given is {d['gap']['rms']:.3g} {unit} "
        f"rms, at a noise of {d['gap']['noise_rms']:.2g}. Recalibration alone, without any effect, lowers it above the "
        f"noise from {r['gap_before']:.3g} to {r['gap_after']:.3g} {unit}. {text}.",
        "The gap before is that of the twin as given, the gap after that of the written twin, with the file's clock, "
        "map and biases; both on stretches that the fit has not used. Probabilities come from cross-validation. Model "
        "discrepancy is correlated from sample to sample: the effective sample size is reduced accordingly (factor "
        f"{b['noise_share_of_residual']:.2g}). Seed {d['seed']}.",
    ]
    return Section("Method", "\n\n".join(lines), folded=True)
