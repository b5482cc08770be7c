# SPDX-License-Identifier: Apache-2.0
"""Noise and model discrepancy: densities, shares of the motion, and filters that leave white residuals of one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from suspension_twin.identification.noise import ScaledObjective, Whitener, density, shares
from suspension_twin.identification.objectives import Measured, Objective, parse_objective

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
