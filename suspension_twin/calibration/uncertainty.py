# SPDX-License-Identifier: Apache-2.0
"""What the drives tell: intervals around the result, and bands around its characteristics."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.presets import PRESETS, build_space
from suspension_twin.calibration.recorder import Outcome
from suspension_twin.calibration.request import CurveEstimate
from suspension_twin.calibration.setup import Setup
from suspension_twin.calibration.squares import full_precision, in_floors
from suspension_twin.identification.gauss_newton import GaussNewton, GaussNewtonSettings
from suspension_twin.identification.noise import NEAR_FLOOR, ScaledObjective, Whitener
from suspension_twin.identification.posterior import Posterior, Travel, Weighing, posterior, span_of, travel
from suspension_twin.identification.problem import FitProblem, Problem
from suspension_twin.identification.space import Curve, Space
from suspension_twin.vehicle.twin import Twin

__all__ = ["INTERVAL", "Told", "curve_estimates", "tell"]

#: Quantiles of the intervals.
INTERVAL = (0.05, 0.95)
_GRID = 120
_POLISH = GaussNewtonSettings(iterations=12, tolerance=0.0, absolute=0.1, patience=1)


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
    """Look around the result, in a space with wide bounds.

    Where noise is what is left, by the likelihood fitted from the result on. Where more is left (or the
    search kept to another objective), by least squares with what is left as the scale; that the likelihood,
    which weighs the same residuals in another way, would have ended elsewhere counts as doubt of that
    size: what two ways of weighing disagree on, no statistics of the residual knows.
    """
    problem = _widened(setup, outcome)
    precision = full_precision(problem)
    searched = outcome.x is not None and outcome.likelihood is not None
    if searched:
        assert outcome.x is not None and outcome.likelihood is not None
        x, likelihood = outcome.x.copy(), outcome.likelihood
    else:
        x = np.concatenate([problem.space.to_slopes(outcome.values), outcome.nuisance - outcome.placed])
        if outcome.x is not None:
            x = outcome.x.copy()
        likelihood = _likelihood_at(problem, x)
        x = _polished(problem, likelihood, x, precision, outcome.placed)
        likelihood = _likelihood_at(problem, x)
    x = _polished(problem, likelihood, x, precision, outcome.placed)
    if searched or (outcome.x is None and in_floors(setup, problem, _compared(problem, x)) < NEAR_FLOOR):
        for _ in range(3):
            where = _travel_at(setup, problem, x)
            found = posterior(problem, likelihood, x, precision, where, seed)
            if found.better is None:
                break
            x = _polished(problem, likelihood, found.better, precision, outcome.placed)
    else:
        other = x
        squares = ScaledObjective.at(
            problem.objective, _compared(problem, other if outcome.x is None else outcome.x)
        )
        x = _polished(problem, squares, other, precision, outcome.placed) if outcome.x is None else outcome.x
        found = posterior(
            problem, squares, x, precision, _travel_at(setup, problem, x), seed, doubt=other - x
        )
    low, high = np.quantile(found.draws, INTERVAL, axis=1)
    twin = setup.space.applied(setup.twin, outcome.values)
    return Told(problem.space, found, travel(twin, problem), low, high, x)


def _travel_at(setup: Setup, problem: Problem, x: Floats) -> Travel:
    values = problem.space.from_slopes(x[: len(problem.space)])
    return travel(problem.space.applied(setup.twin, values), problem)


def _compared(problem: Problem, x: Floats) -> Floats:
    d = len(problem.space)
    signals, _ = problem.simulate(problem.space.from_slopes(x[:d, None]))
    return np.asarray(problem.compared(signals, x[d:, None])[:, :, 0])


def _widened(setup: Setup, outcome: Outcome) -> Problem:
    """The problem in a space whose bounds are nobody's, so that an interval may reach beyond them."""
    problem = copy.copy(outcome.problem)
    problem.space = build_space(setup.twin, PRESETS["fast"], setup.space.keys, known=setup.space.parameters)
    return problem


def _likelihood_at(problem: Problem, x: Floats) -> Whitener:
    return Whitener.of_residual(problem.measured, _compared(problem, x))


def _polished(problem: Problem, likelihood: Weighing, x: Floats, precision: Floats, placed: Floats) -> Floats:
    centre = np.concatenate([problem.space.z0, -placed])
    fit = FitProblem(problem, likelihood.residuals)
    solver = GaussNewton(fit, x, precision, centre, settings=_POLISH)
    solver.run()
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
        key=curve.key,
        unit=curve.unit,
        grid=grid,
        force=_interpolated(grid, curve.x, value[:, None])[:, 0],
        low=low,
        high=high,
        start=_interpolated(grid, before_x, before[:, None])[:, 0],
        span=span,
        static=static,
        rest_grid=rest[0],
        rest_low=rest[1],
        rest_high=rest[2],
    )


def _from_rest(
    x: Floats, force: Floats, draws: Floats, static: float, span: tuple[float, float]
) -> tuple[Floats, Floats, Floats]:
    """Band over the travel from standstill: each draw counted from where it bears the same load."""
    load = float(_interpolated(np.array([static]), x, force[:, None])[0, 0])
    travel = np.linspace(span[0] - static, span[1] - static, _GRID)
    place = _place_of(load, x, draws)
    thinned = slice(0, None, 4)
    forces = _interpolated(travel[:, None] + place[thinned], x, draws[:, thinned])
    low, high = np.quantile(forces, INTERVAL, axis=1)
    return travel, low, high


def _place_of(load: float, x: Floats, force: Floats) -> Floats:
    """(N,) compressions at which curves (k, N) bear ``load``."""
    edges = np.concatenate([[0.0], x])
    values = np.concatenate([np.zeros((1, force.shape[1])), force])
    above = np.clip(np.count_nonzero(values < load, axis=0), 1, x.size)
    lane = np.arange(force.shape[1])
    bottom = values[above - 1, lane]
    rise = np.maximum(values[above, lane] - bottom, 1e-9)
    return np.asarray(edges[above - 1] + (load - bottom) / rise * (edges[above] - edges[above - 1]))


def _interpolated(grid: Floats, x: Floats, force: Floats) -> Floats:
    """(g, N) forces of N curves (k, N) through (0, 0), going on with their first and last slopes.

    ``grid`` (g,) for all of them, or (g, N) each its own."""
    edges = np.concatenate([[0.0], x])
    values = np.concatenate([np.zeros((1, force.shape[1])), force])
    segment = np.clip(np.searchsorted(edges, grid, side="right") - 1, 0, x.size - 1)
    share = (grid - edges[segment]) / (edges[segment + 1] - edges[segment])
    if grid.ndim == 1:
        return np.asarray(values[segment] + share[:, None] * (values[segment + 1] - values[segment]))
    below, above = (np.take_along_axis(values, at, axis=0) for at in (segment, segment + 1))
    return np.asarray(below + share * (above - below))
