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
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.evidence import FOLDS, Blocks
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis

__all__ = [
    "RemainingResidual",
    "Shrink",
    "relative_residual",
    "remaining_residual",
    "shrink_of",
    "uncalibrated_residual",
]

_DRAWS = 2000
#: Prior of the standard deviation of log(after / before) from drive to drive of one car on one road, and its degrees of
#: freedom; lower limit of after / before, below which the residual is noise.
_FROM_DRIVE_TO_DRIVE, _COUNTS_AS = 0.15, 4
_LEAST_SHARE_LEFT = 0.02


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


def uncalibrated_residual(bench: Bench) -> RemainingResidual:
    """The residual of the twin as given; nothing was fitted, so that all of it is held out."""
    z = bench.problem.space.z0[:, None]
    signals, _ = bench.signals(BASELINE, z, np.zeros((0, 1)))
    plain = bench.compared(signals, np.zeros((bench.q, 1)))[:, :, 0]
    difference = plain - bench.problem.measured.values
    return RemainingResidual(difference, difference)


def remaining_residual(
    bench: Bench, hypothesis: Hypothesis, unknowns: Floats, blocks: Blocks
) -> RemainingResidual:
    """The residual at the unknowns (d + q + k, FOLDS) fitted without each fold."""
    d, q = bench.d, bench.q
    signals, _ = bench.signals(hypothesis, unknowns[:d], unknowns[d + q :])
    full = [s if s.shape[2] == FOLDS else np.repeat(s, FOLDS, axis=2) for s in signals]
    fold = blocks.fold(blocks.sample)[:, None, None]

    def remaining(nuisance: Floats) -> Floats:
        compared = bench.compared(full, nuisance)
        chosen = np.take_along_axis(compared, fold, axis=2)[:, :, 0]
        return np.asarray(chosen - bench.problem.measured.values)

    return RemainingResidual(remaining(np.zeros((q, FOLDS))), remaining(unknowns[d : d + q]))


def drives_of(bench: Bench) -> np.ndarray:
    """(M,) the drive of every compared sample."""
    measured = bench.problem.measured
    out = np.zeros(len(measured.values), dtype=int)
    for s, drive in zip(measured.segments, measured.drives, strict=True):
        out[s] = drive
    return out


def gap_rows(bench: Bench) -> np.ndarray:
    """(M,) True for samples of drives with the gap."""
    return np.asarray(np.array(bench.active)[drives_of(bench)])


def relative_residual(
    bench: Bench,
    remaining: RemainingResidual,
    noise: dict[str, float],
    driven: Sequence[str],
    with_gap: bool,
    with_nuisances: bool = False,
) -> float:
    """Rms of the residual above the noise as a share of that of the motion, over the ``driven`` channels, on drives
    ``with_gap`` or on the others; ``with_nuisances`` as fitted or at zero."""
    rows, rest_of = (
        gap_rows(bench) == with_gap,
        remaining.with_nuisances if with_nuisances else remaining.difference,
    )
    measured = bench.problem.measured
    columns = [(c, noise[name] ** 2) for c, name in enumerate(measured.channels) if name in driven]
    floors = np.array([floor for _, floor in columns])
    excess = np.array([max(float(np.var(rest_of[rows, c])) - floor, 0.0) for c, floor in columns])
    motion = np.array([max(float(np.var(measured.values[rows, c])) - floor, 1e-12) for c, floor in columns])
    # channels are weighted by their signal to noise ratio
    weight = motion / floors
    return float(np.sqrt(np.sum(weight * (excess / motion)) / weight.sum()))


def shrink_of(
    bench: Bench,
    before: RemainingResidual,
    after: RemainingResidual,
    blocks: Blocks,
    noise: float,
    column: int,
    seed: int,
    new_drive: bool = False,
    with_nuisances: bool = False,
) -> Shrink:
    """The shrink in one channel over the drives with the gap, with a 90 % interval by bootstrap over blocks of road.

    With ``new_drive`` the interval is predictive for one more drive: the scatter between drives is added, by
    Student's t with a scaled inverse chi-squared prior of the variance (Gelman et al., Bayesian Data Analysis, 3rd
    ed., section 3.3). ``with_nuisances`` as fitted or at zero.
    """
    rows = gap_rows(bench)
    with_gap = [i for i, active in enumerate(bench.active) if active]
    drive = (
        np.searchsorted(with_gap, drives_of(bench)[rows])
        if new_drive
        else np.zeros(int(rows.sum()), dtype=int)
    )
    drives = len(with_gap) if new_drive else 1
    cell = drive * blocks.count + blocks.sample[rows]

    def by_cell(values: Floats | None = None) -> Floats:
        return np.bincount(cell, values, drives * blocks.count).reshape(drives, blocks.count).astype(float)

    count, first, second = (
        by_cell(),
        *(
            by_cell((r.with_nuisances if with_nuisances else r.difference)[rows, column] ** 2)
            for r in (before, after)
        ),
    )

    def above(squares: Floats, samples: Floats) -> Floats:
        return np.sqrt(np.maximum(squares / np.maximum(samples, 1.0) - noise**2, 0.0))

    a, b = above(first.sum(), count.sum()), above(second.sum(), count.sum())
    rng = np.random.default_rng(seed)
    used = np.flatnonzero(count.any(axis=0))
    blocks_drawn = rng.multinomial(used.size, np.full(used.size, 1.0 / used.size), _DRAWS).astype(float)
    n, f, s = (np.sum(v[:, used].sum(axis=0) * blocks_drawn, axis=1) for v in (count, first, second))
    share = above(s, n) / np.maximum(above(f, n), 1e-12)
    if new_drive:
        before_after = [above(v.sum(axis=1), count.sum(axis=1)) for v in (first, second)]
        share *= np.exp(_new_drive_scatter(before_after[0], before_after[1], rng))
    ratio = 1.0 - share
    low, high = np.quantile(ratio, [0.05, 0.95])
    shrink = 1.0 - float(b) / float(a) if a > 1e-12 else 0.0
    return Shrink(float(a), float(b), shrink, (float(min(low, shrink)), float(max(high, shrink))))


def _new_drive_scatter(before: Floats, after: Floats, rng: np.random.Generator) -> Floats:
    """(_DRAWS,) draws of log(after / before) of one more drive, about that of these drives (D,)."""
    known = before > 1e-12
    # below the noise the ratio is undetermined
    remaining = np.log(np.maximum(after[known] / before[known], _LEAST_SHARE_LEFT))
    apart = float(np.sum((remaining - remaining.mean()) ** 2)) if remaining.size else 0.0
    freedom = _COUNTS_AS + max(remaining.size - 1, 0)
    variance = (_COUNTS_AS * _FROM_DRIVE_TO_DRIVE**2 + apart) / freedom * (1.0 + 1.0 / max(remaining.size, 1))
    return np.asarray(np.sqrt(variance) * rng.standard_t(freedom, _DRAWS))
