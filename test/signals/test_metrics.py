# SPDX-License-Identifier: Apache-2.0
"""Measures of agreement against closed forms, numpy and the published implementation of ISO/TS 18571."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from suspension_twin.errors import InputError
from suspension_twin.signals.metrics import (
    correlation,
    iso18571,
    mean_squared_error,
    rms_error,
    spectral_distance,
)

VALUES = arrays(np.float64, 30, elements=st.floats(-100, 100))
T = np.arange(1000) / 100


@given(VALUES, VALUES)
@settings(max_examples=100, deadline=None)
def test_distances_are_one_thing_in_two_units(m: np.ndarray, s: np.ndarray) -> None:
    squares = math.fsum((a - b) ** 2 for a, b in zip(m, s, strict=True))
    assert float(mean_squared_error(m, s)) == pytest.approx(squares / 30)
    assert float(rms_error(m, s)) == pytest.approx(math.sqrt(squares / 30))
    assert rms_error(m, m) == 0.0


@given(VALUES, VALUES, st.floats(0.1, 10), st.floats(-10, 10))
@settings(max_examples=100, deadline=None)
def test_correlation(m: np.ndarray, s: np.ndarray, scale: float, shift: float) -> None:
    rho = float(correlation(m, s))
    assert -1.0 - 1e-9 <= rho <= 1.0 + 1e-9
    if np.std(m) > 1e-3 and np.std(s) > 1e-3:
        assert rho == pytest.approx(np.corrcoef(m, s)[0, 1], abs=1e-6)
        assert float(correlation(m, scale * s + shift)) == pytest.approx(rho, abs=1e-6)
        assert float(correlation(m, -s)) == pytest.approx(-rho, abs=1e-12)


def test_a_constant_correlates_with_nothing() -> None:
    assert correlation(np.ones(10), np.arange(10.0)) == 0.0


def test_lanes_are_what_they_are_alone() -> None:
    random = np.random.default_rng(0)
    m = random.normal(size=400).cumsum()
    lanes = m[:, None] + random.normal(size=(400, 4))
    for measure in (
        mean_squared_error,
        rms_error,
        correlation,
        lambda a, b: spectral_distance(a, b, 100.0),
        lambda a, b: iso18571(a, b, 100.0).overall,
    ):
        together = measure(m, lanes)
        assert together.shape == (4,)
        assert together == pytest.approx([float(measure(m, lanes[:, k])) for k in range(4)], rel=1e-9)


def test_spectral_distance_is_blind_to_time_and_counts_decibels() -> None:
    random = np.random.default_rng(1)
    m = random.normal(size=6000)
    assert float(spectral_distance(m, 2 * m, 100.0)) == pytest.approx(20 * math.log10(2), rel=1e-6)
    assert float(spectral_distance(m, m, 100.0)) == 0.0
    other = random.normal(size=6000)
    assert float(spectral_distance(m, other, 100.0)) < 2.0
    assert abs(float(correlation(m, other))) < 0.05
    with pytest.raises(InputError, match="no frequency"):
        spectral_distance(m, m, 100.0, low=60.0, high=70.0)


@pytest.fixture(scope="module")
def published() -> Any:
    """The published implementation, uncompiled: compiling it takes longer than all else here."""
    before, numba.config.DISABLE_JIT = numba.config.DISABLE_JIT, True
    try:
        from objective_rating_metrics.rating import ISO18571
    finally:
        numba.config.DISABLE_JIT = before
    return ISO18571


@pytest.mark.parametrize("n", [12, 50, 301])
@pytest.mark.parametrize("seed", range(4))
def test_iso_18571_against_the_published_implementation(n: int, seed: int, published: Any) -> None:
    random = np.random.default_rng(100 * n + seed)
    m = 0.1 * random.normal(size=n).cumsum()
    s = np.roll(m, int(random.integers(-n // 6, n // 6 + 1))) * random.uniform(0.5, 1.4)
    s += 0.1 * random.normal(size=n)
    ours = iso18571(m, s, 100.0)
    t = np.arange(n) / 100.0
    theirs = published(np.column_stack([t, m]), np.column_stack([t, s]), dt=0.01)
    assert float(ours.corridor) == pytest.approx(theirs.corridor_rating(-1), abs=1e-9)
    assert float(ours.phase) == pytest.approx(theirs.phase_rating(-1), abs=1e-9)
    assert float(ours.magnitude) == pytest.approx(theirs.magnitude_rating(-1), abs=1e-9)
    assert float(ours.slope) == pytest.approx(theirs.slope_rating(-1), abs=1e-9)
    assert float(ours.overall) == pytest.approx(theirs.overall_rating(-1), abs=1e-9)


def test_iso_18571_of_the_same_signal_is_one_and_falls_with_what_it_is_about() -> None:
    m = np.exp(-0.5 * T) * np.sin(2 * np.pi * 1.2 * T)
    same = iso18571(m, m, 100.0)
    assert [float(v) for v in (same.corridor, same.phase, same.magnitude, same.slope, same.overall)] == [
        1
    ] * 5
    late = iso18571(m, np.concatenate([np.zeros(40), m[:-40]]), 100.0)
    assert float(late.phase) == pytest.approx(1 - 40 / 200)
    assert float(late.magnitude) > 0.99
    high = iso18571(m, 1.3 * m, 100.0)
    assert float(high.slope) == pytest.approx(1 - 0.3 / 2)
    assert 1 - 0.3 / 0.5 <= float(high.magnitude) < 0.9  # warping in time cannot make it worse
    noisy = m + 0.05 * np.sin(2 * np.pi * 20 * T)
    assert float(iso18571(m, noisy, 100.0).slope) < 0.9


@pytest.mark.parametrize(
    ("m", "s"),
    [
        (np.empty(0), np.empty(0)),
        (np.zeros(5), np.zeros(6)),
        (np.zeros((5, 2)), np.zeros((5, 2))),
        (np.zeros(5), np.zeros((5, 2, 2))),
    ],
)
def test_wrong_shapes_are_refused(m: np.ndarray, s: np.ndarray) -> None:
    with pytest.raises(InputError, match="agreement"):
        mean_squared_error(m, s)


def test_iso_18571_refuses_what_it_cannot_rate() -> None:
    with pytest.raises(InputError, match="ten samples"):
        iso18571(np.arange(5.0), np.arange(5.0), 100.0)
    with pytest.raises(InputError, match="constant"):
        iso18571(np.ones(50), np.arange(50.0), 100.0)
