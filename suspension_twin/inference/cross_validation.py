# SPDX-License-Identifier: Apache-2.0
"""Cross-validated evidence of hypotheses.

Blocks are segments of road, the same in all drives: model discrepancy repeats on every pass, so that the passes over
one segment are not independent. Without a road, blocks are segments of time. Every fifth block belongs to one fold,
and each fold is held out in turn. The score of a block b in channel c is its log predictive density

    score_b = -0.5 sum_c (n_bc log v_c + S_bc / v_c),

with the effective number of samples n, the held-out sum of squares S and the variance v of all blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.stats import norm

from suspension_twin.arrays import Floats
from suspension_twin.inference.checkpoint import stored
from suspension_twin.inference.fit import Fit, LinearisedFit
from suspension_twin.inference.gauss_newton import Quadratic, bounded_step
from suspension_twin.inference.problem import Problem, whitener_of

__all__ = [
    "Blocks",
    "Evidence",
    "NuisancePenalty",
    "blocks_of",
    "covariance_of",
    "evidence",
    "held_out",
    "intervals",
    "penalty_of",
]

#: Five-fold cross-validation (Hastie, Tibshirani and Friedman 2009, section 7.10).
FOLDS = 5
#: Factors on the prior precision of characteristics and nuisance parameters while a fold is held out; the one that fits
#: the other folds best is used. A parameter that only one fold excites (the end of a spring curve) is otherwise free in
#: the others, which costs every hypothesis thousands of nats at random.
_PRIOR_FACTORS = (1e2, 1e3, 1e4)
#: Nuisance parameters of timing, which a few sharp edges determine. In a fold without edges they would follow model
#: discrepancy, which penalises hypotheses with unbounded clocks.
_TIMES = ("clock_offset", "map_position")


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of cross-validation: ``sample`` (M,) that of every compared sample, ``row`` (R,) that of every whitened
    residual, ``count`` of them."""

    sample: np.ndarray
    row: np.ndarray
    count: int

    def fold(self, which: np.ndarray) -> np.ndarray:
        """The fold of each of these blocks."""
        return np.asarray(which % FOLDS)


def blocks_of(problem: Problem) -> Blocks:
    """The blocks of a problem: of road over all drives, of the distance of a run, of time without a road."""
    sample = problem.data.block
    return Blocks(sample, sample[whitener_of(problem).row], int(sample.max()) + 1)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Cross-validation of a fit: ``unknowns`` (d + q + k, FOLDS) fitted without each fold; ``residual`` (R,) held-out
    residuals; ``timed`` (R,) the same with timing as fitted to all folds; quadratic models ``by_group`` of rows."""

    unknowns: Floats
    residual: Floats
    timed: Floats
    by_group: list[Quadratic]


def held_out(
    problem: Problem,
    fit: LinearisedFit,
    blocks: Blocks,
    group: np.ndarray | None = None,
    linear: bool = False,
) -> HeldOut:
    """Cross-validate a fit; ``group`` (R,) of each row, one if not given.

    One Gauss-Newton step from the fit to all data removes a fold. The step is tried with several factors on the prior,
    and the one that fits the other folds best is used: by simulation, or by the linearisation alone (``linear``).
    """
    problem = problem.having(fit.hypothesis)
    precision, centre = problem.joint_prior()
    residual, fold = fit.at.residual, blocks.fold(blocks.row)
    group = np.zeros(fold.size, dtype=np.intp) if group is None else group
    groups = int(group.max()) + 1
    # every group and fold has its rows, however few
    parts = fit.at.grouped(fold * groups + group)
    parts += [Quadratic(0.0, np.zeros_like(precision), np.zeros_like(fit.x))] * (FOLDS * groups - len(parts))
    folds = [_summed(parts[f * groups : (f + 1) * groups]) for f in range(FOLDS)]
    by_group = [_summed(parts[g::groups]) for g in range(groups)]
    whole = _summed(folds)
    total, slope = whole.squares + precision, whole.slope + precision @ (fit.x - centre)
    # this step is unbounded: unknowns on a bound are held there
    low, high = problem.limits()
    inside = (fit.x > low) & (fit.x < high)
    known, p = np.zeros(fit.x.size, dtype=bool), problem.shared
    known[problem.d : p] = [n.endswith(_TIMES) for n in problem.nuisances.names]
    shared = np.where(np.arange(fit.x.size) < p, np.diag(precision), 0.0)
    candidates = [fit.x]
    for free in (np.flatnonzero(inside), np.flatnonzero(inside & ~known)):
        for f in range(FOLDS):
            rest, pull = (total - folds[f].squares)[np.ix_(free, free)], (slope - folds[f].slope)[free]
            for times in _PRIOR_FACTORS:
                held = rest + np.diag(1e-9 * np.diag(rest) + times * shared[free])
                step = np.zeros(fit.x.size)
                step[free] = -linalg.solve(held, pull, assume_a="sym")
                step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-300))
                candidates.append(fit.x + step)
    tried = problem.clipped(np.stack(candidates, axis=1))
    if linear:
        residuals = residual[:, None] + fit.at.jacobian @ (tried - fit.x[:, None])
        failed = np.zeros(tried.shape[1], dtype=bool)
    else:
        residuals, failed = problem.residuals(tried)
    away = tried - centre[:, None]
    penalty = np.einsum("il,ij,jl->l", away, precision, away, optimize=False)
    unknowns = np.repeat(fit.x[:, None], FOLDS, axis=1)
    held, timed = residual.copy(), residual.copy()
    rows = [fold == f for f in range(FOLDS)]
    squares = np.stack(
        [np.einsum("rl,rl->l", r, r, optimize=False) for r in (residuals[own] for own in rows)]
    )
    for f, own in enumerate(rows):
        costs = np.delete(squares, f, axis=0).sum(axis=0) + penalty
        costs = np.where(failed, np.inf, costs)
        for number, out in enumerate((held, timed)):
            first = 1 + (number * FOLDS + f) * len(_PRIOR_FACTORS)
            lanes = [*range(first, first + len(_PRIOR_FACTORS)), 0]
            best = lanes[int(np.argmin(costs[lanes]))]
            out[own] = residuals[own, best]
            if out is held:
                unknowns[:, f] = tried[:, best]
    return HeldOut(unknowns, held, timed, by_group)


def _summed(parts: Sequence[Quadratic]) -> Quadratic:
    return Quadratic(
        sum(p.value for p in parts),
        np.sum([p.squares for p in parts], axis=0),
        np.sum([p.slope for p in parts], axis=0),
    )


@stored
@dataclass(frozen=True, eq=False)
class NuisancePenalty:
    """The nuisance penalty: log prior probability of the nuisance parameters (clocks, map, mount) of a hypothesis.

    The remaining residual is mostly model discrepancy, which is correlated over samples: its likelihood is tempered by
    the share ``temper`` that is noise. The priors of the nuisance parameters are independent of it and not tempered.

    It holds the posterior about a fit: ``curvature`` (p, p) and ``slope`` (p,) of half its squares, ``precision``
    (p, p) of the prior, how far ``away`` (p,) its centre is, the ``nuisances`` among the p unknowns and the room that
    each has down and up.
    """

    curvature: Floats
    slope: Floats
    precision: Floats
    away: Floats
    nuisances: slice
    low: Floats
    high: Floats

    def at(self, temper: float) -> tuple[float, float]:
        """Nuisance penalty in nats at the minimum of the tempered cost, and the Occam term of all unknowns there."""
        own, given = self.nuisances, temper * self.precision
        given[own, own] = self.precision[own, own]
        hessian = temper * self.curvature + given
        gradient = temper * self.slope + given @ self.away
        step = bounded_step(hessian, gradient[:, None], self.low, self.high)[:, 0]
        # includes the change of the residuals
        changed = float(gradient @ step + 0.5 * step @ hessian @ step)
        spent = 0.5 * float(self.away[own] @ self.precision[own, own] @ self.away[own]) + changed
        full = temper * self.curvature + self.precision
        freedom = 0.5 * (np.linalg.slogdet(full)[1] - np.linalg.slogdet(self.precision)[1])
        return max(spent, 0.0), float(freedom)


def penalty_of(problem: Problem, fit: LinearisedFit, at: Quadratic) -> NuisancePenalty:
    """The nuisance penalty of a fit; ``at`` is its quadratic model in units of the remaining residual."""
    precision, centre = problem.joint_prior()
    low, high = problem.room(fit.x)
    pulled = precision @ (fit.x - centre)
    outward = ((low >= 0) & (at.slope + pulled > 0)) | ((high <= 0) & (at.slope + pulled < 0))
    # at the optimum the gradients of residuals and prior cancel, except on an active bound
    slope = np.where(outward, at.slope, -pulled)
    nuisances = slice(problem.d, problem.shared)
    return NuisancePenalty(at.squares, slope, precision, fit.x - centre, nuisances, low, high)


@stored
@dataclass(frozen=True, eq=False)
class Evidence:
    """The evidence of one hypothesis.

    ``score`` (B,): log predictive density of each held-out block, timing as fitted to all folds; ``occam``: Occam
    term in nats; ``level``: held-out mean square by channel and side (1 where the noise model holds); ``residual``
    (R,): held-out residuals; ``unknowns`` (d + q + k, FOLDS); ``fitted``: log density of all blocks in the fit to all
    of them; ``penalty``: the nuisance penalty.
    """

    fit: Fit
    score: Floats
    occam: float
    level: dict[tuple[int, bool], float]
    residual: Floats
    unknowns: Floats
    fitted: float
    penalty: NuisancePenalty | None = None

    def over(self, base: Evidence) -> float:
        """Gain of log evidence over ``base`` in nats."""
        return float(self.score.sum() - base.score.sum()) - 0.5 * (self.occam - base.occam)


def evidence(problem: Problem, fit: LinearisedFit, blocks: Blocks, linear: bool = False) -> Evidence:
    """The cross-validated evidence of a fit; ``linear`` as in :func:`held_out`."""
    problem = problem.having(fit.hypothesis)
    whitener, independent = whitener_of(problem), problem.measured.independent
    group = 2 * whitener.channel + ~np.array(problem.data.active)[whitener.drive]
    out = held_out(problem, fit, blocks, group, linear)
    score = np.zeros(blocks.count)
    level: dict[tuple[int, bool], float] = {}
    noise = np.ones(len(out.by_group))
    fitted = 0.0
    for number in np.unique(group).tolist():
        c, side, rows = number // 2, number % 2 == 0, group == number
        counts = independent * np.bincount(blocks.row[rows], minlength=blocks.count)
        level[c, side] = max(float(np.sum(out.residual[rows] ** 2) / counts.sum()), 1e-6)
        squares = np.bincount(blocks.row[rows], out.timed[rows] ** 2, blocks.count)
        noise[number] = max(float(squares.sum() / counts.sum()), 1e-6)
        fitted -= (
            0.5 * counts.sum() * np.log(max(float(np.mean(fit.at.residual[rows] ** 2)) / independent, 1e-6))
        )
        score -= 0.5 * (counts * np.log(noise[number]) + squares / noise[number])
    precision, centre = problem.joint_prior()
    scaled = _summed(
        [Quadratic(p.value / v, p.squares / v, p.slope / v) for p, v in zip(out.by_group, noise, strict=True)]
    )
    hessian = scaled.squares + precision
    away = fit.x - centre
    away[problem.d : problem.shared] = 0.0  # part of the nuisance penalty
    occam = 0.5 * (np.linalg.slogdet(hessian)[1] - np.linalg.slogdet(precision)[1])
    occam += 0.5 * float(away @ precision @ away) / max(float(np.mean(noise[group])), 1.0)
    plain = Fit(fit.hypothesis, fit.x, fit.cost)
    penalty = penalty_of(problem, fit, scaled)
    return Evidence(plain, score, float(occam), level, out.residual, out.unknowns, float(fitted), penalty)


def covariance_of(
    problem: Problem, fit: LinearisedFit, blocks: Blocks, temper: float, beside: Floats | None = None
) -> Floats:
    """(p, p) covariance of all unknowns of a fit.

    Clustered sandwich covariance over blocks (White 1982): H^-1 (sum_b g_b g_b^T + P) H^-1 with the gradient g_b of
    each block. Model discrepancy is correlated over blocks and does not average out: the covariance is divided by
    ``temper``, the share of the remaining residual that is noise. Changes (R, n) of the whitened residuals that stand
    ``beside`` the fit, each with a coordinate w ~ N(0, 1), are unknown as well.
    """
    precision, _ = problem.having(fit.hypothesis).joint_prior()
    p, model, jacobian = len(precision), fit.at.model, fit.at.jacobian
    if beside is not None:
        model = fit.at.with_effects(fit.at.residual, beside)
        jacobian = np.concatenate([jacobian, beside], axis=1)
        # what they are is known of other cars, not of this residual: the division below leaves their variance at 1
        precision = linalg.block_diag(precision, np.eye(beside.shape[1]) / temper)
    inverse: Floats = np.asarray(linalg.inv(model.squares + precision))
    pulls: Floats = np.stack(
        [np.bincount(blocks.row, column * fit.at.residual, blocks.count) for column in jacobian.T],
        axis=1,
    ).astype(np.float64)
    return np.asarray(inverse @ (pulls.T @ pulls + precision) @ inverse / temper)[:p, :p]


def intervals(problem: Problem, fit: LinearisedFit, blocks: Blocks, temper: float) -> Floats:
    """(k, 2) 90 % intervals of the effects' parameters, in their units and inside their bounds."""
    p = problem.shared
    variance = np.diag(covariance_of(problem, fit, blocks, temper))[p:]
    away = norm.ppf(0.95) * np.sqrt(np.maximum(variance, 0.0))
    low, high = fit.hypothesis.bounds()
    u = np.clip(fit.x[p:, None] + np.stack([-away, away], axis=1), low[:, None], high[:, None])
    return np.sort(fit.hypothesis.values(u), axis=1)
