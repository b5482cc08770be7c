# SPDX-License-Identifier: Apache-2.0
"""The searches on functions whose minimum is known, and their states taken up again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from suspension_twin.calibration.checkpoint import Checkpoint, State
from suspension_twin.calibration.genetic import (
    GaSettings,
    GeneticSearch,
    adaptive_feasible,
    rank_expectation,
    stochastic_uniform,
)
from suspension_twin.calibration.pattern import PatternSearch, PatternSettings

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
    assert search.ask().shape == (100, 6)
    search.tell(bowl(search._asked.get("X")))
    before, _ = search.state()
    order = np.argsort(before["costs"], kind="stable")[:15]
    children = search.ask()
    assert children.shape == (85, 6)
    search.tell(bowl(children) + 100.0)  # every child is worse than any parent, and survives all the same
    after, _ = search.state()
    np.testing.assert_array_equal(after["population"][:15], before["population"][order])
    np.testing.assert_array_equal(after["population"][15:], children)
    assert search.evaluations == 185


def test_ga_closes_in_and_never_loses_its_best() -> None:
    search = GeneticSearch(6, GaSettings(), seed=1)
    run_ga(search, 60)
    assert all(b <= a for a, b in zip(search.best, search.best[1:], strict=False))
    assert search.best[-1] < 0.02 * search.best[0]


def test_the_start_is_in_the_first_population() -> None:
    search = GeneticSearch(6, GaSettings(population=10), seed=1, start=TARGET)
    search.tell(bowl(search.ask()))
    assert search.best[0] == 0.0


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


def test_ga_continues_to_the_same_bits(tmp_path: Path) -> None:
    whole = GeneticSearch(6, GaSettings(population=30), seed=5)
    run_ga(whole, 12)
    first = GeneticSearch(6, GaSettings(population=30), seed=5)
    run_ga(first, 5)
    store = Checkpoint(tmp_path / "state", "problem")
    arrays, plain = first.state()
    store.save(State("search", arrays, plain))
    loaded = store.load()
    assert loaded is not None and loaded.stage == "search"
    second = GeneticSearch(6, GaSettings(population=30), seed=99)
    second.restore(loaded.arrays, loaded.plain)
    run_ga(second, 7)
    for name in ("population", "costs", "best", "mean"):
        assert np.array_equal(second.state()[0][name], whole.state()[0][name])


def test_selection_gives_each_its_share() -> None:
    rng = np.random.default_rng(0)
    expectation = rank_expectation(np.array([3.0, 1.0, 2.0, np.inf]))
    np.testing.assert_allclose(expectation[[1, 2, 0, 3]] / expectation[1], 1 / np.sqrt([1, 2, 3, 4]))
    counts = np.bincount(stochastic_uniform(expectation, 10_000, rng), minlength=4)
    np.testing.assert_allclose(counts, 10_000 * expectation, atol=1.5)


def test_mutation_moves_and_stays_within_the_bounds() -> None:
    rng = np.random.default_rng(0)
    x = rng.random((50, 5))
    x[0] = 0.0
    for step in (1.0, 1e-2, 1e-5):
        mutants = adaptive_feasible(x, step, rng)
        assert np.all((mutants >= 0) & (mutants <= 1))
        assert np.all(np.any(mutants != x, axis=1))
        assert np.abs(mutants - x).max() <= 1.0 * np.sqrt(step) + step


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


def test_pattern_search_keeps_to_its_evaluations_and_continues() -> None:
    settings = PatternSettings(evaluations=100)
    start = np.full(6, 0.5)
    whole = PatternSearch(start, float(bowl(start[None])[0]), settings)
    while not whole.finished:
        whole.tell(bowl(whole.ask()))
    assert whole.evaluations <= 100
    part = PatternSearch(start, float(bowl(start[None])[0]), settings)
    for _ in range(3):
        part.tell(bowl(part.ask()))
    again = PatternSearch.restore(*part.state(), settings)
    while not again.finished:
        again.tell(bowl(again.ask()))
    assert np.array_equal(again.x, whole.x) and again.cost == whole.cost


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
    assert len(list((tmp_path / "state").iterdir())) == 2
    assert Checkpoint(tmp_path / "state", "another").load() is None
    for damage in (
        "format: 1\n",
        "- [",
        "format: 1\nfingerprint: one\nstage: x\narrays: no.npz\nplain: {}\n",
    ):
        (tmp_path / "state" / "state.yaml").write_text(damage)
        assert store.load() is None
    store.remove()
    assert not (tmp_path / "state").exists()


def test_a_state_can_be_read_with_plain_tools(tmp_path: Path) -> None:
    search = GeneticSearch(6, GaSettings(population=10), seed=5)
    run_ga(search, 2)
    Checkpoint(tmp_path, "x").save(State("search", *search.state()))
    index = yaml.safe_load((tmp_path / "state.yaml").read_text())
    with np.load(tmp_path / index["arrays"], allow_pickle=False) as arrays:
        assert arrays["population"].shape == (10, 6)
    assert index["plain"]["generation"] == 2


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    from suspension_twin.errors import InputError

    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        Checkpoint(tmp_path / "file" / "state", "x")
