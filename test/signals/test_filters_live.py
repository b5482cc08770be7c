# SPDX-License-Identifier: Apache-2.0
"""The low-pass of a signal that comes sample by sample: the block filter's answer, whatever the stamps do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from suspension_twin.errors import InputError
from suspension_twin.signals.filters import CausalLowPass, FilterSpec, LiveLowPass

T0 = 1.7e9
SPEC = FilterSpec(3, 12.0)


def lively(s: np.ndarray) -> np.ndarray:
    """A signal of several hertz that starts somewhere."""
    return 2.0 + np.sin(2.0 * np.pi * 1.7 * s + 0.5) + 0.5 * np.cos(2.0 * np.pi * 6.0 * s)


@pytest.mark.parametrize("rate", [50.0, 104.3, 800.0])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_it_is_the_block_filter(rate: float, order: int) -> None:
    """From the first sample on: it counts as having been there for ever. Once the rate has been measured, too."""
    s = np.arange(int(1.5 * rate)) / rate
    spec = FilterSpec(order, 12.0)
    x = lively(s)
    low_pass = LiveLowPass(spec)
    got = np.array([low_pass.push(T0 + t, v) for t, v in zip(s, x, strict=True)])
    expected = CausalLowPass(spec, rate, 1).process(x)
    assert got[:16] == pytest.approx(expected[:16], rel=1e-4)
    # what it has forgotten of the first guess at the rate
    late = int(0.5 * rate)
    assert got[-late:] == pytest.approx(expected[-late:], abs=1e-3)


@given(st.floats(-100, 100), st.lists(st.floats(1e-3, 0.4), min_size=1, max_size=40))
@settings(max_examples=25, deadline=None)
def test_a_constant_passes_whatever_the_stamps_do(level: float, steps: list[float]) -> None:
    low_pass, t = LiveLowPass(SPEC), T0
    assert low_pass.push(t, level) == level
    for step in steps:
        t += step
        assert low_pass.push(t, level) == pytest.approx(level, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_missing_samples_are_those_on_the_line_between(lost: int) -> None:
    s = np.arange(400) * 0.01
    x = lively(s)
    gone = np.arange(200, 200 + lost)
    line = x.copy()
    line[gone] = np.interp(s[gone], np.delete(s, gone), np.delete(x, gone))
    sparse, full = LiveLowPass(SPEC), LiveLowPass(SPEC)
    expected = [full.push(T0 + t, v) for t, v in zip(s, line, strict=True)]
    got = [sparse.push(T0 + s[k], x[k]) for k in range(400) if k not in gone]
    assert got == pytest.approx([expected[k] for k in range(400) if k not in gone], abs=1e-6)
    assert np.abs(np.array(expected) - CausalLowPass(SPEC, 100.0, 1).process(x)).max() > 1e-4


def test_after_a_pause_it_starts_where_the_signal_is() -> None:
    low_pass = LiveLowPass(SPEC)
    for k in range(100):
        low_pass.push(T0 + 0.01 * k, 1.0)
    assert low_pass.push(T0 + 3.0, 7.0) == pytest.approx(7.0)
    assert low_pass.push(T0 + 3.01, 7.0) == pytest.approx(7.0)
    step = [low_pass.push(T0 + 3.01 + 0.01 * k, 8.0) for k in range(1, 60)]
    fresh = CausalLowPass(SPEC, 100.0, 1)
    fresh.step([7.0])
    assert step == pytest.approx(fresh.process(np.full(59, 8.0)), abs=1e-5)


def test_late_and_repeated_stamps_give_the_last_answer_and_change_nothing() -> None:
    s = np.arange(200) * 0.01
    plain, pestered = LiveLowPass(SPEC), LiveLowPass(SPEC)
    for t, v in zip(s, lively(s), strict=True):
        expected = plain.push(T0 + t, v)
        assert pestered.push(T0 + t, v) == expected
        assert pestered.push(T0 + t, 99.0) == expected
        if t > 0.5:
            assert pestered.push(T0 + t - 0.3, -99.0) == expected


@pytest.mark.parametrize("how", ["set back", "reset"])
def test_it_starts_anew(how: str) -> None:
    s = np.arange(150) * 0.01
    low_pass, fresh = LiveLowPass(SPEC), LiveLowPass(SPEC)
    for k in range(500):
        low_pass.push(T0 + 0.005 * k, 5.0)
    if how == "reset":
        low_pass.reset()
    start = T0 - 50.0 if how == "set back" else T0 + 100.0
    x = lively(s)
    got = [low_pass.push(start + t, v) for t, v in zip(s, x, strict=True)]
    assert got[0] == x[0]
    assert got == [fresh.push(start + t, v) for t, v in zip(s, x, strict=True)]


@pytest.mark.parametrize(
    ("t", "value"), [(math.nan, 1.0), (T0 + 9.0, math.nan), (math.inf, 1.0), (T0, -math.inf)]
)
def test_what_is_not_finite_is_refused_and_leaves_it_as_it_was(t: float, value: float) -> None:
    low_pass, other = LiveLowPass(SPEC), LiveLowPass(SPEC)
    for k in range(50):
        assert low_pass.push(T0 + 0.01 * k, float(k)) == other.push(T0 + 0.01 * k, float(k))
    with pytest.raises(InputError, match="not a finite number"):
        low_pass.push(t, value)
    assert low_pass.push(T0 + 0.5, 3.0) == other.push(T0 + 0.5, 3.0)


def test_a_cutoff_that_the_rate_cannot_carry_is_lowered() -> None:
    s = np.arange(300) / 30.0
    x = np.sin(2.0 * np.pi * 2.0 * s)
    low_pass = LiveLowPass(FilterSpec(2, 20.0))
    got = [low_pass.push(T0 + t, v) for t, v in zip(s, x, strict=True)]
    assert got[100:] == pytest.approx(CausalLowPass(FilterSpec(2, 12.0), 30.0, 1).process(x)[100:], abs=1e-3)
    # one that it can just carry is not
    near = LiveLowPass(FilterSpec(2, 14.4))
    got = [near.push(T0 + t, v) for t, v in zip(s, x, strict=True)]
    assert got[100:] == pytest.approx(CausalLowPass(FilterSpec(2, 14.4), 30.0, 1).process(x)[100:], abs=1e-3)


def test_it_follows_a_sensor_that_is_switched_to_another_rate() -> None:
    """The cut-off stays what it is in hertz: a sine at it loses 3 dB before and after."""
    low_pass, spec = LiveLowPass(FilterSpec(2, 5.0)), FilterSpec(2, 5.0)
    slow, quick = np.arange(200) * 0.01, 2.0 + np.arange(4000) * 0.0025
    both = np.concatenate([slow, quick])
    got = np.array([low_pass.push(T0 + t, math.sin(2.0 * math.pi * 5.0 * t)) for t in both])
    for part in (slice(100, 200), slice(-1600, None)):
        assert math.sqrt(2.0) * np.std(got[part]) == pytest.approx(math.sqrt(0.5), rel=0.02)
    assert low_pass.spec == spec
