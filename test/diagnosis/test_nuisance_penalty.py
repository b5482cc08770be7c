# SPDX-License-Identifier: Apache-2.0
"""The nuisance penalty of a hypothesis: its clocks, map and mount."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from one_channel import Formula
from scipy.optimize import minimize

from suspension_twin.diagnosis import decision, features
from suspension_twin.diagnosis.judge import tempered_gain
from suspension_twin.inference.cross_validation import Evidence, penalty_of
from suspension_twin.inference.fit import LinearisedFit, fitted
from suspension_twin.inference.hypothesis import BASELINE, Hypothesis

LATE = Hypothesis(("time_offset",))
LIMIT = 3.0


class Line(Formula):
    """One unknown of the vehicle, ``q`` nuisances and a late clock, and residuals that are linear in all of them."""

    def __init__(self, a: np.ndarray, b: np.ndarray) -> None:
        self.a, self.b = a, b
        precision = np.eye(a.shape[1])
        precision[0, 0] = 0.01
        super().__init__(
            lambda x: a[:, : x.shape[0]] @ x - b[:, None], 1, a.shape[1] - 2, precision, limit=LIMIT
        )

    def fit(self, hypothesis: Hypothesis) -> LinearisedFit:
        problem: Any = self.having(hypothesis)
        return fitted(problem, [np.zeros(self.shared + len(hypothesis))], 50)


def clocks(late: float, seed: int = 0, rows: int = 200, louder: float = 3.0) -> Line:
    """Two drives with clocks of their own and a common one, on which a late clock acts as the common one does."""
    rng = np.random.default_rng(seed)
    first = np.arange(rows) < rows // 2
    common = louder * rng.normal(size=rows)
    a = np.stack([rng.normal(size=rows), common, common * first, common * ~first, 5.0 * common], axis=1)
    return Line(a, common * late + 0.1 * rng.normal(size=rows))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("temper", [1.0, 0.1, 0.01])
def test_the_price_is_that_of_the_best_between_residuals_and_prior(seed: int, temper: float) -> None:
    """Against a general minimiser with bounds."""
    problem: Any = clocks(4.0, seed, louder=0.5)
    fit = problem.fit(BASELINE)
    precision, _ = problem.joint_prior()
    slope, curvature = problem.a[:, :4].T @ fit.at.residual, problem.a[:, :4].T @ problem.a[:, :4]

    def price(x: np.ndarray) -> float:
        step, own = x - fit.x, precision[1:4, 1:4]
        squares = slope @ step + 0.5 * step @ curvature @ step
        rest = 0.5 * precision[0, 0] * (x[0] ** 2 - fit.x[0] ** 2)
        return float(temper * (squares + rest) + 0.5 * x[1:4] @ own @ x[1:4])

    low, high = problem.limits()
    best = minimize(
        price, fit.x, bounds=list(zip(low, high, strict=True)), options={"ftol": 1e-14, "gtol": 1e-10}
    )
    spent, _ = penalty_of(problem, fit, fit.at.model).at(temper)
    assert spent == pytest.approx(best.fun, rel=1e-3, abs=1e-4)
    assert spent <= 0.5 * float(np.sum(fit.x[1:4] ** 2)) + 1e-9


def test_clocks_at_their_ends_are_chance_where_little_asks_for_it() -> None:
    """A clock that is late by far takes all of them to their ends at any price; one that is late by a little, of which
    a model's own error makes a lot, does so for next to nothing."""
    for late, louder in ((60.0, 3.0), (9.0, 0.2)):
        problem: Any = clocks(late, louder=louder)
        names = ["clock_offset", "one.clock_offset", "two.clock_offset"]
        problem.nuisances = SimpleNamespace(names=names, spread=np.ones(3))
        fit = problem.fit(BASELINE)
        assert (fit.x[2:4] > 2.95).all()
        found: Any = SimpleNamespace(fit=fit, penalty=penalty_of(problem, fit, fit.at.model))
        row = features.clock_offsets(problem, found, 0.01)
        assert row["clocks"] > 2.9 and (row["clocks_by_chance"] > 0.05) == (late < 10.0)
        assert (decision._clocks(row) < 0.5) == (late < 10.0)


def gain(problem: Any, before: Hypothesis, after: Hypothesis) -> float:
    """Nats of evidence where the residuals are scored alike: what nuisances and freedom cost."""
    score = np.random.default_rng(0).normal(size=30)

    def found(h: Hypothesis) -> Evidence:
        fit = problem.fit(h)
        penalty = penalty_of(problem.having(h), fit, fit.at.model)
        return Evidence(fit, score, 0.0, {}, np.zeros(1), np.zeros((1, 5)), 0.0, penalty)

    judged: Any = SimpleNamespace(
        scale=SimpleNamespace(temper=0.03), base=SimpleNamespace(found=found(before))
    )
    return tempered_gain(judged, found(after))


def test_an_effect_gains_by_the_nuisance_penalty_that_it_saves() -> None:
    """Nuisances together compensate for five standard deviations of a late clock, within the limits of each."""
    problem: Any = clocks(5.0)
    base = problem.fit(BASELINE)
    assert (np.abs(base.x[1:4]) <= LIMIT).all() and base.x[1:4] @ base.x[1:4] > 12
    assert 3.0 < gain(problem, BASELINE, LATE) < 12.0
    assert gain(problem, LATE, BASELINE) < -3.0


@pytest.mark.parametrize("late", [0.0, 1.0])
def test_an_offset_within_its_prior_gains_nothing(late: float) -> None:
    """One standard deviation of a clock is worth less than the freedom of an effect."""
    assert gain(clocks(late), BASELINE, LATE) < 0.2
