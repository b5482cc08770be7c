# SPDX-License-Identifier: Apache-2.0
"""Which of the five track parameters a manoeuvre determines: Fisher information, and profiles of the likelihood.

Everything in places between 0 and 1 of the bounds (10) to (14), decades alike: k_gl spans four, b_gl six.
A parameter that nothing is known of has a standard deviation of 0.29 (the bounds alone).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.tracked_paper import simulate_runs, unit_values, values_at
from suspension_twin.errors import WorkError
from suspension_twin.gap.marker_runs import MarkerRun
from suspension_twin.vehicle.tracked import BOUNDS, TrackedVehicle

__all__ = ["BOUNDS_ALONE", "STEPS", "Profile", "fisher", "profile"]

BOUNDS_ALONE: Final = 1.0 / 12.0**0.5
#: Steps of the differences, share of the range: where the answer depends on them it is no answer.
STEPS: Final = (0.005, 0.02, 0.05, 0.1)


@dataclass(frozen=True)
class Profile:
    """``places`` (k,) of one parameter, ``cost`` (k,) half chi square at the best of the others less the least of all,
    ``low`` and ``high``: where it stays below 1.35, the 90 % interval (a bound where it never rises above)."""

    key: str
    places: Floats
    cost: Floats
    low: float
    high: float


def _signals(run: MarkerRun, noise: Floats) -> Floats:
    """Displacement, velocity and acceleration in units of the noise (3,), about their means."""
    parts = [m / s for m, s in zip((run.markers, run.velocity, run.acceleration), noise, strict=True)]
    stacked = np.concatenate(parts, axis=1)
    return np.asarray((stacked - stacked.mean(axis=0)).ravel())


def _stack(vehicles: Sequence[TrackedVehicle], runs: Sequence[MarkerRun], noise: Floats) -> list[Floats]:
    out = []
    for told in simulate_runs(vehicles, runs):
        if told is None:
            raise WorkError("identifiability: a neighbour of the vehicle diverges")
        out.append(np.concatenate([_signals(r, noise) for r in told]))
    return out


def fisher(
    vehicle: TrackedVehicle, runs: Sequence[MarkerRun], noise: Floats, steps: Sequence[float] = STEPS
) -> dict[float, dict[str, float]]:
    """Standard deviation of each parameter, share of its range, for each step of the central differences.

    ``noise`` (3,) m, m/s, m/s² of samples taken as independent (give what a model misses as well). Each with
    the others free, with the bounds as a prior of 0.29. Raises WorkError where a neighbour diverges.
    """
    centre, keys = unit_values(vehicle), list(BOUNDS)
    out: dict[float, dict[str, float]] = {}
    for step in steps:
        places = np.clip(centre, step, 1 - step)
        points = [places + sign * step * np.eye(5)[i] for i in range(5) for sign in (1.0, -1.0)]
        told = _stack([vehicle.with_changes(values_at(p)) for p in points], runs, noise)
        jacobian = np.stack(
            [(a - b) / (2 * step) for a, b in zip(told[::2], told[1::2], strict=True)], axis=1
        )
        information = jacobian.T @ jacobian + np.eye(5) / BOUNDS_ALONE**2
        deviation = np.sqrt(np.diag(np.linalg.inv(information)))
        out[step] = dict(zip(keys, (float(d) for d in deviation), strict=True))
    return out


def profile(
    vehicle: TrackedVehicle,
    runs: Sequence[MarkerRun],
    noise: Floats,
    key: str,
    points: int = 9,
    rounds: int = 3,
    tell: Callable[[float], None] = lambda _: None,
) -> Profile:
    """Likelihood of ``key`` over its whole range, the other four fitted anew at each place by Gauss-Newton.

    From the vehicle's own values outwards, each place starting from its neighbour's answer.
    """
    index = list(BOUNDS).index(key)
    measured = np.concatenate([_signals(r, noise) for r in runs])
    others = [i for i in range(5) if i != index]
    centre = unit_values(vehicle)
    places = np.linspace(0.0, 1.0, points)
    middle = int(np.argmin(np.abs(places - centre[index])))
    cost = np.full(points, np.inf)
    for side in (range(middle, points), range(middle - 1, -1, -1)):
        x = centre.copy()
        for k in side:
            x[index] = places[k]
            for _ in range(rounds):
                step = np.where(x[others] > 0.95, -0.03, 0.03)
                around = [x, *(x + s * np.eye(5)[i] for i, s in zip(others, step, strict=True))]
                told = _stack(
                    [vehicle.with_changes(values_at(np.clip(p, 0, 1))) for p in around], runs, noise
                )
                rest = measured - told[0]
                here = 0.5 * float(rest @ rest)
                if here < cost[k]:
                    cost[k], best = here, x.copy()
                jacobian = np.stack([(t - told[0]) / s for t, s in zip(told[1:], step, strict=True)], axis=1)
                move = np.linalg.solve(jacobian.T @ jacobian + 12.0 * np.eye(4), jacobian.T @ rest)
                x = x.copy()
                x[others] = np.clip(x[others] + np.clip(move, -0.2, 0.2), 0.0, 1.0)
            x = best.copy()
            tell(float(places[k]))
    cost -= cost.min()
    fine = np.linspace(0.0, 1.0, 1001)
    inside = fine[np.interp(fine, places, cost) <= 1.35]
    return Profile(key, places, cost, float(inside.min()), float(inside.max()))
