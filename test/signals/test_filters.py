# SPDX-License-Identifier: Apache-2.0
"""The low-pass against closed forms, against scipy, and against itself sample by sample."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy import signal

from suspension_twin.errors import InputError
from suspension_twin.signals.filters import CausalLowPass, FilterSpec, filter_lanes, settling_time, zero_phase

SPECS = st.builds(FilterSpec, st.integers(1, 6), st.floats(1.0, 20.0))
RATES = st.floats(50.0, 1600.0)
SIGNALS = arrays(np.float64, (60, 2), elements=st.floats(-1e3, 1e3))


@given(SPECS, RATES, st.floats(-100, 100))
@settings(max_examples=50, deadline=None)
def test_a_constant_passes_from_the_first_sample(spec: FilterSpec, rate: float, level: float) -> None:
    x = np.full((40, 1), level)
    assert CausalLowPass(spec, rate, 1).process(x) == pytest.approx(x, rel=1e-9, abs=1e-9)
    assert zero_phase(spec, rate, x) == pytest.approx(x, rel=1e-9, abs=1e-9)


@given(SPECS, RATES, SIGNALS)
@settings(max_examples=50, deadline=None)
def test_steps_and_blocks_give_the_same_bits(spec: FilterSpec, rate: float, x: np.ndarray) -> None:
    block = CausalLowPass(spec, rate, 2).process(x)
    live = CausalLowPass(spec, rate, 2)
    assert np.array_equal(np.array([live.step(row) for row in x]), block)
    halves = CausalLowPass(spec, rate, 2)
    assert np.array_equal(np.vstack([halves.process(x[:17]), halves.process(x[17:])]), block)
    live.reset()
    assert np.array_equal(live.process(x), block)


@given(SPECS, RATES, SIGNALS, SIGNALS, st.floats(-3, 3), st.booleans())
@settings(max_examples=50, deadline=None)
def test_linear(
    spec: FilterSpec, rate: float, x: np.ndarray, y: np.ndarray, k: float, both_ways: bool
) -> None:
    def run(z: np.ndarray) -> np.ndarray:
        return filter_lanes(spec, rate, z, zero_phase=both_ways)

    assert run(x + k * y) == pytest.approx(run(x) + k * run(y), rel=1e-7, abs=1e-6)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 8])
def test_magnitude_at_the_cutoff_and_far_above(order: int) -> None:
    rate, spec = 1000.0, FilterSpec(order, 20.0)
    t = np.arange(8000) / rate
    for frequency in (2.0, 20.0, 60.0):
        # Butterworth's magnitude with the bilinear transform's warped frequency.
        warped = math.tan(math.pi * frequency / rate) / math.tan(math.pi * 20.0 / rate)
        gain = 1.0 / math.sqrt(1.0 + warped ** (2 * order))
        x = np.sin(2 * np.pi * frequency * t)
        inner = slice(3000, 5000)
        causal = CausalLowPass(spec, rate, 1).process(x)[inner]
        assert math.sqrt(2) * np.std(causal) == pytest.approx(gain, rel=1e-3, abs=1e-7)
        both = zero_phase(spec, rate, x)[inner]
        assert both == pytest.approx(gain**2 * x[inner], abs=2e-4)  # no delay at all


@pytest.mark.parametrize(("order", "cutoff", "rate"), [(2, 20.0, 100.0), (4, 10.0, 104.3), (3, 30.0, 800.0)])
def test_same_as_scipy(order: int, cutoff: float, rate: float) -> None:
    spec, x = FilterSpec(order, cutoff), np.random.default_rng(1).normal(size=(500, 3))
    sos = signal.butter(order, cutoff, fs=rate, output="sos")
    zi = signal.sosfilt_zi(sos)[:, :, None] * x[0]
    assert CausalLowPass(spec, rate, 3).process(x) == pytest.approx(
        signal.sosfilt(sos, x, axis=0, zi=zi)[0], abs=1e-12
    )
    pad = math.ceil(3 * settling_time(spec, rate) * rate)
    expected = signal.sosfiltfilt(sos, x, axis=0, padtype="odd", padlen=pad)
    # Away from the ends the order in which sections run does not matter.
    inner = slice(pad, -pad)
    assert zero_phase(spec, rate, x)[inner] == pytest.approx(expected[inner], abs=1e-9)
    if order <= 2:
        assert zero_phase(spec, rate, x) == pytest.approx(expected, abs=1e-12)


def test_lanes_do_not_meet() -> None:
    x = np.random.default_rng(2).normal(size=(200, 3, 40))
    together = zero_phase(FilterSpec(), 100.0, x)
    assert together.shape == x.shape
    assert np.array_equal(together[:, 1, 7], zero_phase(FilterSpec(), 100.0, x[:, 1, 7]))


def test_delay_is_that_of_a_slow_ramp() -> None:
    spec, rate = FilterSpec(2, 20.0), 100.0
    ramp = np.arange(400) / rate
    late = ramp[-1] - CausalLowPass(spec, rate, 1).process(ramp)[-1]
    assert spec.delay(rate) == pytest.approx(late, rel=1e-6)
    assert spec.delay(10_000.0) == pytest.approx(math.sqrt(2) / (2 * math.pi * 20.0), rel=1e-3)


def test_settling_time_is_that_of_a_step() -> None:
    spec, rate = FilterSpec(2, 20.0), 1000.0
    low_pass = CausalLowPass(spec, rate, 1)
    low_pass.step([0.0])
    step = low_pass.process(np.ones(400))
    after = int(settling_time(spec, rate) * rate)
    assert np.abs(1 - step[after:]).max() < 0.02
    assert np.abs(1 - step[: after // 2]).max() > 0.1


def test_nan_is_refused_and_forgotten() -> None:
    low_pass, other = (CausalLowPass(FilterSpec(), 100.0, 2) for _ in range(2))
    rows = np.random.default_rng(3).normal(size=(10, 2))
    low_pass.process(rows)
    other.process(rows)
    with pytest.raises(InputError, match="not a finite number"):
        low_pass.step([math.nan, 0.0])
    assert np.array_equal(low_pass.step([1.0, 2.0]), other.step([1.0, 2.0]))
    with pytest.raises(InputError, match="not a finite number"):
        CausalLowPass(FilterSpec(), 100.0, 1).step([math.inf])


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: FilterSpec(0, 20.0), "order"),
        (lambda: FilterSpec(9, 20.0), "order"),
        (lambda: FilterSpec(2, 0.0), "cutoff"),
        (lambda: FilterSpec(2, math.nan), "cutoff"),
        (lambda: FilterSpec(2, 30.0).sections(60.0), "lower the cut-off"),
        (lambda: FilterSpec().sections(math.nan), "rate"),
        (lambda: CausalLowPass(FilterSpec(), 100.0, 3).process(np.zeros((5, 2))), "3 channels"),
    ],
)
def test_what_cannot_be_is_refused(make: object, word: str) -> None:
    with pytest.raises(InputError, match=word):
        make()  # type: ignore[operator]


def test_nothing_in_nothing_out() -> None:
    assert zero_phase(FilterSpec(), 100.0, np.empty((0, 3))).shape == (0, 3)
    assert CausalLowPass(FilterSpec(), 100.0, 3).process(np.empty((0, 3))).shape == (0, 3)
    assert zero_phase(FilterSpec(), 100.0, np.array([4.0])) == pytest.approx([4.0])


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize(("cutoff", "rate"), [(20.0, 100.0), (1.0, 1000.0), (40.0, 82.0)])
def test_sections_are_scipys(order: int, cutoff: float, rate: float) -> None:
    """The same cascade as SciPy's design, whichever way the sections are paired and ordered."""
    ours = FilterSpec(order, cutoff).sections(rate)
    _, own = signal.sosfreqz(ours, 256)
    _, theirs = signal.sosfreqz(signal.butter(order, cutoff, fs=rate, output="sos"), 256)
    assert own == pytest.approx(theirs, rel=1e-9, abs=1e-9)


def test_a_calibration_does_not_wait_for_what_it_does_not_use() -> None:
    """Half a second of imports: nothing on the way from a drive to a calibrated twin needs scipy.signal."""
    code = "import sys, suspension_twin.calibration.run; sys.exit('scipy.signal' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
