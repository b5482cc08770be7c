# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of a calibration: intervals, bands of the characteristics, and which parameters the data identify.

Let C be the posterior covariance in the solver's coordinates and P the prior's precision. Parameter i
is *identified* if the data carry at least as much information on it as the prior does, alone and
given all others:

    C_ii <= 1/2 (P^-1)_ii    and    1 / (C^-1)_ii <= 1/2 (1 / P_ii).

Up to this limit of one half (a gain of ln(2)/2 nats) the estimate is more the prior's than the data's,
for a Gaussian posterior weighs the two by their precisions. What is not identified follows the prior:
*extrapolated* from identified parameters that the prior correlates with it (neighbouring segments of a
characteristic; *interpolated* where the drives reached its point), else *kept* at its start. A parameter that the prior
correlates with no other is kept as well if its 90 % interval holds its start and a likelihood ratio test does not
reject the start. What is kept is held there and the rest is fitted once more, unless that rejects the starts by as many
independent residuals as there are blocks of two seconds: then those that are farthest from theirs, in standard
deviations, are identified too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtri

from suspension_twin.arrays import Floats
from suspension_twin.calibration.presets import PRESETS, build_space
from suspension_twin.calibration.recorder import SearchOutcome
from suspension_twin.calibration.request import Band, CurveEstimate
from suspension_twin.calibration.setup import Setup
from suspension_twin.calibration.squares import LIKELIHOOD, in_floors
from suspension_twin.inference.gauss_newton import GaussNewton
from suspension_twin.inference.noise import NEAR_FLOOR, ScaledObjective, Whitener
from suspension_twin.inference.objectives import Objective, Term
from suspension_twin.inference.posterior import (
    Posterior,
    Travel,
    drawn_curve,
    forces_at,
    posterior,
    span_of,
    travel,
)
from suspension_twin.inference.problem import JointPrior, Noise, Problem
from suspension_twin.inference.runs import TWO_PERIODS
from suspension_twin.inference.space import Curve, Space
from suspension_twin.models.parameters import twin_value
from suspension_twin.vehicle.twin import Twin

__all__ = ["HALF_WIDTH", "INTERVAL", "Uncertainty", "assess", "curve_estimates"]

#: Quantiles of the intervals.
INTERVAL = _LOW, _HIGH = (0.05, 0.95)
#: Half the width of that interval in standard deviations of a Gaussian.
HALF_WIDTH = float(ndtri(_HIGH))
#: Level of the likelihood ratio test, the interval's.
_LEVEL = _LOW + _LOW
#: Posterior over prior variance at which data and prior are worth the same.
_EQUAL_INFORMATION = 0.5
_GRID = 120


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """``space`` has wide bounds, ``posterior`` is taken in it around the coordinates ``x`` (d + q,) of the fit, whose
    kept parameters are at their start. ``where`` the drives took the suspension; ``low``, ``high`` (d,) ends of the
    90 % intervals, which hold what is reported; ``status`` of each parameter; ``absorbed`` (d,) the value that a kept
    parameter had while it was free, where that lies outside its prior's 90 % interval, else NaN."""

    space: Space
    posterior: Posterior
    where: Travel
    low: Floats
    high: Floats
    x: Floats
    status: tuple[str, ...]
    absorbed: Floats


def assess(setup: Setup, outcome: SearchOutcome, seed: int) -> Uncertainty:
    """The uncertainty around the result of a search, in a space with wide bounds.

    Where the residual is noise, by the likelihood fitted from the result on. Where it is larger (or the
    search minimised another objective), by least squares with the residual's size as the scale; the distance
    to the likelihood's own optimum, which weighs the same residuals in another way, then counts as one more
    standard deviation: model discrepancy that no statistics of the residual shows.
    """
    problem = _widened(setup, outcome)
    precision = problem.prior.precision
    d = len(problem.space)
    x, weighing, doubt = _best_fit(setup, problem, outcome, precision)

    def around(x: Floats) -> Posterior:
        where = _travel_at(setup, problem, x)
        return posterior(problem, weighing, x, precision, where, seed, placed=outcome.placed, doubt=doubt)

    for _ in range(3):
        found = around(x)
        if doubt is not None or found.better is None:
            break
        x = _polished(problem, weighing, found.better, precision, outcome.placed)
    status = np.where(_identified(found.covariance, precision)[:d], "identified", "not identified")
    absorbed = np.full(d, np.nan)
    if outcome.squares is not None:
        weight = outcome.squares.prior_weight
        status, absorbed, held = _settle(
            problem,
            outcome,
            weighing,
            x=x,
            covariance=found.covariance,
            precision=precision,
            weight=weight,
            status=status,
        )
        if held is not x:
            x, found = held, around(held)
    low, high = np.quantile(found.draws, INTERVAL, axis=1)
    # What is reported belongs to its interval, also where another objective found it at the end of a valley.
    reported = problem.space.from_slopes(x[:d, None])[:, 0]
    low, high = np.minimum(low, reported), np.maximum(high, reported)
    where = _travel_at(setup, problem, x)
    reached = [
        row
        for curve in problem.space.curves
        for begin, end in [span_of(curve, where)]
        for row, at in zip(curve.rows, curve.x, strict=True)
        if row >= 0 and begin <= at <= end and status[row] == "extrapolated"
    ]
    status[reached] = "interpolated"
    return Uncertainty(problem.space, found, where, low, high, x, tuple(map(str, status)), absorbed)


def _best_fit(
    setup: Setup, problem: Problem, outcome: SearchOutcome, precision: Floats
) -> tuple[Floats, Whitener | ScaledObjective, Floats | None]:
    """Coordinates (d + q,) of the fit that the posterior is taken around, what weighs its residuals, and the
    standard deviation (d + q,) that model discrepancy adds, or None where the residual is noise."""
    ended = outcome.squares
    if ended is not None and ended.likelihood is not None:
        x = _polished(problem, ended.likelihood, ended.x, precision, outcome.placed)
        return x, ended.likelihood, None
    start = np.concatenate([problem.space.to_slopes(outcome.values), outcome.nuisance - outcome.placed])
    x = start if ended is None else ended.x
    x = _polished(problem, _likelihood_at(problem, x), x, precision, outcome.placed)
    likelihood = _likelihood_at(problem, x)
    x = _polished(problem, likelihood, x, precision, outcome.placed)
    if ended is None and in_floors(setup, problem, problem.readings(x)) < NEAR_FLOOR:
        return x, likelihood, None
    objective = _least_squares(setup.objective)
    squares = ScaledObjective.at(objective, problem.readings(x if ended is None else ended.x))
    fit = _polished(problem, squares, x, precision, outcome.placed) if ended is None else ended.x
    return fit, squares, x - fit


def _identified(covariance: Floats, precision: Floats) -> NDArray[np.bool_]:
    """(d + q,) True where the data carry more information than the prior, alone and given all others."""
    alone = np.diag(covariance) / np.diag(np.linalg.inv(precision))
    given_others = np.diag(precision) / np.diag(np.linalg.inv(covariance))
    return np.asarray((alone <= _EQUAL_INFORMATION) & (given_others <= _EQUAL_INFORMATION))


def _settle(
    problem: Problem,
    outcome: SearchOutcome,
    weighing: Noise,
    *,
    x: Floats,
    covariance: Floats,
    precision: Floats,
    weight: float,
    status: NDArray[np.str_],
) -> tuple[NDArray[np.str_], Floats, Floats]:
    """Status (d,), absorbed values (d,) and coordinates (d + q,) of the fit with the kept parameters at their start
    (``x`` itself if there are none)."""
    d = len(problem.space)
    identified = status == "identified"
    prior = np.linalg.inv(precision)[:d, :d]
    coupled = np.abs(prior) > 1e-9 * np.sqrt(np.outer(np.diag(prior), np.diag(prior)))
    status = np.where(
        identified, status, np.where(coupled[:, identified].any(axis=1), "extrapolated", "kept")
    )
    z0 = outcome.problem.space.z0
    away = np.abs(x[:d] - z0)
    fit = outcome.problem.weighed(weighing)

    def held(keep: NDArray[np.bool_]) -> tuple[Floats, float]:
        """The fit with some coordinates at their start, and its sum of squares."""
        at = x
        if keep.any():
            at = x.copy()
            at[:d][keep] = z0[keep]
            fixed = np.append(keep, np.zeros(x.size - d, dtype=bool))
            at = _polished(outcome.problem, weighing, at, weight * precision, outcome.placed, fixed)
        return at, float(fit.sums_of_squares(at[:, None])[0])

    kept = status == "kept"
    sure = away / np.sqrt(np.diag(covariance)[:d])
    free = float(fit.sums_of_squares(x[:, None])[0])
    result, squares = held(kept)
    # a residual that is model discrepancy is independent from block to block, not from sample to sample
    blocks = fit.measured.values.shape[0] / (fit.measured.rate * TWO_PERIODS)
    while kept.any() and blocks * np.log(squares / free) > chdtri(int(kept.sum()), _LEVEL):
        kept &= sure < min(HALF_WIDTH, float(sure[kept].max()))
        result, squares = held(kept)
    status = np.where(~kept & (status == "kept"), "identified", status)
    far = kept & (away > HALF_WIDTH * np.sqrt(np.diag(prior)))
    absorbed = np.where(far, problem.space.from_slopes(x[:d]), np.nan)
    near = sure <= HALF_WIDTH
    tested = identified & near & (coupled.sum(axis=1) == 1)
    if tested.any():
        other, more = held(kept | tested)
        if blocks * np.log(more / squares) < chdtri(int(tested.sum()), _LEVEL):
            status, result = np.where(tested, "kept", status), other
    return status, absorbed, result


def _travel_at(setup: Setup, problem: Problem, x: Floats) -> Travel:
    values = problem.space.from_slopes(x[: len(problem.space)])
    return travel(problem.space.applied(setup.twin, values), problem)


def _widened(setup: Setup, outcome: SearchOutcome) -> Problem:
    """The problem in a space with wide bounds, so that an interval may reach beyond those of the search."""
    problem = outcome.problem
    space = build_space(setup.twin, PRESETS["fast"], setup.space.keys, known=setup.space.parameters)
    return replace(problem, space=space, prior=JointPrior.of(space, problem.nuisances))


def _least_squares(objective: Objective) -> Objective:
    """The objective, or the distance in its channels where it is no sum of squares."""
    if all(t.kind != "iso18571" for t in objective.terms):
        return objective
    distance = tuple(Term("euclidean", t.channel, t.weight) for t in objective.terms)
    return Objective(distance, objective.measured)


def _likelihood_at(problem: Problem, x: Floats) -> Whitener:
    return Whitener.of_residual(problem.measured, problem.readings(x))


def _polished(
    problem: Problem,
    weighing: Noise,
    x: Floats,
    precision: Floats,
    placed: Floats,
    fixed: NDArray[np.bool_] | None = None,
) -> Floats:
    """The optimum near ``x`` (d + q,) with the prior's ``precision``, coordinates ``fixed`` left where they are."""
    centre = np.concatenate([problem.space.z0, -placed])
    low, high = (None, None) if fixed is None else (np.where(fixed, x, side) for side in (-np.inf, np.inf))
    solver = GaussNewton(problem.weighed(weighing), x, precision, centre, low, high, settings=LIKELIHOOD)
    solver.run()
    return solver.x


def curve_estimates(setup: Setup, twin: Twin, found: Uncertainty) -> tuple[CurveEstimate, ...]:
    """Every characteristic with at least one free point, and its band."""
    return tuple(_curve(setup, twin, found, curve) for curve in setup.space.curves)


def _curve(setup: Setup, twin: Twin, found: Uncertainty, curve: Curve) -> CurveEstimate:
    span = span_of(curve, found.where)
    grid = np.linspace(0.0, curve.x[-1], _GRID)
    value = twin_value(twin, curve.key).points[1]
    before_x, before = twin_value(setup.original, curve.key).points
    _, draws = drawn_curve(curve, twin, found.posterior.draws)
    low, high = np.quantile(forces_at(grid, curve.x, draws), INTERVAL, axis=1)
    static, from_rest = float("nan"), None
    if curve.part == "spring" and np.isfinite(span[0]):
        static = found.where.static[curve.axle]
        from_rest = _from_rest(curve.x, value, draws, static, span)
    return CurveEstimate(
        key=curve.key,
        unit=curve.unit,
        band=Band(grid, low, high),
        force=forces_at(grid, curve.x, value[:, None])[:, 0],
        start=forces_at(grid, before_x, before[:, None])[:, 0],
        span=span,
        static=static,
        from_rest=from_rest,
    )


def _from_rest(x: Floats, force: Floats, draws: Floats, static: float, span: tuple[float, float]) -> Band:
    """Band over the travel from standstill: each draw counted from where it bears the same load."""
    load = float(forces_at(static, x, force[:, None])[0])
    travel = np.linspace(span[0] - static, span[1] - static, _GRID)
    place = _place_of(load, x, draws)
    thinned = slice(0, None, 4)
    forces = forces_at(travel[:, None] + place[thinned], x, draws[:, thinned])
    low, high = np.quantile(forces, INTERVAL, axis=1)
    return Band(travel, low, high)


def _place_of(load: float, x: Floats, force: Floats) -> Floats:
    """(N,) compressions at which curves (k, N) bear ``load``."""
    edges = np.concatenate([[0.0], x])
    values = np.concatenate([np.zeros((1, force.shape[1])), force])
    above = np.clip(np.count_nonzero(values < load, axis=0), 1, x.size)
    lane = np.arange(force.shape[1])
    bottom = values[above - 1, lane]
    rise = np.maximum(values[above, lane] - bottom, 1e-9)
    return np.asarray(edges[above - 1] + (load - bottom) / rise * (edges[above] - edges[above - 1]))
