# SPDX-License-Identifier: Apache-2.0
"""Spectra: a sine where it belongs, Parseval's sum, bands that add up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.signals.spectra import band_rms, octave_bands, power_density, power_spectrum

T = np.arange(8000) / 100


@pytest.mark.parametrize("frequency", [1.5, 9.0, 23.0])
def test_a_sine_lies_at_its_frequency_with_its_power(frequency: float) -> None:
    x = 3.0 * np.sin(2 * np.pi * frequency * T) + 7.0
    at, density = power_density(x, 100.0)
    assert at[np.argmax(density)] == pytest.approx(frequency, abs=0.3)
    assert np.sum(density) * (at[1] - at[0]) == pytest.approx(4.5, rel=0.02)
    two_sided, amplitude = power_spectrum(x, 100.0)
    assert abs(two_sided[np.argmax(amplitude)]) == pytest.approx(frequency, abs=0.02)
    assert amplitude.max() == pytest.approx(1.5, rel=1e-3)  # half of it on either side
    assert two_sided.size == T.size
    assert two_sided.min() == -50.0


def test_white_noise_is_flat_and_adds_up() -> None:
    x = np.random.default_rng(0).normal(0, 2.0, (60_000, 2))
    at, density = power_density(x, 100.0)
    assert density.shape == (at.size, 2)
    assert np.mean(density[5:-5], axis=0) == pytest.approx(4.0 / 50.0, rel=0.03)
    bands = np.column_stack([np.arange(1.0, 49.0), np.arange(2.0, 50.0)])
    rms = band_rms(x, 100.0, bands)
    assert rms.shape == (48, 2)
    assert np.sqrt(np.sum(rms**2, axis=0)) == pytest.approx(2.0 * math.sqrt(48 / 50), rel=0.02)


def test_parseval() -> None:
    x = np.random.default_rng(1).normal(size=1000)
    _, amplitude = power_spectrum(x, 100.0)
    assert np.sum(amplitude**2) == pytest.approx(np.var(x), rel=1e-9)


def test_third_octaves_meet_and_hold_the_preferred_frequencies() -> None:
    bands = octave_bands(1.0, 40.0)
    assert bands[1:, 0] == pytest.approx(bands[:-1, 1])
    centre = np.sqrt(bands[:, 0] * bands[:, 1])
    assert 3 * np.log2(centre / 1000) == pytest.approx(np.round(3 * np.log2(centre / 1000)), abs=1e-9)
    assert centre[0] >= 1.0 - 1e-9
    assert centre[-1] <= 40.0 + 1e-9
    assert bands[:, 1] / bands[:, 0] == pytest.approx(2 ** (1 / 3))
    assert np.any(np.isclose(centre, 1000 / 2**5))  # 31.25 Hz, nominally 31.5


def test_octave_band_of_a_sine() -> None:
    bands = octave_bands(1.0, 16.0, fraction=1)
    rms = band_rms(2.0 * np.sin(2 * np.pi * 7.8 * T), 100.0, bands)
    centre = np.sqrt(bands[:, 0] * bands[:, 1])
    assert centre[np.argmax(rms)] == pytest.approx(7.8125)
    assert rms.max() == pytest.approx(math.sqrt(2), rel=0.01)
    assert np.sort(rms)[-2] < 0.05


def test_refusals() -> None:
    with pytest.raises(InputError, match="too few"):
        power_density(np.zeros(4), 100.0)
    with pytest.raises(InputError, match="one signal"):
        power_spectrum(np.zeros((20, 2)), 100.0)
    with pytest.raises(InputError, match="octave"):
        octave_bands(5.0, 2.0)
