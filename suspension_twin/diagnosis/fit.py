# SPDX-License-Identifier: Apache-2.0
"""The joint fit of characteristics, nuisance parameters and effects.

A hypothesis is screened first: its effects are simulated at points over their prior with the baseline vehicle, and one
linear least squares step refits characteristics and nuisance parameters. From the best points, bounded Gauss-Newton
(``identification.gauss_newton``) fits all unknowns jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench, Linearised
from suspension_twin.diagnosis.hypotheses import Hypothesis
from suspension_twin.diagnosis.partial import kept
from suspension_twin.inference.gauss_newton import (
    WHITENED,
    GaussNewton,
    Quadratic,
    bounded_step,
)
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
    "room",
    "screen",
    "twin_of",
]

FIT_SETTINGS = WHITENED
#: Iterations at most of a first fit, of one from a start of its own, and of a joint one; a fit ends by itself before.
ROUGH, DEEP, LONG = 4, 6, 15
#: Scan of an effect coordinate: points, range in standard deviations of its prior, and points simulated after refit.
_SWEPT, _FAR, _TRIED = 9, 2.5, 4


@kept
@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at its best: unknowns ``x`` (d + q + k,), ``cost`` -2 log posterior."""

    hypothesis: Hypothesis
    x: Floats
    cost: float

    def effects(self, bench: Bench) -> Floats:
        """(k,) values of the effects' parameters."""
        return self.hypothesis.values(self.x[bench.d + bench.q :, None])[:, 0]


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


def _curvature(bench: Bench, base: LinearisedFit) -> tuple[Floats, Floats, float]:
    """Curvature of the posterior about ``base``, half gradient of the prior, and cost of the prior."""
    precision, centre = bench.prior(base.hypothesis)
    hessian = base.at.model.squares + precision
    away = base.x - centre
    pull = np.einsum("ij,j->i", precision, away, optimize=False)
    return hessian + 1e-10 * np.diag(np.diag(hessian)), pull, float(away @ precision @ away)


def room(bench: Bench, hypothesis: Hypothesis, x: Floats) -> tuple[Floats, Floats]:
    """(p,) how far each coordinate may go down and up."""
    low, high = bench.limits(hypothesis)
    return np.minimum(low - x, 0.0), np.maximum(high - x, 0.0)


def _at_active_bound(bench: Bench, hypothesis: Hypothesis, x: Floats, gradient: Floats) -> NDArray[np.bool_]:
    """(p,) True for coordinates on a bound whose gradient points outwards."""
    low, high = bench.limits(hypothesis)
    return np.asarray(((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0)))


def screen(bench: Bench, base: LinearisedFit, hypothesis: Hypothesis, starts: Floats) -> Screening:
    """Evaluate every start (k, S) of the last effects of a hypothesis with the vehicle of ``base``.

    ``base`` may be a hypothesis of fewer effects: its coordinates are the first of those of ``hypothesis``.
    """
    p = bench.d + bench.q
    kept = base.x.size - p
    u = np.concatenate([np.repeat(base.x[p:, None], starts.shape[1], axis=1), starts])
    x = np.concatenate([np.repeat(base.x[:p, None], u.shape[1], axis=1), u])
    residual, failed = bench.residuals(hypothesis, x)
    jacobian = base.at.jacobian
    hessian, pull, penalty = _curvature(bench, base)
    gradient = jacobian.T @ residual + pull[:, None]
    step = bounded_step(hessian, gradient, *room(bench, base.hypothesis, base.x))
    costs = np.einsum("rl,rl->l", residual, residual, optimize=False) + penalty
    bent = gradient + 0.5 * np.einsum("ij,jl->il", hessian, step, optimize=False)
    costs = costs + 2.0 * np.einsum("il,il->l", bent, step, optimize=False)
    costs = costs + np.sum(starts**2, axis=0)
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


def resonance_scan(
    bench: Bench, base: LinearisedFit, hypothesis: Hypothesis, scan: tuple[int, Floats]
) -> Floats | None:
    """Unknowns of the best point of a ``scan`` (row of the strength, coordinates (k, S)) over resonance frequencies.

    Scattered starts miss a narrow resonance. Its response is linear in its strength, so that one simulation per
    frequency gives the best strength, of either sign, by linear least squares.
    """
    row, points = scan
    p, kept = bench.d + bench.q, base.x.size - bench.d - bench.q
    nothing = hypothesis.neutral()[kept + row]
    x = np.concatenate([np.repeat(base.x[:, None], points.shape[1], axis=1), points])
    residual, failed = bench.residuals(hypothesis, x)
    jacobian, base_residual = base.at.jacobian, base.at.residual
    hessian, pull, _ = _curvature(bench, base)
    gradient = base.at.model.slope + pull
    change = residual - base_residual[:, None]
    free = np.flatnonzero(~_at_active_bound(bench, base.hypothesis, base.x, gradient))
    seen = (jacobian.T @ change)[free]
    factor = linalg.cho_factor(hessian[np.ix_(free, free)])
    taken = linalg.cho_solve(factor, np.column_stack([seen, gradient[free]]))
    far = points[row] - nothing
    curve = np.einsum("rl,rl->l", change, change, optimize=False) + far**2
    curve -= np.einsum("il,il->l", seen, taken[:, :-1], optimize=False)
    slope = np.einsum("r,rl->l", base_residual, change, optimize=False) + nothing * far
    slope -= np.einsum("il,i->l", seen, taken[:, -1], optimize=False)
    low, high = (b[kept + row] for b in hypothesis.bounds())
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.clip(nothing - far * slope / curve, low, high)
        share = (strength - nothing) / far
        gain = -(2.0 * slope * share + curve * share**2) - np.sum(np.delete(points, row, axis=0) ** 2, axis=0)
    gain = np.where(failed | ~np.isfinite(gain), -np.inf, gain)
    best = int(np.argmax(gain))
    if not np.isfinite(gain[best]):
        return None
    found: Floats = x[:, best].copy()
    found[p + kept + row] = strength[best]
    step = -(taken[:, -1] + share[best] * taken[:, best])
    found[free] += np.clip(step, -FIT_SETTINGS.largest_step, FIT_SETTINGS.largest_step)
    return np.asarray(bench.clipped(hypothesis, found[:, None])[:, 0])


def coordinate_scan(bench: Bench, at: LinearisedFit) -> Floats | None:
    """Unknowns of lower cost than a fit, found by scanning each effect coordinate over its prior; None if there are
    none.

    At each point all other unknowns are refitted by linear least squares. This finds separate local minima: a stop that
    touches at one axle only, a mass in front instead of behind.
    """
    hypothesis, p = at.hypothesis, bench.d + bench.q
    low, high = hypothesis.bounds()
    precision, centre = bench.prior(hypothesis)
    hessian, _, _ = _curvature(bench, at)
    rows = np.repeat(np.arange(p, at.x.size), _SWEPT)
    points = np.repeat(at.x[:, None], rows.size, axis=1)
    for i in range(len(hypothesis)):
        points[p + i, rows == p + i] = np.linspace(max(-_FAR, low[i]), min(_FAR, high[i]), _SWEPT)
    residual, failed = bench.residuals(hypothesis, points)
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
    tried = bench.clipped(hypothesis, points[:, np.argsort(costs, kind="stable")[:_TRIED]])
    found = bench.costs(hypothesis, tried)
    best = int(np.argmin(found))
    return tried[:, best].copy() if found[best] < at.cost else None


class _HypothesisResiduals:
    """The residuals of a hypothesis for the solver.

    ``fixed_columns`` are Jacobian columns of characteristics and nuisance parameters that are reused in all iterations;
    with ``alternate_jacobian`` those of one iteration are reused in the next.
    """

    def __init__(
        self, bench: Bench, hypothesis: Hypothesis, fixed_columns: Linearised | None, alternate_jacobian: bool
    ) -> None:
        self.bench, self.hypothesis, self.fixed_columns, self.alternate_jacobian = (
            bench,
            hypothesis,
            fixed_columns,
            alternate_jacobian,
        )
        self.at: Linearised | None = None
        self._last: Linearised | None = None

    def quadratic(self, x: Floats) -> Quadratic:
        held, self.at = self.fixed_columns or self._last, None
        if held is not None:
            self._last = None
            return held.with_effects(*self.bench.effect_columns(self.hypothesis, x))
        self.at = self.bench.linearise(self.hypothesis, x)
        self._last = self.at.first(self.bench.d + self.bench.q) if self.alternate_jacobian else None
        return self.at.model

    def sums_of_squares(self, x: Floats) -> Floats:
        residual, failed = self.bench.residuals(self.hypothesis, x)
        sums = np.einsum("rl,rl->l", residual, residual)
        return np.where(failed | ~np.isfinite(sums), np.inf, sums)


def refit(
    bench: Bench,
    hypothesis: Hypothesis,
    starts: Sequence[Floats],
    fixed_columns: Linearised | None,
    iterations: int,
    alternate_jacobian: bool = False,
) -> tuple[Floats, float]:
    """Bounded Gauss-Newton from the best of ``starts``: unknowns and -2 log posterior; ``fixed_columns`` and
    ``alternate_jacobian`` as in :class:`_HypothesisResiduals`."""
    solver, _ = _solved(bench, hypothesis, starts, fixed_columns, iterations, alternate_jacobian)
    return solver.x, solver.cost


def fitted(bench: Bench, hypothesis: Hypothesis, starts: Sequence[Floats], iterations: int) -> LinearisedFit:
    """As ``refit``, with the linearisation at the result."""
    solver, problem = _solved(bench, hypothesis, starts, None, iterations)
    there = problem.at is not None and np.array_equal(problem.at.x, solver.x)
    at = problem.at if there else bench.linearise(hypothesis, solver.x)
    assert at is not None
    return LinearisedFit(hypothesis, solver.x, solver.cost, at)


def approximated(
    bench: Bench, hypothesis: Hypothesis, starts: Sequence[Floats], base: LinearisedFit
) -> LinearisedFit:
    """The best of ``starts``, with the Jacobian columns of vehicle and nuisance parameters as they are at ``base``.

    For a hypothesis that is far from the best one: its linearisation costs two simulations instead of one for every
    unknown.
    """
    costs = bench.costs(hypothesis, np.stack(list(starts), axis=1))
    x = starts[int(np.argmin(costs))]
    residual, columns = bench.effect_columns(hypothesis, x)
    known = base.at.jacobian[:, : bench.d + bench.q]
    return LinearisedFit(
        hypothesis, x, float(costs.min()), Linearised(x, residual, np.hstack([known, columns]))
    )


def _solved(
    bench: Bench,
    hypothesis: Hypothesis,
    starts: Sequence[Floats],
    fixed_columns: Linearised | None,
    iterations: int,
    alternate_jacobian: bool = False,
) -> tuple[GaussNewton, _HypothesisResiduals]:
    problem = _HypothesisResiduals(bench, hypothesis, fixed_columns, alternate_jacobian)
    settings = replace(FIT_SETTINGS, iterations=iterations)
    solver = GaussNewton(
        problem,
        starts[0],
        *bench.prior(hypothesis),
        *bench.limits(hypothesis),
        settings,
        finished=not iterations,
    )
    solver.begin(np.stack(list(starts), axis=1))
    solver.run()
    return solver, problem


def twin_of(bench: Bench, fit: Fit) -> Twin:
    """The twin with a fit's characteristics and effects, checked like any twin file."""
    values = bench.problem.space.from_slopes(fit.x[: bench.d])
    changes = {k: float(v) for k, v in zip(bench.problem.space.keys, values, strict=True)}
    twin = bench.problem.twin.with_changes(changes)
    specs = fit.hypothesis.spec(fit.effects(bench)) if fit.hypothesis.effects else ()
    return twin.model_copy(
        update={"effects": (*bench.problem.twin.effects, *specs), "road": bench.problem.twin.road}
    )


def linearised_fit(bench: Bench, hypothesis: Hypothesis, x: Floats) -> LinearisedFit:
    """The fit at ``x`` with its linearisation."""
    at = bench.linearise(hypothesis, x)
    cost = float(bench.costs(hypothesis, x[:, None])[0])
    return LinearisedFit(hypothesis, x, cost, at)
