# SPDX-License-Identifier: Apache-2.0
"""One path for measured and simulated: linear, lane by lane, honest about gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec, settling_time, zero_phase

T0 = 1.7e9
SPEC = FilterSpec()


def stamps(seed: int = 0, n: int = 800, jitter: float = 0.1, lost: int = 10) -> np.ndarray:
    """(n - lost,) 100 Hz with jitter, samples missing at random."""
    random = np.random.default_rng(seed)
    t = T0 + np.arange(n) * 0.01 + random.normal(0, jitter * 0.01, n)
    return np.delete(t, random.choice(np.arange(1, n - 1), lost, replace=False))


@given(st.integers(0, 1000), st.booleans())
@settings(max_examples=25, deadline=None)
def test_linear_and_the_same_for_every_shape(seed: int, both_ways: bool) -> None:
    t = stamps(seed)
    path = Conditioner.for_stamps(t, SPEC, zero_phase=both_ways)
    x = np.random.default_rng(seed).normal(size=(path.stamps.size, 3, 5))
    y = path.apply(x)
    assert y.shape == (path.grid.size, 3, 5)
    assert np.array_equal(path.apply(x[:, 1]), y[:, 1])
    assert np.array_equal(path.apply(x[:, 2, 4]), y[:, 2, 4])
    assert path.apply(2 * x[:, 0, 0] - x[:, 1, 1]) == pytest.approx(2 * y[:, 0, 0] - y[:, 1, 1], abs=1e-10)


def test_grid_is_even_at_the_measured_rate() -> None:
    path = Conditioner.for_stamps(stamps(), SPEC)
    assert path.rate == pytest.approx(100.0, rel=1e-3)
    assert np.diff(path.grid) == pytest.approx(1 / path.rate, abs=1e-6)
    assert path.grid[0] == path.stamps[0]
    assert path.stamps[-1] - 1 / path.rate < path.grid[-1] <= path.stamps[-1]


def test_jittered_samples_of_a_smooth_signal_come_out_as_the_filtered_signal() -> None:
    t = stamps(jitter=0.2, lost=0)
    path = Conditioner.for_stamps(t, SPEC)

    def motion(at: np.ndarray) -> np.ndarray:
        s = at - T0
        return (
            np.sin(2 * np.pi * 1.3 * s) + 0.5 * np.cos(2 * np.pi * 7.0 * s) + 0.2 * np.sin(2 * np.pi * 12 * s)
        )

    even = zero_phase(SPEC, path.rate, motion(path.grid))
    error = (path.apply(motion(path.stamps)) - even)[path.valid]
    assert np.std(error) < 0.005  # of a signal of 0.8 rms; by lines instead of cubics it is four times that
    assert np.abs(error).max() < 0.03


def test_order_repeats_and_nan_do_not_matter() -> None:
    t = stamps(lost=0)
    x = np.random.default_rng(5).normal(size=t.size)
    plain = Conditioner.for_stamps(t, SPEC)
    order = np.random.default_rng(6).permutation(40) + 300  # within 0.4 s
    mixed = np.concatenate([t[:300], t[order], t[340:], [np.nan, t[-1]]])
    values = np.concatenate([x[:300], x[order], x[340:], [9.9, 9.9]])
    path = Conditioner.for_stamps(mixed, SPEC)
    assert np.array_equal(path.stamps, plain.stamps)
    assert np.array_equal(path.apply(values[path.keep]), plain.apply(x))


@pytest.mark.parametrize("both_ways", [True, False])
def test_gaps_and_what_the_filter_remembers_of_them_are_invalid(both_ways: bool) -> None:
    whole = stamps(jitter=0.0, lost=0)
    t = whole[(whole < T0 + 3.0) | (whole > T0 + 3.5)]
    path = Conditioner.for_stamps(t, SPEC, zero_phase=both_ways)
    memory = settling_time(SPEC, path.rate)
    s = path.grid - T0
    assert not path.valid[(s > 3.0) & (s < 3.49 + memory)].any()
    assert path.valid[(s > 3.52 + memory) & (s < 7.8)].all()
    assert path.valid[(s > 3.0 - 0.8 * memory) & (s < 2.97)].any() != both_ways
    # Where it is valid it is as if nothing were missing, however wild the signal was in the gap.
    full = Conditioner.for_stamps(whole, SPEC, zero_phase=both_ways)
    x = np.sin(40.0 * (whole - T0))
    ends = min(path.grid.size, full.grid.size)
    error = path.apply(x[np.isin(whole, t)])[:ends] - full.apply(x)[:ends]
    assert np.abs(error[path.valid[:ends]]).max() < 0.02
    assert np.abs(error[~path.valid[:ends]]).max() > 0.5


def test_few_samples_and_mixed_clocks_are_refused() -> None:
    with pytest.raises(InputError, match="too few"):
        Conditioner.for_stamps([1.0, 2.0, 3.0], SPEC)
    with pytest.raises(InputError, match="mixed clocks"):
        Conditioner.for_stamps(np.concatenate([np.arange(50) * 0.01, [1e6]]), SPEC)
    with pytest.raises(InputError, match="lower the cut-off"):
        Conditioner.for_stamps(np.arange(100) / 30.0, SPEC)
    path = Conditioner.for_stamps(stamps(), SPEC)
    with pytest.raises(InputError, match="must have"):
        path.apply(np.zeros(5))
