# SPDX-License-Identifier: Apache-2.0
"""From a request to a problem: reading, checking, and calibrating the vehicle without any effect (the baseline)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.calibration.checks import LEAST_EXCITED, check_drive, check_on_road, check_recording
from suspension_twin.calibration.presets import PART_KEYS, build_space, preset_named
from suspension_twin.diagnosis.library import DECOYS, OF_PLACE
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import InputError
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows
from suspension_twin.inference.fit import Fit, LinearisedFit, fitted, linearised_fit, refit, twin_of
from suspension_twin.inference.noise import USUAL_SHARE, Whitener, shares
from suspension_twin.inference.nuisance import NuisancePriors, map_spread
from suspension_twin.inference.observation import (
    VERTICAL,
    Observation,
    ObserveSettings,
    observe,
    renamed,
    road_of,
    with_shown_errors,
)
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.placement import NoPlaceError, in_reach, on_one_clock, place
from suspension_twin.inference.problem import (
    Data,
    Interrupted,
    Likelihood,
    Problem,
    Simulation,
    counting,
    effective_weight,
    whitener_of,
)
from suspension_twin.inference.runs import observe_runs, repeats
from suspension_twin.inference.sensor_correction import Turn
from suspension_twin.inference.smooth_space import smooth_space
from suspension_twin.inference.space import Space
from suspension_twin.models.constants import Conditions, outside
from suspension_twin.models.excitation import coarser
from suspension_twin.models.parameters import has_number, layout, pack, twin_value
from suspension_twin.models.parts import OPTIONAL_PARTS
from suspension_twin.models.registry import model_of
from suspension_twin.models.types import Excitation, RepeatedRun
from suspension_twin.road import flat_road
from suspension_twin.signals.common_rate import on_common_rate
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["ALSO", "Case", "baseline", "build", "drive_problem", "read_case", "with_noise_of"]

#: Without a road the motion by GNSS is compared with that of the IMU.
_PLANAR_ONLY = ObserveSettings(filter=FilterSpec(2, 1.6), satellites=True, saturated=True)
_ON_ROAD = ObserveSettings(saturated=True)
#: Error of a change that a model predicts, over its error about the sound vehicle at the same sample: a prior.
_DOUBT = 0.5
#: Stated deviations by which values found anew on another drive of a sound car differ, with something to spare (prior;
#: rms 0.5 to 1.3 of springs and dampers by code that is not the models': ``benchmarks/intervals.py --apart``).
_STATED = 1.5
#: Seconds of compared driving below which nothing can be held out from the fit: two blocks of time.
SHORTEST = 8.0
#: Receiver's standard deviation in m from which on a drive has its own slow position error.
_INACCURATE = 0.1
#: Longest time step of the simulation in s: signals differ by 0.2 % of their rms from those in steps of 1 ms.
_STEP = 2.5e-3
#: Time step as a share of the period of a wheel on its tyre: 2.5 ms of 12 Hz.
_OF_A_PERIOD = 0.03
#: Corrections of a low-pass (numerics): at its cut-off, where half is passed, a sixteenth is left.
_CORRECTIONS = 4
#: Free beside the characteristics: parameters that no weighbridge measures. Of the optional parts those alone that no
#: effect acts as: a fault of friction or tyre damping would else be taken for a wrong number of the twin file.
ALSO = (
    "vehicle.sprung_inertia.roll",
    "vehicle.sprung_inertia.pitch",
    "vehicle.tyre.vertical_stiffness",
    "vehicle.front.unsprung_mass",
    "vehicle.rear.unsprung_mass",
    "vehicle.unsprung_mass",
    *(key for key in PART_KEYS if key in OPTIONAL_PARTS["linkage"].keys.values()),
)
#: Free without a road, where the drives hold no information on the characteristics but on how far the body leans.
_LEANING = ("vehicle.cog.2",)


@dataclass(frozen=True, eq=False)
class Case:
    """Observations ready to compare; ``active`` True where the gap is shown."""

    twin: Twin
    drives: tuple[Observation, ...]
    active: tuple[bool, ...]
    warnings: tuple[str, ...]

    @property
    def road(self) -> bool:
        """Whether the vehicle drives on a known road."""
        return self.drives[0].usage.fused

    @property
    def excited(self) -> bool:
        """Whether it is known what excites the vehicle."""
        return self.drives[0].excited

    @property
    def kind(self) -> str:
        """How the documents name it: drives on a ``road``, of the ``planar`` motion alone, or controlled ``run``s."""
        return "road" if self.road else "run" if self.excited else "planar"

    @property
    def channels(self) -> tuple[str, ...]:
        """The compared channels: those of all observations."""
        first, *others = (d.usage.channels for d in self.drives)
        return tuple(c for c in first if all(c in other for other in others))

    @property
    def driven(self) -> tuple[str, ...]:
        """Channels by which the vehicle itself is judged: those that its excitation brings about."""
        return tuple(c for c in self.drives[0].usage.driven if c in self.channels)

    @property
    def placed(self) -> bool:
        """Whether a drive was placed on its road by what was felt: its place and its receiver's clock are nuisances."""
        return any(d.reading is not None and d.settings.placed is not None for d in self.drives)

    def named(self, effects: Sequence[str]) -> Sequence[str]:
        """The effects that may be named: those that are asked for, else all that place and clock do not hide."""
        if effects or not self.placed:
            return effects
        return [name for name in EFFECTS if name not in (*DECOYS, *OF_PLACE)]

    @property
    def turn(self) -> Turn:
        """Mounting error of the sensor (roll, pitch, yaw; rad) that the drives with the gap show."""
        shown = [d.reading.shown for d, a in zip(self.drives, self.active, strict=True) if a and d.reading]
        turns = [one.turn for one in shown if one is not None and one.turn is not None]
        if not turns:
            return (0.0, 0.0, 0.0)
        roll, pitch, yaw = np.angle(np.exp(1j * np.array(turns)).sum(axis=0)).tolist()
        return roll, pitch, yaw


def read_case(
    request: DiagnosisRequest,
    note: Callable[[str], None],
    stop: Callable[[], bool],
    calibrated: Twin | None = None,
) -> Case:
    """Read and check everything; raises InputError that names the file or the drive. Drives whose place is open are
    placed by what the ``calibrated`` twin makes of the road, or that of the request."""
    twin = load_twin(request.twin)
    _check(request, twin)
    active = tuple(i < len(request.bags) for i in range(len(request.bags) + len(request.reference)))
    bags = (*request.bags, *request.reference)
    if model_of(twin).recordings != "drive":
        return _runs(twin, observe_runs(twin, bags), active)
    road, settings = (flat_road(), _PLANAR_ONLY) if twin.road is None else (road_of(twin), _ON_ROAD)

    def recording(bag: str) -> Drive:
        if stop():
            raise Interrupted
        recorded = read_drive(bag, topics=request.topics)
        check_recording(recorded)
        return recorded

    def ready(recorded: Drive) -> Observation | NoPlaceError:
        if stop():
            raise Interrupted
        # without a road no place matters: a drive may be far from the twin's origin
        here = twin if twin.road is not None else twin.model_copy(update={"datum": None})
        observation = observe(recorded, here, road, settings, strict=True)
        if twin.road is not None:
            check_drive(in_reach(observation))
            observation = on_one_clock(observation)
            try:
                where = place(observation, calibrated or twin)
            except NoPlaceError as error:
                return error
            observation = observation if where is None else where.kept(observation)
        return with_shown_errors(observation)

    recordings = side_by_side(recording, bags, lambda _, bag: note(f"reading {Path(bag).name}"))
    found = side_by_side(ready, on_common_rate(recordings, FilterSpec()))
    left_out = [d for d in found if isinstance(d, NoPlaceError)]
    active = tuple(a for d, a in zip(found, active, strict=True) if not isinstance(d, NoPlaceError))
    if not any(active):
        raise left_out[0]
    drives = renamed([d for d in found if not isinstance(d, NoPlaceError)])
    warnings = [error.left_out for error in left_out]
    warnings += [f"{d.name}: {text}" for d in drives for text in d.warnings]
    if twin.road is None:
        warnings.append(
            "the twin file names no road: only the planar channels are compared, and only effects of clock, sensor "
            "and mount can be judged"
        )
    case = Case(twin, tuple(drives), active, tuple(warnings))
    if case.placed:
        text = (
            f"the receiver leaves place and time open: {', '.join(OF_PLACE)} are nuisances and cannot be named, "
            "and other causes are confused more often than with RTK"
        )
        case = replace(case, warnings=(*case.warnings, text))
    return case


def _check(request: DiagnosisRequest, twin: Twin) -> None:
    if not request.bags:
        raise InputError("drives", "none are given: name at least one recorded drive that shows the gap")
    same = {Path(b).resolve() for b in request.bags} & {Path(b).resolve() for b in request.reference}
    if same:
        raise InputError(min(same).name, "is given as a drive with the gap and as one from before it")
    for name in request.effects:
        if name in EFFECTS and twin.model not in EFFECTS[name].models:
            raise InputError("effects", name, f"does not apply to a vehicle of the model {twin.model}")
    if model_of(twin).opaque:
        text = f"{twin.model} has equations of its own, in which no effect can be tried: calibrate it"
        raise InputError("twin", "model", text)


def _runs(twin: Twin, runs: Sequence[Observation], active: tuple[bool, ...]) -> Case:
    """Controlled runs, of a vehicle with somebody who drives it."""
    before = [r for r, a in zip(runs, active, strict=True) if not a]
    after = [r for r, a in zip(runs, active, strict=True) if a]
    lone = {r.name for r in after if not any(repeats(r, known) for known in before)}
    warnings = [w for r in runs for w in r.warnings]
    if lone and not all(active):
        warnings.append(
            f"no reference with the excitation of {', '.join(sorted(lone))}: the model alone is expected"
        )
    return Case(model_of(twin).prepared(twin), tuple(_in_coarse_steps(twin, runs)), active, tuple(warnings))


def _in_coarse_steps(twin: Twin, runs: Sequence[Observation]) -> list[Observation]:
    """Runs on a rig in the longest time steps that a diagnosis takes, of a light wheel on a stiff tyre in shorter ones;
    runs that share an excitation still do."""
    if not has_number(twin, "vehicle.unsprung_mass") or model_of(twin).recordings != "rig":
        return list(runs)
    stiffness, mass = (twin_value(twin, f"vehicle.{k}") for k in ("tyre.vertical_stiffness", "unsprung_mass"))
    step = min(_STEP, _OF_A_PERIOD * 2.0 * np.pi * float(np.sqrt(mass / stiffness)))
    known = {id(r.excitation): r.road_excitation for r in runs}
    fewer = {key: coarser(one, step) if step > one.max_step else one for key, one in known.items()}
    return [replace(r, excitation=fewer[id(r.excitation)]) for r in runs]


def build(case: Case, stop: Callable[[], bool], free: Sequence[str] = ()) -> Problem:
    """The problem of a case with the noise model of the usual share of the motion; ``free`` are the vehicle's keys
    that are fitted, those of the preset and what no weighbridge measures if there are none."""
    twin, drives = case.twin, case.drives
    data = Data(drives, tuple(range(len(drives))), tuple(_compared(case)), case.channels, case.active)
    wander = [0.5 * d.position_sigma if d.position_sigma >= _INACCURATE else 0.0 for d in drives]
    priors = drives[0].usage.priors
    if case.road:
        priors = replace(priors, map_position=min(map_spread(drives), priors.map_position))
    space = _space(twin, free) if free or case.excited else _space(twin, _LEANING)
    problem = drive_problem(
        twin, space, data, priors, wander, Simulation(_STEP, fused=case.road, centred=True, stop=stop)
    )
    return replace(problem, prior=problem.prior.knowing(space.stated_precision(twin, _STATED)))


def _space(twin: Twin, free: Sequence[str] = ()) -> Space:
    """The vehicle's parameters of a diagnosis: those of the preset and ``ALSO``, or the ``free`` ones alone."""
    preset = replace(preset_named("fast"), also=())
    also = () if free else [k for k in ALSO if has_number(twin, k)]
    return smooth_space(twin, build_space(twin, preset, free=free, also=also))


def drive_problem(
    twin: Twin,
    space: Space | None,
    data: Data,
    priors: NuisancePriors,
    wander: Sequence[float],
    simulation: Simulation,
) -> Problem:
    """A problem whose noise model takes the discrepancy for the usual share of the motion; ``space`` None for the
    vehicle's parameters of a diagnosis."""
    nuisances = data.nuisances(priors, wander)
    usual = np.full(len(data.channels), USUAL_SHARE)
    noise = Whitener.designed(data.measured, usual, [d.noise_rms for d in data.parts])
    likelihood = Likelihood(data, nuisances, noise, weight=effective_weight(noise), affine=True)
    return Problem.of(twin, _space(twin) if space is None else space, likelihood, simulation)


def _compared(case: Case) -> list[NDArray[np.intp]]:
    """Samples of each observation that are compared; InputError where they are too few to hold any out.

    Of a drive with a road these are the excited ones. Where those are too few (a smooth road, or an effect that hides
    them in its noise), it is all that is driven on the road: an engine or a sensor shows there as well.
    """
    excited, driven = TrimSettings(), TrimSettings(threshold=0.0)
    rows = [fit_rows(d, excited if case.road else driven) for d in case.drives]
    for wanted, what in ((True, "drives that show the gap"), (False, "reference drives")):
        known = [i for i, a in enumerate(case.active) if a == wanted and case.drives[i].reading is not None]
        if not known:
            continue
        few = _seconds(case, rows, known) < SHORTEST
        for i in known if case.road else []:
            if few or _seconds(case, rows, [i]) < LEAST_EXCITED:
                check_on_road(case.drives[i], driven)
                rows[i] = fit_rows(case.drives[i], driven)
        seconds = _seconds(case, rows, known)
        if seconds < SHORTEST:
            pace = "" if case.road else " above 3 m/s (without a road the path comes from the fixes alone)"
            raise InputError(
                case.drives[known[0]].name,
                f"{seconds:.1f} s of driving{pace} in the {what} cannot be split into stretches to fit and stretches "
                f"to judge on: at least {SHORTEST:.0f} s are needed",
            )
    return rows


def _seconds(case: Case, rows: Sequence[NDArray[np.intp]], drives: Sequence[int]) -> float:
    """Compared seconds of some drives together."""
    return float(sum(rows[i].size / case.drives[i].rate for i in drives))


def baseline(case: Case, problem: Problem) -> tuple[Problem, LinearisedFit, LinearisedFit]:
    """The problem with the noise that is found, and the vehicle without any effect: on all drives, and where searches
    for effects start from.

    With a reference, the residual of the calibrated model there, band by band, is the discrepancy of the same car, and
    searches start from the vehicle that the reference shows. Planar accelerations come from GNSS and not from the
    model: their residual is their noise. Whether vehicle or sensor has a small static tilt is as the fit has it. A
    controlled run repeats: with a reference of the same excitation, its residual is the discrepancy to be expected of
    the run after the change.
    """
    active = problem.data.active
    quiet = [i for i, a in enumerate(active) if not a] or list(range(len(active)))
    referenced = len(quiet) < len(active)
    x = problem.prior.centre.copy()
    for number in range(2):
        if case.road:
            problem = problem.with_planar_response(x)
        trial = counting(problem, np.isin(whitener_of(problem).drive, quiet))
        x, cost = refit(trial, [x] if number else _many(problem, x), None, 8 if number == 0 else 5)
        if case.road and number == 0:
            level = replace(trial, simulation=replace(trial.simulation, upright=True))
            y, other = refit(level, [x], None, 5)
            if other < cost:
                x, problem = y, replace(problem, simulation=level.simulation)
        problem = with_noise_of(problem, x, quiet, () if referenced or not case.road else VERTICAL)
    if referenced and case.drives[0].reading is None:
        problem = _repeated(case, problem, x)
        x = problem.prior.centre
    anchor = linearised_fit(problem, x)
    return (problem, fitted(problem, [x], 6), anchor) if referenced else (problem, anchor, anchor)


def with_noise_of(problem: Problem, x: Floats, drives: Sequence[int], usual: Sequence[str] = ()) -> Problem:
    """The problem with the noise that its fit at ``x`` leaves on some drives; ``usual`` channels keep the usual share
    of the motion."""
    simulated = problem.readings(x)
    left = shares(problem.measured, simulated - problem.measured.values, drives)
    for c, channel in enumerate(problem.channels):
        if channel in usual:
            left[c] = USUAL_SHARE
    noise = Whitener.designed(problem.measured, left, [d.noise_rms for d in problem.data.parts])
    # the size of the noise in each channel is that of the residuals
    white = noise.residuals(simulated[:, :, None])[:, 0]
    rows, scale = np.isin(noise.drive, drives), noise.scale.copy()
    for c in range(scale.size):
        own = white[rows & (noise.channel == c)]
        scale[c] *= float(np.clip(np.sqrt(np.mean(own**2)), 1e-2, 1e3)) if own.size else 1.0
    return problem.weighed(replace(noise, scale=scale), weight=effective_weight(noise))


def _repeated(case: Case, problem: Problem, x: Floats) -> Problem:
    """The problem of controlled runs whose expected discrepancy is the residual of their references.

    A reference is no witness of itself: what is expected of it is what others of its program leave, or nothing. It is
    what the sensors of a rig saw (``RepeatedRun``), for an effect of a sensor acts on it as on the motion. The
    discrepancy of a sound vehicle is known, so the vehicle is held as the references show it. The model reproduces
    a change no better than the sound vehicle: half of its residual there is noise of the change. Beside it stands the
    scatter of repeats, which the references of one program show: one of n misses the mean of the others by
    1 + 1 / (n - 1) times the variance of a run, a run after them misses their mean by 1 + 1 / n times that. What one
    run leaves is compared with what another does at the same place of the program: the clock and the speed of each are
    known by its fit.
    """
    data, measured, found = problem.data, problem.measured, x[problem.d : problem.shared, None]
    missed = measured.values - problem.readings(x)
    program = [part.t + problem.nuisances.stamped_early(i, found)[:, 0] for i, part in enumerate(data.parts)]
    ends = np.cumsum([0, *(r.size for r in data.rows)])
    quiet = [j for j, active in enumerate(data.active) if not active]
    expected: list[Floats | None] = []
    scatter, again = np.zeros_like(missed), list[int]()
    for number, part in enumerate(data.parts):
        same = [j for j in quiet if j != number and repeats(part, data.parts[j])]
        off = [interpolated(part.t, program[j], missed[ends[j] : ends[j + 1]]) for j in same]
        others = np.mean(off, axis=0) if off else None
        expected.append(others)
        if others is not None and number in quiet:
            own = slice(ends[number], ends[number + 1])
            off_here = interpolated(program[number], part.t, others)[data.rows[number]]
            scatter[own] = np.sqrt(1.0 - (len(off) + 1) ** -2.0) * (missed[own] - off_here)
            again.append(number)
    share = _DOUBT * shares(measured, missed, quiet)
    if again:
        share = np.hypot(share, shares(measured, scatter, again))
    noise = Whitener.designed(measured, share, [d.noise_rms for d in data.parts])
    twin = twin_of(problem, Fit(problem.hypothesis, x, 0.0))
    wander = [0.0] * len(case.drives)
    before = [_run_before(twin, p, e, data.channels) for p, e in zip(data.parts, expected, strict=True)]
    expected = [e if p is b else None for p, b, e in zip(data.parts, before, expected, strict=True)]
    data = replace(data, parts=tuple(before))
    fresh = drive_problem(twin, Space(twin, ()), data, problem.nuisances.priors, wander, problem.simulation)
    still = replace(fresh.likelihood, noise=noise, weight=effective_weight(noise), expected=tuple(expected))
    return replace(fresh, likelihood=still).with_still_references()


def _run_before(
    twin: Twin, part: Observation, expected: Floats | None, channels: Sequence[str]
) -> Observation:
    """A run on a rig with the discrepancy ``expected`` (m, C) in its excitation, as it was before the clock of the twin
    and the low-pass of the comparison: found by repeated correction (van Cittert 1931). Other runs as they are."""
    driven = part.excitation
    if expected is None or not isinstance(driven, Excitation):
        return part
    clock = outside(pack(twin)[:, None], layout(twin), Conditions.of(driven)).clock
    stamps, late = driven.t - driven.t[0], 0.0 if clock is None else float(clock.delay[0])
    raw = np.zeros((stamps.size, len(channels)))
    for _ in range(_CORRECTIONS):
        read = interpolated(stamps - late, stamps, raw)
        left = expected - part.apply(read)
        raw += interpolated(stamps + late, part.t, left)
    return replace(part, excitation=RepeatedRun(**vars(driven), channels=tuple(channels), missed=raw))


def _many(problem: Problem, x: Floats) -> Sequence[Floats]:
    """The twin as it stands and stiffer, softer, harder and weaker versions of it."""
    if not problem.space.curves:
        return [x]
    shifts = [(s, d) for s in (-0.7, 0.0, 0.7, 1.4) for d in (-0.7, 0.0, 0.7)]
    return [x, *(problem.space.shifted(x, springs, dampers) for springs, dampers in shifts)]
