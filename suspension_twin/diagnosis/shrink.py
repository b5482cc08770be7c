# SPDX-License-Identifier: Apache-2.0
"""The shrink of the gap on held-out road.

The twin with a hypothesis is fitted without each fold in turn and simulated over that fold. With clock, map and biases
of the twin file, the shrink is that of the written twin:

    shrink = 1 - after / before,   of the rms above the noise, sqrt(max(mean(r^2) - sigma^2, 0)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.inference.cross_validation import FOLDS, Blocks
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.problem import Problem

__all__ = [
    "DRAWS",
    "BlockBootstrap",
    "RemainingResidual",
    "Shrink",
    "relative_residual",
    "remaining_residual",
    "uncalibrated_residual",
]

DRAWS = 2000  # of a bootstrap: the ends of a 90 % interval to half a per cent
#: Prior of the standard deviation of log(after / before) from drive to drive of one car on one road, and its degrees of
#: freedom.
_FROM_DRIVE_TO_DRIVE, _COUNTS_AS = 0.15, 4
_LEAST_SHARE_LEFT = 0.02  # of after / before, below which the residual is noise


@dataclass(frozen=True, eq=False)
class RemainingResidual:
    """Held-out simulated minus measured signals (M, C) in the units of the channels: ``difference`` with all nuisance
    parameters at zero, ``with_nuisances`` with clocks, map, biases and mount as fitted."""

    difference: Floats
    with_nuisances: Floats


@dataclass(frozen=True)
class Shrink:
    """``before`` and ``after`` m/s² rms above the noise, ``shrink`` with its 90 % interval."""

    before: float
    after: float
    shrink: float
    interval: tuple[float, float]


def uncalibrated_residual(problem: Problem) -> RemainingResidual:
    """The residual of the twin as given; nothing was fitted, so that all of it is held out."""
    x = np.concatenate([problem.space.z0, np.zeros(problem.q)])
    plain = problem.readings(x)
    difference = plain - problem.measured.values
    return RemainingResidual(difference, difference)


def remaining_residual(
    problem: Problem, hypothesis: Hypothesis, unknowns: Floats, blocks: Blocks
) -> RemainingResidual:
    """The residual at the unknowns (d + q + k, FOLDS) fitted without each fold."""
    signals, _ = problem.having(hypothesis).signals(unknowns)
    full = [s if s.shape[2] == FOLDS else np.repeat(s, FOLDS, axis=2) for s in signals]
    fold = blocks.fold(blocks.sample)[:, None, None]

    def remaining(nuisance: Floats) -> Floats:
        compared = problem.likelihood.compared(full, nuisance)
        chosen = np.take_along_axis(compared, fold, axis=2)[:, :, 0]
        return np.asarray(chosen - problem.measured.values)

    return RemainingResidual(
        remaining(np.zeros((problem.q, FOLDS))), remaining(unknowns[problem.d : problem.shared])
    )


def drives_of(problem: Problem) -> np.ndarray:
    """(M,) the drive of every compared sample."""
    measured = problem.measured
    out = np.zeros(len(measured.values), dtype=int)
    for s, drive in zip(measured.segments, measured.drives, strict=True):
        out[s] = drive
    return out


def gap_rows(problem: Problem) -> np.ndarray:
    """(M,) True for samples of drives with the gap."""
    return np.asarray(np.array(problem.data.active)[drives_of(problem)])


def relative_residual(
    problem: Problem,
    remaining: RemainingResidual,
    noise: dict[str, float],
    driven: Sequence[str],
    with_gap: bool,
    with_nuisances: bool = False,
) -> float:
    """Rms of the residual above the noise as a share of that of the motion, over the ``driven`` channels, on drives
    ``with_gap`` or on the others; ``with_nuisances`` as fitted or at zero."""
    rows, rest_of = (
        gap_rows(problem) == with_gap,
        remaining.with_nuisances if with_nuisances else remaining.difference,
    )
    measured = problem.measured
    columns = [(c, noise[name] ** 2) for c, name in enumerate(measured.channels) if name in driven]
    floors = np.array([floor for _, floor in columns])
    excess = np.array([max(float(np.var(rest_of[rows, c])) - floor, 0.0) for c, floor in columns])
    motion = np.array([max(float(np.var(measured.values[rows, c])) - floor, 1e-12) for c, floor in columns])
    # channels are weighted by their signal to noise ratio
    weight = motion / floors
    return float(np.sqrt(np.sum(weight * (excess / motion)) / weight.sum()))


@dataclass(frozen=True, eq=False)
class BlockBootstrap:
    """Shrinks of the gap in every channel over the drives with the gap, with 90 % intervals by bootstrap over blocks.

    ``cell`` (m,) block of every sample with the gap, drive after drive; ``count`` (D, B) samples by drive and block;
    ``drawn`` (N, U) how often each draw takes the ``used`` (U,) blocks.
    """

    rows: np.ndarray
    cell: np.ndarray
    count: Floats
    used: np.ndarray
    drawn: Floats
    noise: Floats
    seed: int

    @classmethod
    def of(cls, problem: Problem, blocks: Blocks, noise: dict[str, float], seed: int) -> BlockBootstrap:
        """For the blocks of a problem; ``noise`` rms by channel."""
        rows = gap_rows(problem)
        with_gap = [i for i, active in enumerate(problem.data.active) if active]
        cell = np.searchsorted(with_gap, drives_of(problem)[rows]) * blocks.count + blocks.sample[rows]
        count = (
            np.bincount(cell, minlength=len(with_gap) * blocks.count).reshape(len(with_gap), -1).astype(float)
        )
        used = np.flatnonzero(count.any(axis=0))
        drawn = used.size * np.random.default_rng(seed).dirichlet(np.ones(used.size), DRAWS)
        floor = np.array([noise[c] for c in problem.channels])
        return cls(rows, cell, count, used, drawn, floor, seed)

    def squares(self, residual: Floats) -> Floats:
        """(D, B, C) sums of squares of a residual (M, C) by drive, block and channel."""
        own = residual[self.rows] ** 2
        sums = [np.bincount(self.cell, own[:, c], self.count.size) for c in range(own.shape[1])]
        return np.stack(sums, axis=1).reshape(*self.count.shape, own.shape[1]).astype(np.float64)

    def shrinks(self, before: Floats, after: Floats, new_drive: bool = False) -> list[Shrink]:
        """The shrink in each channel between two sums of squares (D, B, C).

        With ``new_drive`` the interval is predictive for one more drive: the scatter between drives is added, by
        Student's t with a scaled inverse chi-squared prior of the variance (Gelman et al., Bayesian Data Analysis,
        3rd ed., section 3.3).
        """
        a, b = (self._above(v.sum(axis=(0, 1)), self.count.sum()) for v in (before, after))
        samples = self.drawn @ self.count[:, self.used].sum(axis=0)
        first, second = (self.drawn @ v[:, self.used].sum(axis=0) for v in (before, after))
        share = self._above(second, samples[:, None]) / np.maximum(
            self._above(first, samples[:, None]), 1e-12
        )
        if new_drive:
            rng, each = np.random.default_rng(self.seed + 1), self.count.sum(axis=1)[:, None]
            by_drive = [self._above(v.sum(axis=1), each) for v in (before, after)]
            for c in range(share.shape[1]):
                share[:, c] *= np.exp(_new_drive_scatter(by_drive[0][:, c], by_drive[1][:, c], rng))
        ends = np.quantile(1.0 - share, [0.05, 0.95], axis=0)
        shrink = np.where(a > 1e-12, 1.0 - b / np.maximum(a, 1e-12), 0.0)
        low, high = np.minimum(ends[0], shrink), np.maximum(ends[1], shrink)
        return [
            Shrink(float(a[c]), float(b[c]), float(shrink[c]), (float(low[c]), float(high[c])))
            for c in range(a.size)
        ]

    def _above(self, squares: Floats, samples: Floats | float) -> Floats:
        """Rms above the noise of sums of squares (..., C)."""
        mean = squares / np.maximum(samples, 1.0)
        return np.asarray(np.sqrt(np.maximum(mean - self.noise**2, 0.0)))


def _new_drive_scatter(before: Floats, after: Floats, rng: np.random.Generator) -> Floats:
    """(DRAWS,) draws of log(after / before) of one more drive, about that of these drives (D,)."""
    known = before > 1e-12
    # below the noise the ratio is undetermined
    remaining = np.log(np.maximum(after[known] / before[known], _LEAST_SHARE_LEFT))
    apart = float(np.sum((remaining - remaining.mean()) ** 2)) if remaining.size else 0.0
    freedom = _COUNTS_AS + max(remaining.size - 1, 0)
    variance = (_COUNTS_AS * _FROM_DRIVE_TO_DRIVE**2 + apart) / freedom * (1.0 + 1.0 / max(remaining.size, 1))
    return np.asarray(np.sqrt(variance) * rng.standard_t(freedom, DRAWS))
