# SPDX-License-Identifier: Apache-2.0
"""CMA-ES (the package ``cma``) for objectives that are no sum of squares.

A search follows from its seed and the costs of every generation: asked and told again with them, it is where it was, to
the same bits.
"""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["CmaSearch"]

#: Spread of a generation's costs, as a share of what the search has gained, that ends it.
_TOLERANCE = 1e-6


class CmaSearch:
    """``ask`` gives candidates (n, d), ``tell`` takes their costs (n,)."""

    def __init__(
        self, start: Floats, sigma: float, seed: int, population: int, generations: int = 300
    ) -> None:
        import cma  # takes a second, and most objectives do not need it

        draw = np.random.default_rng(seed).standard_normal
        options = {
            "randn": lambda *shape: draw(shape),
            "seed": math.nan,  # leaves NumPy's global generator alone
            "maxiter": generations,
            "popsize": population,
            "tolfunrel": _TOLERANCE,
            "verbose": -9,
        }
        self._search = cma.CMAEvolutionStrategy(start, sigma, options)
        self._asked: list[Floats] = []
        self.best_point, self.mean_cost = (start.astype(float), np.inf), np.inf

    def ask(self) -> Floats:
        """Candidates drawn around the mean."""
        self._asked = self._search.ask()
        return np.array(self._asked)

    def tell(self, costs: Floats) -> None:
        """Adapt mean, step and covariance; a failed candidate's cost is infinite, and it ranks last."""
        finite = costs[np.isfinite(costs)]
        self.mean_cost = float(finite.mean()) if finite.size else np.inf
        best = int(np.argmin(costs))
        if costs[best] < self.best_point[1]:
            self.best_point = np.array(self._asked[best]), float(costs[best])
        last = float(finite.max()) if finite.size else 0.0
        self._search.tell(self._asked, np.where(np.isfinite(costs), costs, last).tolist())

    @property
    def finished(self) -> bool:
        return bool(self._search.stop())
