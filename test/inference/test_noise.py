# SPDX-License-Identifier: Apache-2.0
"""Noise and model discrepancy: densities, shares of the motion, and filters that leave white residuals of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from suspension_twin.inference.noise import ScaledObjective, Whitener, autoregression, density, shares
from suspension_twin.inference.objectives import Measured, Objective, parse_objective

RATE = 100.0
CHANNEL = "vertical_acceleration"


def coloured(rng: np.random.Generator, size: int, pole: float = 0.9) -> np.ndarray:
    """An autoregressive process of innovation one."""
    return np.asarray(signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(size + 500))[500:])


def of_drives(values: np.ndarray, lengths: list[int], drives: list[int], bandwidth: float = 50.0) -> Measured:
    """Segments of so many samples, one behind the other."""
    ends = np.cumsum(lengths)
    segments = tuple(slice(int(e - n), int(e)) for e, n in zip(ends, lengths, strict=True))
    return Measured((CHANNEL,), values, segments, RATE, tuple(drives), bandwidth)


def test_the_density_of_white_noise_is_twice_its_variance_over_the_rate() -> None:
    rng = np.random.default_rng(1)
    values = np.concatenate(
        [np.full(31, 1e6), 3.0 * rng.standard_normal(30_000), 5.0 + rng.standard_normal(30_000)]
    )
    parts = [slice(0, 31), slice(31, 30_031), slice(30_031, 60_031)]
    power = density(values, parts, RATE)
    assert power[3:].mean() == pytest.approx((9.0 + 1.0) / 2 * 2.0 / RATE, rel=0.03)  # 31 samples are none
    assert power[3:].std() < 0.1 * power.mean()
    alone = density(values, [slice(0, 31)], RATE)
    assert (alone > 0).all() and alone.max() < 1e-15  # where there is nothing


def test_a_residual_is_a_share_of_the_motion_of_its_own_drives_within_limits() -> None:
    rng = np.random.default_rng(2)
    motion = coloured(rng, 20_000)[:, None]
    measured = of_drives(motion, [10_000, 10_000], [0, 1])
    residual = motion * np.r_[np.full(10_000, 0.3), np.full(10_000, 9.0)][:, None]
    assert shares(measured, residual, [0])[0] == pytest.approx(0.3)
    assert (shares(measured, residual, [1]) == 3.0).all()
    assert (shares(measured, 1e-6 * residual, [0, 1]) == 0.02).all()


@pytest.mark.parametrize(
    ("short", "groups"), [(3000, (0, 0, 1)), (400, (0, 0, 0))], ids=["each of its own", "one is too short"]
)
def test_each_drive_is_whitened_by_itself_where_all_are_long_enough(
    short: int, groups: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(3)
    loud, quiet = 2.0 * coloured(rng, 6000), 0.5 * coloured(rng, short, pole=0.3)
    residual = np.concatenate([loud, quiet])[:, None]
    measured = of_drives(np.zeros_like(residual), [3000, 3000, short], [4, 4, 7])
    whitener = Whitener.of_residual(measured, residual)
    assert whitener.group == groups and len(whitener.sigma) == max(groups) + 1
    white = whitener.residuals(residual[:, :, None])[:, 0]
    assert white.size == whitener.row.size == whitener.drive.size
    levels = [float(np.sqrt(np.mean(white[whitener.drive == d] ** 2))) for d in (4, 7)]
    if groups[-1]:
        assert levels == pytest.approx([1.0, 1.0], abs=0.05)
        ahead = np.corrcoef(white[whitener.drive == 4][1:], white[whitener.drive == 4][:-1])[0, 1]
        assert abs(ahead) < 0.05
    else:
        assert levels[1] < 0.5 * levels[0]


def test_a_designed_filter_whitens_what_it_was_designed_for() -> None:
    """A share of the motion and the sensor's noise; of the other drive the noise alone, for it hardly moves."""
    rng = np.random.default_rng(4)
    motion = np.concatenate([coloured(rng, 20_000), 1e-3 * coloured(rng, 20_000)])
    noise = np.repeat([0.2, 0.05], 20_000)
    measured = of_drives(motion[:, None], [20_000, 20_000], [2, 5])
    residual = 0.3 * np.concatenate([coloured(rng, 20_000), np.zeros(20_000)]) + noise * rng.standard_normal(
        40_000
    )
    whitener = Whitener.designed(measured, np.array([0.3]), {2: {CHANNEL: 0.2}, 5: {CHANNEL: 0.05}})
    assert whitener.group == (0, 1)
    white = whitener.residuals((motion + residual)[:, None, None])[:, 0]
    for drive in (2, 5):
        assert np.mean(white[whitener.drive == drive] ** 2) == pytest.approx(1.0, abs=0.08)


def test_the_scale_of_an_objective_counts_independent_samples() -> None:
    rng = np.random.default_rng(5)
    values = rng.standard_normal((2000, 1))
    for bandwidth, independent in ((20.0, 0.4), (10.0, 0.2), (80.0, 1.0)):
        measured = of_drives(values, [2000], [0], bandwidth)
        assert measured.independent == pytest.approx(independent)
        objective = Objective(parse_objective("euclidean", {CHANNEL: 1.0}), measured)
        scaled = ScaledObjective.at(objective, values + 0.7)
        found = scaled.residuals((values + 0.7)[:, :, None])
        assert np.mean(found**2) == pytest.approx(independent)


# -- every value by its formula ------------------------------------------------------------------------------------


def yule_walker(parts: list[np.ndarray], order: int) -> tuple[np.ndarray, float]:
    """From the normal equations of the covariance pooled over the parts."""
    c = np.array(
        [sum(float(np.sum(p[lag:] * p[: max(p.size - lag, 0)])) for p in parts) for lag in range(order + 1)]
    ) / sum(p.size for p in parts)
    table = np.array([[c[abs(i - j)] for j in range(order)] for i in range(order)])
    weights = np.linalg.solve(table, c[1:])
    return np.concatenate([[1.0], -weights]), float(np.sqrt(c[0] - weights @ c[1:]))


@pytest.mark.parametrize("order", [1, 2, 7])
def test_an_autoregression_solves_the_normal_equations_of_the_pooled_covariance(order: int) -> None:
    rng = np.random.default_rng(6)
    parts = [coloured(rng, 60), 3.0 * coloured(rng, 25, 0.2), coloured(rng, 3), coloured(rng, 1)]
    taps, sigma = autoregression(parts, order)
    wanted, spread = yule_walker(parts, order)
    assert taps.shape == (order + 1,)
    np.testing.assert_allclose(taps, wanted, rtol=1e-5, atol=1e-7)
    assert sigma == pytest.approx(spread, rel=1e-6)


def test_an_autoregression_of_nothing_and_of_what_is_known_exactly() -> None:
    for parts in ([], [np.zeros(50)]):
        taps, sigma = autoregression(parts, 3)
        assert taps.tolist() == [1.0, 0.0, 0.0, 0.0] and 0.0 < sigma < 1e-100
    wave = np.sin(2 * np.pi * 0.1 * np.arange(200_000))
    taps, sigma = autoregression([wave], 2)  # told from two samples before
    np.testing.assert_allclose(taps, [1.0, -2.0 * np.cos(2 * np.pi * 0.1), 1.0], atol=1e-3)
    assert sigma < 0.01


def whitener_of(
    order: int, lanes: int, rng: np.random.Generator
) -> tuple[Whitener, np.ndarray, tuple[slice, ...]]:
    """Two channels, four segments of two groups with samples between them that are not numbers, one too short."""
    segments = (
        slice(3, 3 + 2 * order + 1),
        slice(60, 60 + 2 * order),
        slice(120, 161),
        slice(161, 200),
        slice(205, 245),
    )
    measured, simulated = np.full((250, 2), np.nan), np.full((250, 2, lanes), np.nan)
    for s in segments[:1] + segments[2:]:
        measured[s] = rng.standard_normal((s.stop - s.start, 2))
        simulated[s] = rng.standard_normal((s.stop - s.start, 2, lanes))
    filters = np.concatenate([np.ones((2, 2, 1)), rng.standard_normal((2, 2, order))], axis=2)
    sigma = rng.uniform(0.5, 2.0, (2, 2))
    known = Measured((CHANNEL, "pitch_rate"), measured, segments, RATE, (4, 4, 4, 9, 9))
    return Whitener.with_filters(known, (0, 0, 0, 1, 1), filters, sigma), simulated, segments


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 16])
@pytest.mark.parametrize("lanes", [1, 3, 8, 9])
def test_residuals_are_filtered_within_their_segments_and_scaled(order: int, lanes: int) -> None:
    """e_k = (r_k + a_1 r_(k-1) + ...) / (sigma scale): nothing else counts, and each knows where it comes from."""
    rng = np.random.default_rng(order)
    whitener, simulated, segments = whitener_of(order, lanes, rng)
    whitener = replace(whitener, scale=np.array([0.5, 3.0]))
    found = whitener.residuals(simulated)
    wanted, rows, channels, drives = [], [], [], []
    for c in range(2):
        for s, g, drive in zip(segments, whitener.group, (4, 4, 4, 9, 9), strict=True):
            if s.stop - s.start <= 2 * order:
                continue
            r = simulated[s, c] - whitener.measured.values[s, c, None]
            level = whitener.sigma[g, c] * whitener.scale[c]
            wanted.append(signal.lfilter(whitener.filters[g, c], [1.0], r, axis=0)[order:] / level)
            rows += range(s.start + order, s.stop)
            channels += [c] * len(wanted[-1])
            drives += [drive] * len(wanted[-1])
    np.testing.assert_allclose(found, np.concatenate(wanted), rtol=1e-10, atol=1e-12)
    assert whitener.row.tolist() == rows and whitener.channel.tolist() == channels
    assert whitener.drive.tolist() == drives


def test_filters_begin_with_a_scale_of_one_for_each_channel() -> None:
    whitener, _, _ = whitener_of(2, 1, np.random.default_rng(0))
    assert whitener.scale.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("shortest", "groups"), [(480, (0, 1, 1)), (479, (0, 0, 0))])
def test_thirty_samples_for_each_coefficient_are_enough_for_a_filter_of_its_own(
    shortest: int, groups: tuple[int, ...]
) -> None:
    """All segments of a drive together; each less its mean, in each channel."""
    rng = np.random.default_rng(8)
    lengths = [700, 200, shortest - 200]
    first, second = coloured(rng, 500 + sum(lengths))[500:], 2.0 * coloured(rng, sum(lengths), 0.4)
    residual = np.stack([first + 5.0, second], axis=1)
    one = of_drives(rng.standard_normal((sum(lengths), 1)), lengths, [3, 8, 8])
    measured = replace(one, channels=(CHANNEL, "pitch_rate"), values=np.repeat(one.values, 2, axis=1))
    whitener = Whitener.of_residual(measured, measured.values + residual)
    assert whitener.group == groups and whitener.filters.shape == (max(groups) + 1, 2, 17)
    for c in range(2):
        for g in range(max(groups) + 1):
            parts = [
                residual[s, c] - residual[s, c].mean()
                for s, k in zip(measured.segments, groups, strict=True)
                if k == g
            ]
            taps, sigma = autoregression(parts, 16)
            np.testing.assert_allclose(whitener.filters[g, c], taps, atol=1e-9)
            assert whitener.sigma[g, c] == pytest.approx(sigma)
    low = Whitener.of_residual(measured, measured.values + residual, order=3)
    assert low.group == (0, 1, 1) and low.filters.shape == (2, 2, 4)


def test_segments_of_no_named_drive_are_whitened_alike() -> None:
    rng = np.random.default_rng(9)
    residual = coloured(rng, 1500)[:, None]
    measured = of_drives(np.zeros_like(residual), [900, 600], [])
    whitener = Whitener.of_residual(measured, residual)
    assert whitener.group == (0, 0) and set(whitener.drive.tolist()) == {0}
    named = Whitener.of_residual(replace(measured, drives=(0, 0)), residual)
    np.testing.assert_array_equal(whitener.filters, named.filters)


def test_a_density_is_that_of_all_segments_by_their_length() -> None:
    """Smoothed over frequency; 32 samples are a segment, and a line through each is taken off."""
    rng = np.random.default_rng(10)
    values = np.concatenate([rng.standard_normal(600), 4.0 * rng.standard_normal(200)])
    cuts = [slice(0, 600), slice(600, 800)]
    one, two = (density(values, [s], RATE) for s in cuts)
    np.testing.assert_allclose(density(values, cuts, RATE), 0.75 * one + 0.25 * two, rtol=1e-9)
    assert (
        density(values, [slice(600, 632)], RATE).max() > 0.01 > density(values, [slice(600, 631)], RATE).max()
    )
    trend = values + 7.0 + 0.03 * np.arange(800)
    np.testing.assert_allclose(density(trend, [slice(0, 256)], RATE), density(values, [slice(0, 256)], RATE))
    t = np.arange(5120) / RATE
    tone = density(3.0 * np.sin(2 * np.pi * 12.5 * t), [slice(0, 5120)], RATE)
    assert int(np.argmax(tone)) == 32 and tone.sum() * RATE / 256 == pytest.approx(4.5, rel=0.01)
    assert tone[36] / tone[32] == pytest.approx(np.exp(-0.5 * 16 / (4.0 + 0.5)), rel=0.1)


def test_shares_are_by_channel() -> None:
    rng = np.random.default_rng(11)
    motion = np.stack([coloured(rng, 4000), coloured(rng, 4000, 0.2)], axis=1)
    measured = replace(of_drives(motion, [2000, 2000], [0, 1]), channels=(CHANNEL, "pitch_rate"))
    residual = motion * np.repeat([[0.3, 0.7], [0.1, 2.0]], 2000, axis=0)
    np.testing.assert_allclose(shares(measured, residual, [0]), np.repeat([[0.3], [0.7]], 129, axis=1))
    np.testing.assert_allclose(shares(measured, residual, (1,)), np.repeat([[0.1], [2.0]], 129, axis=1))


@pytest.mark.parametrize("bandwidth", [20.0, 50.0])
def test_a_filter_for_noise_alone_divides_by_its_level_in_the_pass_band(bandwidth: float) -> None:
    """White up to Nyquist, although the low-pass removed the upper band: for each drive and channel its own."""
    rng = np.random.default_rng(12)
    one = of_drives(rng.standard_normal((1200, 1)), [400, 500, 300], [7, 2, 7], bandwidth)
    measured = replace(one, channels=(CHANNEL, "pitch_rate"), values=rng.standard_normal((1200, 2)))
    floors = [{}, {}, {CHANNEL: 0.3, "pitch_rate": 0.02}, *[{}] * 4, {CHANNEL: 0.1, "pitch_rate": 0.05}]
    whitener = Whitener.designed(measured, np.zeros(2), floors)
    assert whitener.group == (1, 0, 1)
    silent = np.zeros((2, 2, whitener.filters.shape[2]))
    silent[:, :, 0] = 1.0
    np.testing.assert_allclose(whitener.filters, silent, atol=1e-9)
    levels = np.array([[0.3, 0.02], [0.1, 0.05]]) / np.sqrt(measured.independent)
    np.testing.assert_allclose(whitener.sigma, levels, rtol=1e-5)


def test_a_designed_filter_has_the_spectrum_of_what_it_was_designed_for() -> None:
    """sigma^2 / |A|^2 is the density of the motion by the share of each band, and of the noise, within a decibel."""
    rng = np.random.default_rng(13)
    motion = coloured(rng, 30_000, 0.6)[:, None]
    measured = of_drives(motion, [30_000], [0])
    frequency = np.fft.rfftfreq(256, 1.0 / RATE)
    share = np.where(frequency < 20.0, 0.5, 0.5 - 0.02 * (np.minimum(frequency, 35.0) - 20.0))
    whitener = Whitener.designed(measured, share[None], [{CHANNEL: 0.1}])
    _, response = signal.freqz(whitener.filters[0, 0], worN=frequency, fs=RATE)
    found = 2.0 / RATE * (whitener.sigma[0, 0] / np.abs(response)) ** 2
    wanted = share**2 * density(motion[:, 0], [slice(0, 30_000)], RATE) + 2.0 * 0.1**2 / RATE
    apart = 10.0 * np.abs(np.log10(found / wanted))[1:]  # of a mean nothing is known
    assert apart.max() < 1.0 and apart.mean() < 0.2


def test_no_designed_filter_amplifies_without_limit() -> None:
    """Of a motion that leaves most of the band empty: a thousandth of it, white, remains below one."""
    rng = np.random.default_rng(14)
    low = signal.butter(8, 2.0, fs=RATE, output="sos")
    motion = signal.sosfilt(low, rng.standard_normal(8000))[:, None]
    measured = of_drives(motion, [8000], [0])
    whitener = Whitener.designed(measured, np.ones(1), [{CHANNEL: 1e-12}])
    white = 1e-3 * np.std(motion) * rng.standard_normal((8000, 1))
    left = whitener.residuals((motion + white)[:, :, None])
    assert 0.1 < np.sqrt(np.mean(left**2)) < 1.1


def test_an_objective_is_scaled_by_the_rms_of_its_residuals_for_independent_samples() -> None:
    rng = np.random.default_rng(15)
    values = rng.standard_normal((500, 1))
    measured = of_drives(values, [500], [0], 20.0)
    objective = Objective(parse_objective("2*euclidean", {CHANNEL: 1.0}), measured)
    scaled = ScaledObjective.at(objective, values + 0.5)
    assert scaled.scale == pytest.approx(2.0 * 0.5 / np.sqrt(0.4)) and scaled.objective is objective
    np.testing.assert_allclose(scaled.residuals(values[:, :, None] + 3.0), 2.0 * 3.0 / scaled.scale)
    assert 0.0 < ScaledObjective.at(objective, values).scale < 1e-100
