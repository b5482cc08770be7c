# SPDX-License-Identifier: Apache-2.0
"""The joint fit of vehicle, nuisance parameters and effects.

A hypothesis is screened first: its effects are simulated at points over their prior with the baseline vehicle, and one
linear least squares step refits vehicle and nuisance parameters. From the best points, bounded Gauss-Newton
(``gauss_newton``) fits all unknowns jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from suspension_twin.arrays import Floats
from suspension_twin.inference.checkpoint import stored
from suspension_twin.inference.gauss_newton import (
    WHITENED,
    GaussNewton,
    Quadratic,
    bounded_step,
)
from suspension_twin.inference.hypothesis import Hypothesis, having_effects
from suspension_twin.inference.problem import Linearised, Problem
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "DEEP",
    "FIT_SETTINGS",
    "LONG",
    "ROUGH",
    "Fit",
    "LinearisedFit",
    "Screening",
    "approximated",
    "coordinate_scan",
    "fitted",
    "linearised_fit",
    "refit",
    "resonance_scan",
    "screen",
    "twin_of",
]

FIT_SETTINGS = WHITENED
#: Iterations at most of a first fit, of one from a start of its own, and of a joint one; a fit ends by itself before.
ROUGH, DEEP, LONG = 4, 6, 15
#: Scan of an effect coordinate: points, range in standard deviations (99 % of a normal prior), and
#: points simulated after refit.
_SWEPT, _FAR, _TRIED = 9, 2.5, 4


@stored
@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at its best: unknowns ``x`` (d + q + k,), ``cost`` -2 log posterior."""

    hypothesis: Hypothesis
    x: Floats
    cost: float

    @property
    def effect_values(self) -> Floats:
        """(k,) values of the effects' parameters."""
        return self.hypothesis.values(self.x[self.x.size - len(self.hypothesis) :, None])[:, 0]


@dataclass(frozen=True, eq=False)
class LinearisedFit(Fit):
    """A fit with the linearisation ``at`` its unknowns: tens of megabytes, kept only while it is used."""

    at: Linearised


@dataclass(frozen=True, eq=False)
class Screening:
    """Linearised joint ``cost`` and unknowns ``x`` of starts, the best first, and the ``power`` (S,) of each in the
    order given: half the squared change of the whitened signals that characteristics and nuisance parameters cannot
    reproduce, in nats."""

    cost: list[float]
    x: list[Floats]
    power: Floats


def _curvature(problem: Problem, base: LinearisedFit) -> tuple[Floats, Floats, float]:
    """Curvature of the posterior about ``base``, half gradient of the prior, and cost of the prior."""
    precision, centre = problem.having(base.hypothesis).joint_prior()
    hessian = base.at.model.squares + precision
    away = base.x - centre
    pull = np.einsum("ij,j->i", precision, away, optimize=False)
    return hessian + 1e-10 * np.diag(np.diag(hessian)), pull, float(away @ precision @ away)


def _at_active_bound(problem: Problem, x: Floats, gradient: Floats) -> NDArray[np.bool_]:
    """(p,) True for coordinates on a bound whose gradient points outwards."""
    low, high = problem.limits()
    return np.asarray(((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0)))


def screen(problem: Problem, base: LinearisedFit, starts: Floats) -> Screening:
    """Evaluate every start (k, S) of the last effects of a problem with the vehicle of ``base``.

    ``base`` may be a fit of fewer effects: its coordinates are the first of those of ``problem``.
    """
    p = problem.shared
    kept = base.x.size - p
    u = np.concatenate([np.repeat(base.x[p:, None], starts.shape[1], axis=1), starts])
    x = np.concatenate([np.repeat(base.x[:p, None], u.shape[1], axis=1), u])
    residual, failed = problem.residuals(x)
    jacobian = base.at.jacobian
    hessian, pull, penalty = _curvature(problem, base)
    gradient = jacobian.T @ residual + pull[:, None]
    step = bounded_step(hessian, gradient, *problem.having(base.hypothesis).room(base.x))
    costs = np.einsum("rl,rl->l", residual, residual, optimize=False) + penalty
    bent = gradient + 0.5 * np.einsum("ij,jl->il", hessian, step, optimize=False)
    costs = costs + 2.0 * np.einsum("il,il->l", bent, step, optimize=False)
    costs = costs + np.sum((starts - problem.hypothesis.centre()[kept:, None]) ** 2, axis=0)
    costs = np.where(failed | ~np.isfinite(costs), np.inf, costs)
    change = residual - base.at.residual[:, None]
    seen = jacobian.T @ change
    no_match = np.einsum("il,il->l", seen, linalg.cho_solve(linalg.cho_factor(hessian), seen), optimize=False)
    power = 0.5 * (np.einsum("rl,rl->l", change, change, optimize=False) - no_match)
    order = np.argsort(costs, kind="stable")
    unknowns = []
    for i in order:
        moved = x[:, i].copy()
        moved[: p + kept] += np.clip(step[:, i], -FIT_SETTINGS.largest_step, FIT_SETTINGS.largest_step)
        unknowns.append(moved)
    return Screening(costs[order].tolist(), unknowns, np.where(failed, 0.0, power))


def resonance_scan(problem: Problem, base: LinearisedFit, scan: tuple[int, Floats]) -> Floats | None:
    """Unknowns of the best point of a ``scan`` (row of the strength, coordinates (k, S)) over resonance frequencies.

    Scattered starts miss a narrow resonance. Its response is linear in its strength, so that one simulation per
    frequency gives the best strength, of either sign, by linear least squares.
    """
    row, points = scan
    hypothesis, p = problem.hypothesis, problem.shared
    kept = base.x.size - p
    nothing, centre = hypothesis.neutral()[kept + row], hypothesis.centre()[kept:]
    x = np.concatenate([np.repeat(base.x[:, None], points.shape[1], axis=1), points])
    residual, failed = problem.residuals(x)
    jacobian, base_residual = base.at.jacobian, base.at.residual
    hessian, pull, _ = _curvature(problem, base)
    gradient = base.at.model.slope + pull
    change = residual - base_residual[:, None]
    free = np.flatnonzero(~_at_active_bound(problem.having(base.hypothesis), base.x, gradient))
    seen = (jacobian.T @ change)[free]
    factor = linalg.cho_factor(hessian[np.ix_(free, free)])
    taken = linalg.cho_solve(factor, np.column_stack([seen, gradient[free]]))
    far = points[row] - nothing
    curve = np.einsum("rl,rl->l", change, change, optimize=False) + far**2
    curve -= np.einsum("il,il->l", seen, taken[:, :-1], optimize=False)
    slope = np.einsum("r,rl->l", base_residual, change, optimize=False) + (nothing - centre[row]) * far
    slope -= np.einsum("il,i->l", seen, taken[:, -1], optimize=False)
    low, high = (b[kept + row] for b in hypothesis.bounds())
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.clip(nothing - far * slope / curve, low, high)
        share = (strength - nothing) / far
        gain = -(2.0 * slope * share + curve * share**2)
        gain -= np.sum(np.delete(points - centre[:, None], row, axis=0) ** 2, axis=0)
    gain = np.where(failed | ~np.isfinite(gain), -np.inf, gain)
    best = int(np.argmax(gain))
    if not np.isfinite(gain[best]):
        return None
    found: Floats = x[:, best].copy()
    found[p + kept + row] = strength[best]
    step = -(taken[:, -1] + share[best] * taken[:, best])
    found[free] += np.clip(step, -FIT_SETTINGS.largest_step, FIT_SETTINGS.largest_step)
    return np.asarray(problem.clipped(found[:, None])[:, 0])


def coordinate_scan(problem: Problem, at: LinearisedFit) -> Floats | None:
    """Unknowns of lower cost than a fit of the problem; None if there are none.

    Each effect coordinate is scanned over its prior. At each point all other unknowns are refitted by linear least
    squares. This finds separate local minima: a stop that touches at one axle only, a mass in front instead of behind.
    """
    problem, hypothesis, p = problem.having(at.hypothesis), at.hypothesis, problem.shared
    low, high = hypothesis.bounds()
    precision, centre = problem.joint_prior()
    hessian, _, _ = _curvature(problem, at)
    rows = np.repeat(np.arange(p, at.x.size), _SWEPT)
    points = np.repeat(at.x[:, None], rows.size, axis=1)
    for i in range(len(hypothesis)):
        ends = np.clip(centre[p + i] + np.array([-_FAR, _FAR]), low[i], high[i])
        points[p + i, rows == p + i] = np.linspace(ends[0], ends[1], _SWEPT)
    residual, failed = problem.residuals(points)
    away = points - centre[:, None]
    slope = at.at.jacobian.T @ residual + precision @ away
    costs = np.einsum("rl,rl->l", residual, residual, optimize=False)
    costs += np.einsum("il,ij,jl->l", away, precision, away, optimize=False)
    for i in range(p, at.x.size):
        own = rows == i
        others = np.delete(np.arange(at.x.size), i)
        step = -linalg.cho_solve(
            linalg.cho_factor(hessian[np.ix_(others, others)]), slope[np.ix_(others, own)]
        )
        costs[own] += np.einsum("il,il->l", slope[np.ix_(others, own)], step, optimize=False)
        points[np.ix_(others, own)] += np.clip(step, -FIT_SETTINGS.largest_step, FIT_SETTINGS.largest_step)
    costs = np.where(failed | ~np.isfinite(costs), np.inf, costs)
    tried = problem.clipped(points[:, np.argsort(costs, kind="stable")[:_TRIED]])
    found = problem.costs(tried)
    best = int(np.argmin(found))
    return tried[:, best].copy() if found[best] < at.cost else None


class _Residuals:
    """The residuals of a problem for the solver.

    ``fixed_columns`` are Jacobian columns of vehicle and nuisance parameters that are reused in all iterations; with
    ``alternate_jacobian`` those of one iteration are reused in the next.
    """

    def __init__(self, problem: Problem, fixed_columns: Linearised | None, alternate_jacobian: bool) -> None:
        self.problem, self.fixed_columns, self.alternate_jacobian = problem, fixed_columns, alternate_jacobian
        self.at: Linearised | None = None
        self._last: Linearised | None = None

    def quadratic(self, x: Floats) -> Quadratic:
        """The quadratic model about ``x``."""
        held, self.at = self.fixed_columns or self._last, None
        if held is not None:
            self._last = None
            return held.with_effects(*self.problem.effect_columns(x))
        self.at = self.problem.linearise(x)
        self._last = self.at.first(self.problem.shared) if self.alternate_jacobian else None
        return self.at.model

    def sums_of_squares(self, x: Floats) -> Floats:
        """(L,) sums of squared residuals."""
        return self.problem.sums_of_squares(x)


def refit(
    problem: Problem,
    starts: Sequence[Floats],
    fixed_columns: Linearised | None,
    iterations: int,
    alternate_jacobian: bool = False,
) -> tuple[Floats, float]:
    """Bounded Gauss-Newton from the best of ``starts``: unknowns and -2 log posterior.

    ``fixed_columns`` are Jacobian columns of vehicle and nuisance parameters that are reused in all iterations; with
    ``alternate_jacobian`` those of one iteration are reused in the next.
    """
    solver, _ = _solved(problem, starts, fixed_columns, iterations, alternate_jacobian)
    return solver.x, solver.cost


def fitted(problem: Problem, starts: Sequence[Floats], iterations: int) -> LinearisedFit:
    """As ``refit``, with the linearisation at the result."""
    solver, residuals = _solved(problem, starts, None, iterations)
    there = residuals.at is not None and np.array_equal(residuals.at.x, solver.x)
    at = residuals.at if there else problem.linearise(solver.x)
    assert at is not None
    return LinearisedFit(problem.hypothesis, solver.x, solver.cost, at)


def approximated(problem: Problem, starts: Sequence[Floats], base: LinearisedFit) -> LinearisedFit:
    """The best of ``starts``, with the Jacobian columns of vehicle and nuisance parameters as they are at ``base``.

    For a hypothesis that is far from the best one: its linearisation costs two simulations instead of one for every
    unknown.
    """
    costs = problem.costs(np.stack(list(starts), axis=1))
    x = starts[int(np.argmin(costs))]
    residual, columns = problem.effect_columns(x)
    known = base.at.jacobian[:, : problem.shared]
    at = Linearised(x, residual, np.hstack([known, columns]))
    return LinearisedFit(problem.hypothesis, x, float(costs.min()), at)


def linearised_fit(problem: Problem, x: Floats) -> LinearisedFit:
    """The fit at ``x`` with its linearisation."""
    cost = float(problem.costs(x[:, None])[0])
    return LinearisedFit(problem.hypothesis, x, cost, problem.linearise(x))


def _solved(
    problem: Problem,
    starts: Sequence[Floats],
    fixed_columns: Linearised | None,
    iterations: int,
    alternate_jacobian: bool = False,
) -> tuple[GaussNewton, _Residuals]:
    residuals = _Residuals(problem, fixed_columns, alternate_jacobian)
    settings = replace(FIT_SETTINGS, iterations=iterations)
    prior, limits = problem.joint_prior(), problem.limits()
    solver = GaussNewton(residuals, starts[0], *prior, *limits, settings, finished=not iterations)
    solver.begin(np.stack(list(starts), axis=1))
    solver.run()
    return solver, residuals


def twin_of(problem: Problem, fit: Fit) -> Twin:
    """The twin with a fit's characteristics and effects, checked like any twin file."""
    space, given = problem.space, problem.twin
    values = space.from_slopes(fit.x[: problem.d])
    twin = given.with_changes({k: float(v) for k, v in zip(space.keys, values, strict=True)})
    specs = fit.hypothesis.spec(fit.effect_values) if fit.hypothesis.effects else ()
    return having_effects(twin.model_copy(update={"effects": given.effects, "road": given.road}), specs)
