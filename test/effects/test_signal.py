# SPDX-License-Identifier: Apache-2.0
"""The second-order stage of low-pass and mount resonance, against closed forms and an integrator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import freqs

from suspension_twin.effects._signal import STATES, second_order


def through(
    x: np.ndarray, t: np.ndarray, omega: float, zeta: float, feed: float = 0.0, pieces: int = 1
) -> np.ndarray:
    signals = np.zeros((t.size, 7, 1))
    signals[:, 2, 0] = x
    fresh = np.zeros(t.size, dtype=bool)
    fresh[0] = True
    state = np.zeros((STATES, 1))
    for part in np.array_split(np.arange(t.size), pieces):
        own = np.ascontiguousarray(signals[part])
        second_order(own, t[part], fresh[part], 2, 1, 0, omega, zeta, feed, 1.0, state)
        signals[part] = own
    return signals[:, 2, 0]


@pytest.mark.parametrize("hertz", [3.0, 8.0, 12.0])
@pytest.mark.parametrize(("cutoff", "feeds"), [(42.0, False), (15.0, False), (25.0, True)])
def test_at_a_phones_hundred_hertz_a_wheels_hop_keeps_its_size(
    hertz: float, cutoff: float, feeds: bool
) -> None:
    """Lines between stamps would take 5 % off it at 12 Hz."""
    t = np.arange(0.0, 6.0, 0.01) + np.random.default_rng(3).uniform(-5e-4, 5e-4, 600)
    omega, zeta = 2 * np.pi * cutoff, 0.7
    feed = 2 * zeta * omega if feeds else 0.0
    read = through(np.sin(2 * np.pi * hertz * t), t, omega, zeta, feed)
    late = t > 2.0
    basis = np.stack([np.sin(2 * np.pi * hertz * t[late]), np.cos(2 * np.pi * hertz * t[late])], axis=1)
    real, imaginary = np.linalg.lstsq(basis, read[late], rcond=None)[0]
    true = freqs([feed, omega**2], [1.0, 2 * zeta * omega, omega**2], [2 * np.pi * hertz])[1][0]
    found = complex(real, imaginary)
    assert abs(found) == pytest.approx(abs(true), rel=0.01)
    assert np.angle(found / true) == pytest.approx(0.0, abs=0.03)


def test_parabolas_pass_exactly_however_the_stamps_jitter() -> None:
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.004, 0.02, 60))
    omega, zeta = 2 * np.pi * 9.0, 0.2

    def x(s: np.ndarray | float) -> np.ndarray:
        return np.asarray(1.0 + 2.0 * (s - t[0]) - 3.0 * (s - t[0]) ** 2)

    exact = solve_ivp(
        lambda s, y: [y[1], x(s) - 2 * zeta * omega * y[1] - omega**2 * y[0]],
        (t[1], t[-1]),
        [0.0, 0.0],
        t_eval=t[1:],
        rtol=1e-11,
        atol=1e-13,
    ).y
    read = through(x(t), t, omega, zeta)
    # before the second stamp nothing is known of the bend; what differs from there on swings freely
    free = read[1:] - omega**2 * exact[0]
    swing = np.exp(-zeta * omega * (t[1:] - t[1]))[:, None] * np.stack(
        [
            np.cos(omega * np.sqrt(1 - zeta**2) * (t[1:] - t[1])),
            np.sin(omega * np.sqrt(1 - zeta**2) * (t[1:] - t[1])),
        ],
        axis=1,
    )
    left = free - swing @ np.linalg.lstsq(swing, free, rcond=None)[0]
    assert np.abs(free).max() > 1e-3 and np.abs(left).max() < 1e-7


def test_piece_by_piece_is_the_same() -> None:
    t = np.arange(0.0, 2.0, 0.01)
    x = np.random.default_rng(1).standard_normal(t.size)
    whole, pieces = (through(x, t, 80.0, 0.3, pieces=n) for n in (1, t.size))
    assert np.array_equal(whole, pieces)


def test_axes_together_are_axes_alone() -> None:
    """With steps that they have in common, and where one has begun later than the others."""
    rng = np.random.default_rng(7)
    t = np.cumsum(rng.uniform(0.004, 0.02, 80))
    fresh = np.zeros(80, dtype=bool)
    fresh[[0, 40]] = True
    x = rng.normal(size=(80, 7, 3))
    x[:, 6] = x[:, 2]
    state = np.zeros((6 * STATES, 3))
    state[3 * STATES + 3] = t[0] - 0.1  # an axis whose last stamp is another one
    alone, apart = x.copy(), state.copy()
    for axis in range(6):
        one = apart[STATES * axis : STATES * (axis + 1)].copy()
        second_order(alone, t, fresh, axis, 1, 1, 60.0, 0.7, 0.0, 1.0, one)
        apart[STATES * axis : STATES * (axis + 1)] = one
    second_order(x, t, fresh, 0, 6, 1, 60.0, 0.7, 0.0, 1.0, state)
    np.testing.assert_array_equal(x, alone)
    np.testing.assert_array_equal(state, apart)
    assert np.abs(x[:, 6, 1] - x[:, 2, 1]).max() < 1e-12
