# SPDX-License-Identifier: Apache-2.0
"""Pattern search after the genetic algorithm (the car paper's hybrid function, section 4.3).

MATLAB's ``patternsearch`` defaults: generalised pattern search on the positive basis 2N, mesh
expansion 2, contraction 0.5, tolerances 1e-6. One difference: all 2N points of a poll are simulated
in one batch and the best is taken (MATLAB's ``UseCompletePoll``), because a batch of 48 lanes costs
little more than one; every point counts as an evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["PatternSearch", "PatternSettings"]


@dataclass(frozen=True)
class PatternSettings:
    """``mesh`` is the first step in unit coordinates: half the bounds' distance."""

    mesh: float = 0.5
    expansion: float = 2.0
    contraction: float = 0.5
    mesh_tolerance: float = 1e-6
    function_tolerance: float = 1e-6
    step_tolerance: float = 1e-6
    evaluations: int = 2242


class PatternSearch:
    """``ask`` gives the poll around the best point (2d, d), ``tell`` takes its costs (2d,)."""

    def __init__(self, start: Floats, cost: float, settings: PatternSettings) -> None:
        self.settings = settings
        self.x = np.clip(np.asarray(start, dtype=float), 0.0, 1.0)
        self.cost = float(cost)
        self.mesh = settings.mesh
        self.evaluations = 0
        self.converged = False
        self._asked = np.empty((0, self.x.size))

    def ask(self) -> Floats:
        """The poll points within the bounds that differ from the point itself."""
        d = self.x.size
        step = self.mesh * np.concatenate([np.eye(d), -np.eye(d)])
        points = np.clip(self.x + step, 0.0, 1.0)
        self._asked = points[np.any(points != self.x, axis=1)]
        return self._asked

    def tell(self, costs: Floats) -> None:
        """Move to the best point where it improves and widen the mesh, else halve it."""
        s = self.settings
        self.evaluations += len(costs)
        best = int(np.argmin(costs)) if len(costs) else -1
        if best >= 0 and costs[best] < self.cost:
            gain = self.cost - float(costs[best])
            moved = float(np.linalg.norm(self._asked[best] - self.x))
            self.x, self.cost = self._asked[best].copy(), float(costs[best])
            self.mesh = min(s.expansion * self.mesh, 1.0)
            if moved < s.step_tolerance and gain <= s.function_tolerance * abs(self.cost):
                self.converged = True
        else:
            self.mesh *= s.contraction
            if self.mesh < s.mesh_tolerance:
                self.converged = True

    @property
    def finished(self) -> bool:
        return self.converged or self.evaluations + 2 * self.x.size > self.settings.evaluations

    @property
    def best_point(self) -> tuple[Floats, float]:
        """Unit coordinates and cost of the best point so far."""
        return self.x, self.cost

    @property
    def mean_cost(self) -> float:
        """The best cost: a pattern search has no population."""
        return self.cost
