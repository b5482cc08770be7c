# SPDX-License-Identifier: Apache-2.0
"""Spectra: a sine where it belongs, Parseval's sum."""

from __future__ import annotations

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.signals.spectra import power_density, power_spectrum

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
    assert np.sum(density, axis=0) * (at[1] - at[0]) == pytest.approx(4.0, rel=0.02)


def test_parseval() -> None:
    x = np.random.default_rng(1).normal(size=1000)
    _, amplitude = power_spectrum(x, 100.0)
    assert np.sum(amplitude**2) == pytest.approx(np.var(x), rel=1e-9)


def test_refusals() -> None:
    with pytest.raises(InputError, match="too few"):
        power_density(np.zeros(4), 100.0)
    with pytest.raises(InputError, match="one signal"):
        power_spectrum(np.zeros((20, 2)), 100.0)
