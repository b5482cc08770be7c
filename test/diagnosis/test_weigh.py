# SPDX-License-Identifier: Apache-2.0
"""Weights of effects that came since, where the vehicle may have pre-existing ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from suspension_twin.diagnosis import evidence as held_out
from suspension_twin.diagnosis import judge
from suspension_twin.diagnosis.evidence import Evidence
from suspension_twin.diagnosis.fit import Fit
from suspension_twin.diagnosis.hypotheses import Hypothesis
from suspension_twin.diagnosis.search import Single


def gained(effect: str, gain: float) -> Evidence:
    """Evidence of ``gain`` nats over all else being nothing, spread evenly over ten blocks."""
    hypothesis = Hypothesis((effect,) if effect else ())
    score = np.full(10, gain / 10)
    return Evidence(Fit(hypothesis, np.zeros(0), 0.0), score, 0.0, {}, np.zeros(0), np.zeros((0, 5)), gain)


def weighed(
    monkeypatch: pytest.MonkeyPatch, plain: tuple[float, float], base: float | None, late: tuple[float, float]
) -> Any:
    """A payload and a late clock, which gain ``plain`` by themselves and ``late`` beside pre-existing effects that
    gain ``base``."""
    effects = ("payload", "time_offset")
    beside = {i: gained(e, g) for i, (e, g) in enumerate(zip(effects, late, strict=True))}
    monkeypatch.setattr(
        judge, "beyond_preexisting", lambda *given: None if base is None else (gained("", base), beside)
    )
    monkeypatch.setattr(held_out, "penalty_gains", lambda penalties, temper: np.zeros(len(penalties)))
    base_alone: Any = gained("", 0.0)
    everything = [base_alone, *(gained(e, g) for e, g in zip(effects, plain, strict=True))]
    found = [
        Single(e, one, np.ones(1), finalist=False) for e, one in zip(effects, everything[1:], strict=True)
    ]
    nothing: Any = None
    prior = np.array([0.4, 0.3, 0.3])
    weights, beats = judge.model_weights(
        nothing, nothing, 0, 1.0, base_alone, everything, prior, found, nothing
    )
    assert weights.sum() == pytest.approx(1.0)
    assert beats.shape == (3, 3)
    return SimpleNamespace(weights=weights, win_rate=beats)


def test_what_is_small_counts_beside_preexisting_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    search = weighed(monkeypatch, plain=(8.0, 4.0), base=20.0, late=(22.0, 35.0))
    assert search.weights[2] > 0.99
    assert search.win_rate[2, 1] == 1.0


def test_what_is_large_bends_preexisting_effects_and_counts_without(monkeypatch: pytest.MonkeyPatch) -> None:
    search = weighed(monkeypatch, plain=(190.0, 40.0), base=60.0, late=(70.0, 90.0))
    assert search.weights[1] > 0.99
    assert search.win_rate[1, 2] == 1.0


def test_either_is_as_likely_at_first(monkeypatch: pytest.MonkeyPatch) -> None:
    search = weighed(monkeypatch, plain=(30.0, 0.0), base=0.0, late=(0.0, 30.0))
    assert_allclose(search.weights, [0.0, 0.5, 0.5], atol=1e-6)


def test_without_preexisting_effects_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    search = weighed(monkeypatch, plain=(0.0, np.log(2.0)), base=None, late=(0.0, 0.0))
    assert_allclose(search.weights, np.array([0.4, 0.3, 0.6]) / 1.3, rtol=1e-9)
