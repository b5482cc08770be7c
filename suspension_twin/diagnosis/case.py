# SPDX-License-Identifier: Apache-2.0
"""From a request to a bench: reading, checking, and calibrating the vehicle without any effect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.calibration.checks import LEAST_EXCITED, check_drive, check_on_road, check_recording
from suspension_twin.calibration.presets import build_space, preset_named
from suspension_twin.diagnosis.bench import Bench, Excitations
from suspension_twin.diagnosis.fit import Fit, LinearisedFit, fitted, linearised_fit, refit, twin_of
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import InputError
from suspension_twin.inference.common_rate import on_common_rate
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows
from suspension_twin.inference.gap import CHANNELS
from suspension_twin.inference.noise import USUAL_SHARE, Whitener, shares
from suspension_twin.inference.nuisance import OF_A_DRIVE, OF_PLANAR_MOTION, map_spread
from suspension_twin.inference.objectives import parse_objective
from suspension_twin.inference.observations import Run, observe, renamed
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.posterior import CORRELATION
from suspension_twin.inference.prepare import (
    Prepared,
    PrepareSettings,
    prepare,
    reclocked_excitation,
    regained_excitation,
    road_of,
    turned_excitation,
    upright_excitation,
)
from suspension_twin.inference.problem import Interrupted, Problem
from suspension_twin.inference.smooth_space import smooth_space
from suspension_twin.models.parameters import has_number
from suspension_twin.models.registry import model_of
from suspension_twin.road import flat_road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["ALSO", "PLANAR", "VERTICAL", "Case", "baseline", "build", "read_case", "with_noise_of"]

VERTICAL = ("vertical_acceleration", "roll_rate", "pitch_rate")
PLANAR = ("longitudinal_acceleration", "lateral_acceleration", "yaw_rate")
#: Without a road: what the receiver has seen against what the IMU has felt.
_PLANAR_ONLY = PrepareSettings(filter=FilterSpec(2, 1.6), satellites=True, saturated=True)
_ON_ROAD = PrepareSettings(saturated=True)
#: Error of a change that a model predicts, over its error about the sound vehicle there and then: a prior.
_DOUBT = 0.5
#: Seconds of compared driving below which nothing can be held back from the fit.
SHORTEST = 8.0
#: Free beside the characteristics: what no weighbridge tells.
ALSO = (
    "vehicle.sprung_inertia.roll",
    "vehicle.sprung_inertia.pitch",
    "vehicle.tyre.vertical_stiffness",
    "vehicle.front.unsprung_mass",
    "vehicle.rear.unsprung_mass",
    "vehicle.unsprung_mass",
)
#: Without a road nothing speaks for the characteristics; how far the body leans is all that its motion shows.
_LEANING = ("vehicle.cog.2",)


@dataclass(frozen=True, eq=False)
class Case:
    """Observations ready to compare; ``active`` True where the gap is shown.

    ``kind``: drives on a known ``road``, drives whose ``planar`` motion alone is known, or controlled runs (``run``).
    Of drives ``excitations`` are what else may excite the vehicle on each, and ``turn`` (roll, pitch, yaw; rad) is by
    how much the sensor is turned on those with the gap.
    """

    twin: Twin
    drives: tuple[Any, ...]
    excitations: tuple[Excitations, ...]
    turn: tuple[float, float, float]
    active: tuple[bool, ...]
    kind: Literal["road", "planar", "run"]
    warnings: tuple[str, ...]

    @property
    def road(self) -> bool:
        """Whether the vehicle drives on a known road."""
        return self.kind == "road"

    @property
    def excited(self) -> bool:
        """Whether it is known what excites the vehicle."""
        return self.kind != "planar"

    @property
    def channels(self) -> tuple[str, ...]:
        """What is compared: of controlled runs what all of them measured."""
        if self.kind == "run":
            return tuple(c for c in self.drives[0].measured if all(c in d.measured for d in self.drives))
        return CHANNELS if self.road else PLANAR

    @property
    def driven(self) -> tuple[str, ...]:
        """Channels by which the vehicle itself is judged: what its excitation brings about."""
        return VERTICAL if self.road else self.channels


def read_case(request: DiagnosisRequest, note: Callable[[str], None], stop: Callable[[], bool]) -> Case:
    """Read and check everything; raises InputError that names the file or the drive."""
    twin = load_twin(request.twin)
    if not request.bags:
        raise InputError("drives", "none are given: name at least one recorded drive that shows the gap")
    same = {Path(b).resolve() for b in request.bags} & {Path(b).resolve() for b in request.reference}
    if same:
        raise InputError(min(same).name, "is given as a drive with the gap and as one from before it")
    for name in request.effects:
        if name in EFFECTS and twin.model not in EFFECTS[name].models:
            raise InputError("effects", name, f"does not apply to a vehicle of the model {twin.model}")
    if model_of(twin).opaque:
        raise InputError(
            "twin",
            "model",
            f"{twin.model} has equations of its own, in which no effect can be tried: calibrate it",
        )
    if model_of(twin).recordings != "drive":
        return _runs(twin, request)
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
    drives = renamed([prepared for prepared, _, _ in found])
    excitations, turns = [known for _, known, _ in found], [turn for _, _, turn in found]
    active = tuple(i < len(request.bags) for i in range(len(drives)))
    warnings = [f"{d.name}: {text}" for d in drives for text in d.warnings]
    if not on_road:
        warnings.append(
            "the twin file names no road: only the planar channels are compared, and only effects of clock, sensor "
            "and mount can be judged"
        )
    roll, pitch, yaw = np.angle(np.exp(1j * np.array(turns[: len(request.bags)])).sum(axis=0)).tolist()
    kind: Literal["road", "planar"] = "road" if on_road else "planar"
    return Case(twin, tuple(drives), tuple(excitations), (roll, pitch, yaw), active, kind, tuple(warnings))


def _runs(twin: Twin, request: DiagnosisRequest) -> Case:
    """Controlled runs, of a vehicle with somebody who drives it."""
    runs = observe(twin, [*request.bags, *request.reference])
    active = tuple(i < len(request.bags) for i in range(len(runs)))
    lone = {r.name for r, a in zip(runs, active, strict=True) if a and not _alike(runs, active, r)}
    warnings = [w for r in runs for w in r.warnings]
    if lone and not all(active):
        warnings.append(
            f"no reference with the excitation of {', '.join(sorted(lone))}: the model alone is expected"
        )
    return Case(
        model_of(twin).prepared(twin), tuple(runs), (), (0.0, 0.0, 0.0), active, "run", tuple(warnings)
    )


def _alike(runs: Sequence[Run], active: Sequence[bool], one: Run) -> list[Run]:
    """Reference runs with the excitation of a run."""
    return [r for r, a in zip(runs, active, strict=True) if not a and r.excitation is one.excitation]


def _excitations(prepared: Prepared, drive: Drive) -> tuple[Excitations, tuple[float, float, float]]:
    """What else may excite the vehicle, and by how much the sensor is turned."""
    turned, turn = turned_excitation(prepared, drive)
    regained, reclocked = (
        {upright: found for upright in (False, True) if (found := of(prepared, drive, upright)) is not None}
        for of in (regained_excitation, reclocked_excitation)
    )
    return Excitations(upright_excitation(prepared, drive), turned, regained, reclocked), turn


def build(case: Case, stop: Callable[[], bool], free: Sequence[str] = ()) -> Bench:
    """The bench of a case with the noise model for a share of the motion that nobody knows yet; ``free`` are the
    vehicle's keys that are fitted, those of the preset and what no weighbridge shows if there are none."""
    twin, preset = case.twin, preset_named("fast")
    rows = _compared(case)
    if free:
        space = build_space(twin, preset, free=free)
    elif case.excited:
        space = build_space(twin, replace(preset, also=()), also=[k for k in ALSO if has_number(twin, k)])
    else:
        space = build_space(twin, replace(preset, also=()), free=_LEANING)
    terms = parse_objective("euclidean", dict.fromkeys(case.channels, 1.0), case.channels)
    wander = [0.5 * d.position_sigma if d.position_sigma >= 0.1 else 0.0 for d in case.drives]
    if case.kind == "run":
        normal = case.drives[0].priors
    elif case.road:
        normal = replace(OF_A_DRIVE, map_position=min(map_spread(case.drives), OF_A_DRIVE.map_position))
    else:
        normal = OF_PLANAR_MOTION
    space = smooth_space(twin, space)
    problem = Problem(twin, space, case.drives, range(len(case.drives)), terms, normal, wander, rows)
    problem.interrupt = stop
    d, q = len(space), len(problem.nuisances)
    precision = np.zeros((d + q, d + q))
    precision[:d, :d] = space.prior_precision(CORRELATION)
    precision[np.arange(d, d + q), np.arange(d, d + q)] = 1.0 / problem.nuisances.spread**2
    centre = np.concatenate([space.z0, np.zeros(q)])
    whitener = Whitener.designed(problem.measured, np.full(len(case.channels), USUAL_SHARE), _floors(case))
    return Bench(
        problem, case.excitations, case.turn, case.active, whitener, precision, centre, stop, fused=case.road
    )


def _compared(case: Case) -> list[NDArray[np.intp]]:
    """Samples of each observation that are compared; InputError where they are too few to hold any back.

    Of a drive with a road these are the excited ones. Where those are too few (a smooth road, or an effect that hides
    them in its noise), it is all that is driven on the road: what an engine or a sensor does shows there as well.
    """
    excited, driven = TrimSettings(), TrimSettings(threshold=0.0)
    rows = [
        np.arange(d.t.size) if case.kind == "run" else fit_rows(d, excited if case.road else driven)
        for d in case.drives
    ]
    for wanted, what in ((True, "drives that show the gap"), (False, "reference drives")):
        known = [i for i, a in enumerate(case.active) if a == wanted]
        if not known or case.kind == "run":
            continue
        few = _seconds(case, rows, known) < SHORTEST
        for i in known if case.road else []:
            if few or _seconds(case, rows, [i]) < LEAST_EXCITED:
                check_on_road(case.drives[i], driven)
                rows[i] = fit_rows(case.drives[i], driven)
        seconds = _seconds(case, rows, known)
        if seconds < SHORTEST:
            raise InputError(
                case.drives[known[0]].name,
                f"{seconds:.1f} s of driving in the {what} cannot be split into stretches to fit and stretches to "
                f"judge on: at least {SHORTEST:.0f} s are needed",
            )
    return rows


def _seconds(case: Case, rows: Sequence[NDArray[np.intp]], drives: Sequence[int]) -> float:
    """Compared seconds of some drives together."""
    return float(sum(rows[i].size / case.drives[i].rate for i in drives))


def _floors(case: Case) -> list[dict[str, float]]:
    return [dict(d.noise_rms) for d in case.drives]


def baseline(case: Case, bench: Bench) -> tuple[Bench, LinearisedFit, LinearisedFit]:
    """The bench with the noise that is found, and the vehicle without any effect: on all drives, and where searches
    for effects start from.

    With a reference, what the calibrated model leaves there, band by band, is what it leaves of the same
    car anyway, and searches start from the vehicle that the reference shows. Planar accelerations come
    from GNSS and not from the model: their noise is what they leave. Whether vehicle or sensor leans by the little
    that any does is as the fit has it. A controlled run leaves the same where it is done again: with a reference of the
    same excitation, its residual is the discrepancy to be expected of the run after the change.
    """
    quiet = [i for i, a in enumerate(bench.active) if not a] or list(range(len(bench.active)))
    referenced = len(quiet) < len(bench.active)
    x = bench.centre.copy()
    for number in range(2):
        if case.road:
            bench.carry(x)
        trial = replace(bench, counted_drives=tuple(quiet))
        x, cost = refit(trial, BASELINE, [x] if number else _many(bench, x), None, 8 if number == 0 else 5)
        if case.road and number == 0:
            level = trial.levelled()
            y, other = refit(level, BASELINE, [x], None, 5)
            if other < cost:
                x, bench = y, replace(bench, problem=level.problem, level=True)
        bench = with_noise_of(
            case, bench, BASELINE, x, quiet, () if referenced or not case.road else VERTICAL
        )
    if referenced and case.kind == "run":
        bench = _repeated(case, bench, x)
        x = bench.centre
    anchor = linearised_fit(bench, BASELINE, x)
    return (bench, fitted(bench, BASELINE, [x], 6), anchor) if referenced else (bench, anchor, anchor)


def with_noise_of(
    case: Case,
    bench: Bench,
    hypothesis: Hypothesis,
    x: Floats,
    drives: Sequence[int],
    usual: Sequence[str] = (),
) -> Bench:
    """The bench with the noise that a fit leaves on some drives; ``usual`` channels keep the usual share of it."""
    left, simulated = _missed(bench, hypothesis, x, drives)
    for c, channel in enumerate(bench.problem.channels):
        if channel in usual:
            left[c] = USUAL_SHARE
    return _scaled(bench, Whitener.designed(bench.problem.measured, left, _floors(case)), simulated, drives)


def _missed(bench: Bench, hypothesis: Hypothesis, x: Floats, drives: Sequence[int]) -> tuple[Floats, Floats]:
    """(C, F) share of the motion that a fit leaves on some drives, and the signals (M, C) that it compares."""
    d, q = bench.d, bench.q
    signals, _ = bench.signals(hypothesis, x[:d, None], x[d + q :, None])
    simulated = bench.compared(signals, x[d : d + q, None])[:, :, 0]
    return shares(bench.problem.measured, simulated - bench.problem.measured.values, drives), simulated


def _scaled(bench: Bench, whitener: Whitener, simulated: Floats, drives: Sequence[int]) -> Bench:
    """The bench with a noise model whose size in each channel is that of the residuals on some drives."""
    white = whitener.residuals(simulated[:, :, None])[:, 0]
    rows, scale = np.isin(whitener.drive, drives), whitener.scale.copy()
    for c in range(scale.size):
        own = white[rows & (whitener.channel == c)]
        scale[c] *= float(np.clip(np.sqrt(np.mean(own**2)), 1e-2, 1e3)) if own.size else 1.0
    return replace(bench, whitener=replace(whitener, scale=scale))


def _repeated(case: Case, bench: Bench, x: Floats) -> Bench:
    """The bench of controlled runs whose expected discrepancy is what their references leave.

    What a sound vehicle leaves is known, so the vehicle is held as the references show it. The model reproduces a
    change no better than the sound vehicle: half of what it misses there is noise of the change, beside the scatter of
    repeats.
    """
    problem, d, q = bench.problem, bench.d, bench.q
    signals, _ = bench.signals(BASELINE, x[:d, None], np.zeros((0, 1)))
    missed = problem.measured.values - problem.compared(signals, x[d : d + q, None])[:, :, 0]
    ends = np.cumsum([0, *(r.size for r in problem.rows)])
    expected: list[Floats | None] = []
    for part in problem.parts:
        same = [
            j for j, p in enumerate(problem.parts) if p.excitation is part.excitation and not bench.active[j]
        ]
        off = [
            np.stack(
                [np.interp(part.t, problem.parts[j].t, c) for c in missed[ends[j] : ends[j + 1]].T], axis=1
            )
            for j in same
        ]
        expected.append(np.mean(off, axis=0) if off else None)
    quiet = [j for j, active in enumerate(bench.active) if not active]
    share = _DOUBT * shares(problem.measured, missed, quiet)
    held = replace(case, twin=twin_of(bench, Fit(BASELINE, x, 0.0)))
    fresh = build(held, bench.stop, problem.space.keys[:1])
    return replace(
        fresh, expected=tuple(expected), whitener=Whitener.designed(problem.measured, share, _floors(case))
    )


def _many(bench: Bench, x: Floats) -> Sequence[Floats]:
    """The twin as it stands and stiffer, softer, harder and weaker versions of it."""
    found = [x]
    if not bench.problem.space.curves:
        return found
    for springs in (-0.7, 0.0, 0.7, 1.4):
        for dampers in (-0.7, 0.0, 0.7):
            found.append(bench.problem.space.shifted(x, springs, dampers))
    return found
