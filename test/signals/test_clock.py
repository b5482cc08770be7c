# SPDX-License-Identifier: Apache-2.0
"""Stamps out of order, repeated, rounded, missing, set back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.signals.clock import LiveClock, Stamp, clean_stamps, find_gaps, nominal_rate

T0 = 1.7e9


@given(st.lists(st.integers(0, 90), min_size=1, max_size=60), st.data())
@settings(max_examples=200, deadline=None)
def test_what_is_kept_rises_and_comes_from_the_input(ticks: list[int], data: st.DataObject) -> None:
    t = T0 + 0.01 * np.array(ticks)  # within 0.9 s: disorder, never a loop
    bad = data.draw(st.lists(st.integers(0, len(ticks) - 1), max_size=5, unique=True))
    t[bad] = math.nan
    cleaned = clean_stamps(t)
    assert np.all(np.diff(cleaned.stamps) > 0)
    assert np.array_equal(cleaned.stamps, t[cleaned.keep])
    assert set(cleaned.stamps) == set(t[np.isfinite(t)])
    assert cleaned.invalid == len(bad)
    assert cleaned.other_loops == 0
    assert cleaned.keep.size + cleaned.invalid + cleaned.duplicates == t.size


def test_of_a_looped_recording_the_longest_loop_is_kept() -> None:
    one = T0 + np.arange(500) / 100
    t = np.concatenate([one[300:], one, one[:100]])
    cleaned = clean_stamps(t)
    assert np.array_equal(cleaned.keep, np.arange(200, 700))
    assert cleaned.other_loops == 300


def test_one_stray_stamp_is_no_loop() -> None:
    t = T0 + np.arange(300) / 100
    t[150] = t[0] - 100.0
    cleaned = clean_stamps(t)
    assert cleaned.stamps.size == 300
    assert cleaned.reordered == 1


@pytest.mark.parametrize("rate", [50.0, 104.36, 400.0])
@pytest.mark.parametrize("rounding", [None, 3])
def test_rate_through_jitter_rounding_and_gaps(rate: float, rounding: int | None) -> None:
    random = np.random.default_rng(4)
    t = np.arange(4000) / rate
    t = t + random.uniform(-0.2, 0.2, t.size) / rate
    t = np.delete(t, random.choice(t.size, 100, replace=False))
    t = t[(t < 5) | (t > 6)]
    if rounding:
        t = np.unique(np.round(t, rounding))
    assert nominal_rate(t) == pytest.approx(rate, rel=2e-2)
    if rate < 300:
        assert len(find_gaps(t, rate)) == 1
        assert find_gaps(t, rate)[0] == pytest.approx([5.0, 6.0], abs=0.05)


def test_a_rate_needs_two_stamps() -> None:
    with pytest.raises(InputError, match="fewer than two"):
        nominal_rate(np.array([1.0]))


def test_live_judgement() -> None:
    clock = LiveClock(warmup=10)
    assert clock.classify(T0) is Stamp.FIRST
    for k in range(1, 11):
        assert clock.rate is None
        assert clock.classify(T0 + 0.01 * k) is Stamp.NEXT
    assert clock.rate == pytest.approx(100.0, rel=1e-4)
    assert clock.classify(T0 + 0.10) is Stamp.DUPLICATE
    assert clock.classify(T0 + 0.055) is Stamp.LATE
    assert clock.classify(math.nan) is Stamp.INVALID
    assert clock.classify(T0 + 0.12) is Stamp.NEXT  # one is missing
    assert clock.classify(T0 + 0.50) is Stamp.GAP
    assert clock.classify(T0 + 0.51) is Stamp.NEXT
    assert clock.classify(T0 - 2.0) is Stamp.JUMP_BACK
    assert clock.last == pytest.approx(T0 + 0.51)


def test_live_rate_follows_a_slow_drift_and_a_switch() -> None:
    clock, t = LiveClock(), T0
    for k in range(3000):
        t += 0.01 * (1 + 0.05 * k / 3000)
        clock.classify(t)
    assert clock.rate == pytest.approx(100 / 1.05, rel=0.02)
    for _ in range(200):
        t += 0.0025
        clock.classify(t)
    assert clock.rate == pytest.approx(400.0, rel=0.01)
