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
    """Held-out differences (M, C) between a twin and the drives, in the channels' units; ``settled`` with clocks, map,
    biases and mount where they were fitted, ``difference`` with all of them at nothing."""

    difference: Floats
    settled: Floats


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
    difference = plain - bench.problem.measured.values
    return Remainder(difference, difference)


def remainder(bench: Bench, hypothesis: Hypothesis, unknowns: Floats, blocks: Blocks) -> Remainder:
    """Simulated at the unknowns (d + q + k, FOLDS) that have not seen each fold."""
    d, q = bench.d, bench.q
    signals, _ = bench.signals(hypothesis, unknowns[:d], unknowns[d + q :])
    full = [s if s.shape[2] == FOLDS else np.repeat(s, FOLDS, axis=2) for s in signals]
    fold = blocks.fold(blocks.sample)[:, None, None]

    def left(nuisance: Floats) -> Floats:
        compared = bench.compared(full, nuisance)
        chosen = np.take_along_axis(compared, fold, axis=2)[:, :, 0]
        return np.asarray(chosen - bench.problem.measured.values)

    return Remainder(left(np.zeros((q, FOLDS))), left(unknowns[d : d + q]))


def drives_of(bench: Bench) -> np.ndarray:
    """(M,) the drive of every compared sample."""
    measured = bench.problem.measured
    out = np.zeros(len(measured.values), dtype=int)
    for s, drive in zip(measured.stretches, measured.drives, strict=True):
        out[s] = drive
    return out


def shown_rows(bench: Bench) -> np.ndarray:
    """(M,) True on samples of drives that show the gap."""
    return np.asarray(np.array(bench.active)[drives_of(bench)])


def shrink_of(
    bench: Bench, before: Remainder, after: Remainder, blocks: Blocks, noise: float, column: int, seed: int,
    another: bool = False, settled: bool = False,
) -> Shrink:  # fmt: skip
    """The shrink in one channel over the drives with the gap; interval by resampling blocks of road, with
    ``another`` the drives too: what one more drive at some other speed would show. ``settled`` with the nuisances
    where they were fitted."""
    rows = shown_rows(bench)
    shown = [i for i, active in enumerate(bench.active) if active]
    drive = np.searchsorted(shown, drives_of(bench)[rows]) if another else np.zeros(int(rows.sum()), dtype=int)
    drives = len(shown) if another else 1
    cell = drive * blocks.count + blocks.sample[rows]

    def by_cell(values: Floats | None = None) -> Floats:
        return np.bincount(cell, values, drives * blocks.count).reshape(drives, blocks.count).astype(float)

    count, first, second = by_cell(), *(
        by_cell((r.settled if settled else r.difference)[rows, column] ** 2) for r in (before, after)
    )

    def above(squares: Floats, samples: Floats) -> Floats:
        return np.sqrt(np.maximum(squares / np.maximum(samples, 1.0) - noise**2, 0.0))

    a, b = above(first.sum(), count.sum()), above(second.sum(), count.sum())
    rng = np.random.default_rng(seed)
    used = np.flatnonzero(count.any(axis=0))
    blocks_drawn = rng.multinomial(used.size, np.full(used.size, 1.0 / used.size), _DRAWS).astype(float)
    drives_drawn = rng.multinomial(drives, np.full(drives, 1.0 / drives), _DRAWS).astype(float)
    n, f, s = (
        np.sum(np.einsum("kd,db->kb", drives_drawn, v[:, used], optimize=False) * blocks_drawn, axis=1)
        for v in (count, first, second)
    )
    ratio = 1.0 - above(s, n) / np.maximum(above(f, n), 1e-12)
    low, high = np.quantile(ratio, [0.05, 0.95])
    shrink = 1.0 - float(b) / float(a) if a > 1e-12 else 0.0
    return Shrink(float(a), float(b), shrink, (float(min(low, shrink)), float(max(high, shrink))))
