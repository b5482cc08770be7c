# SPDX-License-Identifier: Apache-2.0
"""Weights of places along the road, and what follows of measured and expected signals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from suspension_twin.pose.place_bank import SHARES, PlaceBank, PlaceEvidence, correlate

OFFSETS = np.arange(-8.0, 8.01, 0.25)
FLOOR = np.array([0.05])


def evidence_of(measured: np.ndarray, expected: np.ndarray, batch: int = 10) -> np.ndarray:
    """Summed log-likelihood ratios (shares, p) of one signal ``measured`` (n,) and ``expected`` (n, p)."""
    evidence, total = PlaceEvidence(FLOOR, expected.shape[1]), np.zeros((SHARES.size, expected.shape[1]))
    for k in range(0, len(measured), batch):
        y, s = measured[k : k + batch], expected[k : k + batch]
        total += evidence.gain(
            0.01 * batch, y[:, None], (y @ s / batch)[:, None], np.mean(s**2, axis=0)[:, None]
        )
    return total


@given(
    st.lists(
        st.tuples(st.floats(-0.5, 0.5), st.floats(0.01, 2.0), st.floats(-3.0, 3.0), st.floats(0.3, 8.0)),
        min_size=1,
        max_size=8,
    ),
    st.integers(0, 1000),
)
def test_the_weights_sum_to_one(steps, seed):
    bank, rng = PlaceBank(OFFSETS), np.random.default_rng(seed)
    bank.begin(0.0, 2.5)
    for shift, wander, centre, sigma in steps:
        bank.move(0.1, shift, wander, (centre, sigma))
        bank.weigh(rng.normal(0.0, 300.0, bank.weights.shape))
        assert bank.weights.min() >= 0.0 and bank.null >= 0.0
        assert bank.weights.sum() + bank.null == pytest.approx(1.0, abs=1e-12)
        assert OFFSETS[0] <= bank.mean <= OFFSETS[-1] and 0.0 < bank.spread < 20.0


@pytest.mark.parametrize("shift", [-0.7, 0.0, 0.1, 0.4])
def test_a_place_that_moves_is_followed(shift):
    bank = PlaceBank(OFFSETS)
    bank.begin(1.0, 0.5)
    before = bank.mean
    bank.move(0.0, shift, 0.2, (1.0, 0.5))
    assert bank.mean - before == pytest.approx(shift, abs=0.03)
    assert bank.spread == pytest.approx(np.hypot(0.5, 0.2), rel=0.03)


def test_without_evidence_all_returns_to_the_receiver():
    bank = PlaceBank(OFFSETS)
    bank.begin(5.0, 0.2)
    for _ in range(4000):
        bank.move(6.0, 0.0, 0.05, (-1.0, 1.5))
    assert bank.mean == pytest.approx(-1.0, abs=0.05)
    assert bank.spread == pytest.approx(1.5, rel=0.1)
    assert bank.null == pytest.approx(0.5, abs=0.01)


def test_a_bump_like_one_of_the_map_does_not_outweigh_the_road_before_it():
    """After a road that is not the map's; at first it does, and more of it does."""
    fresh, bank = PlaceBank(OFFSETS), PlaceBank(OFFSETS)
    fresh.begin(0.0, 2.5)
    bank.begin(0.0, 2.5)
    for _ in range(200):
        bank.move(0.1, 0.0, 0.05, (0.0, 2.5))
        bank.weigh(np.full(bank.weights.shape, -3.0))
    assert bank.null > 0.9999
    like_a_bump = np.full(bank.weights.shape, -3.0)
    like_a_bump[:, 32] = 1.2
    for one in (fresh, bank):
        for _ in range(10):
            one.weigh(like_a_bump)
    assert fresh.null < 0.001 and bank.null > 0.9
    for _ in range(10):
        bank.weigh(like_a_bump)
    assert bank.null < 0.01


def test_a_quiet_signal_on_a_flat_road_says_nothing():
    """No place and no hypothesis gains anything, to the last bit."""
    noise = 0.03 * np.random.default_rng(1).standard_normal(500)
    assert np.all(evidence_of(noise, np.zeros((500, 20))) == 0.0)


def test_a_lively_signal_on_a_flat_road_is_no_evidence_for_it():
    total = evidence_of(np.random.default_rng(1).standard_normal(500), np.zeros((500, 20)))
    assert total.max() < -10.0 and np.ptp(total, axis=1).max() == 0.0


@pytest.mark.parametrize("left", [0.1, 0.2, 0.4])
def test_the_place_that_is_felt_wins_and_the_share_that_is_left_is_found(left):
    rng = np.random.default_rng(3)
    road = np.convolve(rng.standard_normal(1200), np.hanning(15), mode="same")
    road /= road.std()
    expected = np.stack([np.roll(road, -8 * k)[:800] for k in range(20)], axis=1)
    other = np.convolve(rng.standard_normal(800), np.hanning(15), mode="same")
    measured = expected[:, 7] + left * other / other.std()
    total = evidence_of(measured, expected)
    share, place = np.unravel_index(total.argmax(), total.shape)
    assert place == 7 and total.max() > 20.0
    assert SHARES[share] == SHARES[np.abs(SHARES - left).argmin()]
    unrelated = evidence_of(other / other.std(), expected)
    assert unrelated.max() < 0.0


def test_places_between_lanes_felt_what_the_lane_ahead_felt_before():
    rng = np.random.default_rng(0)
    history, measured = rng.standard_normal((40, 2, 3)), rng.standard_normal((5, 2))
    rows = np.arange(30.0, 35.0)[:, None] - np.array([0.0, 1.5, 3.0, 4.5])
    products, squares = np.empty((2, 9, 2))
    correlate(history, rows, measured, products, squares)
    before = 0.5 * (history[[28, 29, 30, 31, 32], :, 2] + history[[29, 30, 31, 32, 33], :, 2])
    np.testing.assert_allclose(products[7], np.mean(measured * before, axis=0))
    np.testing.assert_allclose(squares[7], np.mean(before**2, axis=0))
    np.testing.assert_allclose(squares[0], np.mean(history[30:35, :, 0] ** 2, axis=0))
    np.testing.assert_allclose(squares[4], np.mean(history[30:35, :, 1] ** 2, axis=0))
