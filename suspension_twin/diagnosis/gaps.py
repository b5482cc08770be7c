# SPDX-License-Identifier: Apache-2.0
"""How far the gap shrinks, on stretches of road that the fit has not seen.

The twin with a hypothesis is fitted without each fold in turn and then simulated, not extrapolated,
over it. Clock, map and biases are left as the twin file has them: what is measured is what the written
twin will show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis
from suspension_twin.diagnosis.judge import FOLDS, Blocks
from suspension_twin.drive.types import Floats

__all__ = ["Remainder", "Shrink", "remainder", "shrink_of", "standing"]

_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class Remainder:
    """Held-out differences (M, C) between a twin and the drives, in the channels' units."""

    difference: Floats


@dataclass(frozen=True)
class Shrink:
    """``before`` and ``after`` m/s² rms above the noise, ``shrink`` with its 90 % interval."""

    before: float
    after: float
    shrink: float
    interval: tuple[float, float]


def standing(bench: Bench) -> Remainder:
    """What the twin as it stands leaves; nothing was fitted, so all of it counts as unseen."""
    z = bench.problem.space.z0[:, None]
    signals, _ = bench.signals(BASELINE, z, np.zeros((0, 1)))
    plain = bench.compared(signals, np.zeros((bench.q, 1)))[:, :, 0]
    return Remainder(plain - bench.problem.measured.values)


def remainder(bench: Bench, hypothesis: Hypothesis, unknowns: Floats, blocks: Blocks) -> Remainder:
    """Simulated without nuisances at the unknowns (d + q + k, FOLDS) that have not seen each fold."""
    d, q = bench.d, bench.q
    signals, _ = bench.signals(hypothesis, unknowns[:d], unknowns[d + q :])
    full = [s if s.shape[2] == FOLDS else np.repeat(s, FOLDS, axis=2) for s in signals]
    compared = bench.compared(full, np.zeros((q, FOLDS)))
    chosen = np.take_along_axis(compared, blocks.fold(blocks.sample)[:, None, None], axis=2)[:, :, 0]
    return Remainder(chosen - bench.problem.measured.values)


def shown_rows(bench: Bench) -> np.ndarray:
    """(M,) True on samples of drives that show the gap."""
    measured = bench.problem.measured
    out = np.zeros(len(measured.values), dtype=bool)
    for s, drive in zip(measured.stretches, measured.drives, strict=True):
        out[s] = bench.active[drive]
    return out


def shrink_of(
    bench: Bench, before: Remainder, after: Remainder, blocks: Blocks, noise: float, column: int, seed: int
) -> Shrink:
    """The shrink in one channel over the drives with the gap; interval by resampling blocks of road."""
    rows = shown_rows(bench)
    block = blocks.sample[rows]
    count = np.bincount(block, minlength=blocks.count).astype(float)
    first = np.bincount(block, before.difference[rows, column] ** 2, blocks.count)
    second = np.bincount(block, after.difference[rows, column] ** 2, blocks.count)

    def above(squares: Floats, samples: Floats) -> Floats:
        return np.sqrt(np.maximum(squares / np.maximum(samples, 1.0) - noise**2, 0.0))

    a, b = above(first.sum(), count.sum()), above(second.sum(), count.sum())
    rng = np.random.default_rng(seed)
    used = np.flatnonzero(count)
    draws = rng.integers(0, used.size, (_DRAWS, used.size))
    n, f, s = (v[used][draws].sum(axis=1) for v in (count, first, second))
    before_drawn = above(f, n)
    ratio = 1.0 - above(s, n) / np.maximum(before_drawn, 1e-12)
    low, high = np.quantile(ratio, [0.05, 0.95])
    shrink = 1.0 - float(b) / float(a) if a > 1e-12 else 0.0
    return Shrink(float(a), float(b), shrink, (float(min(low, shrink)), float(max(high, shrink))))
