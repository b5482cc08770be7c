# SPDX-License-Identifier: Apache-2.0
"""From a request to a problem: reading, checking, trimming, aligning."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.checks import check_drive, check_parts, check_recording
from suspension_twin.calibration.presets import (
    Preset,
    build_space,
    preset_named,
    refined,
    with_effects,
    with_table_2,
)
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.errors import InputError
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows, trim
from suspension_twin.inference.gap import CHANNELS
from suspension_twin.inference.nuisance import OF_A_CALIBRATION, NuisancePriors
from suspension_twin.inference.objectives import Objective, Term, parse_objective
from suspension_twin.inference.observation import (
    Observation,
    ObserveSettings,
    observe,
    renamed,
    road_of,
)
from suspension_twin.inference.placement import (
    NoPlaceError,
    Placement,
    in_reach,
    is_open,
    on_one_clock,
    place,
)
from suspension_twin.inference.priors import SINGLE
from suspension_twin.inference.problem import Data, Interrupted, Likelihood, Problem, Simulation
from suspension_twin.inference.runs import is_actuated, observe_runs
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.inference.space import Space
from suspension_twin.models.parameters import has_number, layout
from suspension_twin.models.registry import model_of
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.road import Road
from suspension_twin.road.recipe import taped_features
from suspension_twin.signals.coarse_alignment import coarse_lag
from suspension_twin.signals.common_rate import on_common_rate
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["Setup", "set_up"]

SPRUNG_MASS = "vehicle.sprung_mass"
_LONGEST_LAG = 1.0  # s
_SURE = 0.02  # how much better the correlation has to become before a drive is moved in time


@dataclass(frozen=True, eq=False)
class Setup:
    """A ``problem`` ready to search, and the ``objective`` that its candidates are compared by.

    ``original`` is the twin as given, ``drives`` are whole observations, where they were placed, ``problem.data.parts``
    their simulated parts, ``lags`` s by which each drive's pose was moved before the search.
    """

    original: Twin
    preset: Preset
    problem: Problem
    objective: Objective
    drives: tuple[Observation, ...]
    lags: tuple[float, ...]
    warnings: tuple[str, ...]
    placements: tuple[Placement | None, ...] = ()

    @property
    def twin(self) -> Twin:
        """The twin that is searched from."""
        return self.problem.twin

    @property
    def space(self) -> Space:
        """Its free parameters."""
        return self.problem.space

    @property
    def on_road(self) -> bool:
        """Whether the vehicle drives on a road; else its recordings are controlled runs."""
        return model_of(self.twin).recordings == "drive"


def set_up(
    request: CalibrationRequest,
    note: Callable[[str], None],
    should_stop: Callable[[], bool],
    further: Mapping[str, float] | None = None,
    calibrated: Twin | None = None,
) -> Setup:
    """Read, check and align everything; raises InputError that names the file or the drive.

    ``further`` m, by axle, lie the points of refined springs beyond those of the twin file. Drives whose place is open
    are placed by what the ``calibrated`` twin makes of the road, or that of the request."""
    preset = preset_named(request.preset)
    given = load_twin(request.twin)
    original = with_effects(given, [*request.free, *request.also])
    if not request.bags:
        raise InputError("drives", "none are given: name at least one recorded drive")
    named = [*request.free, *request.freeze, *(key for key, _, _ in request.bounds)]
    twin = with_table_2(original) if preset.table_2 else original
    if preset.refined and not request.free:
        twin = refined(original, named, further)
    bounds = {key: (low, high) for key, low, high in request.bounds}
    nuisances = [k for k in request.freeze if k.startswith("nuisances.")]
    priors = OF_A_CALIBRATION.without(nuisances)
    frozen = [k for k in request.freeze if k not in nuisances]

    def space_with(also: Sequence[str]) -> Space:
        return build_space(
            twin, preset, request.free, also=[*request.also, *also], freeze=frozen, bounds=bounds
        )

    if model_of(twin).recordings != "drive":
        return _of_runs(request, original, twin, space_with, should_stop)
    space = space_with(())
    own = set(preset.keys) & set(layout(twin).names)
    if preset.keys and not own and not request.free and not model_of(twin).opaque:
        text = f"searches {preset.keys[0]} and others, which a {twin.model} does not have: take fast or paper"
        raise InputError("preset", preset.name, text)
    road = road_of(twin)
    recordings = []
    for bag in request.bags:
        if should_stop():
            raise Interrupted
        note(f"reading {Path(bag).name}")
        recorded = read_drive(bag, topics=request.topics)
        recordings.append(replace(recorded, fix=FixData.empty()) if request.no_position else recorded)
        check_recording(recordings[-1])
    alike = on_common_rate(recordings, FilterSpec())
    drives, placements, left_out = [], list[Placement | None](), list[NoPlaceError]()
    for drive in renamed([on_one_clock(observe_checked(d, twin, road)) for d in alike]):
        note(f"placing {drive.name} on its road")
        try:
            where = place(drive, calibrated or twin)
        except NoPlaceError as error:
            left_out.append(error)
            continue
        placements.append(where)
        drives.append(drive if where is None else where.moved(drive))
    if not drives:
        raise left_out[0]
    data, lags, warnings = aligned_parts(twin, drives)
    warnings = (*(error.left_out for error in left_out), *warnings)
    terms = objective_terms(request, preset, drives)
    rates = {round(d.rate, 3) for d in drives}
    if len(rates) > 1 and any(t.kind in ("spectral", "iso18571") for t in terms):
        raise InputError(
            "drives", f"come at different rates ({sorted(rates)} Hz): calibrate on them one by one"
        )
    problem, objective = problem_of(twin, space, data, terms, priors, should_stop)
    return Setup(original, preset, problem, objective, tuple(drives), lags, warnings, tuple(placements))


def observe_checked(
    drive: Drive, twin: Twin, road: Road, settings: ObserveSettings | None = None
) -> Observation:
    """Observe a drive for calibration, or refuse it with the reason and the remedy."""
    check_recording(drive)
    # a turn of the sensor that the twin has as an effect is calibrated; one that it has not bends everything else
    refused = ("facing",) if SensorCorrection.of_twin(twin).turn is None else ()
    observation = observe(drive, twin, road, settings, strict=True, refused=refused)
    check_drive(in_reach(observation))
    return observation


def problem_of(
    twin: Twin,
    space: Space,
    data: Data,
    terms: Sequence[Term],
    priors: NuisancePriors,
    stop: Callable[[], bool] | None = None,
) -> tuple[Problem, Objective]:
    """The problem over some data with the residuals of an objective, in the channels of its ``terms``."""
    data = replace(data, channels=tuple(dict.fromkeys(t.channel for t in terms)))
    objective = Objective(terms, data.measured)
    drives = dict(zip(data.drive_of, data.parts, strict=True))
    wander = [_wander(drives[d], priors) for d in sorted(drives)]
    if all(wander):  # clock and map are parts of the receiver's error then
        priors = replace(priors, clock=0.0, map_position=0.0)
    taped = taped_features(twin.road.file) if priors.tape is None and twin.road is not None else None
    likelihood = Likelihood(data, data.nuisances(priors, wander, taped), objective)
    simulation = Simulation() if stop is None else Simulation(stop=stop)
    problem = Problem.of(twin, space, likelihood, simulation)
    return problem.with_tape_response(problem.prior.centre), objective


def _of_runs(
    request: CalibrationRequest,
    original: Twin,
    twin: Twin,
    space_with: Callable[[Sequence[str]], Space],
    should_stop: Callable[[], bool],
) -> Setup:
    """The problem over controlled runs; with a preset that says so the slowest are fitted, the others validate.

    A known force between the masses of a corner weighs them: then the sprung mass is free as well.
    """
    preset = preset_named(request.preset)
    runs = observe_runs(twin, request.bags)
    weighed = has_number(twin, SPRUNG_MASS) and not request.free and any(map(is_actuated, runs))
    space = space_with([SPRUNG_MASS] if weighed else [])
    slowest = min(float(np.abs(r.along).mean()) for r in runs)
    alike = SINGLE["repeated_speed"] * slowest
    fitted = [r for r in runs if not preset.slowest or float(np.abs(r.along).mean()) <= alike]
    measured = [c for c in fitted[0].measured if all(c in r.measured for r in fitted)]
    channels = dict(request.channels) or {c: w for c, w in preset.channels.items() if c in measured}
    weighted = _weighted(channels or dict.fromkeys(measured, 0.0), fitted)
    terms = parse_objective(_objective_text(request, preset), weighted, model_of(twin).channels)
    priors = fitted[0].usage.priors
    if preset.search != "squares":  # a genetic search compares signals as they were measured
        priors = replace(priors, clock=0.0, speed=0.0)
    priors = priors.without([k for k in request.freeze if k.startswith("nuisances.")])
    rows = tuple(np.arange(r.t.size) for r in fitted)
    every = tuple(range(len(fitted)))
    data = Data(tuple(fitted), every, rows, (), (True,) * len(fitted))
    problem, objective = problem_of(twin, space, data, terms, priors, should_stop)
    warnings = tuple(f"{r.name}: {text}" for r in runs for text in r.warnings)
    return Setup(original, preset, problem, objective, tuple(runs), (0.0,) * len(runs), warnings)


def _objective_text(request: CalibrationRequest, preset: Preset) -> str:
    objective = request.objective or preset.objective
    return "euclidean" if objective == "likelihood" else objective


def objective_terms(
    request: CalibrationRequest, preset: Preset, drives: Sequence[Observation]
) -> tuple[Term, ...]:
    """Terms of the objective over recorded drives, each channel with its weight."""
    channels = dict(request.channels) or {c: w for c, w in preset.channels.items() if c in CHANNELS}
    return parse_objective(_objective_text(request, preset), _weighted(channels, drives))


def _weighted(channels: dict[str, float], drives: Sequence[Observation]) -> dict[str, float]:
    """Weights of channels; 0 stands for the inverse of the unit in which its residual counts, the noise floor of a
    drive, in units of the first's."""
    floors = {
        c: float(np.mean([d.usage.unit.get(c, d.noise_rms[c]) for d in drives]))
        for c in channels
        if c in drives[0].noise_rms
    }
    unit = floors.get("vertical_acceleration", next(iter(floors.values()), 1.0))
    return {c: w if w > 0 else unit / max(floors.get(c, unit), 1e-12) for c, w in channels.items()}


def aligned_parts(
    twin: Twin, drives: Sequence[Observation], settings: TrimSettings | None = None
) -> tuple[Data, tuple[float, ...], tuple[str, ...]]:
    """The excited parts of drives, each moved in time to where it roughly fits; the lag of each drive in s, and
    warnings."""
    settings = settings or TrimSettings()
    parts: list[Observation] = []
    drive_of: list[int] = []
    lags: list[float] = []
    for number, drive in enumerate(drives):
        pieces = [p for p in trim(drive, settings) if fit_rows(p, settings).size >= 0.5 * p.rate]
        check_parts(drive, sum(fit_rows(p, settings).size for p in pieces), settings)
        lag = _lag(twin, pieces, settings)
        lags.append(lag)
        parts += [p.moved(lag, 0.0) if lag else p for p in pieces]
        drive_of += [number] * len(pieces)
    warnings = [f"{d.name}: {text}" for d in drives for text in d.warnings]
    warnings += [
        f"{d.name}: the pose was read {lag:+.3f} s off the IMU's clock before the fit"
        for d, lag in zip(drives, lags, strict=True)
        if lag
    ]
    rows = tuple(fit_rows(part, settings) for part in parts)
    data = Data(tuple(parts), tuple(drive_of), rows, (), (True,) * len(drives))
    return data, tuple(lags), tuple(warnings)


def _lag(twin: Twin, pieces: list[Observation], settings: TrimSettings) -> float:
    """Seconds to move a drive's pose by, 0 where the twin as it stands does not clearly ask for it."""
    pairs: list[tuple[Floats, Floats]] = []
    for part in pieces:
        simulated = part.condition(simulate_twin(twin, part.road_excitation))
        rows = fit_rows(part, settings)
        cut = slice(int(rows[0]), int(rows[-1]) + 1)
        pairs += [(part.measured[c][cut], simulated[c][cut]) for c in ("vertical_acceleration", "pitch_rate")]
    lag, there, here = coarse_lag(pairs, pieces[0].rate, _LONGEST_LAG)
    return lag if abs(lag) * pieces[0].rate > 1.5 and there > here + _SURE and there > 0.3 else 0.0


def _wander(drive: Observation, priors: NuisancePriors) -> float:
    """Standard deviation in m of the slow error of a drive's smoothed positions, 0 where it is not worth a nuisance."""
    if priors.wander is not None:
        return priors.wander
    return drive.position_sigma if is_open(drive) else 0.0
