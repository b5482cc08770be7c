# SPDX-License-Identifier: Apache-2.0
"""Fits that have to leave a valley to find the right one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from one_channel import Formula
from scipy.optimize import lsq_linear

from suspension_twin.inference import cross_validation, fit
from suspension_twin.inference.cross_validation import FOLDS, Blocks, held_out, intervals
from suspension_twin.inference.fit import LinearisedFit, coordinate_scan, fitted, refit, screen
from suspension_twin.inference.hypothesis import BASELINE, Hypothesis
from suspension_twin.inference.problem import Linearised

STOP = Hypothesis(("rebound_stop",))
TRUTH = np.array([0.7, -1.2, 0.4])
CENTRE = np.array([0.0, 0.0, 1.0, 0.0])


def valleys(x: np.ndarray) -> np.ndarray:
    """(R, L) residuals of one characteristic and a stop's three coordinates: the second is flat beyond 0.3, as a
    clearance is that nothing touches, and the characteristic makes up for a part of it."""
    touch = np.minimum(x[2], 0.3)
    wanted = min(TRUTH[1], 0.3)
    return np.stack(
        [
            20 * (x[1] - TRUTH[0]),
            30 * (touch - wanted) + 8 * (x[0] - 0.5),
            10 * (x[3] - TRUTH[2]),
            9 * (x[0] - 0.5),
        ]
    )


@pytest.fixture
def problem() -> Any:
    """A vehicle with one unknown and a stop."""
    return Formula(valleys, 1, 0, 1e-2 * np.eye(4), CENTRE).having(STOP)


def at(problem: Any, x: np.ndarray) -> LinearisedFit:
    return LinearisedFit(STOP, x, float(problem.costs(x[:, None])[0]), problem.linearise(x))


def test_a_coordinate_that_nothing_touches_is_swept_into_the_valley(problem: Any) -> None:
    stuck, cost = refit(problem, [np.array([0.0, 0.6, 1.0, 0.0])], None, 30)
    assert stuck[2] > 0.3 and cost > 500, "no descent gets out of there"
    begun = coordinate_scan(problem, at(problem, stuck))
    assert begun is not None
    found, cost = refit(problem, [begun], None, 30)
    assert_allclose(found[1:], TRUTH, atol=0.02)
    assert cost < 1.0


def test_a_fit_is_linearised_where_it_ends_and_nowhere_twice(problem: Any) -> None:
    places, tried, linearise, residuals = [], [], problem.linearise, problem.residuals
    problem.linearise = lambda x: (places.append(tuple(x)), linearise(x))[1]
    problem.residuals = lambda x: (tried.append(x), residuals(x))[1]
    found = fitted(problem, [np.array([0.0, 0.6, 0.2, 0.0])], 30)
    assert_allclose(found.x[1:], TRUTH, atol=0.02)
    assert_allclose(found.at.x, found.x, atol=0.0)
    assert found.cost == pytest.approx(float(problem.costs(found.x[:, None])[0]), rel=1e-9)
    assert len(set(places)) == len(places)
    places.clear(), tried.clear()
    again = fitted(problem, [found.x], 30)
    assert_allclose(again.x, found.x, atol=0.0)
    assert (len(places), len(tried)) == (1, 1), "no step could gain anything, so none is tried"


def test_a_sparing_fit_linearises_half_as_often(problem: Any) -> None:
    """And comes to the same place: in between, the effect's own columns alone are anew."""
    places, linearise = [], problem.linearise

    def alone(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here = linearise(x)
        return here.residual, np.ascontiguousarray(here.jacobian[:, 1:])

    problem.linearise = lambda x: (places.append(tuple(x)), linearise(x))[1]
    problem.effect_columns = alone
    start = np.array([0.0, 0.6, 0.2, 0.0])
    whole, _ = refit(problem, [start], None, 30)
    often = len(places)
    spared, _ = refit(problem, [start], None, 30, alternate_jacobian=True)
    assert_allclose(spared, whole, atol=0.02)
    assert often > 1 and len(places) - often <= (often + 1) // 2


def test_a_step_that_fails_is_tried_shorter_from_the_same_linearisation(problem: Any) -> None:
    """All but short steps break off, as a simulation does."""
    places, linearise = [], problem.linearise
    start = np.array([0.0, 0.6, 0.2, 0.0])
    problem.linearise = lambda x: (places.append(tuple(x)), linearise(x))[1]
    problem.residuals = lambda x: (valleys(x), np.abs(x - start[:, None]).max(axis=0) >= 0.02)
    _, cost = refit(problem, [start], None, 5)
    assert cost < float(problem.costs(start[:, None])[0])
    assert len(set(places)) == len(places) < 5


def test_what_is_best_stays(problem: Any) -> None:
    best, _ = refit(problem, [np.array([0.5, *TRUTH])], None, 30)
    assert coordinate_scan(problem, at(problem, best)) is None


def test_candidates_that_fail_are_passed_over(problem: Any) -> None:
    stuck, _ = refit(problem, [np.array([0.0, 0.6, 1.0, 0.0])], None, 30)
    problem.residuals = lambda x: (np.zeros((4, x.shape[1])), np.ones(x.shape[1], dtype=bool))
    assert coordinate_scan(problem, at(problem, stuck)) is None


def walled(x: np.ndarray) -> np.ndarray:
    """(R, L) residuals of two characteristics: what little there is of the first pulls it into a wall."""
    wall = 1e3 * np.maximum(x[0] - 0.1, 0.0) ** 2
    return np.stack(
        [0.5 * (x[0] - 1.0), wall, 30 * (np.exp(x[1]) - 2.0), 20 * (np.sin(x[1]) + 0.2 * x[1] ** 2 - 0.7)]
    )


def test_a_wall_beside_what_nothing_tells_does_not_hold_back_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = Formula(walled, 2, 0, 0.1 * np.eye(2))
    _, best = refit(problem, [np.array([0.12, 0.7])], None, 60)
    start = [np.array([-0.5, -1.0])]
    _, cost = refit(problem, start, None, 3)
    assert cost < best + 1.0
    monkeypatch.setattr(fit, "FIT_SETTINGS", replace(fit.FIT_SETTINGS, prior_damping=0.0))
    _, cost = refit(problem, start, None, 3)
    assert cost > best + 10.0


def test_what_one_fold_alone_tells_of_the_vehicle_is_not_lost_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An effect, though, has to do without."""
    hypothesis = Hypothesis(("tyre_damping",))
    rows = np.arange(60) % FOLDS

    def shape(x: np.ndarray) -> np.ndarray:
        vehicle, effect = (np.where(rows == 2, np.arange(60) // 5 % 2 == i, 0)[:, None] for i in (0, 1))
        return np.asarray(vehicle * 40 * (np.exp(-3 * (x[0] - 0.8)) - 1.0) + effect * 4 * (x[1] - 0.9))

    problem: Any = Formula(shape, 1, 0, np.eye(2)).having(hypothesis)
    x, cost = refit(problem, [np.array([0.5, 1.0])], None, 60)
    at = LinearisedFit(hypothesis, x, cost, problem.linearise(x))
    blocks = Blocks(rows, rows, FOLDS)
    fitted = np.sum(at.at.residual**2)
    out = held_out(problem, at, blocks)
    assert_allclose(out.unknowns[0], x[0], atol=0.02)
    assert out.unknowns[1, 2] == pytest.approx(0.0, abs=1e-6) and x[1] > 0.8
    moved = shape(np.array([[x[0]], [0.0]]))
    assert np.sum(out.residual**2) < 1.2 * np.sum(moved**2)
    monkeypatch.setattr(cross_validation, "_PRIOR_FACTORS", (0.0,))
    free = held_out(problem, at, blocks)
    assert np.sum(free.residual**2) > 10 * np.sum(out.residual**2) > 10 * fitted


@pytest.mark.parametrize("seed", range(5))
def test_no_start_ranks_by_a_clock_beyond_its_limit(seed: int) -> None:
    """Where nuisances have to stay inside their limits the screened cost is that of least squares with bounds."""
    rng = np.random.default_rng(seed)
    effect, nuisances = Hypothesis(("time_offset",)), 4
    a, b = rng.normal(size=(40, 6)) + 1.0, 40 * rng.normal(size=40)
    bounds = np.array([[-np.inf, *[-3.0] * nuisances], [np.inf, *[3.0] * nuisances]])

    def best(u: float) -> tuple[np.ndarray, float]:
        rows, right = np.vstack([a[:, :5], 0.1 * np.eye(5)]), np.concatenate([b - a[:, 5] * u, np.zeros(5)])
        found = lsq_linear(rows, right, bounds)
        return found.x, 2 * found.cost + u**2

    precision = np.diag([*[0.01] * 5, 1.0])
    problem: Any = Formula(lambda x: a[:, : x.shape[0]] @ x - b[:, None], 1, nuisances, precision)
    x, cost = best(0.0)
    assert (np.abs(x[1:]) > 3.0 - 1e-6).any(), "a nuisance is at its limit"
    base = LinearisedFit(BASELINE, x, cost, Linearised(x, a[:, :5] @ x - b, a[:, :5]))
    starts = np.array([[-1.5, 0.3, 2.0]])
    tried = screen(problem.having(effect), base, starts)
    assert_allclose(tried.cost, sorted(best(u)[1] for u in starts[0]), rtol=0.01)
    assert all((np.abs(found[1:5]) <= 3.0 + 1e-9).all() for found in tried.x)


def test_a_models_own_error_widens_intervals_up_to_the_bounds() -> None:
    rng = np.random.default_rng(0)
    effect = Hypothesis(("tyre_damping",))
    a, rest = rng.normal(size=(60, 2)), rng.normal(size=60)
    problem: Any = Formula(lambda x: a @ x, 1, 0, np.eye(2))
    fit = LinearisedFit(effect, np.array([0.0, 2.0]), 0.0, Linearised(np.array([0.0, 2.0]), rest, a))
    blocks = Blocks(np.arange(60) // 6, np.arange(60) // 6, 10)
    (low, high), (lower, higher), (least, _) = (
        intervals(problem, fit, blocks, t)[0] for t in (1.0, 0.25, 0.001)
    )
    told = effect.values(np.array([[2.0]]))[0, 0]
    assert_allclose([told - lower, higher - told], [2 * (told - low), 2 * (high - told)])
    assert least == 0.0 and low > 0.0
