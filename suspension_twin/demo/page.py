# SPDX-License-Identifier: Apache-2.0
"""The page of the demo."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.calibration.labels import parameter_unit
from suspension_twin.calibration.presets import PART_KEYS
from suspension_twin.demo.steps import DRIVES, LEARNT, UNSEEN, DemoResult, Outcome
from suspension_twin.inference.observation import observe
from suspension_twin.models.parameters import twin_value
from suspension_twin.models.parts import has_part
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.report import Cell, Page, Section, Table, plots
from suspension_twin.report.characteristics import AxleEvidence, characteristics, force
from suspension_twin.report.page import short
from suspension_twin.signals.spectra import power_density

__all__ = ["demo_page", "figures"]

_CUTOFF = 20.0  # Hz, the nodes' default low-pass
_WAVE = 4.0  # m; longer waves move the car and not its struts
_IDENTIFIED = Cell("yes", "good")
_NOT_IDENTIFIED = Cell("no", "warn", "extrapolated from its neighbours, or kept at its start")


def demo_page(result: DemoResult) -> Page:
    """Everything on one page; :func:`figures` has the figures alone."""
    drawn = figures(result)
    page = Page(
        "A car and its twin",
        "Two simulated drives, replayed through the four nodes; the suspension found from the first, checked on the "
        "second.",
    )
    for name, title in DRIVES.items():
        before, after = result.before[name], result.after[name]
        note = f"was {before.rms:.2f} m/s² before calibration"
        label = f"Gap on the {title}" + (", not seen in calibration" if name == UNSEEN else "")
        page.card(label, f"{after.rms:.2f} m/s²", note, "good" if after.rms < 0.6 * before.rms else "warn")
    page.card("Whole demo", f"{result.seconds:.0f} s", "replays, calibration and validation")
    page.add(Section("The gap in numbers", _explain(), _table(result)))
    page.add(
        Section(
            "The speed bump, in time",
            "Vertical acceleration at the phone's place, of the phone and of the twin's virtual sensor on the same "
            "road, its x, y and yaw locked to the car. Both went through the same low-pass; both are as the nodes "
            "published them while the drive was played.",
            drawn["bump_time"],
            captions=["Three passes at 15 km/h. Below, the difference between car and twin."],
        )
    )
    page.add(
        Section(
            "The road it has not seen, in time",
            "The same calibrated twin on another road, 90 m with potholes and a ramp. Nothing was fitted here.",
            drawn["road_time"],
            captions=["The whole drive, from the moment the heading is known."],
        )
    )
    page.add(
        Section(
            "In frequency",
            "Where the gap lies. The body heaves at 1 to 3 Hz, the wheels hop at about 10 Hz.",
            drawn["bump_frequency"],
            drawn["road_frequency"],
            captions=[f"On the {DRIVES[LEARNT]}.", f"On the {DRIVES[UNSEEN]}, not seen in calibration."],
        )
    )
    page.add(
        Section(
            "Where the car was",
            "The twin follows the real car's x, y and yaw; the line is the pose that the pose injector computes "
            "from fixes and gyroscope. The fixes are of the antenna, which is beside and ahead of the locked point.",
            drawn["bump_map"],
            drawn["road_map"],
            captions=[
                "Out over the bump, round, back, round and over it again.",
                "Along the road that the file holds.",
            ],
        )
    )
    page.add(
        Section(
            "Where on the road the gap lies",
            "",
            drawn["road_residual"],
            captions=["Rms of the gap in each metre of the unseen road; below, the road under the wheels."],
        )
    )
    page.add(
        Section(
            "Springs and dampers",
            "Springs and dampers as identified from the bump alone. Springs are drawn over the travel from standstill: "
            "a drive does not identify their free length. Outside the shaded range the drive did not move the struts: "
            "there the characteristics are extrapolated. The truth is known because the drive is simulated; the "
            "calibration did not see it.",
            drawn["characteristics"],
        )
    )
    page.add(_calibration(result, drawn.get("convergence")))
    return page


def figures(result: DemoResult) -> dict[str, Figure]:
    """Every figure of the page by name."""
    bump, road = (result.before[n] for n in (LEARNT, UNSEEN))
    drawn = {
        "bump_time": _in_time(result, LEARNT, _passes(bump)),
        "road_time": _in_time(result, UNSEEN, [_whole(road)]),
        "bump_frequency": _in_frequency(result, LEARNT),
        "road_frequency": _in_frequency(result, UNSEEN),
        "bump_map": _map(result, LEARNT),
        "road_map": _map(result, UNSEEN),
        "road_residual": _by_road(result, UNSEEN),
        "characteristics": _characteristics(result),
    }
    searched = [f for f in result.history if f.evaluations > 0 and math.isfinite(f.best_cost)]
    if len(searched) > 1:
        drawn["convergence"] = plots.convergence(
            np.array([float(f.evaluations) for f in searched]), np.array([f.best_cost for f in searched])
        )
    return drawn


def _passes(outcome: Outcome) -> list[plots.Window]:
    """The three strongest seconds, each a pass over the bump, in their order."""
    t, y = outcome.replay.t, np.where(outcome.compared, outcome.replay.measured, 0.0)
    middles: list[float] = []
    left = np.abs(y)
    for _ in range(3):
        middle = float(t[np.argmax(left)])
        middles.append(middle)
        left = np.where(np.abs(t - middle) < 5.0, 0.0, left)
    return [plots.Window(m - 0.6, m + 1.6, f"pass {i}") for i, m in enumerate(sorted(middles), start=1)]


def _whole(outcome: Outcome) -> plots.Window:
    t = outcome.replay.t[outcome.compared]
    return plots.Window(float(t[0]), float(t[-1]))


def _in_time(result: DemoResult, name: str, windows: list[plots.Window]) -> Figure:
    before, after = result.before[name].replay, result.after[name].replay
    return plots.in_time(
        after.t,
        after.measured,
        after.simulated,
        before=_at(before.t, before.simulated, after.t),
        windows=windows,
        origin=float(after.t[0]),
        names={"simulated": "twin, calibrated", "before": "twin as it started"},
    )


def _at(t: Floats, y: Floats, stamps: Floats) -> Floats:
    """Values at exactly those stamps, NaN where there is none."""
    place = np.clip(np.searchsorted(t, stamps), 0, t.size - 1)
    return np.where(t[place] == stamps, y[place], np.nan)


def _in_frequency(result: DemoResult, name: str) -> Figure:
    before, after = result.before[name].replay, result.after[name].replay
    both = np.isin(after.t, before.t[result.before[name].compared])
    t = after.t[np.logical_and(result.after[name].compared, both)]
    rate = 1.0 / float(np.median(np.diff(after.t)))
    grid = np.arange(t[0], t[-1], 1.0 / rate)
    measured, simulated = (np.interp(grid, after.t, x) for x in (after.measured, after.simulated))
    signals = {
        "residual": measured - simulated,
        "before": np.interp(grid, before.t, before.simulated),
        "measured": measured,
        "simulated": simulated,
    }
    frequency, density = power_density(np.column_stack(list(signals.values())), rate, 4.0)
    names = {
        "simulated": "twin, calibrated",
        "before": "twin as it started",
        "residual": "measured − calibrated",
    }
    columns = dict(zip(signals, density.T, strict=True))
    return plots.in_frequency(frequency, columns, cutoff=_CUTOFF, names=names)


def _map(result: DemoResult, name: str) -> Figure:
    path = result.after[name].replay.path
    path = path[np.isfinite(path[:, 5])]
    site = result.sites[name]
    road, fix = site.road, site.drive.fix
    outline = np.column_stack(road.uv_to_xy(*_border(road.u, road.v)))
    fixes = LocalMap(site.datum).to_map(fix.latitude, fix.longitude, fix.altitude)[:, :2]
    middle = road.x.size // 2
    heading = float(np.arctan2(road.y[middle + 1] - road.y[middle], road.x[middle + 1] - road.x[middle]))
    return plots.path_map(
        path[:, 1],
        path[:, 2],
        outline=outline,
        fixes=fixes,
        value=3.6 * path[:, 4],
        turn=-heading,
    )


def _border(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Road coordinates once around the road's border."""
    ones_u, ones_v = np.ones_like(u), np.ones_like(v)
    along = np.concatenate([u, u[-1] * ones_v, u[::-1], u[0] * ones_v])
    across = np.concatenate([v[0] * ones_u, v, v[-1] * ones_u, v[::-1]])
    return along, across


def _by_road(result: DemoResult, name: str) -> Figure:
    before, after = result.before[name], result.after[name]
    road = result.sites[name].road
    difference = (after.replay.measured - after.replay.simulated)[after.compared]
    early = before.replay.measured - before.replay.simulated
    station = after.station[after.compared]
    lane = float(np.median(road.xy_to_uv(after.replay.path[:, 1], after.replay.path[:, 2])[1]))
    half = result.twins["before"].vehicle.front_track / 2
    u = np.arange(station.min(), station.max() + 3.0, road.u_step)
    tracks = np.column_stack([road.heights_uv(u, np.full(u.size, lane + side)) for side in (half, -half)])
    tracks -= uniform_filter1d(tracks, round(_WAVE / road.u_step), axis=0, mode="nearest")
    return plots.residual_by_road(
        station,
        difference,
        before=_at(before.replay.t, early, after.replay.t)[after.compared],
        profile=(u, tracks),
        profile_label=f"waves below\n{_WAVE:g} m [cm]",
        names={"residual": "calibrated", "before": "twin as it started"},
    )


def _excited(result: DemoResult) -> dict[str, AxleEvidence]:
    """Travel from standstill and velocity of the calibrated twin's struts on the drive learnt from."""
    twin, site = result.twins["simulated"], result.sites[LEARNT]
    response = simulate_twin(twin, observe(site.drive, twin, site.road).road_excitation)
    found = {}
    for axle, own in twin.axles.items():
        travel = response.deflection[:, own.columns] - own.static_compression
        velocity = response.deflection_rate[:, own.columns]
        found[axle] = AxleEvidence(
            compression=(float(travel.min()), float(travel.max())),
            velocity=(float(velocity.min()), float(velocity.max())),
        )
    return found


def _characteristics(result: DemoResult) -> Figure:
    vehicles = {role: result.twins[role].vehicle for role in ("before", "simulated", "truth")}
    return characteristics(
        vehicles, evidence=_excited(result), names={"before": "as it started"}, from_rest=True
    )


def _calibration(result: DemoResult, convergence: Figure | None) -> Section:
    answer = result.calibration
    rows: list[list[object]] = []
    for key, value in answer.values.items():
        label, started, truth = _beside(result, key)
        off = f"{round(100 * (value / truth - 1)):+d} %".replace("-", "−") if truth else "–"
        mark = _IDENTIFIED if answer.excited.get(key, True) else _NOT_IDENTIFIED
        rows.append(
            [
                label,
                started,
                value,
                truth,
                off,
                mark,
            ]
        )
    columns = ["parameter", "started as", "found", "truth", "off by", "identified"]
    identified = sum(answer.excited.get(key, True) for key in answer.values)
    text = (
        f"The action `calibrate` brought the cost from {short(answer.initial_cost)} to {short(answer.cost)} with "
        f"{answer.evaluations} simulated candidates in {answer.wall:.0f} s. {identified} of {len(answer.values)} "
        "parameters are identified by the drive; the others are extrapolated from their neighbours or kept."
    )
    return Section(
        "The calibration", text, convergence, Table(columns, rows, "Forces at the wheel, for one wheel.")
    )


def _beside(result: DemoResult, key: str) -> tuple[str, float, float]:
    """Label of a calibrated number, and what it was at the start and is in truth.

    The points of a characteristic are those of the calibrated twin; a spring's count from where the car stands.
    """
    found, others = result.twins["simulated"], (result.twins["before"], result.twins["truth"])
    curve, _, index = key.rpartition(".force.")
    if not curve:
        unit = parameter_unit(key)
        label = key.removeprefix("vehicle.").replace("_", " ").replace(".", " ")
        started, truth = (
            0.0 if key in PART_KEYS and not has_part(t, key) else float(twin_value(t, key)) for t in others
        )
        return f"{label} [{unit}]" if unit else label, started, truth
    axle, part = curve.removeprefix("vehicle.").split(".")
    x = float(twin_value(found, curve).points[0][int(index)])
    spring = part == "spring"
    rest = [t.axles[axle].static_compression if spring else 0.0 for t in (found, *others)]
    started, truth = (
        float(force(twin_value(t, curve).points, np.array([x - rest[0] + own]))[0])
        for t, own in zip(others, rest[1:], strict=True)
    )
    where = f"{x - rest[0]:+.2f} m from rest".replace("-", "−") if spring else f"{x:g} m/s"
    return f"{axle} {part.replace('_', ', ')}, {where} [N]", started, truth


def _explain() -> str:
    return (
        "Root mean square of measured minus simulated vertical acceleration over all driving, as `simulate` prints it; "
        "in brackets the mean square that the car paper counts. Live, as the nodes published it, the pose knows the "
        "past alone, and what came before the heading was known is left out. The true parameters leave a gap too: "
        "the reality behind these drives has friction, tyre damping and a phone's noise that no twin has. "
        "The paper's own figures on its road, 2.42 (IPG CarMaker) and 2.12 (Unity 3D), are of another car, road and "
        "recording, and cannot be compared with these."
    )


def _table(result: DemoResult) -> Table:
    rows = []
    for name, title in DRIVES.items():
        before, after, truth = (part[name] for part in (result.before, result.after, result.truth))
        seen = "calibrated on" if name == LEARNT else "not seen"
        shrink = 1.0 - after.rms / before.rms
        rows.append(
            [
                f"{title} ({seen})",
                f"{after.measured_rms:.3f}",
                f"{before.rms:.3f} ({before.mse:.4f})",
                Cell(f"{after.rms:.3f} ({after.mse:.4f})", "good" if shrink > 0.4 else "warn"),
                f"{after.live:.3f}",
                f"{truth.rms:.3f} ({truth.mse:.4f})",
                f"{100 * shrink:.0f} %",
            ]
        )
    columns = [
        "drive",
        "measured, rms m/s²",
        "gap as it started",
        "gap calibrated",
        "live",
        "gap of the true parameters",
        "closed",
    ]
    return Table(columns, rows)
