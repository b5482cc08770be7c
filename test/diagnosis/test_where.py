# SPDX-License-Identifier: Apache-2.0
"""Localisation of a gap in frequency, at corners and at operating points."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from one_channel import CHANNEL, RATE, problem_over
from scipy.signal import lfilter

from suspension_twin.diagnosis.where import _bands, _corners, _expected_density, _operating_points, localise


def resonance(x: np.ndarray, hertz: float, damping: float) -> np.ndarray:
    """(n,) response of a lightly damped oscillator to ``x``, scaled to the rms of ``x``."""
    radius, angle = np.exp(-2 * np.pi * hertz * damping / RATE), 2 * np.pi * hertz / RATE
    y = lfilter([1.0 - radius], [1.0, -2 * radius * np.cos(angle), radius**2], x)
    return np.asarray(y * np.std(x) / np.std(y))


@given(st.floats(3.0, 16.0), st.floats(0.02, 0.06), st.integers(0, 1000))
@pytest.mark.long
def test_a_resonance_is_located_within_a_sixth_of_an_octave(hertz: float, damping: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    drives = [
        0.3 * resonance(rng.standard_normal(n), hertz, damping) + 0.05 * rng.standard_normal(n)
        for n in (3000, 4500)
    ]
    regions = _bands(drives, RATE, 0.01, np.zeros(129))
    assert regions == sorted(regions, key=lambda r: -r["share"])
    main = regions[0]
    assert main["share"] > 0.4 and main["low_hz"] < main["high_hz"]
    assert abs(np.log2(np.sqrt(main["low_hz"] * main["high_hz"]) / hertz)) < 1 / 6


def test_a_gap_of_equal_energy_in_every_octave_has_no_band() -> None:
    rng = np.random.default_rng(5)
    spectrum = np.fft.rfft(rng.standard_normal(12_000))
    f = np.fft.rfftfreq(12_000, 1 / RATE)
    pink = np.fft.irfft(spectrum / np.sqrt(np.maximum(f, 0.2)))
    assert sum(r["share"] for r in _bands([pink], RATE, 0.0, np.zeros(129))) < 0.5


def test_a_band_of_the_reference_is_none_of_the_gap() -> None:
    """Model discrepancy is a fifth of the motion about 4 Hz on all drives; the gap is at 11 Hz, and smaller."""
    n = [3000, 4500, 4000]
    rng = np.random.default_rng(7)
    motion = [resonance(rng.standard_normal(k), 4.0, 0.1) for k in n]
    left = [0.2 * resonance(rng.standard_normal(k), 4.0, 0.1) for k in n]
    for k, one in zip(n[:2], left[:2], strict=True):
        one += 0.12 * resonance(rng.standard_normal(k), 11.0, 0.04)
    there = problem_over(n, np.concatenate(motion)[:, None], (True, True, False))
    there.channels = (CHANNEL,)
    usual = _expected_density(there, np.concatenate(left)[:, None], 0)
    band = _bands(left[:2], RATE, 0.01, usual)[0]
    assert band["low_hz"] < 11.0 < band["high_hz"]
    # without the reference the larger band is the answer
    alone = problem_over(n[:2], np.concatenate(motion[:2])[:, None])
    plain = _expected_density(alone, np.concatenate(left[:2])[:, None], 0)
    assert not plain.any()
    band = _bands(left[:2], RATE, 0.01, plain)[0]
    assert band["low_hz"] < 4.0 < band["high_hz"]


def blocks(samples: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Block (n,) of every sample and 500 draws of blocks."""
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), 500).astype(float)
    return np.arange(samples) * count // samples, drawn


@pytest.mark.parametrize("corner", range(4))
def test_the_corner_whose_motion_correlates_with_the_gap_comes_first(corner: int) -> None:
    rng = np.random.default_rng(corner)
    velocity = rng.standard_normal((6000, 4)) * [0.1, 0.2, 0.3, 0.1]
    amount = (velocity[:, corner] / np.std(velocity[:, corner])) ** 2
    found = _corners(velocity, amount, *blocks(6000))
    names = ("front_left", "front_right", "rear_left", "rear_right")
    assert found[0]["name"] == names[corner] and found[0]["share"] > 0.9
    assert len(found) < 4  # a part that is not sure is left out


def test_operating_points_hold_the_gap_and_an_even_gap_has_none() -> None:
    rng = np.random.default_rng(3)
    velocity, travel = 0.2 * rng.standard_normal(6000), 0.02 * rng.standard_normal(6000)
    quantities = [("front damper velocity", velocity, "m/s"), ("front spring travel", travel, "m")]
    noise = rng.standard_normal(6000) ** 2
    points = _operating_points(quantities, noise + 8.0 * (velocity < -0.3), *blocks(6000))
    assert {p["quantity"] for p in points} == {"front damper velocity"}
    assert points[0]["low"] < -0.3 and points[0]["high"] < -0.15 and points[0]["share"] > 0.3
    wrong = [
        _operating_points(quantities, np.random.default_rng(s).standard_normal(6000) ** 2, *blocks(6000))
        for s in range(20)
    ]
    assert sum(map(bool, wrong)) <= 4


@pytest.mark.parametrize("excited", [True, False])
def test_a_place_on_the_road_is_named_where_there_is_one(excited: bool) -> None:
    """Without a road positions are metres that were driven: the seconds of the drive say where."""
    n = 4000
    left = 0.1 * np.random.default_rng(2).standard_normal((n, 1))
    left[1500:1600] *= 30.0
    there = problem_over([n], left)
    t, speed = np.arange(n) / RATE, np.full(n, 10.0)
    there.data.parts = [
        SimpleNamespace(name="drive", t=t, rate=RATE, position=10.0 * t, along=speed, excited=excited)
    ]
    there.data.rows = [np.arange(n)]
    bare: Any = SimpleNamespace(axles={})
    where = localise(there, left, {CHANNEL: 0.01}, bare)
    assert where["time"][0]["start"] == pytest.approx(15.0, abs=0.5)
    assert bool(where["road"]) is excited
