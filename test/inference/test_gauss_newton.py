# SPDX-License-Identifier: Apache-2.0
"""The bounded Gauss-Newton on problems whose minimum is known, and its state taken up again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

from suspension_twin.inference.gauss_newton import (
    WHITENED,
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


def test_it_goes_down_the_valley() -> None:
    whole = GaussNewton(Rosenbrock(), START, *FREE)
    whole.run()
    assert_allclose(whole.x, 1.0, atol=1e-4)


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
    best = lsq_linear(a, b, (low, high), tol=1e-12)
    assert (best.active_mask != 0).sum() >= 2
    for size in (1.0, 1e-9):  # whatever the units of the residuals
        gradient = size * (a.T @ (a @ x - b))[:, None]
        step = bounded_step(size * a.T @ a, gradient, low - x, high - x)[:, 0]
        assert_allclose(x + step, best.x, atol=1e-4)


# -- a system and a step within bounds -----------------------------------------------------------------------------


@pytest.mark.parametrize("wide", [False, True])
def test_a_system_is_solved_for_one_right_side_and_for_several(wide: bool) -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(9, 4)) * [1.0, 1e3, 1e-3, 10.0]
    kept, right = a.T @ a, rng.normal(size=(4, 3) if wide else 4)
    matrix, given = kept.copy(), right.copy()
    found = solve_positive(matrix, given)
    assert found.shape == right.shape
    assert_allclose(found, np.linalg.solve(kept, right), rtol=1e-6)
    assert np.array_equal(matrix, kept) and np.array_equal(given, right)


def test_what_nothing_depends_on_does_not_move() -> None:
    """A coordinate without curvature, and two that only their sum is known of."""
    assert_allclose(solve_positive(np.diag([2.0, 0.0]), np.array([3.0, 0.0])), [1.5, 0.0])
    assert_allclose(solve_positive(np.ones((2, 2)), np.array([1.0, 1.0])), [0.5, 0.5], rtol=1e-6)


def best_within(hessian: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least of s^T H s + 2 g^T s within bounds, by trying every set of coordinates on their bounds."""
    found: list[tuple[float, np.ndarray]] = []
    for where in product((-1, 0, 1), repeat=gradient.size):
        at = np.array(where)
        step, free = np.where(at < 0, low, np.where(at > 0, high, 0.0)), at == 0
        if not np.isfinite(step).all():
            continue
        if free.any():
            step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free] + hessian[free] @ step)
        if (step >= low - 1e-12).all() and (step <= high + 1e-12).all():
            found.append((float(step @ hessian @ step + 2 * gradient @ step), step))
    return min(found, key=lambda one: one[0])[1]


@pytest.mark.parametrize("sides", ["low", "high", "both", "none"])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_steps_are_the_best_within_bounds_whatever_the_units(sides: str, size: float) -> None:
    """Several gradients at once; the same step for a quadratic model of another size."""
    rng = np.random.default_rng(7)
    a, gradient = rng.normal(size=(12, 3)) + 0.5, 3.0 * rng.normal(size=(3, 15))
    hessian = a.T @ a
    low = np.full(3, -0.3 if sides in ("low", "both") else -np.inf)
    high = np.full(3, 0.4 if sides in ("high", "both") else np.inf)
    steps = bounded_step(size * hessian, size * gradient, low, high)
    free = -np.linalg.solve(hessian, gradient)
    outside = ((free < low[:, None]) | (free > high[:, None])).any(axis=0)
    assert outside.any() == (sides != "none") and not outside.all()
    assert_allclose(steps[:, ~outside], free[:, ~outside], rtol=1e-6)
    for k in range(15):
        assert_allclose(steps[:, k], best_within(hessian, gradient[:, k], low, high), atol=1e-8)


def test_a_step_with_no_room_at_all_goes_nowhere() -> None:
    nothing = np.zeros(2)
    assert np.array_equal(
        bounded_step(np.eye(2), np.array([[3.0], [-3.0]]), nothing, nothing), [[0.0], [0.0]]
    )
    one_way = bounded_step(np.eye(2), np.array([[3.0], [-3.0]]), nothing, np.full(2, 9.0))
    assert_allclose(one_way, [[0.0], [3.0]])


# -- the search, candidate by candidate ----------------------------------------------------------------------------


class Scripted:
    """A quadratic model that is the same everywhere, and candidates whose least sum of squares is told: ``best`` at
    place ``at`` of each batch in turn, all others failing. After the last every candidate fails."""

    def __init__(self, squares: np.ndarray, slope: np.ndarray, best: Sequence[float], at: int = 0) -> None:
        self.squares, self.slope, self.best, self.at = squares, slope, list(best), at
        self.tried: list[np.ndarray] = []
        self.linearised: list[np.ndarray] = []

    def quadratic(self, x: np.ndarray) -> Quadratic:
        self.linearised.append(x.copy())
        return Quadratic(100.0, self.squares, self.slope)

    def sums_of_squares(self, x: np.ndarray) -> np.ndarray:
        self.tried.append(x.copy())
        out = np.full(x.shape[1], np.nan)
        if self.best:
            out[self.at] = self.best.pop(0)
        return out


SQUARES, SLOPE = np.array([[4.0, 1.0], [1.0, 9.0]]), np.array([-2.0, 5.0])
NOWHERE = np.zeros(2)


def scripted(
    settings: GaussNewtonSettings, *best: float, at: int = 0, precision: np.ndarray | None = None
) -> tuple[GaussNewton, Scripted]:
    told = Scripted(SQUARES, SLOPE, best, at)
    prior = np.zeros((2, 2)) if precision is None else precision
    return GaussNewton(told, np.array([0.5, -0.25]), prior, np.array([0.1, 0.2]), settings=settings), told


@pytest.mark.parametrize(
    "settings",
    [
        GaussNewtonSettings(damping=0.3),
        replace(WHITENED, damping=0.7),
        replace(WHITENED, damping=0.02, prior_damping=3.0, shortened=0.25),
    ],
)
def test_candidates_are_damped_steps_and_a_share_of_that_of_the_current_damping(
    settings: GaussNewtonSettings,
) -> None:
    """min s^T (H + D) s + 2 g^T s with D of the curvature's diagonal and of the prior's, which weighs more."""
    precision = np.array([[0.5, 0.1], [0.1, 2.0]])
    solver, told = scripted(settings, 1.0, precision=precision)
    x = solver.x.copy()
    solver.step()
    hessian, gradient = SQUARES + precision, SLOPE + precision @ (x - solver.centre)
    weight = np.diag(np.diag(hessian) + settings.prior_damping * np.diag(precision))
    steps = [
        -np.linalg.solve(hessian + settings.damping * factor * weight, gradient) for factor in settings.ladder
    ]
    if settings.shortened:
        steps.append(settings.shortened * steps[settings.ladder.index(1.0)])
    assert len(told.tried) == 1
    assert_allclose(told.tried[0], x[:, None] + np.stack(steps, axis=1), rtol=1e-6)


def test_no_step_goes_further_than_the_largest_and_keeps_its_direction() -> None:
    settings = GaussNewtonSettings(ladder=(0.0, 1.0), damping=1.0, largest_step=0.2, shortened=0.5)
    solver, told = scripted(settings, 1.0)
    x = solver.x.copy()
    solver.step()
    steps = told.tried[0] - x[:, None]
    free = -np.linalg.solve(SQUARES, SLOPE)
    assert_allclose(steps[:, 0], 0.2 * free / np.abs(free).max(), rtol=1e-6)
    assert np.abs(steps).max(axis=0) == pytest.approx([0.2, 0.2, 0.1])


def test_candidates_stay_within_bounds() -> None:
    solver, told = scripted(GaussNewtonSettings(ladder=(0.0, 1.0), damping=1.0, shortened=0.5), 1.0)
    solver.low, solver.high = np.array([0.4, -0.3]), np.array([0.6, 3.0])
    assert_allclose(solver.room(solver.x), ([-0.1, -0.05], [0.1, 3.25]))
    assert_allclose(solver.room(np.array([0.2, 4.0])), ([0.0, -4.3], [0.4, 0.0]))
    x = solver.x.copy()
    solver.step()
    assert (told.tried[0] >= solver.low[:, None]).all() and (told.tried[0] <= solver.high[:, None]).all()
    wanted = x + best_within(SQUARES, SLOPE, *solver.room(x))
    assert_allclose(told.tried[0][:, 0], wanted, rtol=1e-6)


def test_without_bounds_there_is_room_for_everything() -> None:
    solver, _ = scripted(GaussNewtonSettings())
    low, high = solver.room(solver.x)
    assert np.array_equal(low, [-np.inf] * 2) and np.array_equal(high, [np.inf] * 2)


def test_the_cost_is_the_sum_of_squares_and_that_of_the_prior() -> None:
    precision = np.array([[0.5, 0.1], [0.1, 2.0]])
    solver, _ = scripted(GaussNewtonSettings(), 7.0, at=1, precision=precision)
    x = np.array([[0.1, 1.1, 0.0], [0.2, 0.2, 0.0]])
    away = [x[:, k] - solver.centre for k in range(3)]
    prior = [float(a @ precision @ a) for a in away]
    assert_allclose(solver.penalty(x), prior)
    assert prior[0] == 0.0 < prior[1]
    costs, fits = solver.costs(x)
    assert_allclose(costs, [np.inf, 7.0 + prior[1], np.inf])
    assert fits[1] == 7.0


def test_it_begins_from_the_best_of_several_starts_within_the_bounds() -> None:
    solver = GaussNewton(Rosenbrock(), np.zeros(2), *FREE, np.full(2, -0.5), np.full(2, 0.5))
    solver.begin(np.array([[-4.0, 0.4, 0.0], [0.2, 9.0, 0.0]]))
    assert np.array_equal(solver.x, [0.0, 0.0]) and solver.cost == solver.fit == 1.0
    solver.begin(np.array([[0.9], [0.2]]))
    assert np.array_equal(solver.x, [0.5, 0.2]) and solver.fit == pytest.approx(100 * 0.05**2 + 0.25)
    kept = GaussNewton(Rosenbrock(), np.zeros(2), np.eye(2), np.array([3.0, 4.0]))
    kept.begin(np.zeros((2, 1)))
    assert kept.fit == 1.0 and kept.cost == 1.0 + 25.0


def test_a_step_takes_the_best_candidate_and_its_damping() -> None:
    for at, factor in enumerate((0.1, 1.0, 10.0, 10.0)):  # the last is the shortened step
        settings = GaussNewtonSettings(ladder=(0.1, 1.0, 10.0), damping=0.5, shortened=0.3)
        solver, told = scripted(settings, 60.0, at=at)
        solver.step()
        assert np.array_equal(solver.x, told.tried[0][:, at])
        assert solver.cost == solver.fit == 60.0 and solver.iteration == 1 and not solver.finished
        assert solver.damping == pytest.approx(0.5 * factor)
        relaxed, _ = scripted(replace(settings, relaxed=0.3), 60.0, at=at)
        relaxed.step()
        assert relaxed.damping == pytest.approx(0.15)
    least, _ = scripted(GaussNewtonSettings(ladder=(0.0, 1.0), damping=0.5, least_damping=0.02), 60.0)
    least.step()
    assert least.damping == 0.02


def test_the_cost_at_the_start_is_that_of_the_model_and_the_prior() -> None:
    solver, _ = scripted(GaussNewtonSettings(iterations=1), precision=np.diag([2.0, 4.0]))
    solver.step()
    assert solver.fit == 100.0 and solver.cost == pytest.approx(100.0 + 2.0 * 0.4**2 + 4.0 * 0.45**2)


def test_a_failed_ladder_is_tried_again_from_the_same_place_with_more_damping() -> None:
    settings = GaussNewtonSettings(ladder=(1.0,), damping=0.5, raised=4.0)
    solver, told = scripted(settings, 100.0, 100.0, 99.0)  # no better is none
    x = solver.x.copy()
    solver.step()
    assert len(told.linearised) == 1 and solver.iteration == 3 and solver.cost == 99.0
    for k, damping in enumerate((0.5, 2.0, 8.0)):
        step = -np.linalg.solve(SQUARES + damping * np.diag(np.diag(SQUARES)), SLOPE)
        assert_allclose(told.tried[k][:, 0], x + step, rtol=1e-6)
    assert solver.damping == pytest.approx(8.0) and not solver.finished


@pytest.mark.parametrize(("iterations", "largest", "tried"), [(5, 1e9, 5), (50, 8.0, 3), (50, 7.9, 2)])
def test_a_search_that_gets_no_better_ends(iterations: int, largest: float, tried: int) -> None:
    """After as many ladders as are allowed, or where the damping exceeds its largest: 0.5, 2, 8, 32."""
    settings = GaussNewtonSettings(
        iterations=iterations, damping=0.5, raised=4.0, largest_damping=largest, ladder=(1.0,)
    )
    solver, told = scripted(settings, *[100.0] * 99)
    solver.run()
    assert solver.finished and solver.iteration == len(told.tried) == tried
    assert np.array_equal(solver.x, [0.5, -0.25]) and solver.cost == 100.0


@pytest.mark.parametrize(
    ("costs", "changes", "iterations"),
    [
        ((60.0, 59.9, 59.8, 1.0), {"tolerance": 0.01}, 3),  # two calm ones in a row
        ((60.0, 59.9, 40.0, 39.9, 39.8, 1.0), {"tolerance": 0.01}, 5),
        ((99.0, 98.5, 98.0, 1.0), {"tolerance": 0.01}, 3),  # a share of exactly that is not calm
        ((99.5, 99.0, 98.5, 98.25, 98.0, 1.0), {"tolerance": 0.0, "absolute": 0.5}, 5),
        ((60.0, 59.9, 1.0), {"tolerance": 0.01, "patience": 1}, 2),
        ((60.0, 59.9, 59.8, 59.7, 1.0), {"tolerance": 0.01, "patience": 3}, 4),
        ((60.0, 40.0, 20.0, 10.0), {"tolerance": 0.01, "iterations": 3}, 3),
    ],
)
def test_calm_iterations_end_the_search(
    costs: tuple[float, ...], changes: dict[str, float], iterations: int
) -> None:
    solver, _ = scripted(GaussNewtonSettings(**changes), *costs)  # type: ignore[arg-type]
    seen: list[float] = []
    solver.run(each=lambda one: seen.append(one.cost))
    assert solver.finished and solver.iteration == iterations
    assert seen == list(costs[:iterations])


def test_a_search_ends_where_the_undamped_step_is_not_worth_it() -> None:
    """It is predicted to lower the cost by g^T H^-1 g."""
    predicted = float(SLOPE @ np.linalg.solve(SQUARES, SLOPE))
    for worthwhile, tried in ((1.001 * predicted, 0), (0.999 * predicted, 1)):
        settings = GaussNewtonSettings(ladder=(0.0, 1.0), absolute=worthwhile, iterations=1)
        solver, told = scripted(settings, 60.0)
        solver.run()
        assert len(told.tried) == tried and solver.finished and solver.iteration == 1
    damped, told = scripted(GaussNewtonSettings(ladder=(1.0,), absolute=1e3 * predicted, iterations=1), 60.0)
    damped.run()
    assert len(told.tried) == 1  # without an undamped step nothing is predicted
