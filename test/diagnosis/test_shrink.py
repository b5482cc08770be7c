# SPDX-License-Identifier: Apache-2.0
"""The shrink of the gap and its interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from one_channel import CHANNEL, problem_over

from suspension_twin.diagnosis.shrink import BlockBootstrap, RemainingResidual, Shrink, relative_residual
from suspension_twin.inference.cross_validation import Blocks


def blocks_of(samples: int, drives: int, length: int) -> Blocks:
    """Blocks of ``length`` samples, the same in all drives."""
    return Blocks(np.tile(np.arange(samples) // length, drives), np.zeros(0, dtype=int), samples // length)


def shrink(
    there: Any, blocks: Blocks, before: np.ndarray, after: np.ndarray, noise: float = 0.0, **how: Any
) -> Shrink:
    draws = BlockBootstrap.of(there, blocks, {CHANNEL: noise}, how.pop("seed", 0))
    return draws.shrinks(draws.squares(before), draws.squares(after), **how)[0]


def test_another_drive_is_less_sure_where_drives_differ() -> None:
    rng = np.random.default_rng(1)
    n = 2000
    before = rng.standard_normal((2 * n, 1))
    after = before * np.repeat([0.2, 0.8], n)[:, None]
    there, blocks = problem_over([n, n], before), blocks_of(n, 2, 100)
    same = shrink(there, blocks, before, after)
    another = shrink(there, blocks, before, after, new_drive=True)
    expected = 1 - np.sqrt(np.mean(after**2) / np.mean(before**2))
    assert same.shrink == another.shrink == pytest.approx(expected)
    assert another.interval[0] < 0.25 and another.interval[1] > 0.75  # it may be like either
    assert same.interval[1] - same.interval[0] < 0.2


@pytest.mark.parametrize("drives", [1, 2, 4])
def test_the_interval_holds_for_one_more_drive(drives: int) -> None:
    """Drives of one car that differ by 15 % in what a twin leaves: nine in ten of further ones lie inside."""
    rng = np.random.default_rng(drives)
    n, held = 600, 0
    for seed in range(200):
        *there, further = 0.3 * np.exp(0.15 * rng.standard_normal(drives + 1))
        before = rng.standard_normal((drives * n, 1))
        after = np.repeat(there, n)[:, None] * rng.standard_normal((drives * n, 1))
        found = shrink(
            problem_over([n] * drives, before),
            blocks_of(n, drives, 20),
            before,
            after,
            seed=seed,
            new_drive=True,
        )
        held += found.interval[0] <= 1 - further <= found.interval[1]
    assert 0.84 <= held / 200 <= 0.99


def test_a_drive_whose_gap_is_gone_leaves_the_interval_finite() -> None:
    rng = np.random.default_rng(5)
    before = rng.standard_normal((2000, 1))
    after = before * np.repeat([0.3, 1e-9], 1000)[:, None]
    found = shrink(
        problem_over([1000, 1000], before), blocks_of(1000, 2, 50), before, after, 1e-3, new_drive=True
    )
    assert np.isfinite(found.interval).all() and found.interval[0] <= found.shrink <= found.interval[1] <= 1.0


def test_reference_drives_are_no_part_of_the_gap() -> None:
    x = np.random.default_rng(2).standard_normal((2000, 1))
    after = x * np.repeat([0.5, 3.0], 1000)[:, None]
    found = shrink(problem_over([1000, 1000], x, (True, False)), blocks_of(1000, 2, 50), x, after)
    assert found.shrink == pytest.approx(0.5)


def test_the_share_of_the_motion_with_nuisances_as_fitted_and_at_zero() -> None:
    x = np.random.default_rng(3).standard_normal((1000, 1))
    left, at = RemainingResidual(0.4 * x, 0.1 * x), problem_over([1000], x)
    for way, share in ((False, 0.4), (True, 0.1)):
        found = relative_residual(at, left, {CHANNEL: 1e-6}, [CHANNEL], True, way)
        assert found == pytest.approx(share, rel=1e-3)


def test_one_bump_holds_all_of_the_gap() -> None:
    """No draw leaves the one block out in which the gap is: elsewhere there is noise, of which nothing shrinks."""
    rng = np.random.default_rng(5)
    noise = 0.01 * rng.standard_normal((2, 1000, 1))
    before, after = noise
    before[300:400] += 1.0
    after[300:400] += 0.2
    found = shrink(problem_over([1000], before), blocks_of(1000, 1, 100), before, after, noise=0.01)
    assert found.shrink == pytest.approx(0.8, abs=0.01)
    assert found.interval[0] > 0.75
