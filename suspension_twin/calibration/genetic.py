# SPDX-License-Identifier: Apache-2.0
"""The car paper's genetic algorithm (section 4.3) on pymoo: MATLAB's ``ga`` with five options set.

Set by the paper: population 100, at most 100 generations, stall after 8, elite share 0.15 (so
each generation is the 15 best parents and 85 children), a hybrid function afterwards. Left at
MATLAB's defaults and built here after its documentation: a uniform first population within the
bounds, fitness scaled by rank (1/sqrt), stochastic uniform selection, scattered crossover for
0.8 of the children and, since the variables are bounded, adaptive feasible mutation for the rest.

Everything is in unit coordinates. The search is driven from outside (``ask``/``tell``), so that
its state can be written between generations and taken up again to the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymoo.algorithms.base.genetic import GeneticAlgorithm
from pymoo.core.infill import InfillCriterion
from pymoo.core.population import Population
from pymoo.core.problem import Problem
from pymoo.core.survival import Survival
from pymoo.core.termination import NoTermination

from suspension_twin.arrays import Floats

__all__ = ["GaSettings", "GeneticSearch"]

_SMALLEST_STEP = 1e-6


@dataclass(frozen=True)
class GaSettings:
    """The paper's options; the two fractions below them are MATLAB's defaults."""

    population: int = 100
    generations: int = 100
    stall_generations: int = 8
    function_tolerance: float = 1e-6
    elite_share: float = 0.15
    crossover_fraction: float = 0.8

    @property
    def elite(self) -> int:
        """How many of the best parents survive as they are (15 of 100)."""
        return max(1, int(np.ceil(self.elite_share * self.population - 1e-9)))


class _Algorithm(GeneticAlgorithm):  # type: ignore[misc]
    """pymoo's generation scheme; the best is kept by :class:`GeneticSearch`, from arrays."""

    def _set_optimum(self) -> None:
        self.opt = self.pop[:1]


class _EliteSurvival(Survival):  # type: ignore[misc]
    """The ``elite`` best parents and every child, however good: (elite + children) survive."""

    def __init__(self, elite: int) -> None:
        super().__init__(filter_infeasible=False)
        self.elite = elite

    def _do(self, problem: Any, pop: Any, *args: Any, n_survive: int | None = None, **kwargs: Any) -> Any:
        # GeneticAlgorithm merges the parents first, the children after them.
        parents = int(n_survive or len(pop))
        order = np.argsort(pop.get("F")[:parents, 0], kind="stable")[: self.elite]
        return Population.merge(pop[order], pop[parents:])


class _Breeding(InfillCriterion):  # type: ignore[misc]
    """Selection, crossover and mutation for one generation."""

    def __init__(self, settings: GaSettings, rng: np.random.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.rng = rng
        self.step = 1.0
        self.x, self.f = np.empty((0, 0)), np.empty(0)

    def do(self, problem: Any, pop: Any, n_offsprings: int, *args: Any, **kwargs: Any) -> Any:
        x, f = self.x, self.f
        n_cross = round(self.settings.crossover_fraction * n_offsprings)
        n_mutate = n_offsprings - n_cross
        parents = stochastic_uniform(rank_expectation(f), 2 * n_cross + n_mutate, self.rng)
        parents = self.rng.permutation(parents)
        first, second = x[parents[:n_cross]], x[parents[n_cross : 2 * n_cross]]
        children = np.where(self.rng.random(first.shape) < 0.5, first, second)
        mutants = adaptive_feasible(x[parents[2 * n_cross :]], self.step, self.rng)
        return Population.new(X=np.concatenate([children, mutants]))


def rank_expectation(f: Floats) -> Floats:
    """MATLAB's fitscalingrank: expectation 1/sqrt(rank), the best has rank 1; sums to 1."""
    expectation = np.empty(f.size)
    expectation[np.argsort(f, kind="stable")] = 1.0 / np.sqrt(np.arange(1, f.size + 1))
    return expectation / float(expectation.sum())


def stochastic_uniform(expectation: Floats, count: int, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """MATLAB's selectionstochunif: equal steps along a line of sections as long as the expectation."""
    wheel = np.cumsum(expectation) / float(np.sum(expectation))
    positions = (rng.random() + np.arange(count)) / count
    return np.asarray(np.minimum(np.searchsorted(wheel, positions), expectation.size - 1))


def adaptive_feasible(x: Floats, step: float, rng: np.random.Generator) -> Floats:
    """MATLAB's mutationadaptfeasible between 0 and 1: a step along a random mesh direction.

    Each row of ``x`` (k, d) tries the directions of a random lower triangular basis (as in mesh
    adaptive direct search) in random order and takes the first that stays within the bounds;
    without any it is handed on unchanged.
    """
    k, d = x.shape
    reach = 1.0 / np.sqrt(step)
    mutants = x.copy()
    for i in range(k):
        lower = np.tril(np.round((reach + 1.0) * rng.random((d, d)) - 0.5), -1)
        basis = lower + np.diag(reach * np.where(rng.random(d) < 0.5, -1.0, 1.0))
        basis = basis[rng.permutation(d)][:, rng.permutation(d)]
        directions = np.concatenate([basis, -basis, np.eye(d), -np.eye(d)], axis=1)
        directions = directions[:, rng.permutation(4 * d)]
        # half the width of the bounds is the scale of a variable
        trial = x[i, :, None] + 0.5 * step * directions
        inside = np.flatnonzero(np.all((trial >= 0.0) & (trial <= 1.0), axis=0))
        if inside.size:
            mutants[i] = trial[:, inside[0]]
    return mutants


class GeneticSearch:
    """The search as ``ask`` (candidates in unit coordinates (n, d)) and ``tell`` (their costs)."""

    def __init__(self, dimension: int, settings: GaSettings, seed: int, start: Floats | None = None) -> None:
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self._breeding = _Breeding(settings, self.rng)
        self._algorithm = _Algorithm(
            pop_size=settings.population,
            n_offsprings=settings.population - settings.elite,
            sampling=self._first_population(dimension, start),
            mating=self._breeding,
            survival=_EliteSurvival(settings.elite),
            eliminate_duplicates=False,
        )
        problem = Problem(n_var=dimension, n_obj=1, xl=0.0, xu=1.0)
        self._algorithm.setup(problem, termination=NoTermination(), seed=1)
        self.generation = 0
        self.evaluations = 0
        self.best: list[float] = []
        self.mean: list[float] = []
        self._asked: Any = None

    def _first_population(self, dimension: int, start: Floats | None) -> Floats:
        first = self.rng.random((self.settings.population, dimension))
        if start is not None:
            first[0] = np.clip(start, 0.0, 1.0)
        return first

    def ask(self) -> Floats:
        """The candidates of the next generation that have no cost yet."""
        self._asked = self._algorithm.ask()
        return np.asarray(self._asked.get("X"), dtype=float)

    def tell(self, costs: Floats) -> None:
        """Costs (n,) in the order of ``ask``; a failed candidate's is infinite."""
        self._asked.set("F", np.asarray(costs, dtype=float)[:, None])
        self._algorithm.tell(infills=self._asked)
        self.evaluations += len(costs)
        self._look()
        population_costs = self._breeding.f
        previous = self.best[-1] if self.best else np.inf
        self.best.append(float(population_costs.min()))
        finite = population_costs[np.isfinite(population_costs)]
        self.mean.append(float(finite.mean()) if finite.size else np.inf)
        if self.generation >= 2:
            grown = min(1.0, 4.0 * self._breeding.step)
            shrunk = max(_SMALLEST_STEP, self._breeding.step / 4.0)
            self._breeding.step = grown if self.best[-1] < previous else shrunk
        self.generation += 1

    def _look(self) -> None:
        """Take the population's arrays out of its individuals, once a generation."""
        pop = self._algorithm.pop
        self._breeding.x = np.asarray(pop.get("X"), dtype=float)
        self._breeding.f = np.asarray(pop.get("F")[:, 0], dtype=float)

    @property
    def stalled(self) -> bool:
        """Whether the best cost's average relative change over the stall window is within tolerance."""
        window = self.settings.stall_generations
        if len(self.best) <= window:
            return False
        last = np.array(self.best[-window - 1 :])
        if not np.isfinite(last).all():
            return False
        change = np.abs(np.diff(last)) / np.maximum(np.abs(last[:-1]), np.finfo(float).tiny)
        return bool(change.mean() <= self.settings.function_tolerance)

    @property
    def finished(self) -> bool:
        # the first population is generation 0; MATLAB counts the ones bred from it
        return self.generation > self.settings.generations or self.stalled

    @property
    def best_point(self) -> tuple[Floats, float]:
        """Unit coordinates and cost of the best candidate so far."""
        i = int(np.argmin(self._breeding.f))
        return self._breeding.x[i].copy(), float(self._breeding.f[i])

    def state(self) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Arrays and plain values that ``restore`` takes up again to the same bits."""
        arrays = {
            "population": self._breeding.x,
            "costs": self._breeding.f,
            "best": np.array(self.best),
            "mean": np.array(self.mean),
        }
        plain = {
            "generation": self.generation,
            "evaluations": self.evaluations,
            "mutation_step": self._breeding.step,
            "random": self.rng.bit_generator.state,
        }
        return arrays, plain

    def restore(self, arrays: Mapping[str, Floats], plain: Mapping[str, Any]) -> None:
        """Continue where ``state`` was taken."""
        self._algorithm.pop = Population.new(X=arrays["population"], F=arrays["costs"][:, None])
        self._algorithm.is_initialized = True
        self._look()
        self._algorithm.n_iter = int(plain["generation"]) + 1
        self.generation = int(plain["generation"])
        self.evaluations = int(plain["evaluations"])
        self.best = [float(v) for v in arrays["best"]]
        self.mean = [float(v) for v in arrays["mean"]]
        self._breeding.step = float(plain["mutation_step"])
        self.rng.bit_generator.state = plain["random"]
