# SPDX-License-Identifier: Apache-2.0
"""Objectives: the papers' formulas, and sums of squares that order candidates as the costs do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from suspension_twin.errors import InputError
from suspension_twin.inference.objectives import Measured, Objective, Term, parse_objective
from suspension_twin.signals.metrics import iso18571

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


# -- every term by its formula -------------------------------------------------------------------------------------


def levels(values: np.ndarray, segments: list[slice], rate: float) -> np.ndarray:
    """Logarithms of the power in sixth-octave bands from 0.5 Hz to four tenths of the rate: a band without a line of
    the spectrum is left out. The segments count by their length, those of less than half a window not at all."""
    window = min(max(s.stop - s.start for s in segments), 4 * int(rate))
    power, samples = np.zeros(window // 2 + 1), 0
    for s in segments:
        n = s.stop - s.start
        if n >= window // 2:
            f, p = signal.welch(values[s], rate, nperseg=min(window, n), nfft=window, detrend="constant")
            power, samples = power + n * p, samples + n
    found, k = [], 0
    while 0.5 * 2.0 ** ((k + 1) / 6) <= 0.4 * rate:
        inside = (f >= 0.5 * 2.0 ** (k / 6)) & (f < 0.5 * 2.0 ** ((k + 1) / 6))
        if inside.any():
            found.append(np.log10(power[inside].mean() / samples))
        k += 1
    return np.array(found)


@pytest.mark.parametrize("rate", [RATE, 50.0, 101.0, 33.5])
@pytest.mark.parametrize(
    "cuts", [[0, 900], [0, 500, 900], [0, 600, 850, 900]], ids=["one", "two", "one too short"]
)
def test_spectral_is_the_mean_square_of_differences_of_levels(rate: float, cuts: list[int]) -> None:
    rng = np.random.default_rng(4)
    values = np.cumsum(rng.standard_normal((900, 2)), axis=0) + 5.0
    candidate = values + rng.standard_normal((900, 2)) + 3.0
    segments = [slice(a, b) for a, b in zip(cuts, cuts[1:], strict=False)]
    here = Measured(CHANNELS, values, tuple(segments), rate)
    wanted = [
        np.mean((levels(candidate[:, c], segments, rate) - levels(values[:, c], segments, rate)) ** 2)
        for c in range(2)
    ]
    objective = build("0.7*spectral", here, {CHANNELS[0]: 1.0, CHANNELS[1]: 4.0})
    assert objective.costs(candidate[:, :, None])[0] == pytest.approx(0.7 * wanted[0] + 2.8 * wanted[1])


def test_silence_has_a_level() -> None:
    here = Measured(CHANNELS[:1], np.ones((900, 1)), (slice(0, 900),), RATE)
    assert build("spectral", here).costs(np.full((900, 1, 1), 3.0))[0] == pytest.approx(0.0, abs=1e-12)


def test_a_drive_too_short_for_a_spectrum_is_named() -> None:
    here = Measured(CHANNELS[:1], np.ones((2, 1)), (slice(0, 2),), RATE)
    with pytest.raises(InputError, match=r"spectral.*too short.*vertical_acceleration"):
        build("spectral", here)


def test_each_kind_weighs_channels_and_terms(measured: Measured, candidates: np.ndarray) -> None:
    off = candidates - measured.values[:, :, None]
    mean = (off**2).mean(axis=0)
    pearson = [
        [1.0 - np.corrcoef(measured.values[:, c], candidates[:, c, k])[0, 1] for k in range(5)]
        for c in range(2)
    ]
    both = {CHANNELS[0]: 1.0, CHANNELS[1]: 4.0}
    np.testing.assert_allclose(
        build("0.5*mse", measured, both).costs(candidates), 0.5 * (mean[0] + 4 * mean[1])
    )
    mixed = build("mse+3*correlation", measured, both).costs(candidates)
    wanted = mean[0] + 4.0 * mean[1] + 3.0 * np.array(pearson[0]) + 12.0 * np.array(pearson[1])
    np.testing.assert_allclose(mixed, wanted, atol=1e-9)
    rooted = build("2*euclidean+mse", measured, both).costs(candidates)
    distance = 2.0 * np.sqrt((off[:, 0] ** 2).sum(axis=0) + 16.0 * (off[:, 1] ** 2).sum(axis=0))
    np.testing.assert_allclose(rooted, distance + mean[0] + 4.0 * mean[1])


def test_residuals_are_one_row_a_sample_and_one_block_a_term(
    measured: Measured, candidates: np.ndarray
) -> None:
    two = build("mse", measured, {CHANNELS[1]: 1.0, CHANNELS[0]: 4.0}).residuals(candidates)
    off = (candidates - measured.values[:, :, None]) / np.sqrt(900)
    np.testing.assert_allclose(two, np.concatenate([off[:, 1], 2.0 * off[:, 0]]))
    one = build("3*euclidean", measured).residuals(candidates)
    np.testing.assert_allclose(one, 3.0 * (candidates[:, 0] - measured.values[:, 0, None]))


def test_a_constant_has_no_direction(measured: Measured) -> None:
    flat = np.full((900, 2, 1), 2.0)
    assert build("correlation", measured).costs(flat)[0] == pytest.approx(0.5)
    still = Measured(CHANNELS, np.full((900, 2), 3.0), (slice(0, 900),), RATE)
    assert build("correlation", still).costs(flat)[0] == 0.0


def test_a_rating_is_one_less_that_of_the_standard(measured: Measured, candidates: np.ndarray) -> None:
    whole = Measured(CHANNELS, measured.values, (slice(0, 900),), RATE)
    costs = build("iso18571", whole, {CHANNELS[1]: 2.5}).costs(candidates)
    ratings = [iso18571(measured.values[:, 1], candidates[:, 1, k], RATE).overall for k in range(5)]
    np.testing.assert_allclose(costs, 2.5 * (1.0 - np.array(ratings)))
    both = build("iso18571+mse", whole).costs(candidates)
    own = [iso18571(measured.values[:, 0], candidates[:, 0, k], RATE).overall for k in range(5)]
    mean = ((candidates[:, 0] - measured.values[:, 0, None]) ** 2).mean(axis=0)
    np.testing.assert_allclose(both, 1.0 - np.array(own) + mean)


def test_a_cost_of_squares_has_a_root_where_there_is_a_distance(measured: Measured) -> None:
    assert build("euclidean", measured).cost_of_squares(9.0) == 3.0
    assert build("mse+spectral", measured).cost_of_squares(9.0) == 9.0


def test_what_can_be_least_squares(measured: Measured) -> None:
    for text, whether in (
        ("euclidean", True), ("2*euclidean+euclidean", True), ("mse+correlation+spectral", True),
        ("mse+euclidean", False), ("iso18571", False), ("euclidean+iso18571", False),
    ):  # fmt: skip
        assert build(text, measured).is_least_squares == whether, text


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("mse", [("mse", 0, 2.0), ("mse", 1, 0.5)]),
        (" 1e-1 * mse +spectral ", [("mse", 0, 0.2), ("mse", 1, 0.05), ("spectral", 0, 2.0), ("spectral", 1, 0.5)]),
        ("4*iso18571", [("iso18571", 0, 8.0), ("iso18571", 1, 2.0)]),
    ],
)  # fmt: skip
def test_an_objective_is_a_term_for_each_kind_and_channel(
    text: str, terms: list[tuple[str, int, float]]
) -> None:
    """But for channels of no weight."""
    found = parse_objective(text, {CHANNELS[0]: 2.0, CHANNELS[1]: 0.5, "roll_rate": 0.0})
    assert [(t.kind, t.channel) for t in found] == [(kind, CHANNELS[c]) for kind, c, _ in terms]
    assert [t.weight for t in found] == pytest.approx([weight for _, _, weight in terms])


@pytest.mark.parametrize(
    "text", ["0*mse", "-*mse", "mse spectral", "2*", "MSE", "", "mse++mse", "2mse", "nan*mse"]
)
def test_what_is_no_objective_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="objective"):
        parse_objective(text, {CHANNELS[0]: 1.0})


def test_channels_are_those_that_the_vehicles_model_has() -> None:
    assert parse_objective("mse", {"heave": 1.0}, ("heave", "pitch")) == (Term("mse", "heave"),)
    with pytest.raises(InputError, match="roll: no such channel: one of heave, pitch"):
        parse_objective("mse", {"heave": 1.0, "roll": 1.0}, ("heave", "pitch"))


@pytest.mark.parametrize(
    ("bandwidth", "rate", "share"), [(20.0, 100.0, 0.4), (5.0, 40.0, 0.25), (50.0, 60.0, 1.0)]
)
def test_a_low_pass_leaves_twice_its_cut_off_over_the_rate(
    bandwidth: float, rate: float, share: float
) -> None:
    here = Measured(CHANNELS, np.zeros((3, 2)), (slice(0, 3),), rate, bandwidth=bandwidth)
    assert here.independent == pytest.approx(share)
    assert [here.column(c) for c in CHANNELS] == [0, 1]
    assert Measured(CHANNELS, np.zeros((3, 2)), (slice(0, 3),), 100.0).drives == ()
