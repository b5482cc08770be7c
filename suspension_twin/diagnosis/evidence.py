# SPDX-License-Identifier: Apache-2.0
"""Evidence on stretches that a fit has not seen, and the probabilities that follow.

Blocks are pieces of road, the same in all drives, so that a model's own error, which comes again on
every pass, is not counted as confirming itself; without a road they are pieces of time. Every fifth
block is held back in turn. Each hypothesis predicts the held-back blocks with the noise level it left
elsewhere; how sure a difference is comes from weighing the blocks anew many times (pseudo-BMA with the
Bayesian bootstrap: Yao, Vehtari, Simpson, Gelman 2018, section 3.4), so correlated blocks temper themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.special import logsumexp
from scipy.stats import norm

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.fit import Fit, LinearisedFit
from suspension_twin.diagnosis.nuisance_penalty import NuisancePenalty, penalty_gains, penalty_of
from suspension_twin.identification.gauss_newton import Quadratic

__all__ = ["Blocks", "Evidence", "blocks_of", "evidence", "held_out", "intervals", "weights"]

FOLDS = 5
#: How many times more the prior holds vehicle and nuisances while a fold is held back: what suits the others best.
#: What one fold alone tells of them, the end of a spring that is visited there, all hypotheses would lose with it, by
#: thousands of nats and as chance has it: held by a tenth of its spread it is none's to win.
_PRIOR_FACTORS = (1e2, 1e3, 1e4)
_DRAWS = 4000
#: How many times what it gains in the fit an effect may gain where it is held out: a vehicle without it, which has made
#: up for it elsewhere, is the worse there.
_LARGEST_HELD_OUT_GAIN = 2.0
_METRES, _METRES_OF_A_RUN, _SECONDS = 8.0, 0.5, 4.0
#: Nuisances that say when: a few sharp edges tell them. Without these they go wherever the model's own error takes
#: them, and that would speak against those hypotheses whose clocks no limit holds.
_TIMES = ("clock_offset", "map_position")


@dataclass(frozen=True, eq=False)
class Blocks:
    """``sample`` (M,) the block of every compared sample, ``row`` (R,) that of every whitened residual."""

    sample: np.ndarray
    row: np.ndarray
    count: int

    def fold(self, which: np.ndarray) -> np.ndarray:
        """The fold of each of these blocks."""
        return np.asarray(which % FOLDS)


def blocks_of(bench: Bench, kind: str) -> Blocks:
    """Blocks of road over all drives, of a run over its obstacle, or, of ``planar`` motion, of time."""
    problem = bench.problem
    keys = []
    for part, rows, drive in zip(problem.parts, problem.rows, problem.drive_of, strict=True):
        if kind != "planar":
            length = _METRES if kind == "road" else _METRES_OF_A_RUN
            keys.append(np.floor(part.position[rows] / length).astype(int))
        else:
            keys.append(np.floor((part.t[rows] - part.t[0]) / _SECONDS).astype(int) + 100_000 * drive)
    _, sample = np.unique(np.concatenate(keys), return_inverse=True)
    return Blocks(sample, sample[bench.whitener.row], int(sample.max()) + 1)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Unknowns (d + q + k, FOLDS) without each fold and the residuals ``left`` (R,) that they leave in it; ``timed``
    (R,) those where clocks and map stay as the whole recording has them; the fit ``by_group`` of rows."""

    unknowns: Floats
    remaining: Floats
    timed: Floats
    by_group: list[Quadratic]


def held_out(bench: Bench, fit: LinearisedFit, blocks: Blocks, group: np.ndarray | None = None) -> HeldOut:
    """A fit on stretches that it has not seen; ``group`` (R,) of each row, one if not given.

    A Gauss-Newton step from the fit to all undoes what a fold pulled on it; of those that the prior holds more or less
    the one that suits the other folds best is taken, simulated.
    """
    precision, centre = bench.prior(fit.hypothesis)
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
    # a severity on its bound, usually at nothing, stays there: the step knows no bounds
    low, high = bench.limits(fit.hypothesis)
    inside = (fit.x > low) & (fit.x < high)
    known, p = np.zeros(fit.x.size, dtype=bool), bench.d + bench.q
    known[bench.d : p] = [n.endswith(_TIMES) for n in bench.problem.nuisances.names]
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
    tried = bench.clipped(fit.hypothesis, np.stack(candidates, axis=1))
    residuals, failed = bench.residuals(fit.hypothesis, tried)
    away = tried - centre[:, None]
    penalty = np.einsum("il,ij,jl->l", away, precision, away, optimize=False)
    unknowns = np.repeat(fit.x[:, None], FOLDS, axis=1)
    remaining, timed = residual.copy(), residual.copy()
    rows = [fold == f for f in range(FOLDS)]
    squares = np.stack(
        [np.einsum("rl,rl->l", r, r, optimize=False) for r in (residuals[own] for own in rows)]
    )
    for f, own in enumerate(rows):
        costs = np.delete(squares, f, axis=0).sum(axis=0) + penalty
        costs = np.where(failed, np.inf, costs)
        for number, out in enumerate((remaining, timed)):
            first = 1 + (number * FOLDS + f) * len(_PRIOR_FACTORS)
            lanes = [*range(first, first + len(_PRIOR_FACTORS)), 0]
            best = lanes[int(np.argmin(costs[lanes]))]
            out[own] = residuals[own, best]
            if out is remaining:
                unknowns[:, f] = tried[:, best]
    return HeldOut(unknowns, remaining, timed, by_group)


def _summed(parts: Sequence[Quadratic]) -> Quadratic:
    return Quadratic(
        sum(p.value for p in parts),
        np.sum([p.squares for p in parts], axis=0),
        np.sum([p.slope for p in parts], axis=0),
    )


@dataclass(frozen=True, eq=False)
class Evidence:
    """One hypothesis: ``score`` (B,) log predictive density of each block, clocks and map as the whole recording has
    them, ``occam`` nats that its freedom costs, ``level`` (groups,) mean square of what it leaves (1 where the noise
    model holds), ``left`` (R,) held-out residuals, ``unknowns`` (d + q + k, FOLDS), ``fitted`` log density of all
    blocks where all are fitted, ``penalty`` what it asks of the nuisances."""

    fit: Fit
    score: Floats
    occam: float
    level: dict[tuple[int, bool], float]
    remaining: Floats
    unknowns: Floats
    fitted: float
    penalty: NuisancePenalty | None = None

    def over(self, base: Evidence) -> float:
        """Nats that the hypothesis gains over ``base``."""
        return float(self.score.sum() - base.score.sum()) - 0.5 * (self.occam - base.occam)


def evidence(bench: Bench, fit: LinearisedFit, blocks: Blocks) -> Evidence:
    """Held-out evidence of a fit."""
    whitener, independent = bench.whitener, bench.problem.measured.independent
    group = 2 * whitener.channel + ~np.array(bench.active)[whitener.drive]
    out = held_out(bench, fit, blocks, group)
    score = np.zeros(blocks.count)
    level: dict[tuple[int, bool], float] = {}
    noise = np.ones(len(out.by_group))
    fitted = 0.0
    for number in np.unique(group).tolist():
        c, side, rows = number // 2, number % 2 == 0, group == number
        counts = independent * np.bincount(blocks.row[rows], minlength=blocks.count)
        level[c, side] = max(float(np.sum(out.remaining[rows] ** 2) / counts.sum()), 1e-6)
        squares = np.bincount(blocks.row[rows], out.timed[rows] ** 2, blocks.count)
        noise[number] = max(float(squares.sum() / counts.sum()), 1e-6)
        fitted -= (
            0.5 * counts.sum() * np.log(max(float(np.mean(fit.at.residual[rows] ** 2)) / independent, 1e-6))
        )
        score -= 0.5 * (counts * np.log(noise[number]) + squares / noise[number])
    precision, centre = bench.prior(fit.hypothesis)
    scaled = _summed(
        [Quadratic(p.value / v, p.squares / v, p.slope / v) for p, v in zip(out.by_group, noise, strict=True)]
    )
    hessian = scaled.squares + precision
    away = fit.x - centre
    away[bench.d : bench.d + bench.q] = 0.0  # counted in full elsewhere
    occam = 0.5 * (np.linalg.slogdet(hessian)[1] - np.linalg.slogdet(precision)[1])
    occam += 0.5 * float(away @ precision @ away) / max(float(np.mean(noise[group])), 1.0)
    plain = Fit(fit.hypothesis, fit.x, fit.cost)
    penalty = penalty_of(bench, fit, scaled)
    return Evidence(plain, score, float(occam), level, out.remaining, out.unknowns, float(fitted), penalty)


def intervals(bench: Bench, fit: LinearisedFit, blocks: Blocks, temper: float) -> Floats:
    """(k, 2) 90 % intervals of the effects' parameters, in their units and inside their bounds.

    How much a fit would move with other stretches is told by what each block pulls it: residuals that
    belong together count once (sandwich covariance: White 1982, by clusters). But a model's own error pulls every
    block the same way, and more road does not average it out: as for the evidence, of what is left only the share
    ``temper`` that is noise counts as many pieces.
    """
    precision, _ = bench.prior(fit.hypothesis)
    jacobian, p = fit.at.jacobian, bench.d + bench.q
    inverse: Floats = np.asarray(linalg.inv(fit.at.model.squares + precision))
    pulls: Floats = np.stack(
        [np.bincount(blocks.row, column * fit.at.residual, blocks.count) for column in jacobian.T], axis=1
    ).astype(np.float64)
    covariance = inverse @ (pulls.T @ pulls + precision) @ inverse
    away = norm.ppf(0.95) * np.sqrt(np.maximum(np.diag(covariance)[p:], 0.0) / temper)
    low, high = fit.hypothesis.bounds()
    u = np.clip(fit.x[p:, None] + np.stack([-away, away], axis=1), low[:, None], high[:, None])
    return np.sort(fit.hypothesis.values(u), axis=1)


def weights(found: list[Evidence], prior: Floats, temper: float, seed: int) -> tuple[Floats, Floats]:
    """(K,) probabilities of the hypotheses, and (K, K) how often one beats another.

    Half of the freedom's cost counts: held-out scores have paid for it once already, in what freedom
    spoils on unseen road, and the evidence of the whole prior would have it in full. ``temper`` is the
    share of what is left that is noise: a model's own error is no new evidence at every sample. What is normal of
    clocks, map and mount is no such evidence and counts in full. The first of ``found`` is part of all others: what
    these gain on unseen road beyond twice of what they gain in the fit is chance.
    """
    scores = np.stack([e.score for e in found])
    gains = scores.sum(axis=1) - scores[0].sum()
    most = _LARGEST_HELD_OUT_GAIN * np.array([max(e.fitted - found[0].fitted, 0.0) for e in found])
    share = np.where(gains > most, most / np.maximum(gains, 1e-12), 1.0)
    scores = scores[0] + share[:, None] * (scores - scores[0])
    occam = np.array([e.occam for e in found])
    count = scores.shape[1]
    draws = np.random.default_rng(seed).dirichlet(np.ones(count), _DRAWS) * count
    total = np.einsum("db,kb->dk", draws, scores, optimize=False) - 0.5 * (occam - occam.min())[None, :]
    with np.errstate(divide="ignore"):  # a prior of nothing
        total = temper * total + penalty_gains([e.penalty for e in found], temper) + np.log(prior)
    probabilities = np.exp(total - logsumexp(total, axis=1)[:, None]).mean(axis=0)
    win_rate = (total[:, :, None] > total[:, None, :]).mean(axis=0)
    return probabilities, win_rate
