# SPDX-License-Identifier: Apache-2.0
"""What the drives tell: intervals around the result, and bands around its characteristics."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from suspension_twin.calibration.identify import Posterior, Travel, posterior, span_of, travel
from suspension_twin.calibration.least_squares import LeastSquares, LmSettings
from suspension_twin.calibration.likelihood import Likelihood
from suspension_twin.calibration.presets import PRESETS, build_space
from suspension_twin.calibration.problem import FitProblem, Problem
from suspension_twin.calibration.recorder import Outcome
from suspension_twin.calibration.request import CurveEstimate
from suspension_twin.calibration.setup import Setup
from suspension_twin.calibration.space import Curve, Space
from suspension_twin.calibration.squares import full_precision
from suspension_twin.drive.types import Floats
from suspension_twin.vehicle.twin import Twin

__all__ = ["INTERVAL", "Told", "curve_estimates", "tell"]

#: Quantiles of the intervals.
INTERVAL = (0.05, 0.95)
_GRID = 120
_POLISH = LmSettings(iterations=12, tolerance=0.0, absolute=0.1, patience=1)


@dataclass(frozen=True, eq=False)
class Told:
    """The posterior in a space without narrow bounds, where the drives went, the intervals of the parameters
    (d,), and the coordinates ``x`` (d + q,) of the best fit of the likelihood."""

    space: Space
    posterior: Posterior
    where: Travel
    low: Floats
    high: Floats
    x: Floats


def tell(setup: Setup, outcome: Outcome, seed: int) -> Told:
    """Fit the likelihood from the result on, in a space with wide bounds, and look around there."""
    problem = _widened(setup, outcome)
    d = len(problem.space)
    precision = full_precision(problem)
    if outcome.x is not None and outcome.likelihood is not None:
        x, likelihood = outcome.x.copy(), outcome.likelihood
    else:
        x = np.concatenate([problem.space.to_slopes(outcome.values), outcome.nuisance - outcome.placed])
        likelihood = _likelihood_at(problem, x)
        x = _polished(problem, likelihood, x, precision, outcome.placed)
        likelihood = _likelihood_at(problem, x)
    x = _polished(problem, likelihood, x, precision, outcome.placed)
    for _ in range(3):
        here = problem.space.applied(setup.twin, problem.space.from_slopes(x[:d]))
        found = posterior(problem, likelihood, x, precision, travel(here, problem), seed)
        if found.better is None:
            break
        x = _polished(problem, likelihood, found.better, precision, outcome.placed)
    low, high = np.quantile(found.draws, INTERVAL, axis=1)
    if outcome.likelihood is None and outcome.x is not None:
        # Where two ways of weighing disagree the model lacks something that no statistics of the residual knows.
        low, high = np.minimum(low, outcome.values), np.maximum(high, outcome.values)
    twin = setup.space.applied(setup.twin, outcome.values)
    return Told(problem.space, found, travel(twin, problem), low, high, x)


def _widened(setup: Setup, outcome: Outcome) -> Problem:
    """The problem in a space whose bounds are nobody's, so that an interval may reach beyond them."""
    problem = copy.copy(outcome.problem)
    problem.space = build_space(setup.twin, PRESETS["fast"], setup.space.keys, known=setup.space.parameters)
    return problem


def _likelihood_at(problem: Problem, x: Floats) -> Likelihood:
    d = len(problem.space)
    signals, _ = problem.simulate(problem.space.from_slopes(x[:d, None]))
    return Likelihood.fitted(problem.measured, problem.compared(signals, x[d:, None])[:, :, 0])


def _polished(problem: Problem, likelihood: Likelihood, x: Floats, precision: Floats, placed: Floats) -> Floats:
    centre = np.concatenate([problem.space.z0, -placed])
    fit = FitProblem(problem, likelihood.residuals)
    solver = LeastSquares(fit, x, precision, centre, _POLISH)
    solver.run(lambda: False)
    return solver.x


def curve_estimates(setup: Setup, twin: Twin, told: Told) -> tuple[CurveEstimate, ...]:
    """Every characteristic with at least one free point, and its band."""
    return tuple(_curve(setup, twin, told, curve) for curve in setup.space.curves)


def _curve(setup: Setup, twin: Twin, told: Told, curve: Curve) -> CurveEstimate:
    _, axle, part = curve.key.split(".")
    span = span_of(curve, told.where)
    grid = np.linspace(0.0, curve.x[-1], _GRID)
    value = getattr(getattr(twin.vehicle, axle), part).points[1]
    before_x, before = getattr(getattr(setup.original.vehicle, axle), part).points
    draws = np.repeat(value[:, None], told.posterior.draws.shape[1], axis=1)
    free = [(i, r) for i, r in enumerate(curve.rows) if r >= 0]
    for i, row in free:
        draws[i] = told.posterior.draws[row]
    low, high = np.quantile(_interpolated(grid, curve.x, draws), INTERVAL, axis=1)
    static, nothing = float("nan"), np.empty(0)
    rest = (nothing, nothing, nothing)
    if part == "spring" and np.isfinite(span[0]):
        static = told.where.static[axle]
        rest = _from_rest(curve.x, value, draws, static, span)
    return CurveEstimate(
        key=curve.key, unit=curve.unit, grid=grid, force=_interpolated(grid, curve.x, value[:, None])[:, 0],
        low=low, high=high, start=_interpolated(grid, before_x, before[:, None])[:, 0], span=span,
        static=static, rest_grid=rest[0], rest_low=rest[1], rest_high=rest[2],
    )  # fmt: skip


def _from_rest(
    x: Floats, force: Floats, draws: Floats, static: float, span: tuple[float, float]
) -> tuple[Floats, Floats, Floats]:
    """Band over the travel from standstill: each draw counted from where it bears the same load."""
    load = float(_interpolated(np.array([static]), x, force[:, None])[0, 0])
    travel = np.linspace(span[0] - static, span[1] - static, _GRID)
    place = _place_of(load, x, draws)
    forces = np.stack(
        [_interpolated(travel + place[k], x, draws[:, k : k + 1])[:, 0] for k in range(0, draws.shape[1], 4)], axis=1
    )
    low, high = np.quantile(forces, INTERVAL, axis=1)
    return travel, low, high


def _place_of(load: float, x: Floats, force: Floats) -> Floats:
    """(N,) compressions at which curves (k, N) bear ``load``."""
    edges = np.concatenate([[0.0], x])
    values = np.concatenate([np.zeros((1, force.shape[1])), force])
    place = np.empty(force.shape[1])
    for k in range(force.shape[1]):
        j = int(np.clip(np.searchsorted(values[:, k], load), 1, x.size))
        rise = max(values[j, k] - values[j - 1, k], 1e-9)
        place[k] = edges[j - 1] + (load - values[j - 1, k]) / rise * (edges[j] - edges[j - 1])
    return place


def _interpolated(grid: Floats, x: Floats, force: Floats) -> Floats:
    """(g, N) forces of N curves (k, N) through (0, 0), going on with their first and last slopes."""
    edges = np.concatenate([[0.0], x])
    values = np.concatenate([np.zeros((1, force.shape[1])), force])
    segment = np.clip(np.searchsorted(edges, grid, side="right") - 1, 0, x.size - 1)
    share = (grid - edges[segment]) / (edges[segment + 1] - edges[segment])
    return np.asarray(values[segment] + share[:, None] * (values[segment + 1] - values[segment]))
