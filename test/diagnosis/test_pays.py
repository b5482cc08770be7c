# SPDX-License-Identifier: Apache-2.0
"""When one more effect joins those that are named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis import selection, verdict
from suspension_twin.diagnosis.shrink import Shrink


class Named(str):
    """Evidence that is its name."""

    penalty = None


def pays(
    monkeypatch: pytest.MonkeyPatch,
    punctual: tuple[float, float],
    after: float,
    reference: float | None = None,
    sure: float = 1.0,
    saved: float = 5.0,
    explained_share: tuple[float, float] = (0.2, 0.9),
) -> bool:
    """Whether ``many`` joins: clocks of few and many, what many leave of a gap of 1 of which few leave 0.8, what each
    takes of what a reference does not show."""
    monkeypatch.setattr(
        selection, "weights", lambda *given: (None, np.array([[0.0, 1.0 - sure], [sure, 0.0]]))
    )
    monkeypatch.setattr(
        verdict, "clocks_within_limits", lambda bench, found, temper: punctual[found == "many"]
    )

    monkeypatch.setattr(selection, "penalty_gains", lambda penalties, temper: np.array([0.0, saved]))

    def shrink(before: Any, found: str, column: int = 0, with_nuisances: bool = False) -> Shrink:
        left = {"few": 0.8, "many": after}[found]
        start = 0.8 if before == "few" else 1.0
        return Shrink(start, left, 1.0 - left / start, (0.0, 1.0))

    judged: Any = SimpleNamespace(
        bench=SimpleNamespace(problem=SimpleNamespace(channels=["vertical_acceleration"])),
        reference=reference,
        remaining=["base"],
        noise={"vertical_acceleration": 0.01},
        temper=1.0,
        keeper=SimpleNamespace(
            shrink=shrink, driven=[0], explained_share=lambda found, left: explained_share[found == "many"]
        ),
    )
    few, many = (selection.Candidate(Named(n), n) for n in ("few", "many"))  # type: ignore[arg-type]
    case: Any = SimpleNamespace(excited=True)
    return selection.pays(case, judged, few, many, seed=0)


def test_it_has_to_be_sure_and_worth_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pays(monkeypatch, (1.0, 1.0), after=0.5)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.5, sure=0.9)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.75)


def test_what_frees_clocks_at_their_ends_joins_where_no_reference_says_what_is_normal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert pays(monkeypatch, (0.02, 0.9), after=0.79)
    assert not pays(monkeypatch, (0.02, 0.9), after=0.79, saved=0.5)
    assert not pays(monkeypatch, (0.02, 0.02), after=0.79)
    assert not pays(monkeypatch, (0.02, 0.9), after=0.79, sure=0.9)
    assert not pays(monkeypatch, (0.02, 0.9), after=0.79, reference=0.1)


def test_with_a_reference_a_tenth_of_what_it_does_not_show_has_to_go(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pays(monkeypatch, (1.0, 1.0), after=0.5, reference=0.1)
    # 0.40 of the rms stays with few, 0.39 or 0.28 with many
    assert not pays(monkeypatch, (1.0, 1.0), after=0.5, reference=0.1, explained_share=(0.84, 0.85))
    assert pays(monkeypatch, (1.0, 1.0), after=0.5, reference=0.1, explained_share=(0.84, 0.92))
    assert pays(monkeypatch, (1.0, 1.0), after=0.5, explained_share=(0.84, 0.85))  # nobody knows without one


def test_what_saves_much_nuisance_penalty_has_not_to_take_a_fifth_of_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert pays(monkeypatch, (1.0, 1.0), after=0.69, saved=3.5)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.69, saved=2.5)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.75, saved=3.5)  # a tenth of the gap it has to
