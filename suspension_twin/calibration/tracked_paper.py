# SPDX-License-Identifier: Apache-2.0
"""Calibration preset ``tracked_paper``: section 4 of the tracked paper, and a better objective beside it.

Five parameters of the track within the bounds (10) to (14), a genetic algorithm with population
40 over 30 generations, objective (15): the mean correlation of the vertical displacement of the
markers A and B on the 4 km/h run. Parameters that span decades are searched in logarithms.

Correlation says nothing of amplitude: twice the motion correlates as well. ``amplitude`` is the rms of
what is left between both displacements over the measured one's. ``motion``, the one to take, is the
same of displacement, velocity and acceleration of every marker seen, each run's clock moved to where
it fits best: velocities and accelerations feel the track, displacements hardly do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.genetic import GaSettings, GeneticSearch
from suspension_twin.calibration.request import Progress
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.marker_runs import MarkerRun, low_pass
from suspension_twin.models.tracked import TrackedResponse, simulate_tracked_lanes
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle

__all__ = [
    "OBJECTIVES",
    "PUBLISHED",
    "PUBLISHED_CORRELATION",
    "SETTINGS",
    "Objective",
    "TrackedResult",
    "Worth",
    "calibrate_tracked",
    "compare",
    "simulate_runs",
    "unit_values",
    "values_at",
]

Objective = Literal["correlation", "amplitude", "motion"]
OBJECTIVES: Final[tuple[str, ...]] = get_args(Objective)
#: The tracked paper's result, eqs (16) to (20).
PUBLISHED: Final = dict(zip(BOUNDS, (2.676e7, 6.257e3, 1.0e4, 7.74e3, -5563.0), strict=True))
#: Its correlations of A and B on the validation run at 13 km/h, section 5.
PUBLISHED_CORRELATION: Final = (0.94, 0.87)
#: No "stall" stop in the paper: the number of generations is its only criterion.
SETTINGS: Final = GaSettings(population=40, generations=30, stall_generations=30, elite_share=0.05)
_LOG = tuple(key for key in BOUNDS if key.startswith("track."))
_LATEST = 0.2  # s that a run's clock may be off


@dataclass(frozen=True)
class Worth:
    """How alike two runs are. For A and B (2,): ``correlation`` of the displacements, eqs (7), (8); ``residual``
    rms of what is left over the measured rms; ``gain`` simulated over measured rms. ``motion`` (3, k): residuals
    of displacement, velocity and acceleration of each marker seen with the clock moved by ``late`` s."""

    correlation: Floats
    residual: Floats
    gain: Floats
    motion: Floats
    late: float

    def cost(self, objective: Objective) -> float:
        """What is made small: 1 - objective (15), or a mean relative residual."""
        if objective == "correlation":
            return 1.0 - float(self.correlation.mean())
        return float((self.residual if objective == "amplitude" else self.motion).mean())


@dataclass(frozen=True)
class TrackedResult:
    """``values`` in the order of ``BOUNDS``, ``worth`` of each run, ``best`` the least cost after each generation."""

    vehicle: TrackedVehicle
    values: dict[str, float]
    worth: tuple[Worth, ...]
    best: Floats
    evaluations: int
    objective: Objective


def compare(measured: MarkerRun, simulated: MarkerRun) -> Worth:
    """Both at the same stamps; everything about its mean. InputError where a marker does not move."""
    m, s = (_centred(r.markers[:, :2]) for r in (measured, simulated))
    size, other = _rms(m), _rms(s)
    if not (size > 0).all():
        raise InputError(measured.name, "markers", "do not move: nothing to compare with")
    correlation = (m * s).mean(axis=0) / np.maximum(size * other, np.finfo(float).tiny)
    seen = np.array(measured.seen)
    pairs = [
        (getattr(measured, kind)[:, seen], getattr(simulated, kind)[:, seen])
        for kind in ("markers", "velocity", "acceleration")
    ]
    late = _late(measured, simulated, seen)
    motion = []
    for have, told in pairs:
        moved = np.stack([np.interp(measured.t - late, measured.t, c) for c in told.T], axis=1)
        motion.append(_rms(_centred(have) - _centred(moved)) / np.maximum(_rms(_centred(have)), 1e-12))
    return Worth(correlation, _rms(m - s) / size, other / size, np.array(motion), late)


def _late(measured: MarkerRun, simulated: MarkerRun, seen: Floats) -> float:
    """Seconds by which the measured displacements come after the simulated ones: least squares, three steps."""
    late = 0.0
    have = _centred(measured.markers[:, seen])
    for _ in range(3):
        at = measured.t - late
        told = np.stack([np.interp(at, measured.t, c) for c in simulated.markers[:, seen].T], axis=1)
        slope = np.stack([np.interp(at, measured.t, c) for c in simulated.velocity[:, seen].T], axis=1)
        slope = _centred(slope)
        step = -float((slope * (have - _centred(told))).sum() / max(float((slope**2).sum()), 1e-12))
        late = float(np.clip(late + step, -_LATEST, _LATEST))
    return late


def _centred(x: Floats) -> Floats:
    return np.asarray(x - x.mean(axis=0))


def _rms(x: Floats) -> Floats:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


def _cut(response: TrackedResponse, run: MarkerRun) -> MarkerRun:
    first = round(run.t[0] * run.rate)
    part = slice(first, first + run.t.size)
    motion = (response.markers, response.marker_velocity, response.marker_acceleration)
    z, v, a = (low_pass(m, run.rate)[part] for m in motion)
    return MarkerRun(run.t, z, v, a, run.speed, run.name)


def simulate_runs(
    vehicles: Sequence[TrackedVehicle], runs: Sequence[MarkerRun], phase: float = 0.0
) -> list[list[MarkerRun] | None]:
    """For each vehicle its motion at the stamps of each run; None where one diverged.

    Repeats at one speed and rate are one simulation. ``phase`` m: where the joints of the links lie.
    """
    kinds = {(r.speed, r.rate): 0.0 for r in runs}
    for run in runs:
        kinds[run.speed, run.rate] = max(kinds[run.speed, run.rate], float(run.t[-1]))
    known = {
        kind: simulate_tracked_lanes(vehicles, [kind[0]] * len(vehicles), seconds, rate=kind[1], phase=phase)
        for kind, seconds in kinds.items()
    }
    out: list[list[MarkerRun] | None] = []
    for i in range(len(vehicles)):
        responses = [known[r.speed, r.rate][i] for r in runs]
        failed = any(r.failed for r in responses)
        out.append(None if failed else [_cut(a, b) for a, b in zip(responses, runs, strict=True)])
    return out


def values_at(unit: Floats) -> dict[str, float]:
    """The five parameters at places (5,) between 0 and 1 of their ranges, decades alike."""
    values = {}
    for u, (key, (low, high)) in zip(unit, BOUNDS.items(), strict=True):
        value = low * (high / low) ** u if key in _LOG else low + u * (high - low)
        values[key] = float(np.clip(value, low, high))
    return values


def unit_values(vehicle: TrackedVehicle) -> Floats:
    """Where a vehicle's five parameters stand in their ranges, (5,) between 0 and 1."""
    places = []
    for key, (low, high) in BOUNDS.items():
        part, name = key.split(".")
        value = float(getattr(getattr(vehicle, part), name))
        places.append(
            np.log(value / low) / np.log(high / low) if key in _LOG else (value - low) / (high - low)
        )
    return np.array(places)


def calibrate_tracked(
    vehicle: TrackedVehicle,
    runs: Sequence[MarkerRun],
    *,
    objective: Objective = "correlation",
    seed: int = 0,
    settings: GaSettings = SETTINGS,
    tell: Callable[[Progress], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrackedResult:
    """Find the five parameters from runs; a cost is the mean over them.

    A candidate that diverges is the worst, not the end. Told to stop, between generations, it ends with the best so
    far. Raises InputError without a run and WorkError where every candidate diverged or none was tried.
    """
    if not runs:
        raise InputError("tracked_paper", "runs", "none is given")
    if objective not in OBJECTIVES:
        raise InputError(
            "tracked_paper", "objective", f"must be one of {', '.join(OBJECTIVES)}, is {objective}"
        )
    search = GeneticSearch(len(BOUNDS), settings, seed)
    while search.generation <= settings.generations and not should_stop():
        candidates = [vehicle.with_changes(values_at(u)) for u in search.ask()]
        search.tell(np.array([_cost(told, runs, objective) for told in simulate_runs(candidates, runs)]))
        tell(Progress("search", search.generation - 1, search.evaluations, float(search.best[-1])))
    if not search.best:
        raise WorkError("tracked_paper: stopped before the search began")
    unit, cost = search.best_point
    if not np.isfinite(cost):
        raise WorkError("tracked_paper: every candidate diverged: check the vehicle and the speed")
    values = values_at(unit)
    found = vehicle.with_changes(values)
    motion = simulate_runs([found], runs)[0]
    assert motion is not None  # it had a finite cost
    worth = tuple(compare(run, told) for run, told in zip(runs, motion, strict=True))
    return TrackedResult(found, values, worth, np.array(search.best), search.evaluations, objective)


def _cost(told: list[MarkerRun] | None, runs: Sequence[MarkerRun], objective: Objective) -> float:
    if told is None:
        return float("inf")
    return float(np.mean([compare(run, t).cost(objective) for run, t in zip(runs, told, strict=True)]))
