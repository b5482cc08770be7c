# SPDX-License-Identifier: Apache-2.0
"""Coarse alignment against a correlation that is summed up lag by lag."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.signals.coarse_alignment import coarse_lag

RATE = 50.0
Pairs = list[tuple[np.ndarray, np.ndarray]]


def correlations(pairs: Pairs, limit: int) -> np.ndarray:
    """(2 limit + 1,) mean over pairs, by their samples, of the normalised sums over what overlaps."""
    total = np.zeros(2 * limit + 1)
    for measured, simulated in pairs:
        a, b = measured - measured.mean(), simulated - simulated.mean()
        for k, lag in enumerate(range(-limit, limit + 1)):
            sums = sum(a[i] * b[i + lag] for i in range(a.size) if 0 <= i + lag < b.size)
            total[k] += a.size * sums / np.sqrt(np.sum(a * a) * np.sum(b * b))
    return total / sum(a.size for a, _ in pairs)


def pulse(at: float, size: int = 120, width: float = 4.0) -> np.ndarray:
    """A wavelet without a mean."""
    square = ((np.arange(size) - at) / width) ** 2
    return np.asarray((1.0 - square) * np.exp(-0.5 * square))


def some(size: int, seed: int) -> np.ndarray:
    return np.convolve(np.random.default_rng(seed).standard_normal(size), np.ones(5) / 5, mode="same") + 3.0


@settings(max_examples=30)
@given(st.integers(0, 1000), st.integers(1, 12))
def test_the_lag_is_that_of_the_largest_correlation(seed: int, limit: int) -> None:
    """Of several pairs a longer one counts for more; each signal may have any size and mean."""
    pairs = [(some(size, seed + i), 7.0 * some(size, seed // 2 + i)) for i, size in enumerate((40, 25))]
    wanted = correlations(pairs, limit)
    lag, there, here = coarse_lag(pairs, RATE, (limit + 0.5) / RATE)
    best = int(np.argmax(wanted))
    assert there == pytest.approx(wanted[best]) and here == pytest.approx(wanted[limit])
    # a parabola through the neighbours of the largest has its vertex within half a sample of it
    expected = float(best - limit)
    if 0 < best < wanted.size - 1:
        expected += np.roots(np.polyder(np.polyfit([-1, 0, 1], wanted[best - 1 : best + 2], 2)))[0]
    assert lag * RATE == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("late", [-7.3, -0.4, 0.0, 0.25, 3.5, 7.4])
def test_a_lag_between_samples_is_met(late: float) -> None:
    """Positive where the simulated signal comes later."""
    lag, there, here = coarse_lag([(pulse(60.0), 5.0 * pulse(60.0 + late))], RATE, 10.0 / RATE)
    assert lag == pytest.approx(late / RATE, abs=0.05 / RATE)
    assert there > 0.97 and (here < there) == (round(late) != 0)


@pytest.mark.parametrize("late", [-15.0, 15.0])
def test_a_lag_beyond_the_longest_is_told_as_the_longest(late: float) -> None:
    lag, there, _ = coarse_lag([(pulse(120.0, 240, 20.0), pulse(120.0 + late, 240, 20.0))], RATE, 10.0 / RATE)
    assert lag == np.sign(late) * 10.0 / RATE and there < 0.95


def test_what_is_too_short_or_still_says_nothing() -> None:
    """A pair has to be longer than the lags that are tried."""
    limit = 30
    nothing = (np.full(60, 2.0), pulse(30.0, 60))
    short, enough = ((pulse(15.0, size), pulse(18.0, size)) for size in (limit, limit + 1))
    long = (pulse(60.0), pulse(65.0))
    alone = coarse_lag([long], RATE, limit / RATE)
    assert coarse_lag([nothing, long, nothing[::-1], short], RATE, limit / RATE) == alone
    for pairs in ([], [nothing], [short], [nothing[::-1], short]):
        assert coarse_lag(pairs, RATE, limit / RATE) == (0.0, 0.0, 0.0)
    assert coarse_lag([enough], RATE, limit / RATE)[0] == pytest.approx(3.0 / RATE, abs=0.2 / RATE)


def test_signals_of_opposite_sign_do_not_fit() -> None:
    _, there, here = coarse_lag([(pulse(60.0), -pulse(60.0))], RATE, 5.0 / RATE)
    assert here == pytest.approx(-1.0) and there < 0.5
