# SPDX-License-Identifier: Apache-2.0
"""What a hypothesis asks of clocks, map and mount."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from suspension_twin.diagnosis.bench import Linearised
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis
from suspension_twin.diagnosis.nuisance_penalty import penalty_of

from suspension_twin.diagnosis import decision, features
from suspension_twin.diagnosis.judge import tempered_gain
from suspension_twin.inference.cross_validation import Evidence
from suspension_twin.inference.fit import LinearisedFit, refit

LATE = Hypothesis(("time_offset",))
LIMIT = 3.0


class Line:
    """A bench of one characteristic, ``q`` nuisances and a late clock, whose residuals are linear in all of them."""

    def __init__(self, a: np.ndarray, b: np.ndarray) -> None:
        self.a, self.b, self.d, self.q = a, b, 1, a.shape[1] - 2

    def limits(self, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        low, high = hypothesis.bounds()
        box = np.full(self.q, LIMIT)
        return np.concatenate([[-np.inf], -box, low]), np.concatenate([[np.inf], box, high])

    def clipped(self, hypothesis: Hypothesis, x: np.ndarray) -> np.ndarray:
        low, high = self.limits(hypothesis)
        return np.clip(x, low[:, None], high[:, None])

    def prior(self, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        p = 1 + self.q + len(hypothesis)
        precision = np.eye(p)
        precision[0, 0] = 0.01
        return precision, np.zeros(p)

    def residuals(self, hypothesis: Hypothesis, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.a[:, : x.shape[0]] @ x - self.b[:, None], np.zeros(x.shape[1], dtype=bool)

    def costs(self, hypothesis: Hypothesis, x: np.ndarray) -> np.ndarray:
        precision, _ = self.prior(hypothesis)
        return np.sum(self.residuals(hypothesis, x)[0] ** 2, axis=0) + np.sum(x * (precision @ x), axis=0)

    def linearise(self, hypothesis: Hypothesis, x: np.ndarray) -> Linearised:
        return Linearised(x, self.residuals(hypothesis, x[:, None])[0][:, 0], self.a[:, : x.size])

    def fit(self, hypothesis: Hypothesis) -> LinearisedFit:
        bench: Any = self
        x, cost = refit(bench, hypothesis, [np.zeros(1 + self.q + len(hypothesis))], None, 50)
        return LinearisedFit(hypothesis, x, cost, self.linearise(hypothesis, x))


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
    bench: Any = clocks(4.0, seed, louder=0.5)
    fit = bench.fit(BASELINE)
    precision, _ = bench.prior(BASELINE)
    slope, curvature = bench.a[:, :4].T @ fit.at.residual, bench.a[:, :4].T @ bench.a[:, :4]

    def price(x: np.ndarray) -> float:
        step, own = x - fit.x, precision[1:4, 1:4]
        squares = slope @ step + 0.5 * step @ curvature @ step
        rest = 0.5 * precision[0, 0] * (x[0] ** 2 - fit.x[0] ** 2)
        return float(temper * (squares + rest) + 0.5 * x[1:4] @ own @ x[1:4])

    low, high = bench.limits(BASELINE)
    best = minimize(
        price, fit.x, bounds=list(zip(low, high, strict=True)), options={"ftol": 1e-14, "gtol": 1e-10}
    )
    spent, _ = penalty_of(bench, fit, fit.at.model).at(temper)
    assert spent == pytest.approx(best.fun, rel=1e-3, abs=1e-4)
    assert spent <= 0.5 * float(np.sum(fit.x[1:4] ** 2)) + 1e-9


def test_clocks_at_their_ends_are_chance_where_little_asks_for_it() -> None:
    """A clock that is late by far takes all of them to their ends at any price; one that is late by a little, of which
    a model's own error makes a lot, does so for next to nothing."""
    for late, louder in ((60.0, 3.0), (9.0, 0.2)):
        bench: Any = clocks(late, louder=louder)
        names = ["clock_offset", "one.clock_offset", "two.clock_offset"]
        bench.problem = SimpleNamespace(nuisances=SimpleNamespace(names=names, spread=np.ones(3)))
        fit = bench.fit(BASELINE)
        assert (fit.x[2:4] > 2.95).all()
        found: Any = SimpleNamespace(fit=fit, penalty=penalty_of(bench, fit, fit.at.model))
        row = features.clock_offsets(bench, found, 0.01)
        assert row["clocks"] > 2.9 and (row["clocks_by_chance"] > 0.05) == (late < 10.0)
        assert (decision._clocks(row) < 0.5) == (late < 10.0)


def gain(bench: Any, before: Hypothesis, after: Hypothesis) -> float:
    """Nats of evidence where the residuals are scored alike: what nuisances and freedom cost."""
    score = np.random.default_rng(0).normal(size=30)

    def found(h: Hypothesis) -> Evidence:
        fit = bench.fit(h)
        penalty = penalty_of(bench, fit, fit.at.model)
        return Evidence(fit, score, 0.0, {}, np.zeros(1), np.zeros((1, 5)), 0.0, penalty)

    judged: Any = SimpleNamespace(temper=0.03, base=SimpleNamespace(found=found(before)))
    return tempered_gain(judged, found(after))


def test_an_effect_gains_by_the_nuisance_penalty_that_it_saves() -> None:
    """Nuisances together compensate for five standard deviations of a late clock, within the limits of each."""
    bench: Any = clocks(5.0)
    base = bench.fit(BASELINE)
    assert (np.abs(base.x[1:4]) <= LIMIT).all() and base.x[1:4] @ base.x[1:4] > 12
    assert 3.0 < gain(bench, BASELINE, LATE) < 12.0
    assert gain(bench, LATE, BASELINE) < -3.0


@pytest.mark.parametrize("late", [0.0, 1.0])
def test_an_offset_within_its_prior_gains_nothing(late: float) -> None:
    """One standard deviation of a clock is worth less than the freedom of an effect."""
    assert gain(clocks(late), BASELINE, LATE) < 0.2
