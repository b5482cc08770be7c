# SPDX-License-Identifier: Apache-2.0
"""The car paper's genetic algorithm (section 4.3): pymoo's operators, the paper's survival.

The paper sets five options of MATLAB's ``ga``: population 100, at most 100 generations, stall after
8, elite share 0.15, a hybrid function afterwards. So each generation is the 15 best parents and 85
children. The children come from pymoo: binary tournaments, uniform crossover (MATLAB's "scattered")
of 0.8 of the pairs, and polynomial mutation.

Everything is in unit coordinates. The search is driven from outside (``ask``/``tell``) and follows from its seed and
the costs that it is told: told them again, it is where it was, to the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pymoo.core.mating import Mating
from pymoo.core.population import Population
from pymoo.core.problem import Problem
from pymoo.operators.crossover.ux import UX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.selection.tournament import TournamentSelection

from suspension_twin.arrays import Floats

__all__ = ["GaSettings", "GeneticSearch"]


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


def _cheapest(pop: Any, contestants: Any, **_: object) -> Any:
    """(n, 1) the winner, by cost, of each tournament of ``contestants`` (n, k), rows of ``pop``."""
    costs = pop.get("F")[contestants, 0]
    return np.take_along_axis(contestants, np.argmin(costs, axis=1)[:, None], axis=1)


class GeneticSearch:
    """The search as ``ask`` (candidates in unit coordinates (n, d)) and ``tell`` (their costs)."""

    def __init__(self, dimension: int, settings: GaSettings, seed: int) -> None:
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self.best: list[float] = []
        self.mean: list[float] = []
        self.population, self.costs = np.empty((0, dimension)), np.empty(0)
        self._asked = self.rng.random((settings.population, dimension))
        self._problem = Problem(n_var=dimension, n_obj=1, xl=0.0, xu=1.0)
        self._mating = Mating(
            TournamentSelection(func_comp=_cheapest), UX(prob=settings.crossover_fraction), PM()
        )

    def ask(self) -> Floats:
        """The candidates of the next generation that have no cost yet."""
        if self.costs.size:
            parents = Population.new(X=self.population, F=self.costs[:, None])
            count = self.settings.population - self.settings.elite
            children = self._mating(self._problem, parents, count, random_state=self.rng)
            self._asked = np.asarray(children.get("X"), dtype=float)
        return self._asked

    def tell(self, costs: Floats) -> None:
        """Costs (n,) in the order of ``ask``; a failed candidate's is infinite.

        The best parents survive as they are, and every child, however good."""
        kept = np.argsort(self.costs, kind="stable")[: self.settings.elite]
        self.population = np.concatenate([self.population[kept], self._asked])
        self.costs = np.concatenate([self.costs[kept], costs])
        self.best.append(float(self.costs.min()))
        finite = self.costs[np.isfinite(self.costs)]
        self.mean.append(float(finite.mean()) if finite.size else np.inf)

    @property
    def generation(self) -> int:
        """How many generations have their costs, the first population included."""
        return len(self.best)

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
        i = int(np.argmin(self.costs))
        return self.population[i].copy(), float(self.costs[i])

    @property
    def mean_cost(self) -> float:
        """Mean cost of the last population, failed candidates left out."""
        return self.mean[-1]
