# SPDX-License-Identifier: Apache-2.0
"""The searches on functions whose minimum is known, and told again what was computed."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.calibration.evolution import CmaSearch
from suspension_twin.calibration.genetic import GaSettings, GeneticSearch
from suspension_twin.calibration.pattern import PatternSearch, PatternSettings
from suspension_twin.calibration.recorder import Recorder
from suspension_twin.calibration.request import CalibrationRequest, Progress
from suspension_twin.inference.checkpoint import STATE, Checkpoint, State

TARGET = np.linspace(0.2, 0.8, 6)


def bowl(x: np.ndarray) -> np.ndarray:
    """An ill-conditioned quadratic with its minimum at TARGET."""
    weights = 10.0 ** np.arange(6)[None, :] / 1e3
    return np.asarray(((x - TARGET) ** 2 * weights).sum(axis=1))


def run_ga(search: GeneticSearch, generations: int) -> None:
    for _ in range(generations):
        search.tell(bowl(search.ask()))


def test_the_papers_generation_is_15_parents_and_85_children() -> None:
    settings = GaSettings()
    assert settings.elite == 15
    search = GeneticSearch(6, settings, seed=3)
    first = search.ask()
    assert first.shape == (100, 6)
    search.tell(bowl(first))
    before = search.population
    order = np.argsort(search.costs, kind="stable")[:15]
    children = search.ask()
    assert children.shape == (85, 6)
    search.tell(bowl(children) + 100.0)  # every child is worse than any parent, and survives all the same
    np.testing.assert_array_equal(search.population[:15], before[order])
    np.testing.assert_array_equal(search.population[15:], children)


def test_ga_closes_in_and_never_loses_its_best() -> None:
    search = GeneticSearch(6, GaSettings(), seed=1)
    run_ga(search, 60)
    assert all(b <= a for a, b in zip(search.best, search.best[1:], strict=False))
    assert search.best[-1] < 0.02 * search.best[0]


def test_stall_ends_the_search_after_eight_generations_without_change() -> None:
    search = GeneticSearch(2, GaSettings(population=20), seed=1)
    search.tell(np.ones(search.ask().shape[0]))
    for _ in range(7):
        search.tell(np.ones(search.ask().shape[0]))
        assert not search.finished
    search.tell(np.ones(search.ask().shape[0]))
    assert search.finished and search.stalled


def test_failed_candidates_do_not_stop_the_search() -> None:
    search = GeneticSearch(6, GaSettings(population=20), seed=1)
    costs = bowl(search.ask())
    costs[::2] = np.inf
    search.tell(costs)
    assert np.isfinite(search.best[-1]) and np.isfinite(search.mean[-1])
    x, f = search.best_point
    assert f == np.min(costs) and np.isfinite(x).all()


def test_children_stay_within_the_bounds_and_differ_from_each_other() -> None:
    search = GeneticSearch(5, GaSettings(), seed=0)
    search.tell(search.ask().sum(axis=1))  # the best lie in a corner of the bounds
    for _ in range(10):
        children = search.ask()
        assert np.all((children >= 0) & (children <= 1))
        assert len(np.unique(children, axis=0)) > 40
        search.tell(children.sum(axis=1))


def test_cma_finds_the_minimum_and_ends() -> None:
    search = CmaSearch(np.full(6, 0.5), 0.3, seed=1, population=12)
    generations = 0
    while not search.finished:
        search.tell(bowl(search.ask()))
        generations += 1
    assert generations < 300 and search.best_point[1] < 1e-5 * bowl(np.full((1, 6), 0.5))[0]


def test_cma_survives_a_generation_of_failures() -> None:
    search = CmaSearch(np.full(6, 0.5), 0.3, seed=2, population=12)
    search.tell(np.full(len(search.ask()), np.inf))
    assert not np.isfinite(search.best_point[1])
    search.tell(bowl(search.ask()))
    assert np.isfinite(search.best_point[1])


def test_pattern_search_reaches_a_corner_and_an_inner_minimum() -> None:
    search = PatternSearch(
        np.full(6, 0.5), float(bowl(np.full((1, 6), 0.5))[0]), PatternSettings(evaluations=4000)
    )
    while not search.finished:
        search.tell(bowl(search.ask()))
    assert search.converged
    np.testing.assert_allclose(search.x, TARGET, atol=2e-3)
    corner = PatternSearch(np.full(3, 0.4), 1.2, PatternSettings())
    while not corner.finished:
        corner.tell(corner.ask().sum(axis=1))
    np.testing.assert_array_equal(corner.x, 0.0)


def test_pattern_search_keeps_to_its_evaluations() -> None:
    start = np.full(6, 0.5)
    search = PatternSearch(start, float(bowl(start[None])[0]), PatternSettings(evaluations=100))
    while not search.finished:
        search.tell(bowl(search.ask()))
    assert search.evaluations <= 100


def made(kind: str) -> GeneticSearch | CmaSearch | PatternSearch:
    """A search, each time the same."""
    if kind == "genetic":
        return GeneticSearch(6, GaSettings(population=30), seed=5)
    start = np.full(6, 0.5)
    return (
        PatternSearch(start, np.inf, PatternSettings()) if kind == "pattern" else CmaSearch(start, 0.3, 5, 12)
    )


@pytest.mark.parametrize("kind", ["genetic", "evolution", "pattern"])
def test_a_search_that_is_told_again_what_was_computed_is_where_it_was(tmp_path: Path, kind: str) -> None:
    store, computed = Checkpoint(tmp_path / "state", "problem"), list[int]()

    def costs(points: np.ndarray) -> np.ndarray:
        computed.append(len(points))
        found = bowl(points)
        found[3] = np.inf  # a failed candidate in every generation
        return found

    def ran(generations: int, store: Checkpoint | None) -> tuple[np.ndarray, float, int, int]:
        seen: list[Progress] = []
        recorder = Recorder(CalibrationRequest("", ()), Any, seen.append, lambda: False, store)  # type: ignore[arg-type]
        search = made(kind)
        for _ in range(generations):
            points = search.ask()
            search.tell(recorder.known(len(points), partial(costs, points)))
            recorder.report(False, *search.best_point, search.mean_cost, 1e3)
            recorder.save(2)
        return *search.best_point, recorder.evaluations, len(seen)

    ran(5, store)
    computed.clear()
    *again, reported = ran(12, store)
    assert len(computed) == reported == 8  # of twelve, four were saved
    *whole, _ = ran(12, None)
    np.testing.assert_equal(again, whole)


def test_a_checkpoint_is_whole_or_not_there(tmp_path: Path) -> None:
    store = Checkpoint(tmp_path / "state", "one")
    assert store.load() is None
    plain: dict[str, Any] = {"number": 0.1 + 0.2, "large": 2**127, "none": np.inf, "list": [1, (2, 3)]}
    store.save(State("search", {"x": np.array([np.pi, np.nan])}, plain))
    store.save(State("search", {"x": np.array([np.e, np.nan])}, plain))
    state = store.load()
    assert state is not None
    np.testing.assert_array_equal(state.arrays["x"], [np.e, np.nan])
    assert state.plain == {"number": 0.1 + 0.2, "large": 2**127, "none": np.inf, "list": [1, [2, 3]]}
    assert [p.name for p in (tmp_path / "state").iterdir()] == [STATE]
    assert Checkpoint(tmp_path / "state", "another").load() is None
    whole = (tmp_path / "state" / STATE).read_bytes()
    for damage in (b"", b"PK", whole[: len(whole) // 2], b"format: 1"):
        (tmp_path / "state" / STATE).write_bytes(damage)
        assert store.load() is None
    np.savez(tmp_path / "state" / STATE, index=np.array('{"format": 1}'))
    assert store.load() is None
    np.savez(tmp_path / "state" / STATE, x=np.array([{"an": "object"}], dtype=object))
    assert store.load() is None  # a pickle is not loaded
    store.remove()
    assert not (tmp_path / "state").exists()


def test_a_state_can_be_read_with_plain_tools(tmp_path: Path) -> None:
    Checkpoint(tmp_path, "x").save(State("search", {"a0": bowl(np.zeros((10, 6)))}, {"generations": 3}))
    with np.load(tmp_path / STATE, allow_pickle=False) as arrays:
        assert arrays["a0"].shape == (10,)
        index = json.loads(str(arrays["index"]))
    assert index["stage"] == "search" and index["plain"]["generations"] == 3


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    from suspension_twin.errors import InputError

    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        Checkpoint(tmp_path / "file" / "state", "x")
