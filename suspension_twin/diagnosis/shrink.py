# SPDX-License-Identifier: Apache-2.0
"""How far the gap shrinks, on stretches of road that the fit has not seen.

The twin with a hypothesis is fitted without each fold in turn and then simulated, not extrapolated,
over it. Clock, map and biases are left as the twin file has them: what is measured is what the written
twin will show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.evidence import FOLDS, Blocks
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis

__all__ = ["RemainingResidual", "Shrink", "remaining_residual", "shrink_of", "uncalibrated_residual"]

_DRAWS = 2000
#: Standard deviation of the logarithm of the share of a gap that a twin leaves, from one drive to another of the same
#: car on the same road, and how many drives this knowledge counts as.
_FROM_DRIVE_TO_DRIVE, _COUNTS_AS = 0.15, 4
_LEAST_SHARE_LEFT = 0.02


@dataclass(frozen=True, eq=False)
class RemainingResidual:
    """Held-out differences (M, C) between a twin and the drives, in the channels' units; ``settled`` with clocks, map,
    biases and mount where they were fitted, ``difference`` with all of them at nothing."""

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
    """What the twin as it stands leaves; nothing was fitted, so all of it counts as unseen."""
    z = bench.problem.space.z0[:, None]
    signals, _ = bench.signals(BASELINE, z, np.zeros((0, 1)))
    plain = bench.compared(signals, np.zeros((bench.q, 1)))[:, :, 0]
    difference = plain - bench.problem.measured.values
    return RemainingResidual(difference, difference)


def remaining_residual(
    bench: Bench, hypothesis: Hypothesis, unknowns: Floats, blocks: Blocks
) -> RemainingResidual:
    """Simulated at the unknowns (d + q + k, FOLDS) that have not seen each fold."""
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
    """(M,) True on samples of drives that show the gap."""
    return np.asarray(np.array(bench.active)[drives_of(bench)])


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
    """The shrink in one channel over the drives with the gap; interval by resampling blocks of road, with
    ``another`` for one more drive: what it leaves differs as these do among each other, or as drives do (Student's t
    of normal values with a scaled inverse chi-squared prior of their variance: Gelman et al., Bayesian Data Analysis,
    3rd ed., section 3.3). ``settled`` with the nuisances where they were fitted."""
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
    """(_DRAWS,) logarithms of how much more or less of the gap one more drive leaves than all of these (D,) do."""
    known = before > 1e-12
    # what lies in the noise is as good as gone, by how much is not known
    remaining = np.log(np.maximum(after[known] / before[known], _LEAST_SHARE_LEFT))
    apart = float(np.sum((remaining - remaining.mean()) ** 2)) if remaining.size else 0.0
    freedom = _COUNTS_AS + max(remaining.size - 1, 0)
    variance = (_COUNTS_AS * _FROM_DRIVE_TO_DRIVE**2 + apart) / freedom * (1.0 + 1.0 / max(remaining.size, 1))
    return np.asarray(np.sqrt(variance) * rng.standard_t(freedom, _DRAWS))
