# SPDX-License-Identifier: Apache-2.0
"""The page of a fleet, in the order in which it is asked for.

Vehicles to look at first and why; changes, their dates and probabilities; the health of every vehicle over time; places
on the road where twin and vehicles disagree; rows that could not be done.
"""

from __future__ import annotations

import html
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from typing import Any
from urllib.parse import quote

import matplotlib.dates
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from suspension_twin.addons.fleet.changes import ChangePoint
from suspension_twin.addons.fleet.work import Record
from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import wording
from suspension_twin.effects.tyre_pressure import EXPONENT
from suspension_twin.inference.gap import channel_unit
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.report import style
from suspension_twin.report.diagnosis import VERDICT_MARKS
from suspension_twin.report.page import Cell, Html, Lead, Page, Row, Section, Table
from suspension_twin.report.style import COLOURS
from suspension_twin.units import plain
from suspension_twin.vehicle.twin import Datum

__all__ = ["fleet_page", "quantity_label"]

#: How much of a large fleet a page holds; all of it is in the tables beside the page.
_FIRST, _DRAWN, _VEHICLES, _QUANTITIES, _ROADS, _WORST, _FAILED = 25, 8, 300, 6, 4, 8, 50
#: A change is listed from this probability on: more likely than not.
_LISTED = 0.5
#: Share of the vehicles that change together from which on a common reason is pointed out.
_COMMON = 1.0 / 3.0
#: m within which roads are drawn on one map.
_NEAR = 2000.0
#: m between two of the worst places that are listed, and least share of its region's median of all but the first.
_APART, _OUTSTANDING = 25.0, 1.5
#: Smallest change, as a share, that fills the height of a health line.
_LEAST_RANGE = 0.2
_LINE_WIDTH, _LINE_HEIGHT, _LINE_POINTS = 96.0, 36.0, 60
_STRIP = dict.fromkeys(("effect", "partly", "suspected"), "mark") | dict.fromkeys(
    ("no_gap", "recalibration"), "truth"
)
_STRIP["unknown"] = "simulated"
_VERDICTS = {
    "no_gap": "no gap",
    "effect": "cause named",
    "partly": "cause named, not all",
    "suspected": "cause suspected",
    "recalibration": "values off",
    "unknown": "unknown cause",
}
_ORDER = ("damper_push", "damper_pull", "spring", "tyre", "effects.")

_DATES: Any = matplotlib.dates  # its functions have no types
#: Pieces of road: position, rms of the residual over all driving there, number of vehicles, rms of the median vehicle,
#: time driven in s.
_PLACE = [(name, float) for name in ("latitude", "longitude", "rms", "vehicles", "median", "seconds")]
Places = NDArray[np.void]
#: Day, value and the ends of its 90 % interval.
Point = tuple[float, float, float, float]


def fleet_page(rows: Sequence[Record], changes: Sequence[ChangePoint], action: str, title: str = "") -> Page:
    """Make the page of a fleet: vehicles to look at first, changes, health over time, map, failures.

    Parameters
    ----------
    rows : sequence of mapping
        A row for every item, as :func:`~suspension_twin.addons.fleet.results.result_rows` makes them.
    changes : sequence of ChangePoint
        Of every vehicle and quantity.
    action : str
        ``calibrate`` or ``diagnose``.
    title : str
        Name of the manifest.

    Returns
    -------
    Page
        ``write(path)`` saves it as one HTML file without scripts; its links to the results are relative to it.

    Examples
    --------
    >>> fleet_page(rows, changes, "calibrate").write("results/fleet.html")  # doctest: +SKIP
    PosixPath('results/fleet.html')
    """
    fleet = _Fleet(_vehicles(rows, changes), rows, action == "calibrate")
    dates = sorted(date for v in fleet.vehicles for date in v.dates)
    days = list(dict.fromkeys(_day(d) for d in (dates[0], dates[-1]))) if dates else []
    span = f", {' to '.join(days)}" if days else ""
    done = "calibrated" if fleet.calibrated else "diagnosed"
    whole = f"{title + ': ' if title else ''}{_count(len(fleet.vehicles), 'vehicle')} {done}{span}"
    page = Page("Fleet", whole, lead=_lead(fleet))
    _cards(page, fleet)
    sections = [
        _first(fleet),
        _changes(fleet.vehicles) if fleet.calibrated else None,
        _health(fleet),
        _map(fleet),
        _failures(fleet.failed) if fleet.failed else None,
        _method(fleet),
    ]
    for section in sections:
        if section is not None:
            page.add(section)
    return page


def quantity_label(quantity: str) -> str:
    """Name of a quantity of ``health.parquet`` in words.

    Parameters
    ----------
    quantity : str
        Key of a parameter, or of a damper with ``@`` and the velocity in m/s at which its force is taken.

    Returns
    -------
    str
        The name.

    Examples
    --------
    >>> quantity_label("vehicle.front.damper_push@0.25")
    'front damper push at 0.25 m/s'
    """
    key, _, velocity = quantity.partition("@")
    parts = key.split(".")
    if parts[0] == "effects" and len(parts) == 3:
        return f"{wording.effect_name(parts[1])}, {wording.parameter_name(parts[1], parts[2])}"
    name = key.removeprefix("vehicle.").replace("_", " ").replace(".", " ")
    return f"{name} at {velocity} m/s" if velocity else name


# -- vehicles ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Vehicle:
    """One vehicle: its rows in the order of their dates, and changes that are listed, the surest first."""

    name: str
    rows: tuple[Record, ...]
    changes: tuple[ChangePoint, ...]

    @property
    def dates(self) -> list[str]:
        return [row["date"] for row in self.rows if row["date"]]

    @cached_property
    def done(self) -> list[Record]:
        return [row for row in self.rows if row["status"] == "done"]

    @property
    def last(self) -> Record | None:
        """The newest result."""
        return self.done[-1] if self.done else None

    @property
    def named(self) -> list[ChangePoint]:
        return [c for c in self.changes if c.named]

    @property
    def faults(self) -> list[Record]:
        """Results of a diagnosis that name a cause, or a gap without one."""
        return [row for row in self.done if row["verdict"] not in (None, "no_gap")]

    @property
    def faulty(self) -> bool:
        """Whether the newest diagnosis shows a gap."""
        return bool(self.faults) and self.faults[-1] is self.last

    @property
    def rank(self) -> tuple[float, float, str]:
        """Sort key: named changes and gaps first, the larger and surer before the smaller."""
        change = max(map(_weight, self.changes), default=0.0)
        last = self.done[-1] if self.faulty else {"probability": 0.0, "gap_before": 0.0}
        fault = float(self.faulty) + (last["probability"] or 0.0) * (last["gap_before"] or 0.0)
        return -float(bool(self.named)) - fault, -change - len(self.faults), self.name

    def series(self, quantity: str) -> list[Point]:
        """A quantity where it was identified, in the order of the dates."""
        return [
            (_number(row["date"]), h["value"], h["low"], h["high"])
            for row in self.done
            if row["date"]
            for h in row["health"]
            if h["quantity"] == quantity and h["identified"] and None not in (h["value"], h["low"], h["high"])
        ]


@dataclass(frozen=True)
class _Fleet:
    """All vehicles, those to look at first at the head, all rows, and whether they were ``calibrated`` or diagnosed."""

    vehicles: Sequence[_Vehicle]
    rows: Sequence[Record]
    calibrated: bool

    @property
    def done(self) -> list[Record]:
        return [row for row in self.rows if row["status"] == "done"]

    @property
    def failed(self) -> list[Record]:
        return [row for row in self.rows if row["status"] != "done"]

    @property
    def long_enough(self) -> bool:
        """Whether any vehicle has as many rows as a change needs, two on either side."""
        return any(sum(bool(r["date"]) for r in v.done) >= 4 for v in self.vehicles)


def _vehicles(rows: Sequence[Record], changes: Sequence[ChangePoint]) -> list[_Vehicle]:
    by_name: dict[str, list[Record]] = defaultdict(list)
    for row in rows:
        by_name[row["vehicle"]].append(row)
    found = []
    for name, own in by_name.items():
        steps = (c for c in changes if c.series.vehicle == name and c.probability >= _LISTED)
        found.append(_Vehicle(name, tuple(sorted(own, key=lambda r: str(r["date"]))), tuple(steps)))
    return sorted(found, key=lambda v: v.rank)


def _weight(change: ChangePoint) -> float:
    """Probability times size of a change."""
    return change.probability * abs(math.log(change.ratio[0]))


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _day(date: str) -> str:
    return date[:10]


def _number(date: str) -> float:
    """A date of a manifest on matplotlib's axis of days; one without a zone is taken as UTC."""
    moment = datetime.fromisoformat(date.replace("Z", "+00:00"))
    return float(_DATES.date2num(moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)))


# -- the head ----------------------------------------------------------------------------------------


def _lead(fleet: _Fleet) -> Lead:
    vehicles, failed, rows = fleet.vehicles, len(fleet.failed), _count(len(fleet.rows), "row")
    remarks = [f"{failed} of {rows} could not be done; the reasons are below."] if failed else []
    whole = _count(len(vehicles), "vehicle")
    changed, faulty = [v for v in vehicles if v.named], [v for v in vehicles if v.faulty]
    if not fleet.done:
        return Lead("No row could be done.", remarks, "bad")
    if not fleet.calibrated and faulty:
        return Lead(f"{len(faulty)} of {whole} differ from their twins: {_names(faulty)}.", remarks, "warn")
    if not fleet.calibrated:
        return Lead(f"None of {whole} shows a gap that its drives can tell from noise.", remarks, "good")
    if changed:
        sentence = f"{len(changed)} of {whole} changed: {_names(changed)}."
        return Lead(sentence, [*_common(changed, vehicles), *remarks], "warn")
    if not fleet.long_enough:
        return Lead("No vehicle has the four rows with a date that it takes to see a change.", remarks)
    return Lead(f"None of {whole} changed, as far as these drives can show.", remarks, "good")


def _names(vehicles: Sequence[_Vehicle]) -> str:
    names = [v.name for v in vehicles[:6]]
    return wording.listed([*names, f"{len(vehicles) - 6} more"] if len(vehicles) > 6 else names)


def _common(changed: Sequence[_Vehicle], vehicles: Sequence[_Vehicle]) -> list[str]:
    """A remark where many vehicles changed at the same time: then it is hardly the vehicles."""
    spans = [(c.earliest, c.latest, v.name) for v in changed for c in v.named]
    together = max((len({n for a, b, n in spans if a <= day <= b}) for day, _, _ in spans), default=0)
    if together < 3 or together < _COMMON * len(vehicles):
        return []
    return [
        f"{together} of them may have changed on the same day: a common reason, such as the road, the season or the "
        "sensors, is then more likely than as many faults."
    ]


def _cards(page: Page, fleet: _Fleet) -> None:
    vehicles, done, failed = fleet.vehicles, fleet.done, len(fleet.failed)
    page.card("Vehicles", str(len(vehicles)), _count(len({d for v in vehicles for d in v.dates}), "date"))
    note = f"{failed} failed" if failed else ""
    page.card("Rows done", f"{len(done)} of {len(fleet.rows)}", note, "bad" if failed else "good")
    key, note = "gap_after", "median of all rows, calibrated"
    if fleet.calibrated and fleet.long_enough:
        changed = sum(bool(v.named) for v in vehicles)
        page.card("Changed", str(changed), "vehicles, probability from 95 %", "warn" if changed else "good")
    if not fleet.calibrated:
        faulty = sum(bool(v.faults) for v in vehicles)
        page.card("With a gap", str(faulty), "vehicles, on any date", "warn" if faulty else "good")
        key, note = "gap_before", "median of all rows, twins as given"
    gaps = [row[key] for row in done if row[key] is not None]
    if gaps:
        page.card("Gap", f"{np.median(gaps):.2g} {channel_unit(done[0]['channel'])}", note)


# -- vehicles to look at first -----------------------------------------------------------------------


def _first(fleet: _Fleet) -> Section:
    title = "Vehicles to look at first"
    shown = [v for v in fleet.vehicles if (v.changes if fleet.calibrated else v.faults)]
    if not shown:
        return Section(title, "None stands out.")
    rows = [_first_changed(v) if fleet.calibrated else _first_faulty(v) for v in shown[:_FIRST]]
    text = "By the newest diagnosis of each vehicle, the surest and largest gap first."
    columns = ("vehicle", "what", "date", "dates with a gap", "result")
    if fleet.calibrated:
        text = "The surest and largest changes come first."
        columns = ("vehicle", "what", "since", "probability", "result")
    return Section(title, text + _more(_FIRST, len(shown)), Table(columns, rows))


def _more(limit: int, number: int, noun: str = "") -> str:
    """A sentence where not all are listed."""
    return f" The first {limit} of {number}{noun}." if number > limit else ""


def _first_changed(vehicle: _Vehicle) -> list[object]:
    best = max(vehicle.changes, key=_weight)
    words = [_change_words(c) for c in vehicle.changes[:4]]
    if len(vehicle.changes) > 4:
        words.append(f"{len(vehicle.changes) - 4} more")
    after = next((r for r in vehicle.done if r["date"] == best.date), vehicle.last)
    since, interval = _unbroken(_day(best.date)), _interval(best)
    if _day(best.earliest) != _day(best.latest):
        since = Html(f"{since.text} ({interval.text})")
    chance = Cell(_unbroken(wording.chance(best.probability)), "warn" if best.named else "soft")
    return [vehicle.name, wording.capital("; ".join(words)), since, chance, _link(after)]


def _first_faulty(vehicle: _Vehicle) -> list[object]:
    last = vehicle.faults[-1]
    return [
        vehicle.name,
        Cell(last["message"], VERDICT_MARKS.get(last["verdict"], "")),
        _unbroken(_day(last["date"]) or "–"),
        f"{len(vehicle.faults)} of {len(vehicle.done)}",
        _link(last),
    ]


def _link(row: Record | None) -> Html:
    """The folder of a result, relative to the page."""
    if row is None or not row["folder"]:
        return Html("–")
    return Html(f'<a href="{html.escape(quote(row["folder"]), quote=True)}/">folder</a>')


def _change_words(change: ChangePoint) -> str:
    """``front damper push at 0.25 m/s 31 % lower (25 to 37 %)``."""
    ratio, *ends = change.ratio
    low, high = sorted(abs(1.0 - r) for r in ends)
    if ends[0] < 1.0 < ends[1]:
        low = 0.0
    word = "lower" if ratio < 1.0 else "higher"
    text = f"{quantity_label(change.series.quantity)} {wording.percent(abs(1.0 - ratio))} {word}"
    text += f" ({wording.percent(low) if low else '0'} to {wording.percent(high)})"
    if change.series.quantity.endswith(".tyre.vertical_stiffness"):
        pressure = ratio ** (1.0 / EXPONENT)
        text += f", as a pressure {wording.percent(abs(1.0 - pressure))} {word} would make it"
    return text


def _interval(change: ChangePoint) -> Html:
    days = dict.fromkeys(_unbroken(_day(d)).text for d in (change.earliest, change.latest))
    return Html(" to ".join(days))


def _unbroken(text: str) -> Html:
    """A text that stays on one line."""
    return Html(f'<span style="white-space:nowrap">{html.escape(text)}</span>')


# -- changes -----------------------------------------------------------------------------------------


def _changes(vehicles: Sequence[_Vehicle]) -> Section:
    found = [c for v in vehicles for c in v.changes]
    found.sort(key=lambda c: (-c.probability, c.series.vehicle, c.series.quantity))
    if not found:
        return Section("Changes", "No quantity of any vehicle changed with a probability above one half.")
    rows = [
        [
            c.series.vehicle,
            quantity_label(c.series.quantity),
            _unbroken(_day(c.date)),
            _interval(c),
            Cell(_unbroken(wording.chance(c.probability)), "warn" if c.named else "soft"),
            _unbroken(plain(c.before, c.series.unit, 3)),
            _unbroken(plain(c.after, c.series.unit, 3)),
            "{} ({} to {})".format(*(wording.percent(r - 1.0) for r in c.ratio)),
        ]
        for c in found[:_FAILED]
    ]
    columns = (
        "vehicle",
        "quantity",
        "since",
        "90 % interval of the date",
        "probability",
        "before",
        "after",
        "change",
    )
    drawn = [(vehicle, change) for vehicle in vehicles for change in vehicle.named[:2]][:_DRAWN]
    captions = [f"{vehicle.name}: {quantity_label(change.series.quantity)}." for vehicle, change in drawn]
    text = (
        "Quantities with a step that is more likely than not; one is called a change from a probability of 95 % on. "
        "The date is that of the first drive after the step."
    )
    if drawn:
        text += " Bars are the 90 % intervals of single rows, the shaded time holds the step with 90 % probability."
    pictures = Row([_step(v, c) for v, c in drawn], captions) if drawn else None
    return Section("Changes", text, pictures, Table(columns, rows))


def _step(vehicle: _Vehicle, change: ChangePoint) -> Figure:
    t, value, low, high = np.array(vehicle.series(change.series.quantity)).T
    factor, unit = (1e-3, "N/mm") if change.series.unit == "N/m" else (1.0, change.series.unit)
    value, low, high = factor * value, factor * low, factor * high
    with style.drawing(4.6, 2.5) as (fig, axes):
        place = int(np.searchsorted(t, _number(change.date)))
        begin, end = (_number(d) for d in (change.earliest, change.latest))
        # The step lies between the drive before its first and the last possible place.
        begin = t[max(int(np.searchsorted(t, begin)) - 1, 0)]
        axes.axvspan(begin, end, color=COLOURS["mark"], alpha=0.2, linewidth=0)
        spans = [np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)]
        axes.errorbar(t, value, spans, fmt="o", color=COLOURS["measured"], markersize=3.5, linewidth=1.0)
        for part, level in ((t[:place], factor * change.before), (t[place:], factor * change.after)):
            if part.size:
                axes.plot([part[0], part[-1]], [level, level], color=COLOURS["simulated"], linewidth=1.6)
        axes.set_ylabel(f"[{unit}]" if unit else "")
        locator = _DATES.AutoDateLocator(minticks=3, maxticks=6)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(_DATES.ConciseDateFormatter(locator))
    return fig


# -- health over time --------------------------------------------------------------------------------


def _health(fleet: _Fleet) -> Section:
    title = "Health over time"
    vehicles, shown = fleet.vehicles, fleet.vehicles[:_VEHICLES]
    days = [_number(d) for v in vehicles for d in v.dates]
    span = (min(days), max(days)) if days else (0.0, 1.0)
    more = _more(_VEHICLES, len(vehicles), " vehicles")
    if not fleet.calibrated:
        legend = " ".join(
            f'<span style="white-space:nowrap"><span class="bar" style="width:.8em;background:var(--{_STRIP[k]})">'
            f"</span> {_VERDICTS[k]}</span>"
            for k in ("no_gap", "effect", "unknown")
        )
        table = Table(
            ["vehicle", "verdicts", "newest gap, twin as given"],
            [[v.name, Html(_strip(v, span)), _gap(v, "gap_before")] for v in shown],
        )
        return Section(title, f"One mark for every date.{more}", Html(f"<p>{legend}</p>"), table)
    quantities = _followed(vehicles)
    if not quantities:
        table = Table(["vehicle", "newest gap, calibrated"], [[v.name, _gap(v, "gap_after")] for v in shown])
        return Section(title, "The drives identify none of the quantities that are followed.", table)
    series = {(v.name, q): v.series(q) for v in shown for q in quantities}
    ranges = {q: _range([series[v.name, q] for v in shown]) for q in quantities}
    units = {h["quantity"]: h["unit"] for v in shown for row in v.done for h in row["health"]}
    rows = []
    for v in shown:
        steps = {c.series.quantity: _number(c.date) for c in v.named}
        cells: list[object] = [
            Html(_line(series[v.name, q], units[q], ranges[q], span, steps.get(q))) for q in quantities
        ]
        rows.append([v.name, *cells, _gap(v, "gap_after")])
    heads = [f"{quantity_label(q)} ({math.exp(-r):.2g} to {math.exp(r):.2g} ×)" for q, r in ranges.items()]
    text = (
        "A line for each quantity that is followed: its value at each date relative to the vehicle's own median, on a "
        "scale that all vehicles share (its ends stand in brackets), with the 90 % interval as a band; below it "
        "the newest value. A vertical line is a change. Dates at which the drives do not identify a quantity are left "
        f"out.{more}"
    )
    return Section(title, text, Table(["vehicle", *heads, "newest gap"], rows))


def _gap(vehicle: _Vehicle, key: str) -> Html:
    last = vehicle.last
    value = None if last is None else last[key]
    return _unbroken("–" if last is None or value is None else f"{value:.2g} {channel_unit(last['channel'])}")


def _followed(vehicles: Sequence[_Vehicle]) -> list[str]:
    """The quantities with a line: identified most often, dampers first."""
    rows = (row for v in vehicles for row in v.done if row["date"])
    counts = Counter(h["quantity"] for row in rows for h in row["health"] if h["identified"])
    most = sorted(counts, key=lambda q: (-counts[q], q))[:_QUANTITIES]

    def place(quantity: str) -> tuple[int, str]:
        return next((i for i, word in enumerate(_ORDER) if word in quantity), len(_ORDER)), quantity

    return sorted(most, key=place)


def _logs(series: Sequence[Point]) -> Floats:
    """(n, 4): day, and the logarithms of value and interval relative to the median value."""
    found = np.array([row for row in series if row[1] > 0.0], dtype=np.float64).reshape(-1, 4)
    if len(found):
        middle = np.median(found[:, 1])
        found[:, 1:] = np.log(np.maximum(found[:, 1:], 1e-3 * middle) / middle)
    return found


def _range(all_series: Sequence[Sequence[Point]]) -> float:
    most = max((float(np.abs(_logs(s)[:, 1]).max(initial=0.0)) for s in all_series if s), default=0.0)
    return max(1.1 * most, math.log1p(_LEAST_RANGE))


def _line(
    series: Sequence[Point], unit: str, reach: float, span: tuple[float, float], change: float | None
) -> str:
    """A small drawing of one series, with the day of a ``change``, and its newest value below it."""
    rows = _logs(series)
    if not len(rows):
        return "–"
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _LINE_POINTS)).astype(int))]
    width, height, margin = _LINE_WIDTH, _LINE_HEIGHT, 3.0
    days = np.append(rows[:, 0], change if change is not None else span[0])
    *x, step = margin + (width - 2.0 * margin) * (days - span[0]) / max(span[1] - span[0], 1e-9)
    y = height / 2.0 - (height / 2.0 - margin) * np.clip(rows[:, 1:] / reach, -1.0, 1.0)
    band = [*zip(x, y[:, 1], strict=True), *zip(x[::-1], y[::-1, 2], strict=True)]
    points, path = (
        " ".join(f"{a:.1f},{b:.1f}" for a, b in line) for line in (band, zip(x, y[:, 0], strict=True))
    )
    mark = f'<path d="M{step:.1f} 1V{height - 1:.0f}" stroke="var(--simulated)" stroke-width="1.5"/>'
    mark = mark if change is not None else ""
    _, value, low, high = series[-1]
    text, interval = plain(value, unit, 3), f"{plain(low, unit, 3)} to {plain(high, unit, 3)}"
    return (
        f'<svg role="img" aria-label="newest {text}" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}" style="display:block"><path d="M0 {height / 2:.0f}H{width:.0f}" '
        f'stroke="var(--grid)"/><polygon points="{points}" fill="var(--measured)" opacity=".22"/>{mark}'
        f'<polyline points="{path}" fill="none" stroke="var(--measured)" stroke-width="1.4"/>'
        f'<circle cx="{x[-1]:.1f}" cy="{y[-1, 0]:.1f}" r="2.2" fill="var(--measured)"/></svg>'
        f'<span title="{interval}" style="white-space:nowrap">{text}</span>'
    )


def _strip(vehicle: _Vehicle, span: tuple[float, float]) -> str:
    """A mark for every date, coloured by its verdict."""
    width, height, size = 4.0 * _LINE_WIDTH, 18.0, 7.0
    marks = []
    for row in vehicle.done:
        if row["date"] and row["verdict"] in _STRIP:
            at = (width - size) * (_number(row["date"]) - span[0]) / max(span[1] - span[0], 1e-9)
            names = wording.listed([wording.effect_name(e) for e in row["combination"]])
            label = html.escape(f"{_day(row['date'])}: {names or _VERDICTS[row['verdict']]}", quote=True)
            marks.append(
                f'<rect x="{at:.1f}" y="2" width="{size:g}" height="{height - 4:g}" rx="1.5" '
                f'fill="var(--{_STRIP[row["verdict"]]})"><title>{label}</title></rect>'
            )
    return (
        f'<svg role="img" aria-label="{len(marks)} verdicts" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'height="{height:g}" style="display:block"><path d="M0 {height / 2:g}H{width:g}" stroke="var(--grid)"/>'
        f"{''.join(marks)}</svg>"
    )


# -- map ---------------------------------------------------------------------------------------------


def _places(rows: Sequence[Record]) -> Places:
    # A road's pieces have the same position in every row; 1e-5 degrees are 1.1 m.
    found: dict[tuple[float, float], dict[str, list[float]]] = defaultdict(
        lambda: defaultdict(lambda: [0.0, 0.0])
    )
    for row in rows:
        for p in row["places"]:
            if p["rms"] is not None and p["seconds"] > 0.0:
                total = found[round(p["latitude"], 5), round(p["longitude"], 5)][row["vehicle"]]
                total[0] += p["rms"] ** 2 * p["seconds"]
                total[1] += p["seconds"]
    table = []
    for place, by_vehicle in found.items():
        square, seconds = np.array(list(by_vehicle.values())).T
        rms, median = math.sqrt(square.sum() / seconds.sum()), np.median(np.sqrt(square / seconds))
        table.append((*place, rms, len(by_vehicle), median, seconds.sum()))
    return np.array(table, dtype=_PLACE)


def _roads(places: Places) -> list[Places]:
    """The places in groups that lie near each other, those with the most driving first."""
    latitude, longitude = np.radians(places["latitude"]), np.radians(places["longitude"])
    around = np.cos(latitude)
    on_sphere = 6.371e6 * np.column_stack(
        [around * np.cos(longitude), around * np.sin(longitude), np.sin(latitude)]
    )
    cells, index = np.unique(np.floor(on_sphere / (0.5 * _NEAR)), axis=0, return_inverse=True)
    tree = cKDTree(cells)
    _, label = connected_components(tree.sparse_distance_matrix(tree, 2.0), directed=False)
    of_place = label[index.ravel()]
    groups = [places[of_place == k] for k in range(of_place.max() + 1)]
    return sorted(groups, key=lambda g: -float(g["seconds"].sum()))


def _map(fleet: _Fleet) -> Section | None:
    places = _places(fleet.done)
    if not places.size:
        return None
    unit = channel_unit("vertical_acceleration")
    roads = _roads(places)
    figures: list[Figure] = []
    captions: list[str] = []
    listed: list[list[object]] = []
    for road in roads[:_ROADS]:
        latitude, longitude = float(road["latitude"].mean()), float(road["longitude"].mean())
        datum = Datum(latitude=latitude, longitude=longitude, altitude=0.0)
        local = LocalMap(datum).to_map(road["latitude"], road["longitude"], np.zeros(road.size))
        worst = _worst(local, road["rms"])
        figures.append(_drawn(local, road["rms"], worst, len(listed), unit))
        captions.append(
            f"{_hours(float(road['seconds'].sum()))} of driving around {latitude:.5f}, {longitude:.5f} "
            "(degrees north, east)."
        )
        for place in road[worst]:
            where = f"{place['latitude']:.5f}, {place['longitude']:.5f}"
            residuals = [f"{place[name]:.2g} {unit}" for name in ("rms", "median")]
            listed.append([len(listed) + 1, where, *residuals, int(place["vehicles"])])
    if len(roads) > _ROADS:
        captions[0] += f" The {_ROADS} of {len(roads)} regions with the most driving are drawn."
    left = "after calibration" if fleet.calibrated else "of the twins as given"
    text = (
        f"Residual of the vertical acceleration {left}, by section of road, over all vehicles. Where one vehicle "
        "raises it, the median vehicle is much lower; where both are high, the road is not as its file says."
    )
    columns = ("no.", "latitude, longitude", "residual, rms", "of the median vehicle", "vehicles")
    return Section("Where the gaps lie", text, *figures, Table(columns, listed), captions=captions)


def _hours(seconds: float) -> str:
    return f"{seconds / 3600.0:.2g} h" if seconds >= 3600.0 else f"{seconds / 60.0:.2g} min"


def _worst(local: Floats, rms: Floats) -> list[int]:
    """Indices of the worst places, apart from each other."""
    chosen: list[int] = []
    least = _OUTSTANDING * float(np.median(rms))
    for i in np.argsort(-rms):
        if len(chosen) == _WORST or (chosen and rms[i] < least):
            break
        if all(np.hypot(*(local[i, :2] - local[j, :2])) >= _APART for j in chosen):
            chosen.append(int(i))
    return chosen


def _drawn(local: Floats, rms: Floats, worst: Sequence[int], before: int, unit: str) -> Figure:
    x, y = local[:, 0], local[:, 1]
    width, height = (max(float(np.ptp(s)), 1.0) for s in (x, y))
    with style.drawing(9.2, float(np.clip(8.0 * height / width + 0.9, 2.8, 6.5))) as (fig, axes):
        order = np.argsort(rms)
        points = axes.scatter(
            x[order], y[order], c=rms[order], cmap="viridis", s=24.0, linewidths=0, zorder=3
        )
        fig.colorbar(points, ax=axes, label=f"residual, rms [{unit}]", shrink=0.9, pad=0.01)
        for number, i in enumerate(worst):
            axes.annotate(
                str(before + number + 1),
                (x[i], y[i]),
                xytext=(6, 6),
                textcoords="offset points",
                fontsize=8.5,
                fontweight="bold",
                zorder=5,
            )
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="east [m]", ylabel="north [m]")
    return fig


# -- the rest ----------------------------------------------------------------------------------------


def _failures(failed: Sequence[Record]) -> Section:
    rows = [
        [
            row["vehicle"],
            _unbroken(_day(row["date"]) or "–"),
            Cell(row["status"], "warn" if row["status"] == "lost" else "bad"),
            row["message"],
        ]
        for row in failed[:_FAILED]
    ]
    more = _more(_FAILED, len(failed))
    text = f"`lost`: another run of the same command tries it again. `failed`: it would fail again.{more}"
    return Section("Rows that could not be done", text, Table(("vehicle", "date", "status", "message"), rows))


def _method(fleet: _Fleet) -> Section:
    if not fleet.calibrated:
        text = (
            "Every row was diagnosed by itself, as `suspension-twin diagnose` does it; its folder holds "
            "diagnosis.json, evidence.json and the twin with the causes that were found."
        )
    else:
        text = (
            "Every row was calibrated by itself, as `suspension-twin calibrate` does it; its folder holds the twin. Of "
            "each quantity of each vehicle the logarithms over time are compared with and without one step: prior "
            "probability of a step 2 %, scatter from drive to drive marginalised. A slow drift is described as a step, "
            "and a change of the road or of the driver that several vehicles share looks like a change of the vehicles."
        )
    text += "\n\nAll of it is in results.parquet, health.parquet and changes.parquet beside this page."
    return Section("Method", text, folded=True)
