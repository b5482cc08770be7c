# SPDX-License-Identifier: Apache-2.0
"""When one more effect joins those that are named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suspension_twin.diagnosis import run, verdict
from suspension_twin.diagnosis.shrink import Shrink


class _Told(str):
    """Evidence that is its name."""

    penalty = None


def pays(
    monkeypatch: pytest.MonkeyPatch,
    punctual: tuple[float, float],
    after: float,
    reference: float | None = None,
    sure: float = 1.0,
    relief: float = 5.0,
    gone: tuple[float, float] = (0.2, 0.9),
) -> bool:
    """Whether ``many`` joins: clocks of few and many, what many leave of a gap of 1 of which few leave 0.8, what each
    takes of what a reference does not show."""
    monkeypatch.setattr(run, "weights", lambda *given: (None, np.array([[0.0, 1.0 - sure], [sure, 0.0]])))
    monkeypatch.setattr(verdict, "punctual", lambda bench, found, temper: punctual[found == "many"])

    monkeypatch.setattr(run, "penalty_gains", lambda strains, temper: np.array([0.0, relief]))

    def shrink(before: Any, found: str, column: int = 0, settled: bool = False) -> Shrink:
        left = {"few": 0.8, "many": after}[found]
        start = 0.8 if before == "few" else 1.0
        return Shrink(start, left, 1.0 - left / start, (0.0, 1.0))

    search: Any = SimpleNamespace(
        bench=SimpleNamespace(problem=SimpleNamespace(channels=["vertical_acceleration"])),
        reference=reference,
        case=SimpleNamespace(road=True),
        left=["base"],
        noise={"vertical_acceleration": 0.01},
        temper=1.0,
        request=SimpleNamespace(seed=0),
        base="base",
        keeper=SimpleNamespace(shrink=shrink, driven=[0], gone=lambda found, left: gone[found == "many"]),
    )
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


def test_with_a_reference_a_tenth_of_what_it_does_not_show_has_to_go(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pays(monkeypatch, (1.0, 1.0), after=0.5, reference=0.1)
    # 0.40 of the rms stays with few, 0.39 or 0.28 with many
    assert not pays(monkeypatch, (1.0, 1.0), after=0.5, reference=0.1, gone=(0.84, 0.85))
    assert pays(monkeypatch, (1.0, 1.0), after=0.5, reference=0.1, gone=(0.84, 0.92))
    assert pays(monkeypatch, (1.0, 1.0), after=0.5, gone=(0.84, 0.85))  # nobody knows without one


def test_what_spares_clocks_and_map_much_has_not_to_take_a_fifth_of_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert pays(monkeypatch, (1.0, 1.0), after=0.69, relief=3.5)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.69, relief=2.5)
    assert not pays(monkeypatch, (1.0, 1.0), after=0.75, relief=3.5)  # a tenth of the gap it has to


def test_where_the_best_addition_closes_nothing_the_next_that_does_joins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        run.gaps, "remainder", lambda bench, hypothesis, unknowns, blocks: f"left by {hypothesis}"
    )
    monkeypatch.setattr(verdict, "uncommon", lambda bench, found, changed: 0.1 if found == "usual" else 1.0)
    worthy = ("usual", "closes", "closes too")

    class Tried(_Told):
        @property
        def fit(self) -> Any:
            return SimpleNamespace(hypothesis=str(self))

        unknowns = None

    search: Any = SimpleNamespace(
        bench=None, reference=None, blocks=None, _pays=lambda few, few_left, many, many_left: many in worthy
    )
    tried = [Tried(name) for name in ("makes up", "usual", "closes", "closes too")]
    joining = list(run._Search._joining(search, _Told("few"), "left", tried))  # type: ignore[arg-type]
    assert joining == [("closes", "left by closes"), ("closes too", "left by closes too")]


def found(effects: tuple[str, ...], gain: float) -> Any:
    fit = SimpleNamespace(hypothesis=SimpleNamespace(effects=effects))
    return SimpleNamespace(fit=fit, over=lambda base: gain)


def combined(
    weights: tuple[float, float],
    materials: tuple[float, float],
    grown: tuple[Any, Any],
    adequate: float = 0.1,
    paying: bool = True,
) -> tuple[tuple[str, ...], list[str]]:
    """What is chosen of leads "a" and "b" that grow to ``grown``, and which of them were grown."""
    base, tried = found((), 0.0), []
    alone = [found(("a",), 10.0), found(("b",), 9.0)]

    def grow(lead: Any, left: Any, gates: Any) -> tuple[Any, str]:
        tried.append(lead.fit.hypothesis.effects[0])
        return grown[alone.index(lead)] or lead, "left"

    search: Any = SimpleNamespace(
        base=base,
        left=["base", "a", "b"],
        weights=np.array([1.0 - sum(weights), *weights]),
        gates=[verdict.Gates(1.0, adequate, 1.0), *(verdict.Gates(m, 0.2, 1.0) for m in materials)],
        singles=[SimpleNamespace(effect="a"), SimpleNamespace(effect="b")],
        _grown=grow,
        _pays=lambda *given: paying,
    )
    chosen, _ = run._Search._combine(search, [base, *alone])
    return chosen.fit.hypothesis.effects, tried


def test_a_set_is_begun_from_the_likeliest_effects() -> None:
    ab, bc = found(("a", "b"), 20.0), found(("b", "c"), 30.0)
    assert combined((0.8, 0.05), (1.0, 1.0), (None, bc)) == (("a",), ["a"])  # nobody else is likely
    assert combined((0.15, 0.1), (1.0, 1.0), (ab, bc)) == (
        ("b", "c"),
        ["b"],
    )  # the first alone has to be likelier
    assert combined((0.6, 0.3), (1.0, 1.0), (None, bc)) == (("b", "c"), ["a", "b"])
    assert combined((0.6, 0.3), (1.0, 1.0), (None, bc), paying=False) == (("a",), ["a", "b"])
    assert combined((0.6, 0.3), (1.0, 1.0), (found(("a", "d"), 20.0), bc)) == (("b", "c"), ["a", "b"])
    assert combined((0.6, 0.3), (1.0, 1.0), (found(("a", "d"), 40.0), bc)) == (("a", "d"), ["a", "b"])
    assert combined((0.6, 0.3), (1.0, 1.0), (ab, bc)) == (("a", "b"), ["a"])  # it is there already


def test_what_is_too_little_by_itself_may_be_one_of_two_where_something_is_missing() -> None:
    ab = found(("a", "b"), 20.0)
    assert combined((0.8, 0.05), (0.4, 1.0), (ab, None)) == (("a", "b"), ["a"])
    assert combined((0.8, 0.05), (0.4, 1.0), (None, None)) == ((), ["a"])
    assert combined((0.8, 0.05), (0.4, 1.0), (ab, None), adequate=0.9) == ((), [])
    assert combined((0.6, 0.3), (0.4, 1.0), (None, None)) == (("b",), ["a", "b"])
    assert combined((0.6, 0.3), (0.4, 0.4), (None, None)) == ((), ["a", "b"])
