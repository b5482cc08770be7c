# SPDX-License-Identifier: Apache-2.0
"""Fits that have to leave a valley to find the right one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from suspension_twin.diagnosis.bench import Linearised
from suspension_twin.diagnosis.fit import Linear, refit, swept
from suspension_twin.diagnosis.hypotheses import Hypothesis

STOP = Hypothesis(("rebound_stop",))
TRUTH = np.array([0.7, -1.2, 0.4])
CENTRE = np.array([0.0, 0.0, 1.0, 0.0])


def valleys(x: np.ndarray) -> np.ndarray:
    """(R, L) residuals of one characteristic and a stop's three coordinates: the second is flat beyond 0.3, as a
    clearance is that nothing touches, and the characteristic makes up for a part of it."""
    touch = np.minimum(x[2], 0.3)
    wanted = min(TRUTH[1], 0.3)
    return np.stack(
        [20 * (x[1] - TRUTH[0]), 30 * (touch - wanted) + 8 * (x[0] - 0.5), 10 * (x[3] - TRUTH[2]), 9 * (x[0] - 0.5)]
    )


@pytest.fixture
def bench() -> Any:
    """What a fit asks of a bench."""

    def clipped(hypothesis: Hypothesis, x: np.ndarray) -> np.ndarray:
        low, high = limits(hypothesis)
        return np.clip(x, low[:, None], high[:, None])

    def limits(hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        low, high = hypothesis.bounds()
        return np.concatenate([[-np.inf], low]), np.concatenate([[np.inf], high])

    def prior(hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        return 1e-2 * np.eye(4), CENTRE

    def costs(hypothesis: Hypothesis, x: np.ndarray) -> np.ndarray:
        return np.sum(valleys(x) ** 2, axis=0) + 1e-2 * np.sum((x - CENTRE[:, None]) ** 2, axis=0)

    def residuals(hypothesis: Hypothesis, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return valleys(x), np.zeros(x.shape[1], dtype=bool)

    def linearise(hypothesis: Hypothesis, x: np.ndarray, known: Any = None) -> Linearised:
        steps = np.repeat(x[:, None], 4, axis=1) + 1e-6 * np.eye(4)
        base = valleys(x[:, None])
        return Linearised(x, base[:, 0], (valleys(steps) - base) / 1e-6)

    return SimpleNamespace(
        d=1, q=0, clipped=clipped, limits=limits, prior=prior, costs=costs, residuals=residuals, linearise=linearise
    )


def at(bench: Any, x: np.ndarray) -> Linear:
    return Linear(STOP, x, float(bench.costs(STOP, x[:, None])[0]), bench.linearise(STOP, x))


def test_a_coordinate_that_nothing_touches_is_swept_into_the_valley(bench: Any) -> None:
    stuck, cost = refit(bench, STOP, [np.array([0.0, 0.6, 1.0, 0.0])], None, 30)
    assert stuck[2] > 0.3 and cost > 500, "no descent gets out of there"
    begun = swept(bench, at(bench, stuck))
    assert begun is not None
    found, cost = refit(bench, STOP, [begun], None, 30)
    assert_allclose(found[1:], TRUTH, atol=0.02)
    assert cost < 1.0


def test_what_is_best_stays(bench: Any) -> None:
    best, _ = refit(bench, STOP, [np.array([0.5, *TRUTH])], None, 30)
    assert swept(bench, at(bench, best)) is None


def test_candidates_that_fail_are_passed_over(bench: Any) -> None:
    stuck, _ = refit(bench, STOP, [np.array([0.0, 0.6, 1.0, 0.0])], None, 30)
    bench.residuals = lambda hypothesis, x: (np.zeros((4, x.shape[1])), np.ones(x.shape[1], dtype=bool))
    bench.costs = lambda hypothesis, x: np.full(x.shape[1], np.inf)
    assert swept(bench, at(bench, stuck)) is None
