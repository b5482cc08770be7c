# SPDX-License-Identifier: Apache-2.0
"""Calibration preset ``tracked_paper``: section 4 of the tracked paper, and a better objective beside it.

Five parameters of the track within the bounds (10) to (14), a genetic algorithm with population
40 over 30 generations, objective (15): the mean correlation of the vertical displacement of the
markers A and B on the 4 km/h run. Parameters that span decades are searched in logarithms.

Correlation says nothing of amplitude: twice the motion correlates as well. ``amplitude`` is the
root mean square of what is left between both curves over the measured one's, mean of A and B.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from suspension_twin.calibration.genetic import GaSettings, GeneticSearch
from suspension_twin.drive.types import Floats
from suspension_twin.errors import InputError, WorkError
from suspension_twin.models.tracked import simulate_tracked_lanes
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle

__all__ = [
    "PUBLISHED",
    "MarkerRun",
    "TrackedResult",
    "Worth",
    "calibrate_tracked",
    "compare",
    "identifiability",
    "read_markers",
]

Objective = Literal["correlation", "amplitude"]
#: The tracked paper's result, eqs (16) to (20).
PUBLISHED: Final = dict(zip(BOUNDS, (2.676e7, 6.257e3, 1.0e4, 7.74e3, -5563.0), strict=True))
#: No "stall" stop in the paper: the number of generations is its only criterion.
SETTINGS: Final = GaSettings(population=40, generations=30, stall_generations=30, elite_share=0.05)
_LOG = tuple(key for key in BOUNDS if key.startswith("track."))


@dataclass(frozen=True)
class MarkerRun:
    """Vertical displacement (n, 2) m of A and B at uniform stamps ``t`` (n,) s from the start; speed m/s."""

    t: Floats
    markers: Floats
    speed: float

    @property
    def rate(self) -> float:
        """Stamps per second."""
        return float((self.t.size - 1) / (self.t[-1] - self.t[0]))


@dataclass(frozen=True)
class Worth:
    """How alike two runs are: per marker correlation, residual/measured rms, and simulated/measured rms."""

    correlation: Floats
    residual: Floats
    gain: Floats

    def cost(self, objective: Objective) -> float:
        """What is made small: 1 - objective (15), or the mean relative residual."""
        return 1.0 - float(self.correlation.mean()) if objective == "correlation" else float(self.residual.mean())


@dataclass(frozen=True)
class TrackedResult:
    """``values`` in the order of ``BOUNDS``, ``best`` the least cost after each generation."""

    vehicle: TrackedVehicle
    values: dict[str, float]
    worth: Worth
    best: Floats
    evaluations: int


def read_markers(path: str | Path, speed: float, *, rate: float = 50.0) -> MarkerRun:
    """Marker tracks from a CSV of a photogrammetry tool: header ``t,A,B``, s and mm upwards.

    Any uniform or jittered stamps that rise; resampled to ``rate``. ``t`` counts from where the idler's front
    edge is 0.5 m before the obstacle. Raises InputError that names the file and what is wrong.
    """
    path = Path(path)
    try:
        with path.open(encoding="utf-8-sig") as file:
            names = [name.strip() for name in file.readline().split(",")]
            if names != ["t", "A", "B"]:
                raise InputError(path, "header", f"must be t,A,B (s, mm, mm), is {','.join(names)[:60]}")
            table = np.loadtxt(file, delimiter=",", ndmin=2)
    except OSError as error:
        raise InputError(path, error.strerror or "cannot be read") from None
    except ValueError as error:
        raise InputError(path, f"not a table of numbers: {str(error).splitlines()[0][:80]}") from None
    if table.shape[0] < 20 or table.shape[1] != 3:
        raise InputError(path, f"needs 3 columns and at least 20 rows, has {table.shape[1]} and {table.shape[0]}")
    if not np.isfinite(table).all():
        raise InputError(path, "holds values that are no numbers: cut or fill the gaps")
    if not (np.diff(table[:, 0]) > 0).all():
        raise InputError(path, "t", "must rise from row to row")
    if table[0, 0] < 0:
        raise InputError(path, "t", "must not begin before 0, where the run does")
    if np.ptp(table[:, 1:]) > 5000.0:
        raise InputError(path, "markers move by more than 5 m: is the unit mm?")
    first = np.ceil(table[0, 0] * rate - 1e-9)
    t = np.arange(first, np.floor(table[-1, 0] * rate + 1e-9) + 1) / rate
    markers = np.stack([np.interp(t, table[:, 0], table[:, k]) for k in (1, 2)], axis=1) / 1000
    return MarkerRun(t, markers, speed)


def compare(measured: Floats, simulated: Floats) -> Worth:
    """Eqs (7), (8) for each marker (n, 2), and what they miss; both about their means."""
    m, s = measured - measured.mean(axis=0), simulated - simulated.mean(axis=0)
    size, other = np.sqrt((m**2).mean(axis=0)), np.sqrt((s**2).mean(axis=0))
    if not (size > 0).all():
        raise InputError("markers", "do not move: nothing to compare with")
    correlation = (m * s).mean(axis=0) / np.maximum(size * other, np.finfo(float).tiny)
    return Worth(correlation, np.sqrt(((m - s) ** 2).mean(axis=0)) / size, other / size)


def _simulate(vehicles: Sequence[TrackedVehicle], run: MarkerRun) -> list[Floats | None]:
    """Markers (n, 2) at the run's stamps for each vehicle; None where it diverged."""
    first = round(run.t[0] * run.rate)
    responses = simulate_tracked_lanes(vehicles, [run.speed] * len(vehicles), float(run.t[-1]), rate=run.rate)
    return [None if r.failed else r.markers[first : first + run.t.size] for r in responses]


def _values(unit: Floats) -> dict[str, float]:
    values = {}
    for u, (key, (low, high)) in zip(unit, BOUNDS.items(), strict=True):
        value = low * (high / low) ** u if key in _LOG else low + u * (high - low)
        values[key] = float(np.clip(value, low, high))
    return values


def calibrate_tracked(
    vehicle: TrackedVehicle,
    run: MarkerRun,
    *,
    objective: Objective = "correlation",
    seed: int = 0,
    settings: GaSettings = SETTINGS,
    on_generation: Callable[[int, float], None] | None = None,
) -> TrackedResult:
    """Find the five parameters from one run. A candidate that diverges is the worst, not the end.

    Raises WorkError where every candidate diverged.
    """
    search = GeneticSearch(len(BOUNDS), settings, seed)
    while search.generation <= settings.generations:
        candidates = [vehicle.with_changes(_values(u)) for u in search.ask()]
        markers = _simulate(candidates, run)
        costs = [np.inf if m is None else compare(run.markers, m).cost(objective) for m in markers]
        search.tell(np.array(costs))
        if on_generation is not None:
            on_generation(search.generation - 1, search.best[-1])
    unit, cost = search.best_point
    if not np.isfinite(cost):
        raise WorkError("tracked_paper: every candidate diverged: check the vehicle and the speed")
    values = _values(unit)
    found = vehicle.with_changes(values)
    motion = _simulate([found], run)[0]
    assert motion is not None  # it had a finite cost
    return TrackedResult(found, values, compare(run.markers, motion), np.array(search.best), search.evaluations)


def identifiability(vehicle: TrackedVehicle, runs: Sequence[MarkerRun], noise: float) -> dict[str, float]:
    """Standard deviation of each parameter as a share of its range (decades for the logarithmic ones).

    From central differences about ``vehicle`` over 2 % of the range, for white noise of ``noise`` m on each
    stamp; each parameter with the others free. 1 and above: these runs say nothing of it (the bounds alone
    know it to 0.29).
    """
    keys, step = list(BOUNDS), 0.02
    centre = []
    for key in keys:
        low, high = BOUNDS[key]
        value = vehicle.model_dump()[key.split(".")[0]][key.split(".")[1]]
        share = np.log(value / low) / np.log(high / low) if key in _LOG else (value - low) / (high - low)
        centre.append(float(np.clip(share, step, 1 - step)))
    points = []
    for i in range(len(keys)):
        for sign in (1.0, -1.0):
            unit = np.array(centre)
            unit[i] += sign * step
            points.append(vehicle.with_changes(_values(unit)))
    columns = []
    for run in runs:
        moved = _simulate(points, run)
        if any(m is None for m in moved):
            raise WorkError("identifiability: a neighbour of the vehicle diverged")
        signals = [np.asarray(m - m.mean(axis=0)).ravel() for m in moved if m is not None]
        columns.append([(a - b) / (2 * step) for a, b in zip(signals[::2], signals[1::2], strict=True)])
    jacobian = np.concatenate([np.stack(c, axis=1) for c in columns])
    # A weak prior of the bounds keeps a parameter without any effect finite (10 ranges).
    information = jacobian.T @ jacobian / noise**2 + np.eye(len(keys)) * 1e-2
    deviation = np.sqrt(np.diag(np.linalg.inv(information)))
    return dict(zip(keys, (float(d) for d in deviation), strict=True))
