# SPDX-License-Identifier: Apache-2.0
"""The live gap against what a window of arrays says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.live.gap import RunningGap

T0 = 1.7e9


def run(gap: RunningGap, t, measured, simulated, speed=10.0):
    for a, b, c in zip(t, measured, simulated, strict=True):
        gap.push(float(a), float(b), float(c), speed)


def test_it_is_the_rms_of_the_difference_over_the_window():
    rng = np.random.default_rng(0)
    t = T0 + np.arange(3000) / 100.0
    measured, simulated = rng.standard_normal((2, t.size))
    gap = RunningGap(window=10.0)
    run(gap, t, measured, simulated)
    now = gap.now()
    late = t > t[-1] - 10.0
    assert now.samples == late.sum()
    assert now.rms == pytest.approx(np.sqrt(np.mean((measured - simulated)[late] ** 2)))
    assert now.measured_rms == pytest.approx(np.sqrt(np.mean(measured[late] ** 2)))


@pytest.mark.parametrize("rate", [100.0, 1000.0, 1600.0])
def test_the_window_holds_at_any_rate_and_for_long(rate):
    t = T0 + np.arange(int(30 * rate)) / rate
    gap = RunningGap(window=8.0)
    run(gap, t, np.linspace(0.0, 1.0, t.size), np.zeros(t.size))
    assert abs(gap.now().samples - 8 * rate) <= 1
    late = t > t[-1] - 8.0
    assert gap.now().rms == pytest.approx(np.sqrt(np.mean(np.linspace(0.0, 1.0, t.size)[late] ** 2)))


def test_the_bands_share_the_whole_and_a_tone_lies_in_its_own():
    rng = np.random.default_rng(1)
    t = T0 + np.arange(2000) / 100.0 + rng.normal(0, 2e-4, 2000)
    tone = 0.7 * np.sin(2 * np.pi * 5.0 * (t - T0))
    gap = RunningGap(window=10.0, edges=(0.0, 3.0, 8.0, 50.1))
    run(gap, t, tone, np.zeros(t.size))
    low, middle, high = gap.now().bands
    assert middle == pytest.approx(0.7 / math.sqrt(2), rel=0.01)
    assert low < 0.01 and high < 0.02
    noise = rng.standard_normal(t.size)
    run(gap, t + 30.0, noise, np.zeros(t.size))
    now = gap.now()
    assert math.hypot(*now.bands) == pytest.approx(now.rms, rel=0.1)


def test_the_floor_is_learnt_at_standstill_and_gives_way_to_the_calibrations():
    rng = np.random.default_rng(2)
    t = T0 + np.arange(1000) / 100.0
    noise = 0.04 * rng.standard_normal(t.size)
    gap = RunningGap()
    run(gap, t[:500], 0.3 + noise[:500], np.zeros(500), speed=0.0)
    assert gap.noise_rms == pytest.approx(0.04, rel=0.1)  # an offset is no noise
    run(gap, t[500:], noise[500:], np.zeros(500), speed=10.0)
    now = gap.now()
    assert now.normalised == pytest.approx(now.rms / gap.noise_rms)
    known = RunningGap(floor=0.1)
    run(known, t, noise, np.zeros(t.size))
    assert math.isnan(known.noise_rms)
    assert known.now().normalised == pytest.approx(known.now().rms / 0.1)


def test_a_fresh_start_does_not_count_until_the_twin_has_settled():
    t = T0 + np.arange(1000) / 100.0
    gap = RunningGap(settle=2.0)
    run(gap, t[:500], np.full(500, 9.0), np.zeros(500))
    gap.restart(float(t[500]))
    assert gap.now() is None
    run(gap, t[500:], np.where(t[500:] < t[500] + 2.0, 9.0, 1.0), np.zeros(500))
    assert gap.now().rms == pytest.approx(1.0)


@pytest.mark.parametrize("seconds", [0.5, 3.0, 10.0])
@pytest.mark.parametrize("begin", [0.0, 4.7, 9.6, 9.9])
def test_no_band_contradicts_the_whole_wherever_a_bump_lies_in_the_window(begin, seconds):
    """The newest samples and the oldest of the window weigh as much as those between."""
    t = T0 + np.arange(1003) / 100.0
    bump = np.where(np.abs(t - T0 - begin - 0.1) < 0.1, 3.0 * np.sin(2 * np.pi * 5.0 * (t - T0)), 0.0)
    gap = RunningGap(window=seconds, edges=(0.0, 3.0, 8.0, 20.0, 51.0))
    run(gap, t, bump, 0.01 * np.cos(2 * np.pi * 1.0 * (t - T0)))
    now = gap.now()
    assert math.hypot(*now.bands) == pytest.approx(now.rms, rel=1e-9)
    assert max(now.bands) <= now.rms * (1.0 + 1e-9)


def test_the_gap_over_all_driving_leaves_out_standing_and_what_is_off_the_road():
    t = T0 + np.arange(3000) / 100.0
    size = np.select([t < T0 + 10.0, t < T0 + 20.0], [0.3, 2.0], 5.0)
    gap = RunningGap(window=1.0)
    assert math.isnan(gap.driving_rms)
    for k, (a, b) in enumerate(zip(t.tolist(), size.tolist(), strict=True)):
        gap.push(a, b, 0.0, 0.0 if k < 1000 else -8.0, on_road=k < 2000)
    assert gap.driving_rms == pytest.approx(2.0) and gap.driving_since == t[1000]
    gap.reset()
    assert gap.driving_rms == pytest.approx(2.0), "a jump back in time ends the window, not the drive"


def test_it_says_what_its_ratio_is_to():
    known, unknown = RunningGap(floor=0.5), RunningGap()
    for gap in (known, unknown):
        run(gap, T0 + np.arange(600) / 100.0, np.tile([1.0, -1.0], 300), np.zeros(600), speed=0.0)
    assert str(known.now()) == "1.00 m/s² (2.0 × calibrated)"
    assert str(unknown.now()) == "1.00 m/s² (1.0 × noise)"


def test_nothing_is_said_of_nothing():
    gap = RunningGap()
    assert gap.now() is None
    gap.push(T0, 1.0, 0.0, 0.0)
    assert gap.now() is None
    gap.push(T0 + 0.01, 1.0, 0.0, 0.0)
    assert gap.now().rms == 1.0 and math.isnan(gap.now().normalised)
    gap.reset()
    assert gap.now() is None


@pytest.mark.parametrize(
    "wrong",
    [{"window": 0.0}, {"edges": (1.0,)}, {"edges": (1.0, 1.0)}, {"edges": (-1.0, 2.0)}, {"floor": -1.0}],
)
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(InputError):
        RunningGap(**wrong)
