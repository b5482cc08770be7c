# SPDX-License-Identifier: Apache-2.0
"""From a request to a problem: reading, checking, trimming, aligning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.checks import check_drive, check_parts, check_recording
from suspension_twin.calibration.presets import Preset, build_space, preset_named, with_effects, with_table_2
from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.inference.coarse_alignment import coarse_lag
from suspension_twin.inference.common_rate import on_common_rate
from suspension_twin.inference.excited_segments import TrimSettings, fit_rows, trim
from suspension_twin.inference.gap import CHANNELS
from suspension_twin.inference.nuisance import NuisancePriors, slow_position_error
from suspension_twin.inference.objectives import parse_objective
from suspension_twin.inference.observations import observe, renamed
from suspension_twin.inference.prepare import Prepared, PrepareSettings, prepare, road_of
from suspension_twin.inference.problem import Interrupted, Problem
from suspension_twin.inference.space import Space
from suspension_twin.models.registry import model_of
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.road import Road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["Setup", "set_up"]

_LONGEST_LAG = 1.0  # s
_ALIKE = 1.02  # largest ratio of the speeds of repeats: drivers hold a speed within 2 % (a prior)
_SURE = 0.02  # how much better the correlation has to become before a drive is moved in time


@dataclass(frozen=True, eq=False)
class Setup:
    """A problem ready to search. ``drives`` are whole, prepared from what was ``recorded``, ``problem.parts`` what is
    simulated of them; ``lags`` s by which each drive's pose was moved before the search."""

    twin: Twin
    original: Twin
    preset: Preset
    space: Space
    problem: Problem
    recorded: tuple[Any, ...]
    drives: tuple[Any, ...]
    lags: tuple[float, ...]
    warnings: tuple[str, ...]

    @property
    def on_road(self) -> bool:
        """Whether the vehicle drives on a road; else its recordings are controlled runs."""
        return model_of(self.twin).recordings == "drive"


def set_up(
    request: CalibrationRequest, note: Callable[[str], None], should_stop: Callable[[], bool]
) -> Setup:
    """Read, check and align everything; raises InputError that names the file or the drive."""
    preset = preset_named(request.preset)
    given = load_twin(request.twin)
    original = with_effects(given, [*request.free, *request.also])
    if not request.bags:
        raise InputError("drives", "none are given: name at least one recorded drive")
    twin = with_table_2(original) if preset.table_2 else original
    bounds = {key: (low, high) for key, low, high in request.bounds}
    nuisances = [k for k in request.freeze if k.startswith("nuisances.")]
    priors = NuisancePriors().without(nuisances)
    frozen = [k for k in request.freeze if k not in nuisances]
    space = build_space(twin, preset, request.free, request.also, frozen, bounds)
    if model_of(twin).recordings != "drive":
        return _of_runs(request, preset, original, twin, space, nuisances, should_stop)
    road = road_of(twin)
    recordings = []
    for bag in request.bags:
        if should_stop():
            raise Interrupted
        note(f"reading {Path(bag).name}")
        recordings.append(read_drive(bag, topics=request.topics))
        check_recording(recordings[-1])
    recorded = on_common_rate(recordings, FilterSpec())
    drives = renamed([prepare_checked(d, twin, road) for d in recorded])
    problem, lags, warnings = assemble(twin, space, preset, request, drives, priors)
    problem.interrupt = should_stop
    return Setup(twin, original, preset, space, problem, tuple(recorded), tuple(drives), lags, warnings)


def prepare_checked(
    drive: Drive, twin: Twin, road: Road, settings: PrepareSettings | None = None
) -> Prepared:
    """Prepare a drive for calibration, or refuse it with the reason and what to do."""
    check_recording(drive)
    prepared = prepare(drive, twin, road, settings, strict=True)
    check_drive(prepared)
    return prepared


def _of_runs(
    request: CalibrationRequest,
    preset: Preset,
    original: Twin,
    twin: Twin,
    space: Space,
    frozen: Sequence[str],
    should_stop: Callable[[], bool],
) -> Setup:
    """The problem over controlled runs; with a preset that says so the slowest are fitted, the others validate."""
    runs = observe(twin, request.bags)
    slowest = min(float(np.abs(r.along).mean()) for r in runs)
    fitted = [r for r in runs if not preset.slowest or float(np.abs(r.along).mean()) <= _ALIKE * slowest]
    measured = [c for c in fitted[0].measured if all(c in r.measured for r in fitted)]
    channels = dict(request.channels) or {c: w for c, w in preset.channels.items() if c in measured}
    weighted = _weighted(channels or dict.fromkeys(measured, 0.0), fitted)
    objective = request.objective or preset.objective
    terms = parse_objective(
        "euclidean" if objective == "likelihood" else objective, weighted, model_of(twin).channels
    )
    # a genetic search compares what was measured as it was measured
    priors = (
        fitted[0].priors if preset.search == "squares" else replace(fitted[0].priors, clock=0.0, speed=0.0)
    )
    priors = priors.without(frozen)
    rows = [np.arange(r.t.size) for r in fitted]
    problem = Problem(twin, space, fitted, range(len(fitted)), terms, priors, [0.0] * len(fitted), rows)
    problem.interrupt = should_stop
    warnings = tuple(f"{r.name}: {text}" for r in runs for text in r.warnings)
    return Setup(
        twin, original, preset, space, problem, tuple(runs), tuple(runs), (0.0,) * len(runs), warnings
    )


def _weighted(channels: dict[str, float], drives: Sequence[Any]) -> dict[str, float]:
    """Weights of channels; 0 stands for "by the channels' floors", in units of the first's."""
    floors = {
        c: float(np.mean([d.noise_rms[c] for d in drives])) for c in channels if c in drives[0].noise_rms
    }
    unit = floors.get("vertical_acceleration", next(iter(floors.values()), 1.0))
    return {c: w if w > 0 else unit / max(floors.get(c, unit), 1e-12) for c, w in channels.items()}


def assemble(
    twin: Twin,
    space: Space,
    preset: Preset,
    request: CalibrationRequest,
    drives: list[Prepared],
    priors: NuisancePriors | None = None,
    settings: TrimSettings | None = None,
) -> tuple[Problem, tuple[float, ...], tuple[str, ...]]:
    """The problem over prepared drives, each trimmed and moved in time to where it roughly fits."""
    priors = priors or NuisancePriors()
    settings = settings or TrimSettings()
    rates = {round(d.rate, 3) for d in drives}
    weighted = _weighted(
        dict(request.channels) or {c: w for c, w in preset.channels.items() if c in CHANNELS}, drives
    )
    objective = request.objective or preset.objective
    terms = parse_objective("euclidean" if objective == "likelihood" else objective, weighted)
    parts: list[Prepared] = []
    drive_of: list[int] = []
    lags: list[float] = []
    for number, drive in enumerate(drives):
        pieces = [p for p in trim(drive, settings) if fit_rows(p, settings).size >= 0.5 * p.rate]
        check_parts(drive, sum(fit_rows(p, settings).size for p in pieces), settings)
        lag = _lag(twin, pieces, settings)
        lags.append(lag)
        parts += [p.moved(lag, 0.0) if lag else p for p in pieces]
        drive_of += [number] * len(pieces)
    warnings = [w for d in drives for w in (f"{d.name}: {text}" for text in d.warnings)]
    if len(rates) > 1 and any(t.kind in ("spectral", "iso18571") for t in terms):
        raise InputError(
            "drives", f"come at different rates ({sorted(rates)} Hz): calibrate on them one by one"
        )
    warnings += [
        f"{d.name}: the pose was read {lag:+.3f} s off the IMU's clock before the fit"
        for d, lag in zip(drives, lags, strict=True)
        if lag
    ]
    wander = [_wander(d, priors) for d in drives]
    rows = [fit_rows(part, settings) for part in parts]
    problem = Problem(twin, space, parts, drive_of, terms, priors, wander, rows)
    return problem, tuple(lags), tuple(warnings)


def _lag(twin: Twin, pieces: list[Prepared], settings: TrimSettings) -> float:
    """Seconds to move a drive's pose by, 0 where the twin as it stands does not clearly ask for it."""
    pairs: list[tuple[Floats, Floats]] = []
    for part in pieces:
        simulated = part.condition(simulate_twin(twin, part.excitation))
        rows = fit_rows(part, settings)
        cut = slice(int(rows[0]), int(rows[-1]) + 1)
        pairs += [(part.measured[c][cut], simulated[c][cut]) for c in ("vertical_acceleration", "pitch_rate")]
    lag, there, here = coarse_lag(pairs, pieces[0].rate, _LONGEST_LAG)
    return lag if abs(lag) * pieces[0].rate > 1.5 and there > here + _SURE and there > 0.3 else 0.0


def _wander(drive: Prepared, priors: NuisancePriors) -> float:
    """Standard deviation in m of the slow error of a drive's smoothed positions, 0 where it is not worth a nuisance."""
    if priors.wander is not None:
        return priors.wander
    return slow_position_error(drive) if drive.position_sigma >= 0.1 else 0.0
