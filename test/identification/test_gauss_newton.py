# SPDX-License-Identifier: Apache-2.0
"""The bounded Gauss-Newton on problems whose minimum is known, and its state taken up again."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

from suspension_twin.identification.gauss_newton import (
    GaussNewton,
    GaussNewtonSettings,
    Quadratic,
    bounded_step,
    solve_positive,
)


class Rosenbrock:
    """The valley function as least squares in two unknowns."""

    def residuals(self, x: np.ndarray) -> np.ndarray:
        return np.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def quadratic(self, x: np.ndarray) -> Quadratic:
        r, j = self.residuals(x), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
        return Quadratic(float(r @ r), j.T @ j, j.T @ r)

    def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
        return np.asarray((self.residuals(x) ** 2).sum(axis=0))


START, FREE = np.array([-1.2, 1.0]), (np.zeros((2, 2)), np.zeros(2))


def test_it_goes_down_the_valley_and_continues_to_the_same_bits() -> None:
    whole = GaussNewton(Rosenbrock(), START, *FREE)
    whole.run()
    assert_allclose(whole.x, 1.0, atol=1e-4)
    part, again = (GaussNewton(Rosenbrock(), START, *FREE) for _ in range(2))
    for _ in range(4):
        part.step()
    again.restore(*part.state())
    again.run()
    assert np.array_equal(again.x, whole.x) and again.iteration == whole.iteration


def test_bounds_hold_and_the_end_is_the_constrained_minimum() -> None:
    solver = GaussNewton(
        Rosenbrock(),
        START,
        *FREE,
        np.full(2, -2.0),
        np.array([0.5, 2.0]),
        GaussNewtonSettings(tolerance=1e-12),
    )
    solver.run()
    assert_allclose(solver.x, [0.5, 0.25], atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_problem_with_prior_and_bounds_is_least_squares_with_bounds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((40, 4)), 3.0 * rng.standard_normal(40)
    weight, centre = np.array([1.0, 2.0, 3.0, 4.0]), np.arange(4.0)

    class Linear:
        def quadratic(self, x: np.ndarray) -> Quadratic:
            r = a @ x - b
            return Quadratic(float(r @ r), a.T @ a, a.T @ r)

        def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
            return np.asarray(((a @ x - b[:, None]) ** 2).sum(axis=0))

    low, high = np.full(4, -0.1), np.full(4, 0.3)
    solver = GaussNewton(
        Linear(), np.zeros(4), np.diag(weight), centre, low, high, GaussNewtonSettings(tolerance=1e-14)
    )
    solver.run()
    root = np.diag(np.sqrt(weight))
    best = lsq_linear(np.vstack([a, root]), np.concatenate([b, root @ centre]), (low, high), tol=1e-14)
    assert_allclose(solver.x, best.x, atol=1e-5)
    free = GaussNewton(
        Linear(), np.zeros(4), np.diag(weight), centre, settings=GaussNewtonSettings(tolerance=1e-14)
    )
    free.run()
    assert_allclose(free.x, np.linalg.solve(a.T @ a + root**2, a.T @ b + root**2 @ centre), rtol=1e-6)


def test_it_stops_when_told_and_survives_failed_candidates() -> None:
    class Cliff(Rosenbrock):
        def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
            return np.where(np.abs(x[0]) > 1.25, np.nan, super().sums_of_squares(x))

    solver = GaussNewton(Cliff(), START, *FREE)
    solver.run(lambda: True)
    assert solver.iteration == 0
    solver.run()
    assert_allclose(solver.x, 1.0, atol=1e-4)


def test_a_search_whose_every_candidate_fails_ends_where_it_began() -> None:
    class Nowhere(Rosenbrock):
        def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
            return np.full(x.shape[1], np.inf)

    solver = GaussNewton(Nowhere(), START, *FREE)
    solver.run()
    assert np.array_equal(solver.x, START) and solver.finished


def test_a_badly_scaled_system_is_solved() -> None:
    rng = np.random.default_rng(2)
    a = rng.standard_normal((300, 7)) * 10.0 ** np.arange(-6, 8, 2)
    x = rng.standard_normal(7) / 10.0 ** np.arange(-6, 8, 2)
    assert_allclose(solve_positive(a.T @ a, a.T @ (a @ x)), x, rtol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_a_step_that_ends_at_bounds_is_the_best_there(seed: int) -> None:
    """Against least squares with bounds, begun inside and on bounds; what a bound held is let go where it should be."""
    rng = np.random.default_rng(seed)
    a, b, x = rng.normal(size=(60, 12)) + 2.0, 60 * rng.normal(size=60), rng.uniform(-3.0, 3.0, 12)
    x[:3] = 3.0
    low, high = np.full(12, -3.0), np.full(12, 3.0)
    low[11], high[11] = -np.inf, np.inf
    step = bounded_step(a.T @ a, (a.T @ (a @ x - b))[:, None], low - x, high - x)[:, 0]
    best = lsq_linear(a, b, (low, high), tol=1e-12)
    assert (best.active_mask != 0).sum() >= 2
    assert_allclose(x + step, best.x, atol=1e-4)
