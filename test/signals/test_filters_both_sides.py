# SPDX-License-Identifier: Apache-2.0
"""The simulated signal's filter is the measured signal's filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.signals.filters import FilterSpec, LiveLowPass
from suspension_twin.signals.ingest import ImuIngest, ImuSettings
from suspension_twin.vehicle.twin import Place

T0 = 1.7e9


def both(t, values, spec=None):
    """Filtered by the ingest as a vertical force, and by the filter under test, at the same stamps."""
    spec = spec or FilterSpec()
    ingest, low_pass = ImuIngest(ImuSettings(filter=spec), Place()), LiveLowPass(spec)
    rows = []
    for a, b in zip(t, values, strict=True):
        out = ingest.push(float(a), (0.0, 0.0, 9.80665 + float(b)), (0.0, 0.0, 0.0))
        mine = low_pass.push(float(a), float(b))
        if out is not None:
            rows.append((out.t, out.force[2] - 9.80665, mine))
    return np.array(rows)


def signal(t):
    x = t - T0
    return (
        1.5 * np.sin(2 * np.pi * 1.3 * x)
        + 0.8 * np.sin(2 * np.pi * 11.0 * x)
        + 0.3 * np.sin(2 * np.pi * 31.0 * x)
    )


@pytest.mark.parametrize("rate", [60.0, 100.0, 400.0, 1000.0])
def test_it_is_the_measured_path(rate):
    rng = np.random.default_rng(4)
    t = T0 + (np.arange(int(8 * rate)) + 0.03 * rng.standard_normal(int(8 * rate))) / rate
    t = t[rng.random(t.size) > 0.01]
    x = signal(t)
    rows = both(t, x)
    late = rows[:, 0] > T0 + 2.0
    difference = (rows[:, 1] - rows[:, 2])[late]
    # The ingest takes a constant off (bias); what matters is what moves.
    difference -= difference.mean()
    assert np.sqrt(np.mean(difference**2)) < 0.005 * np.sqrt(np.mean(rows[late, 1] ** 2))


def test_a_pause_starts_it_anew():
    t = T0 + np.concatenate([np.arange(300), np.arange(400, 500)]) / 100.0
    x = np.where(t < T0 + 3.5, 1.0, -2.0)
    low_pass = LiveLowPass(FilterSpec())
    out = [low_pass.push(a, b) for a, b in zip(t, x, strict=True)]
    assert out == pytest.approx(x.tolist(), abs=1e-9)


def test_the_first_sample_is_answered_and_there_is_no_starting_transient():
    low_pass = LiveLowPass(FilterSpec(order=5, cutoff=10.0))
    for k in range(50):
        assert low_pass.push(T0 + k / 100.0, -4.0) == pytest.approx(-4.0)


def test_it_damps_what_is_above_the_cutoff_as_a_butterworth_does():
    rate, frequency, spec = 500.0, 40.0, FilterSpec(order=2, cutoff=20.0)
    t = T0 + np.arange(3000) / rate
    low_pass = LiveLowPass(spec)
    out = np.array([low_pass.push(a, math.sin(2 * math.pi * frequency * (a - T0))) for a in t])
    tangent = math.tan(math.pi * frequency / rate) / math.tan(math.pi * spec.cutoff / rate)  # bilinear
    assert out[1500:].std() * math.sqrt(2) == pytest.approx(1.0 / math.sqrt(1.0 + tangent**4), rel=0.01)


def test_late_repeated_and_wild_stamps():
    low_pass = LiveLowPass(FilterSpec())
    last = [low_pass.push(T0 + k / 100.0, float(k % 5)) for k in range(100)][-1]
    assert low_pass.push(T0 + 0.99, 50.0) == last
    assert low_pass.push(T0 + 0.5, 50.0) == last
    assert low_pass.push(T0 - 100.0, 7.0) == 7.0  # a loop: afresh


@pytest.mark.parametrize("wrong", [(math.nan, 0.0), (T0 + 9.0, math.inf)])
def test_what_is_not_finite_is_refused_and_changes_nothing(wrong):
    low_pass, other = LiveLowPass(FilterSpec()), LiveLowPass(FilterSpec())
    for k in range(60):
        assert low_pass.push(T0 + k / 100.0, float(k % 7)) == other.push(T0 + k / 100.0, float(k % 7))
        if k == 30:
            with pytest.raises(InputError):
                low_pass.push(wrong[0], wrong[1])


def test_a_cutoff_that_the_rate_cannot_carry_is_lowered_and_the_rate_may_change():
    low_pass = LiveLowPass(FilterSpec(cutoff=40.0))
    out = [low_pass.push(T0 + k / 60.0, 1.0) for k in range(100)]
    out += [low_pass.push(T0 + 100 / 60.0 + k / 400.0, 1.0) for k in range(400)]
    assert out == pytest.approx([1.0] * 500)
