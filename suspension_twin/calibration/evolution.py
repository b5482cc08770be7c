# SPDX-License-Identifier: Apache-2.0
"""CMA-ES for objectives that are no sum of squares.

After N. Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), with its default settings. Its
whole state is a handful of arrays, so a search killed anywhere continues to the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats

__all__ = ["CmaSearch"]

_ARRAYS = ("mean", "covariance", "path_c", "path_s", "best_x")
_PLAIN = ("sigma", "generation", "evaluations", "best_cost", "mean_cost", "calm")


class CmaSearch:
    """``ask`` gives candidates (n, d), ``tell`` takes their costs (n,)."""

    def __init__(
        self, start: Floats, sigma: float, seed: int, population: int = 0, generations: int = 300
    ) -> None:
        d = start.size
        self.d, self.generations = d, generations
        self.population = population or 4 + int(3 * np.log(d))
        self.rng = np.random.default_rng(seed)
        raw = np.log(self.population / 2 + 0.5) - np.log(np.arange(1, self.population // 2 + 1))
        self.weights = raw / raw.sum()
        self.mu_eff = 1.0 / float((self.weights**2).sum())
        self.c_c = (4 + self.mu_eff / d) / (d + 4 + 2 * self.mu_eff / d)
        self.c_s = (self.mu_eff + 2) / (d + self.mu_eff + 5)
        self.c_1 = 2 / ((d + 1.3) ** 2 + self.mu_eff)
        self.c_mu = min(1 - self.c_1, 2 * (self.mu_eff - 2 + 1 / self.mu_eff) / ((d + 2) ** 2 + self.mu_eff))
        self.damp = 1 + 2 * max(0.0, np.sqrt((self.mu_eff - 1) / (d + 1)) - 1) + self.c_s
        self.expected = np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d**2))
        self.mean, self.sigma = start.astype(float).copy(), float(sigma)
        self.covariance = np.eye(d)
        self.path_c, self.path_s = np.zeros(d), np.zeros(d)
        self.generation = self.evaluations = self.calm = 0
        self.best_x, self.best_cost, self.mean_cost = self.mean.copy(), np.inf, np.inf
        self._asked = np.empty((0, d))

    def ask(self) -> Floats:
        """Candidates drawn around the mean."""
        values, vectors = np.linalg.eigh(self.covariance)
        self._scale = np.sqrt(np.maximum(values, 1e-30))
        self._vectors = vectors
        normal = self.rng.standard_normal((self.population, self.d))
        self._asked = self.mean + self.sigma * np.einsum(
            "ni,di->nd", normal * self._scale, vectors, optimize=False
        )
        return self._asked

    def tell(self, costs: Floats) -> None:
        """Move towards the better half and adapt step and covariance; failed candidates rank last."""
        order = np.argsort(np.where(np.isfinite(costs), costs, np.inf), kind="stable")
        self.generation += 1
        self.evaluations += len(costs)
        before = self.best_cost
        if costs[order[0]] < self.best_cost:
            self.best_x, self.best_cost = self._asked[order[0]].copy(), float(costs[order[0]])
        finite = costs[np.isfinite(costs)]
        self.mean_cost = float(finite.mean()) if finite.size else np.inf
        gain = (before - self.best_cost) / max(abs(self.best_cost), 1e-300) if np.isfinite(before) else 1.0
        self.calm = self.calm + 1 if gain < 1e-6 else 0
        chosen = (self._asked[order[: self.weights.size]] - self.mean) / self.sigma
        step = np.einsum("n,nd->d", self.weights, chosen, optimize=False)
        self.mean = self.mean + self.sigma * step
        whitened = np.einsum("id,d->i", self._vectors.T, step, optimize=False) / self._scale
        whitened = np.einsum("di,i->d", self._vectors, whitened, optimize=False)
        self.path_s = (1 - self.c_s) * self.path_s + np.sqrt(
            self.c_s * (2 - self.c_s) * self.mu_eff
        ) * whitened
        length = float(np.sqrt((self.path_s**2).sum()))
        turning = np.sqrt(1 - (1 - self.c_s) ** (2 * self.generation))
        slow = length / turning < (1.4 + 2 / (self.d + 1)) * self.expected
        self.path_c = (1 - self.c_c) * self.path_c
        if slow:
            self.path_c = self.path_c + np.sqrt(self.c_c * (2 - self.c_c) * self.mu_eff) * step
        kept = 1 - self.c_1 - self.c_mu + (0.0 if slow else self.c_1 * self.c_c * (2 - self.c_c))
        rank_mu = np.einsum("n,ni,nj->ij", self.weights, chosen, chosen, optimize=False)
        covariance = (
            kept * self.covariance + self.c_1 * np.outer(self.path_c, self.path_c) + self.c_mu * rank_mu
        )
        self.covariance = 0.5 * (covariance + covariance.T)
        self.sigma *= float(np.exp(min(1.0, (self.c_s / self.damp) * (length / self.expected - 1))))

    @property
    def finished(self) -> bool:
        stall = 10 + int(30 * self.d / self.population)
        return self.generation >= self.generations or self.calm >= stall or self.sigma < 1e-8

    def state(self) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Arrays and plain values for ``restore``."""
        plain: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN}
        plain["random"] = self.rng.bit_generator.state
        return {name: getattr(self, name) for name in _ARRAYS}, plain

    def restore(self, arrays: Mapping[str, Floats], plain: Mapping[str, Any]) -> None:
        """Continue where ``state`` was taken."""
        for name in _ARRAYS:
            setattr(self, name, np.array(arrays[name]))
        for name in _PLAIN:
            setattr(self, name, plain[name])
        self.rng.bit_generator.state = plain["random"]
