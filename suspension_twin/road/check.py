# SPDX-License-Identifier: Apache-2.0
"""Figures of a road, and findings of whatever a simulation on it would suffer from."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.crg import examine, load_road, scan_holes
from suspension_twin.road.road import Road
from suspension_twin.road.roughness import ProfileEvent, Roughness, iri, profile_events, profile_roughness
from suspension_twin.road.smoothing import Spike, Spikes, find_spikes

__all__ = [
    "PathFigures",
    "RoadCheck",
    "RoadFinding",
    "check_file",
    "check_road",
    "enclosed",
    "on_itself",
    "wheel_paths",
]

#: A jump this high (m) and this steep (m/m) between neighbours is a step, unless a spike makes it.
_STEP, _STEP_SLOPE = 0.05, 1.0
_STEEP_ROAD, _STEEP_BANK = 0.25, 0.15
_COARSE = 0.25  # m; a wheel's contact patch is about as long
_APART = 0.5  # m between places that are looked at: no road for a car is as narrow
_TRACK = 1.5

P = ParamSpec("P")
Figure = TypeVar("Figure")


@dataclass(frozen=True)
class RoadFinding:
    """One thing worth knowing: ``fault`` True where a simulation would suffer from it."""

    text: str
    fault: bool


@dataclass(frozen=True, eq=False)
class PathFigures:
    """One wheel path: ``side``, ``v`` m, its single events, its ISO 8608 roughness and its IRI in m/m.

    The last two are None where they are not defined: a path is too short, or level beside its events.
    """

    side: str
    v: float
    events: tuple[ProfileEvent, ...]
    roughness: Roughness | None
    iri: float | None

    @property
    def iso8608(self) -> str:
        """The class in words."""
        if self.roughness is None:
            return "not defined"
        r = self.roughness
        text = f"ISO 8608 class {r.letter} (G(n0) {1e6 * r.g0:.3g}e-6 m^3)"
        if not self.events:
            return text
        count = "1 event" if len(self.events) == 1 else f"{len(self.events)} events"
        if r.letter == r.letter_with_events:
            return f"{text} with and without {count}"
        return f"{text} without {count}, {r.letter_with_events} with"

    def as_record(self) -> dict[str, object]:
        """Numbers for a file."""
        r = self.roughness
        known = None if r is None or not np.isfinite(r.g0) else r
        return {
            "side": self.side,
            "v": self.v,
            "iri": self.iri,
            "iso8608": known and known.letter,
            "g0": known and known.g0,
            "iso8608_with_events": known and known.letter_with_events,
            "events": [vars(e) for e in self.events],
        }


@dataclass(frozen=True, eq=False)
class RoadCheck:
    """A road with its figures (name to text), its findings, its spikes and its two wheel paths."""

    road: Road
    facts: dict[str, str]
    findings: tuple[RoadFinding, ...]
    spikes: Spikes
    wheel_paths: tuple[PathFigures, ...]

    @property
    def sound(self) -> bool:
        """True if nothing is wrong with the road."""
        return not any(f.fault for f in self.findings)


def check_file(path: str | os.PathLike[str]) -> RoadCheck:
    """:func:`check_road` of an OpenCRG file, with findings about its header and its scan."""
    road = load_road(path)
    file = examine(Path(path))
    findings = _holes_of_scan(Path(path))
    start = [file.road.get(f"reference_line_start_{k}", 0.0) for k in ("x", "y", "phi")]
    if file.missing > 0.0 and not np.isnan(road.z).any():
        share = f"{100 * file.missing:.2g} % of the heights are missing in the file"
        findings.insert(0, RoadFinding(f"{share}, filled as its modifiers say", fault=False))
    if file.mods is None and any(start):
        text = (
            "the file has no $ROAD_CRG_MODS section, so OpenCRG's default moves its start from "
            f"({start[0]:.2f}, {start[1]:.2f}) m, heading {math.degrees(start[2]):.1f} deg, to the origin of map; "
            "an empty section would keep it there"
        )
        findings.insert(0, RoadFinding(text, fault=False))
    return check_road(road, tuple(findings))


def _largest(texts: list[str], most: int, rest: str) -> list[RoadFinding]:
    """Faults, the largest first; of those beyond ``most`` only the ``rest`` with their number."""
    more = [rest.format(len(texts) - most)] if len(texts) > most else []
    return [RoadFinding(text, True) for text in (*texts[:most], *more)]


def _holes_of_scan(path: Path) -> list[RoadFinding]:
    """Holes of the scan that a road was made from, which its file cannot show."""
    texts = [
        f"nothing was measured at u {h['u_low']:.2f} to {h['u_high']:.2f} m, v {h['v_low']:.2f} to "
        f"{h['v_high']:.2f} m: heights there are bridged"
        for h in sorted(scan_holes(path), key=lambda h: -h["nodes"])
    ]
    return _largest(texts, 3, "and {} smaller holes of the scan")


def check_road(road: Road, also: tuple[RoadFinding, ...] = ()) -> RoadCheck:
    """Check a road: spikes, missing data, roughness, whatever a simulation would suffer from.

    Parameters
    ----------
    road : Road
        The road.
    also : tuple of RoadFinding
        Findings to put before those of the check.

    Returns
    -------
    RoadCheck
        Figures, findings and spikes; ``sound`` is True if nothing is wrong.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> check_road(bump_road(half_sine(0.9, 0.05))).sound
    True
    """
    spikes = find_spikes(road)
    findings = [*also, *(RoadFinding(f"the OpenCRG library warns: {note}", True) for note in road.notes)]
    paths = _path_figures(road)
    facts = _facts(road, spikes, paths)
    missing = np.isnan(road.z)
    if missing.any():
        inner = int(enclosed(missing).sum())
        share = f"{100 * missing.mean():.2g} % of the heights are missing"
        findings.append(
            RoadFinding(f"{share}, {inner} of them between data; wheels there are held", inner > 0)
        )
    findings += _largest([_spike_text(spike) for spike in spikes.found], 5, "and {} smaller spikes")
    findings += _steps(road, spikes) + _shape(road)
    if (places := on_itself(road)) is not None:
        text = "it lies on itself: u {:.1f} m and u {:.1f} m are one place in map, which has one height alone"
        findings.append(RoadFinding(text.format(*places), True))
    return RoadCheck(road, facts, tuple(findings), spikes, paths)


def _spike_text(spike: Spike) -> str:
    kind = "spike" if spike.height > 0 else "pit"
    across = f"{spike.v:.2f}" if spike.v_low == spike.v_high else f"{spike.v_low:.2f} to {spike.v_high:.2f}"
    return (
        f"{kind} of {1e3 * abs(spike.height):.0f} mm, with a step of {1e3 * spike.step:.0f} mm, "
        f"at u {spike.u:.2f} m, v {across} m"
    )


def wheel_paths(road: Road, track: float = _TRACK) -> tuple[tuple[float, float], Floats, Floats]:
    """v of the left and right wheel path about the middle of the road, and their heights along it.

    On a road narrower than ``track`` m they run at a quarter and three quarters of its width.
    """
    middle = 0.0 if road.v[0] < 0.0 < road.v[-1] else 0.5 * float(road.v[0] + road.v[-1])
    half = min(0.5 * track, 0.25 * road.width)
    left, right = middle + half, middle - half
    return (left, right), road.heights_uv(road.u, left, "hold"), road.heights_uv(road.u, right, "hold")


def _path_figures(road: Road) -> tuple[PathFigures, ...]:
    places, left, right = wheel_paths(road)
    return tuple(
        PathFigures(
            side,
            v,
            _unless_short(profile_events, z, road.u_step, road.u_first) or (),
            _unless_short(profile_roughness, z, road.u_step, road.u_first),
            _unless_short(iri, z, road.u_step),
        )
        for side, v, z in zip(("left", "right"), places, (left, right), strict=True)
    )


def _unless_short(figure: Callable[P, Figure], *given: P.args, **named: P.kwargs) -> Figure | None:
    """A figure of a profile; None where it is not defined."""
    try:
        return figure(*given, **named)
    except InputError:
        return None


def _facts(road: Road, spikes: Spikes, paths: tuple[PathFigures, ...]) -> dict[str, str]:
    grid = road.heights_grid
    x, y = road.uv_to_xy(road.u[:, None], road.v[None, [0, -1]])
    step = np.abs(np.diff(grid, axis=0))
    sections = np.diff(road.v)
    even = float(np.ptp(sections)) < 1e-9 * road.width
    return {
        "length": f"{road.length:.2f} m, {road.z.shape[0]} cross sections every {road.u_step:.6g} m",
        "width": f"{road.width:.2f} m (v {road.v[0]:g} to {road.v[-1]:g} m), {road.v.size} long sections "
        + (f"every {sections[0]:.6g} m" if even else f"{sections.min():.6g} to {sections.max():.6g} m apart"),
        "in map": f"x {x.min():.2f} to {x.max():.2f} m, y {y.min():.2f} to {y.max():.2f} m",
        "heights": f"{np.nanmin(grid):.3f} to {np.nanmax(grid):.3f} m, rms {np.nanstd(grid):.4f} m about their mean",
        "missing heights": f"{100 * np.isnan(road.z).mean():.3g} %",
        "largest step": f"{1e3 * np.nanmax(step):.1f} mm in {road.u_step:.6g} m",
        "slope": _range(np.diff(road.ref_z) / road.u_step),
        "banking": _range(road.bank),
        "curvature": _curvature(road),
        "roughness": ", ".join(f"{p.side} {p.iso8608}" for p in paths),
        "IRI": ", ".join(
            f"{p.side} " + ("not defined" if p.iri is None else f"{1e3 * p.iri:.2f} m/km") for p in paths
        ),
        "events": _events(paths),
        "spikes": str(len(spikes)),
    }


def _range(values: Floats) -> str:
    low, high = 100 * float(values.min()), 100 * float(values.max())
    return "none" if low == high == 0.0 else f"{low:.2f} to {high:.2f} %"


def _curvature(road: Road) -> str:
    turns = _turns(road)
    if road.straight or not turns.size or np.abs(turns).max() < 1e-9:
        return "none"
    return f"radius down to {road.u_step / np.abs(turns).max():.1f} m"


def _turns(road: Road) -> Floats:
    """Change of heading at the inner cross sections, rad."""
    heading = np.arctan2(np.diff(road.y), np.diff(road.x))
    return np.remainder(np.diff(heading) + math.pi, 2.0 * math.pi) - math.pi


def _events(paths: tuple[PathFigures, ...]) -> str:
    """The largest events of each wheel path, once where both paths have the same."""
    texts = []
    for path in paths:
        events = path.events
        largest = sorted(events, key=lambda e: -max(abs(e.height), abs(e.rise)))[:4]
        if largest:
            more = f" and {len(events) - 4} more" if len(events) > 4 else ""
            texts.append("; ".join(str(e) for e in sorted(largest, key=lambda e: e.start)) + more)
        else:
            texts.append("none")
    if texts[0] == texts[1]:
        return texts[0]
    return " | ".join(f"{path.side} {text}" for path, text in zip(paths, texts, strict=True))


def enclosed(missing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Missing heights with data on both sides of them in their cross section, or in none of it."""
    data = ~missing
    left = np.logical_or.accumulate(data, axis=1)
    right = np.logical_or.accumulate(data[:, ::-1], axis=1)[:, ::-1]
    empty = ~data.any(axis=1, keepdims=True)
    return missing & ((left & right) | empty)


def _steps(road: Road, spikes: Spikes) -> list[RoadFinding]:
    grid = road.heights_grid
    jump = np.abs(np.diff(grid, axis=0))
    high = (jump > _STEP) & (jump > _STEP_SLOPE * road.u_step) & ~spikes.mask[1:] & ~spikes.mask[:-1]
    if not high.any():
        return []
    rows = np.flatnonzero(high.any(axis=1))
    # Neighbouring cross sections are one step; a wheel meets each place once.
    places = np.split(rows, np.flatnonzero(np.diff(rows) > max(1, round(0.5 / road.u_step))) + 1)
    sized = [(float(np.where(high[p], jump[p], 0.0).max()), float(road.u[p[0]])) for p in places]
    sized.sort(reverse=True)
    texts = [
        f"step of {1e3 * size:.0f} mm at u {u:.2f} m; a wheel that touches at one point jumps it"
        for size, u in sized
    ]
    return _largest(texts, 3, "and steps at {} more places")


def on_itself(road: Road) -> tuple[float, float] | None:
    """u of two cross sections, m, that lie on each other in ``map``: where a road first crosses or meets itself.

    The end of a closed track may meet its start, and what lies within half a turn about a border is a bend.
    """
    every = max(1, round(_APART / road.u_step))
    u, x, y = (a[::every] for a in (road.u, road.x, road.y))
    v = road.v[~np.isnan(road.z).all(axis=0)]
    if u.size < 3 or road.straight:
        return None
    step, reach = every * road.u_step, float(np.abs(v).max())
    closed = math.hypot(road.x[-1] - road.x[0], road.y[-1] - road.y[0]) < reach
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    found = []
    for across in (v[0], 0.5 * (v[0] + v[-1]), v[-1]):
        places = np.column_stack(road.uv_to_xy(u, across))
        near = cKDTree(places).sparse_distance_matrix(
            cKDTree(np.column_stack([x, y])), reach + step, output_type="coo_matrix"
        )
        i, j = near.row, near.col
        apart = np.abs(u[i] - u[j])
        dx, dy = places[i, 0] - x[j], places[i, 1] - y[j]
        along, beside = (
            dx * np.cos(heading[j]) + dy * np.sin(heading[j]),
            dy * np.cos(heading[j]) - dx * np.sin(heading[j]),
        )
        on = (np.abs(along) <= 0.5 * step) & (beside > v[0]) & (beside < v[-1])
        on &= np.minimum(apart, road.length - apart if closed else np.inf) > math.pi * reach
        found += [(min(a, b), max(a, b)) for a, b in zip(u[i[on]].tolist(), u[j[on]].tolist(), strict=True)]
    return min(found, default=None)


def _shape(road: Road) -> list[RoadFinding]:
    found = []
    if road.u_step > _COARSE:
        text = (
            f"a cross section every {road.u_step:g} m: waves shorter than {2 * road.u_step:g} m are missing"
        )
        found.append(RoadFinding(text, road.u_step > 4 * _COARSE))
    slope = np.abs(np.diff(road.ref_z) / road.u_step)
    if slope.max() > _STEEP_ROAD:
        found.append(RoadFinding(f"the reference line climbs up to {100 * slope.max():.0f} %", True))
    if np.abs(road.bank).max() > _STEEP_BANK:
        found.append(RoadFinding(f"banked up to {100 * np.abs(road.bank).max():.0f} %", True))
    turns = _turns(road)
    if turns.size:
        reach = np.where(turns > 0.0, road.v[-1], -road.v[0])
        folded = np.abs(turns) * reach >= road.u_step
        if folded.any():
            u = float(road.u[1 + int(np.flatnonzero(folded)[0])])
            text = f"the centre of a bend lies on the road at u {u:.2f} m: its inner border runs backwards"
            found.append(RoadFinding(text, True))
    return found
