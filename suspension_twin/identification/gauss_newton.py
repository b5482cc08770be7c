# SPDX-License-Identifier: Apache-2.0
"""The joint refit of characteristics, nuisances and effects.

A hypothesis is screened first: its effects are simulated all over their prior with the vehicle as
the baseline has it, and what the characteristics and nuisances can take back is taken back by linear
algebra. From the best of these, Gauss-Newton runs on everything jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench, Linearised
from suspension_twin.diagnosis.hypotheses import Hypothesis
from suspension_twin.identification.least_squares import gram, solve_positive

__all__ = [
    "Fit",
    "Linear",
    "Screening",
    "finished",
    "fitted",
    "refit",
    "room",
    "scanned",
    "screened",
    "swept",
    "within",
]

_LADDER = (0.0, 1e-2, 1e-1, 1.0, 10.0)
#: How many times more a step is held by the prior than by what is known already. What a drive hardly visits, the end
#: of a spring, has no curvature of its own and a wall behind it, which would hold back all that the drive does tell.
_BY_PRIOR = 1e4
_LARGEST_STEP = 2.0
_ENOUGH = 0.3  # of -2 log posterior: a step that gains less is the last
_ROUNDS = 12  # of holding coordinates at their limits and letting them go
#: Places of each coordinate of an effect, out to so many spreads of its prior, and how many of them are simulated anew.
_SWEPT, _FAR, _TRIED = 9, 2.5, 4


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
class Linear(Fit):
    """A fit with the linearisation ``at`` its place: tens of megabytes, so only while it is worked with."""

    at: Linearised


@dataclass(frozen=True, eq=False)
class Screening:
    """Linearised joint ``cost`` and unknowns ``x`` of starts, the best first, and the ``power`` (S,) of each in the
    order given: half the squared change of the whitened signals that characteristics and nuisances cannot imitate,
    in nats."""

    cost: list[float]
    x: list[Floats]
    power: Floats


def _curvature(bench: Bench, base: Linear) -> tuple[Floats, Floats, float]:
    """Of the posterior about ``base``: its curvature, the prior's gradient, and what the prior costs."""
    precision, centre = bench.prior(base.hypothesis)
    hessian = base.at.squares + precision
    away = base.x - centre
    pull = np.einsum("ij,j->i", precision, away, optimize=False)
    return hessian + 1e-10 * np.diag(np.diag(hessian)), pull, float(away @ precision @ away)


def within(hessian: Floats, gradient: Floats, low: Floats, high: Floats) -> Floats:
    """(p, S) steps that suit gradients (p, S) best and stay between ``low`` and ``high`` (p,), which hold nothing: a
    clock that may not be any later cannot make up for an effect by being so.

    By a primal-dual active set (Hintermüller, Ito, Kunisch 2003): what goes beyond its limit is held there, what is
    held and pulled back is let go, until neither happens.
    """
    steps = -solve_positive(hessian, gradient)
    for i in np.flatnonzero(((steps < low[:, None]) | (steps > high[:, None])).any(axis=0)):
        step = steps[:, i]
        below, above = step < low, step > high
        for _ in range(_ROUNDS):
            step = np.where(below, low, np.where(above, high, 0.0))
            free = np.flatnonzero(~(below | above))
            slope = gradient[free, i] + np.einsum("ij,j->i", hessian[free], step, optimize=False)
            step[free] = -solve_positive(hessian[np.ix_(free, free)], slope)
            pull = gradient[:, i] + np.einsum("ij,j->i", hessian, step, optimize=False)
            kept, lost = (below & (pull > 0)) | (step < low), (above & (pull < 0)) | (step > high)
            if (kept == below).all() and (lost == above).all():
                break
            below, above = kept, lost & ~kept
        steps[:, i] = np.clip(step, low, high)
    return steps


def room(bench: Bench, hypothesis: Hypothesis, x: Floats) -> tuple[Floats, Floats]:
    """(p,) how far each coordinate may go down and up."""
    low, high = bench.limits(hypothesis)
    return np.minimum(low - x, 0.0), np.maximum(high - x, 0.0)


def _stuck(bench: Bench, hypothesis: Hypothesis, x: Floats, gradient: Floats) -> NDArray[np.bool_]:
    """(p,) coordinates on a limit that want out: they stay there."""
    low, high = bench.limits(hypothesis)
    return np.asarray(((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0)))


def screened(bench: Bench, base: Linear, hypothesis: Hypothesis, starts: Floats) -> Screening:
    """Try every start (k, S) of a hypothesis' last effects with the vehicle of ``base``.

    ``base`` may be a hypothesis of fewer effects: its coordinates are the first of those of ``hypothesis``.
    """
    p = bench.d + bench.q
    kept = base.x.size - p
    u = np.concatenate([np.repeat(base.x[p:, None], starts.shape[1], axis=1), starts])
    x = np.concatenate([np.repeat(base.x[:p, None], u.shape[1], axis=1), u])
    residual, failed = bench.residuals(hypothesis, x)
    jacobian = base.at.jacobian
    hessian, pull, penalty = _curvature(bench, base)
    gradient = gram(jacobian, residual) + pull[:, None]
    step = within(hessian, gradient, *room(bench, base.hypothesis, base.x))
    costs = np.einsum("rl,rl->l", residual, residual, optimize=False) + penalty
    bent = gradient + 0.5 * np.einsum("ij,jl->il", hessian, step, optimize=False)
    costs = costs + 2.0 * np.einsum("il,il->l", bent, step, optimize=False)
    costs = costs + np.sum(starts**2, axis=0)
    costs = np.where(failed | ~np.isfinite(costs), np.inf, costs)
    change = residual - base.at.residual[:, None]
    seen = gram(jacobian, change)
    lost = np.einsum("il,il->l", seen, linalg.cho_solve(linalg.cho_factor(hessian), seen), optimize=False)
    power = 0.5 * (np.einsum("rl,rl->l", change, change, optimize=False) - lost)
    order = np.argsort(costs, kind="stable")
    unknowns = []
    for i in order:
        moved = x[:, i].copy()
        moved[: p + kept] += np.clip(step[:, i], -_LARGEST_STEP, _LARGEST_STEP)
        unknowns.append(moved)
    return Screening(costs[order].tolist(), unknowns, np.where(failed, 0.0, power))


def scanned(bench: Bench, base: Linear, hypothesis: Hypothesis, scan: tuple[int, Floats]) -> Floats | None:
    """Unknowns of the best point of a ``scan`` of the hypothesis' last effect: coordinates (k, S) all over where
    its resonance may lie, each with the strength, in the given row, that suits it best.

    A narrow resonance is missed by starts here and there; what it adds grows with its strength, so one simulation
    tells the best strength of either sign by linear algebra.
    """
    row, points = scan
    p, kept = bench.d + bench.q, base.x.size - bench.d - bench.q
    nothing = hypothesis.neutral()[kept + row]
    x = np.concatenate([np.repeat(base.x[:, None], points.shape[1], axis=1), points])
    residual, failed = bench.residuals(hypothesis, x)
    jacobian, rest = base.at.jacobian, base.at.residual
    hessian, pull, _ = _curvature(bench, base)
    gradient = base.at.slope + pull
    change = residual - rest[:, None]
    free = np.flatnonzero(~_stuck(bench, base.hypothesis, base.x, gradient))
    seen = gram(jacobian, change)[free]
    factor = linalg.cho_factor(hessian[np.ix_(free, free)])
    taken = linalg.cho_solve(factor, np.column_stack([seen, gradient[free]]))
    far = points[row] - nothing
    curve = np.einsum("rl,rl->l", change, change, optimize=False) + far**2
    curve -= np.einsum("il,il->l", seen, taken[:, :-1], optimize=False)
    slope = np.einsum("r,rl->l", rest, change, optimize=False) + nothing * far
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
    found[free] += np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
    return np.asarray(bench.clipped(hypothesis, found[:, None])[:, 0])


def swept(bench: Bench, at: Linear) -> Floats | None:
    """Unknowns that cost less than those of a fit, one coordinate of its effects anywhere else in its prior and the
    rest moved to what suits it best by linear algebra; None where there are none.

    A stop that touches at one axle alone, a mass in front instead of behind: such fits lie in valleys of their own,
    and no descent leads from one to the next.
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
    slope = gram(at.at.jacobian, residual) + np.einsum("ij,jl->il", precision, away, optimize=False)
    costs = np.einsum("rl,rl->l", residual, residual, optimize=False)
    costs += np.einsum("il,ij,jl->l", away, precision, away, optimize=False)
    for i in range(p, at.x.size):
        own = rows == i
        others = np.delete(np.arange(at.x.size), i)
        step = -linalg.cho_solve(
            linalg.cho_factor(hessian[np.ix_(others, others)]), slope[np.ix_(others, own)]
        )
        costs[own] += np.einsum("il,il->l", slope[np.ix_(others, own)], step, optimize=False)
        points[np.ix_(others, own)] += np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
    costs = np.where(failed | ~np.isfinite(costs), np.inf, costs)
    tried = bench.clipped(hypothesis, points[:, np.argsort(costs, kind="stable")[:_TRIED]])
    found = bench.costs(hypothesis, tried)
    best = int(np.argmin(found))
    return tried[:, best].copy() if found[best] < at.cost else None


def refit(
    bench: Bench,
    hypothesis: Hypothesis,
    starts: Sequence[Floats],
    known: Linearised | None,
    iterations: int,
    sparing: bool = False,
) -> tuple[Floats, float]:
    """Gauss-Newton from the best of ``starts``; ``known`` columns of the Jacobian, the vehicle's and the nuisances',
    are taken to hold. ``sparing``: those of one iteration are, for one more."""
    x, cost, _ = _descended(bench, hypothesis, starts, known, iterations, sparing)
    return x, cost


def fitted(bench: Bench, hypothesis: Hypothesis, starts: Sequence[Floats], iterations: int) -> Linear:
    """As ``refit``, with the linearisation where it comes to."""
    x, cost, at = _descended(bench, hypothesis, starts, None, iterations)
    return Linear(hypothesis, x, cost, at if at is not None else bench.linearise(hypothesis, x))


def _descended(
    bench: Bench,
    hypothesis: Hypothesis,
    starts: Sequence[Floats],
    known: Linearised | None,
    iterations: int,
    sparing: bool = False,
) -> tuple[Floats, float, Linearised | None]:
    """Unknowns, their cost, and the whole linearisation there if one was made."""
    candidates = bench.clipped(hypothesis, np.stack(list(starts), axis=1))
    costs = bench.costs(hypothesis, candidates)
    best = int(np.argmin(costs))
    x, cost = candidates[:, best], float(costs[best])
    precision, centre = bench.prior(hypothesis)
    damping, at, squares, slope, last = 1e-2, None, None, None, None
    for _ in range(iterations):
        if squares is None:
            held = known if known is not None else last
            if held is None:
                at = bench.linearise(hypothesis, x)
                squares, slope = at.squares, at.slope
                last = at.first(bench.d + bench.q) if sparing else None
            else:
                squares, slope = held.beyond(*bench.effects_alone(hypothesis, x))
                last = None
        hessian = squares + precision
        gradient = slope + np.einsum("ij,j->i", precision, x - centre, optimize=False)
        low, high = room(bench, hypothesis, x)
        trials = []
        for factor in _LADDER:
            more = damping * factor
            damped = hessian + more * np.diag(np.diag(hessian) + _BY_PRIOR * np.diag(precision))
            step = within(damped, gradient[:, None], low, high)[:, 0]
            # what no step can gain is not worth a simulation
            if factor == 0.0 and -2.0 * float(gradient @ step + 0.5 * step @ hessian @ step) < _ENOUGH:
                return x, cost, at
            step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-300))
            trials.append(x + step)
            if factor == 1.0:
                trials.append(x + 0.3 * step)
        tried = bench.clipped(hypothesis, np.stack(trials, axis=1))
        costs = bench.costs(hypothesis, tried)
        best = int(np.argmin(costs))
        gain = cost - float(costs[best])
        if gain <= 0:
            damping *= 100.0
            if damping > 1e4:
                break
            continue
        x, cost, at, squares = tried[:, best].copy(), float(costs[best]), None, None
        damping = max(damping * 0.3, 1e-4)
        if gain < _ENOUGH:
            break
    return x, cost, at


def finished(bench: Bench, hypothesis: Hypothesis, x: Floats) -> Linear:
    """The fit at ``x`` with its linearisation."""
    at = bench.linearise(hypothesis, x)
    cost = float(bench.costs(hypothesis, x[:, None])[0])
    return Linear(hypothesis, x, cost, at)
