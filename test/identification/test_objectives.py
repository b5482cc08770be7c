# SPDX-License-Identifier: Apache-2.0
"""Objectives: the papers' formulas, and sums of squares that order candidates as the costs do."""

from __future__ import annotations

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.identification.objectives import Measured, Objective, parse_objective

RATE = 100.0
CHANNELS = ("vertical_acceleration", "pitch_rate")


@pytest.fixture(scope="module")
def measured() -> Measured:
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.standard_normal((900, 2)), axis=0)
    return Measured(CHANNELS, values - values.mean(axis=0), (slice(0, 500), slice(500, 900)), RATE)


@pytest.fixture(scope="module")
def candidates(measured: Measured) -> np.ndarray:
    """(M, C, L): the measured itself, then ever worse copies."""
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((*measured.values.shape, 5))
    return measured.values[:, :, None] + noise * np.arange(5)


def build(text: str, measured: Measured, channels: dict[str, float] | None = None) -> Objective:
    return Objective(parse_objective(text, channels or {"vertical_acceleration": 1.0}), measured)


def test_euclidean_is_eq_1(measured: Measured, candidates: np.ndarray) -> None:
    costs = build("euclidean", measured).costs(candidates)
    difference = candidates[:, 0] - measured.values[:, 0, None]
    np.testing.assert_allclose(costs, np.sqrt((difference**2).sum(axis=0)))


def test_several_channels_are_one_distance(measured: Measured, candidates: np.ndarray) -> None:
    costs = build("euclidean", measured, {CHANNELS[0]: 1.0, CHANNELS[1]: 3.0}).costs(candidates)
    difference = (candidates - measured.values[:, :, None]) * np.array([1.0, 3.0])[None, :, None]
    np.testing.assert_allclose(costs, np.sqrt((difference**2).sum(axis=(0, 1))))


def test_correlation_is_one_less_pearsons_and_blind_to_amplitude(
    measured: Measured, candidates: np.ndarray
) -> None:
    costs = build("correlation", measured).costs(candidates)
    expected = [1 - np.corrcoef(measured.values[:, 0], candidates[:, 0, k])[0, 1] for k in range(5)]
    np.testing.assert_allclose(costs, expected, atol=1e-12)
    np.testing.assert_allclose(
        build("correlation", measured).costs(3.0 * candidates + 7.0), expected, atol=1e-12
    )


@pytest.mark.parametrize("kind", ["euclidean", "mse", "correlation", "spectral", "iso18571"])
def test_the_measured_signal_itself_costs_nothing_and_worse_costs_more(
    kind: str, measured: Measured, candidates: np.ndarray
) -> None:
    costs = build(kind, measured).costs(candidates)
    assert costs[0] == pytest.approx(0.0, abs=1e-9)
    assert np.all(np.diff(costs) > 0)


@pytest.mark.parametrize(
    "text", ["euclidean", "mse", "correlation", "spectral", "mse+0.5*spectral", "2*mse + correlation"]
)
def test_squares_and_costs_agree(text: str, measured: Measured, candidates: np.ndarray) -> None:
    objective = build(text, measured, {CHANNELS[0]: 1.0, CHANNELS[1]: 0.5})
    assert objective.is_least_squares
    squares = (objective.residuals(candidates) ** 2).sum(axis=0)
    costs = [objective.cost_of_squares(s) for s in squares]
    np.testing.assert_allclose(costs, objective.costs(candidates), rtol=1e-9, atol=1e-12)


def test_spectral_sees_what_is_in_a_band_and_not_its_phase(measured: Measured) -> None:
    t = np.arange(900) / RATE
    values = np.sin(2 * np.pi * 3 * t)[:, None] + 0.01 * measured.values[:, :1]
    here = Measured(CHANNELS[:1], values, (slice(0, 900),), RATE)
    objective = build("spectral", here)
    shifted = np.sin(2 * np.pi * 3 * t + 1.0)[:, None, None] + 0.01 * measured.values[:, :1, None]
    doubled = 2.0 * here.values[:, :, None]
    assert objective.costs(doubled)[0] == pytest.approx(np.log10(4.0) ** 2, rel=1e-6)
    assert objective.costs(shifted)[0] < 0.2 * objective.costs(doubled)[0]


def test_spectral_ends_at_four_tenths_of_the_rate(measured: Measured) -> None:
    """Sixth octaves from 0.5 Hz on; what is above 40 of 100 Hz, the sensor's own filter has shaped."""
    t = np.arange(900) / RATE
    here = Measured(CHANNELS[:1], measured.values[:, :1], (slice(0, 900),), RATE)
    objective = build("spectral", here)
    above, below = (
        here.values[:, :, None] + 3.0 * np.sin(2 * np.pi * f * t)[:, None, None] for f in (45.0, 30.0)
    )
    assert objective.costs(above)[0] < 1e-3 < 0.05 < objective.costs(below)[0]


def test_a_rating_is_the_mean_over_the_segments_by_their_length(
    measured: Measured, candidates: np.ndarray
) -> None:
    one = candidates[:, :, 3:4].copy()
    one[: measured.segments[0].stop] = measured.values[: measured.segments[0].stop, :, None]
    (second,) = (s for s in measured.segments if s.start)
    alone = Measured(CHANNELS, measured.values[second], (slice(0, second.stop - second.start),), RATE)
    cost = build("iso18571", alone).costs(one[second])[0]
    share = (second.stop - second.start) / sum(s.stop - s.start for s in measured.segments)
    assert build("iso18571", measured).costs(one)[0] == pytest.approx(share * cost)


def test_mixtures_with_a_root_or_a_rating_are_no_sums_of_squares(
    measured: Measured, candidates: np.ndarray
) -> None:
    for text in ("euclidean+mse", "iso18571", "mse+iso18571"):
        objective = build(text, measured)
        assert not objective.is_least_squares
        assert np.isfinite(objective.costs(candidates[:, :, :2])).all()
    with pytest.raises(InputError, match="no sum of squares|not a sum of squares"):
        build("iso18571", measured).residuals(candidates)


@pytest.mark.parametrize(
    ("text", "channels", "words"),
    [
        ("euclid", {CHANNELS[0]: 1.0}, "euclid"),
        ("mse+", {CHANNELS[0]: 1.0}, "empty"),
        ("-1*mse", {CHANNELS[0]: 1.0}, "above 0"),
        ("1.2.3*mse", {CHANNELS[0]: 1.0}, "not a number"),
        ("mse", {"heave": 1.0}, "heave"),
        ("mse", {}, "no channel"),
    ],
)
def test_wrong_objectives_are_named(text: str, channels: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_objective(text, channels)
