# SPDX-License-Identifier: Apache-2.0
"""From a request to a bench: reading, checking, and calibrating the vehicle without any effect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.checks import check_drive, check_parts, check_recording
from suspension_twin.calibration.presets import build_space, preset_named
from suspension_twin.diagnosis.bench import NORMAL, Bench, Excitations
from suspension_twin.diagnosis.fit import Linear, finished, fitted, refit
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.gap.common_rate import on_common_rate
from suspension_twin.gap.measure import CHANNELS
from suspension_twin.gap.prepare import (
    Prepared,
    PrepareSettings,
    prepare,
    reclocked_excitation,
    regained_excitation,
    road_of,
    turned_excitation,
    upright_excitation,
)
from suspension_twin.identification.excited_segments import TrimSettings, fit_rows
from suspension_twin.identification.noise import USUAL_SHARE, Whitener, shares
from suspension_twin.identification.objectives import parse_objective
from suspension_twin.identification.parallel import side_by_side
from suspension_twin.identification.posterior import CORRELATION
from suspension_twin.identification.problem import Interrupted, Problem
from suspension_twin.road import flat_road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["PLANAR", "VERTICAL", "Case", "baseline", "build", "read_case", "taught_by"]

VERTICAL = ("vertical_acceleration", "roll_rate", "pitch_rate")
PLANAR = ("longitudinal_acceleration", "lateral_acceleration", "yaw_rate")
#: Without a road: what the receiver has seen against what the IMU has felt.
_PLANAR_ONLY = PrepareSettings(filter=FilterSpec(2, 1.6), satellites=True, saturated=True)
_ON_ROAD = PrepareSettings(saturated=True)
#: What clock and mounting are is then the very question, and nothing else shows it.
#: Rear tyres of cars slip by about 0.005 rad for each m/s²; a course that lags by that would pass for a clock's.
_BARE = replace(
    NORMAL, clock=0.0, common_clock=0.0, map_position=0.0, tilt=0.0, pivot=0.0, slip=0.005, drive_map=0.0
)
#: The best in m that a map and a pose agree to.
_MAP_LEAST = 0.002
#: Seconds of compared driving below which nothing can be held back from the fit.
SHORTEST = 8.0
#: Free beside the characteristics: what no weighbridge tells.
_ALSO = (
    "vehicle.sprung_inertia.roll",
    "vehicle.sprung_inertia.pitch",
    "vehicle.tyre.vertical_stiffness",
    "vehicle.front.unsprung_mass",
    "vehicle.rear.unsprung_mass",
)
#: Without a road nothing speaks for the characteristics; how far the body leans is all that its motion shows.
_LEANING = ("vehicle.cog.2",)


@dataclass(frozen=True, eq=False)
class Case:
    """Drives ready to compare; ``active`` True where the gap is shown, ``road`` False without a road file;
    ``excitations`` what else may excite the vehicle on each drive, and ``turn`` (roll, pitch, yaw; rad) by how much the
    sensor is turned on those with the gap."""

    twin: Twin
    drives: tuple[Prepared, ...]
    excitations: tuple[Excitations, ...]
    turn: tuple[float, float, float]
    active: tuple[bool, ...]
    road: bool
    warnings: tuple[str, ...]

    @property
    def channels(self) -> tuple[str, ...]:
        return CHANNELS if self.road else PLANAR


def read_case(request: DiagnosisRequest, note: Callable[[str], None], stop: Callable[[], bool]) -> Case:
    """Read and check everything; raises InputError that names the file or the drive."""
    twin = load_twin(request.twin)
    if not request.bags:
        raise InputError("drives", "none are given: name at least one recorded drive that shows the gap")
    same = {Path(b).resolve() for b in request.bags} & {Path(b).resolve() for b in request.reference}
    if same:
        raise InputError(min(same).name, "is given as a drive with the gap and as one from before it")
    on_road = twin.road is not None
    road = road_of(twin) if on_road else flat_road()

    def recording(bag: str) -> Drive:
        if stop():
            raise Interrupted
        recorded = read_drive(bag, topics=request.topics)
        check_recording(recorded)
        return recorded

    def ready(recorded: Drive) -> tuple[Prepared, Excitations, tuple[float, float, float]]:
        if stop():
            raise Interrupted
        prepared = prepare(recorded, twin, road, _ON_ROAD if on_road else _PLANAR_ONLY, strict=True)
        if on_road:
            check_drive(prepared)
        return prepared, *_excitations(prepared, recorded)

    bags = (*request.bags, *request.reference)
    recordings = side_by_side(recording, bags, lambda _, bag: note(f"reading {Path(bag).name}"))
    found = side_by_side(ready, on_common_rate(recordings, FilterSpec()))
    drives = [prepared for prepared, _, _ in found]
    excitations, turns = [known for _, known, _ in found], [turn for _, _, turn in found]
    names: list[str] = []
    for i, drive in enumerate(drives):
        name = drive.name if drive.name not in names else f"{drive.name}_{i + 1}"
        names.append(name)
        drives[i] = replace(drive, name=name)
    active = tuple(i < len(request.bags) for i in range(len(drives)))
    warnings = [f"{d.name}: {text}" for d in drives for text in d.warnings]
    if not on_road:
        warnings.append(
            "the twin file names no road: only the planar channels are compared, and only effects of clock, sensor "
            "and mount can be judged"
        )
    roll, pitch, yaw = np.angle(np.exp(1j * np.array(turns[: len(request.bags)])).sum(axis=0)).tolist()
    return Case(twin, tuple(drives), tuple(excitations), (roll, pitch, yaw), active, on_road, tuple(warnings))


def _excitations(prepared: Prepared, drive: Drive) -> tuple[Excitations, tuple[float, float, float]]:
    """What else may excite the vehicle, and by how much the sensor is turned."""
    turned, turn = turned_excitation(prepared, drive)
    regained, reclocked = (
        {upright: found for upright in (False, True) if (found := of(prepared, drive, upright)) is not None}
        for of in (regained_excitation, reclocked_excitation)
    )
    return Excitations(upright_excitation(prepared, drive), turned, regained, reclocked), turn


def build(case: Case, stop: Callable[[], bool]) -> Bench:
    """The bench of a case with the noise model for a share of the motion that nobody knows yet."""
    settings = TrimSettings() if case.road else TrimSettings(threshold=0.0)
    for drive in case.drives:
        samples = fit_rows(drive, settings).size
        if case.road:
            check_parts(drive, samples, settings)
    for wanted, what in ((True, "drives that show the gap"), (False, "reference drives")):
        own = [d for d, a in zip(case.drives, case.active, strict=True) if a == wanted]
        seconds = sum(fit_rows(d, settings).size / d.rate for d in own)
        if own and seconds < SHORTEST:
            raise InputError(
                own[0].name,
                f"{seconds:.1f} s of excited driving in the {what} cannot be split into stretches to fit and stretches "
                f"to judge on: at least {SHORTEST:.0f} s are needed",
            )
    preset = preset_named("fast")
    twin = case.twin
    if case.road:
        space = build_space(twin, replace(preset, also=_ALSO))
    else:
        space = build_space(twin, replace(preset, also=()), free=_LEANING)
    terms = parse_objective("euclidean", dict.fromkeys(case.channels, 1.0))
    wander = [0.5 * d.position_sigma if d.position_sigma >= 0.1 else 0.0 for d in case.drives]
    numbers = list(range(len(case.drives)))
    normal = replace(NORMAL, map_position=_map_spread(case.drives)) if case.road else _BARE
    problem = Problem(twin, space, case.drives, numbers, terms, normal, wander, settings)
    problem.interrupt = stop
    d, q = len(space), len(problem.nuisances)
    precision = np.zeros((d + q, d + q))
    precision[:d, :d] = space.prior_precision(CORRELATION)
    precision[np.arange(d, d + q), np.arange(d, d + q)] = 1.0 / problem.nuisances.spread**2
    centre = np.concatenate([space.z0, np.zeros(q)])
    share = np.full((len(case.channels), 129), USUAL_SHARE)
    floors = [dict(p.noise_rms) for p in case.drives]
    whitener = Whitener.designed(problem.measured, share, floors)
    return Bench(
        problem, case.excitations, case.turn, case.active, whitener, precision, centre, stop, fused=case.road
    )


def _map_spread(drives: Sequence[Prepared]) -> float:
    """m of standard deviation by which all drives' poses may be off the map along the road.

    The mean of drives goes no further than the receiver says of single fixes: that is the limit, three spreads.
    """
    told = [d.position_sigma for d in drives if d.position_sigma > 0]
    return (
        float(np.clip(np.mean(told) / 3.0, _MAP_LEAST, NORMAL.map_position)) if told else NORMAL.map_position
    )


def baseline(case: Case, bench: Bench) -> tuple[Linear, Linear]:
    """The vehicle without any effect: on all drives, and where searches for effects start from.

    With a reference, what the calibrated model leaves there, band by band, is what it leaves of the same
    car anyway, and searches start from the vehicle that the reference shows. Planar accelerations come
    from GNSS and not from the model: their noise is what they leave. Whether vehicle or sensor leans by the little
    that any does is as the fit has it.
    """
    quiet = [i for i, a in enumerate(bench.active) if not a] or list(range(len(bench.active)))
    referenced = len(quiet) < len(bench.active)
    x = bench.centre.copy()
    for number in range(2):
        if case.road:
            bench.carry(x)
        trial = replace(bench, heard=tuple(quiet))
        x, cost = refit(trial, BASELINE, [x] if number else _many(bench, x), None, 8 if number == 0 else 5)
        if case.road and number == 0:
            level = trial.levelled()
            y, other = refit(level, BASELINE, [x], None, 5)
            if other < cost:
                x, bench.problem, bench.level = y, level.problem, True
        taught_by(case, bench, BASELINE, x, quiet, () if referenced else VERTICAL)
    anchor = finished(bench, BASELINE, x)
    return (fitted(bench, BASELINE, [x], 6), anchor) if referenced else (anchor, anchor)


def taught_by(
    case: Case,
    bench: Bench,
    hypothesis: Hypothesis,
    x: Floats,
    drives: Sequence[int],
    usual: Sequence[str] = (),
) -> None:
    """Give the bench the noise that a fit leaves on some drives; ``usual`` channels keep the usual share of it."""
    d, q = bench.d, bench.q
    signals, _ = bench.signals(hypothesis, x[:d, None], x[d + q :, None])
    simulated = bench.compared(signals, x[d : d + q, None])[:, :, 0]
    left = shares(bench.problem.measured, simulated - bench.problem.measured.values, drives)
    for c, channel in enumerate(bench.problem.channels):
        if channel in usual:
            left[c] = USUAL_SHARE
    whitener = Whitener.designed(bench.problem.measured, left, [dict(p.noise_rms) for p in case.drives])
    white = whitener.residuals(simulated[:, :, None])[:, 0]
    bench.whitener = _scaled(whitener, white, np.isin(whitener.drive, drives))


def _scaled(whitener: Whitener, white: Floats, rows: np.ndarray) -> Whitener:
    scale = whitener.scale.copy()
    for c in range(scale.size):
        own = white[rows & (whitener.channel == c)]
        scale[c] *= float(np.clip(np.sqrt(np.mean(own**2)), 1e-2, 1e3)) if own.size else 1.0
    return replace(whitener, scale=scale)


def _many(bench: Bench, x: Floats) -> Sequence[Floats]:
    """The twin as it stands and stiffer, softer, harder and weaker versions of it."""
    found = [x]
    for springs in (-0.7, 0.0, 0.7, 1.4):
        for dampers in (-0.7, 0.0, 0.7):
            y = x.copy()
            for curve in bench.problem.space.curves:
                rows = [r for r in curve.rows if r >= 0]
                y[rows] += springs if curve.key.endswith("spring") else dampers
            found.append(y)
    return found
