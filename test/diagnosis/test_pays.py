# SPDX-License-Identifier: Apache-2.0
"""When one more effect joins those that are named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis import run, verdict
from suspension_twin.diagnosis.gaps import Shrink


class _Told(str):
    """Evidence that is its name."""

    strain = None


def pays(
    monkeypatch: pytest.MonkeyPatch, punctual: tuple[float, float], after: float, reference: float | None = None,
    sure: float = 1.0, relief: float = 5.0,
) -> bool:  # fmt: skip
    """Whether ``many`` joins: clocks of few and many, what many leave of a gap of 1 of which few leave 0.8."""
    monkeypatch.setattr(run, "weights", lambda *given: (None, np.array([[0.0, 1.0 - sure], [sure, 0.0]])))
    monkeypatch.setattr(verdict, "punctual", lambda bench, found, temper: punctual[found == "many"])

    monkeypatch.setattr(run, "relieved", lambda strains, temper: np.array([0.0, relief]))

    def shrink(before: Any, found: str, column: int = 0, settled: bool = False) -> Shrink:
        left = {"few": 0.8, "many": after}[found]
        start = 0.8 if before == "few" else 1.0
        return Shrink(start, left, 1.0 - left / start, (0.0, 1.0))

    search: Any = SimpleNamespace(
        bench=SimpleNamespace(problem=SimpleNamespace(channels=["vertical_acceleration"])), reference=reference,
        case=SimpleNamespace(road=True), left=["base"], noise={"vertical_acceleration": 0.01}, temper=1.0,
        request=SimpleNamespace(seed=0), _shrink=shrink, _driven=lambda channel: True,
    )  # fmt: skip
    few, many = _Told("few"), _Told("many")
    return run._Search._pays(search, few, "few", many, "many")  # type: ignore[arg-type]


def test_it_has_to_be_sure_and_worth_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pays(monkeypatch, (1.0, 1.0), after=0.5)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.5, sure=0.9)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.75)


def test_what_frees_clocks_at_their_ends_joins_where_no_reference_says_what_is_normal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert pays(monkeypatch, (0.02, 0.9), after=0.79)
    assert not pays(monkeypatch, (0.02, 0.9), after=0.79, relief=0.5)
    assert not pays(monkeypatch, (0.02, 0.02), after=0.79)
    assert not pays(monkeypatch, (0.02, 0.9), after=0.79, sure=0.9)
    assert not pays(monkeypatch, (0.02, 0.9), after=0.79, reference=0.1)
