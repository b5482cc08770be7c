# SPDX-License-Identifier: Apache-2.0
"""The nuisance penalty: log prior probability of the nuisance parameters (clocks, map, mount) that a hypothesis needs.

The remaining residual is mostly model discrepancy, which is correlated over samples: its likelihood is tempered by the
share ``temper`` that is noise. The priors of the nuisance parameters are independent of it and not tempered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.fit import LinearisedFit, room
from suspension_twin.diagnosis.partial import kept
from suspension_twin.inference.gauss_newton import Quadratic, bounded_step

__all__ = ["NuisancePenalty", "penalty_of"]


@kept
@dataclass(frozen=True, eq=False)
class NuisancePenalty:
    """The posterior about a fit: ``curvature`` (p, p) and ``slope`` (p,) of half its squares, ``precision`` (p, p) of
    the prior, how far ``away`` (p,) its centre is, the ``nuisances`` among the p unknowns and the room that each has
    down and up."""

    curvature: Floats
    slope: Floats
    precision: Floats
    away: Floats
    nuisances: slice
    low: Floats
    high: Floats

    def at(self, temper: float) -> tuple[float, float]:
        """Nuisance penalty in nats at the minimum of the tempered cost, and the Occam term of all unknowns there."""
        own, given = self.nuisances, temper * self.precision
        given[own, own] = self.precision[own, own]
        hessian = temper * self.curvature + given
        gradient = temper * self.slope + given @ self.away
        step = bounded_step(hessian, gradient[:, None], self.low, self.high)[:, 0]
        # includes the change of the residuals
        changed = float(gradient @ step + 0.5 * step @ hessian @ step)
        spent = 0.5 * float(self.away[own] @ self.precision[own, own] @ self.away[own]) + changed
        full = temper * self.curvature + self.precision
        freedom = 0.5 * (np.linalg.slogdet(full)[1] - np.linalg.slogdet(self.precision)[1])
        return max(spent, 0.0), float(freedom)


def penalty_of(bench: Bench, fit: LinearisedFit, at: Quadratic) -> NuisancePenalty:
    """The nuisance penalty of a fit; ``at`` is its quadratic model in units of the remaining residual."""
    precision, centre = bench.prior(fit.hypothesis)
    low, high = room(bench, fit.hypothesis, fit.x)
    pulled = precision @ (fit.x - centre)
    outward = ((low >= 0) & (at.slope + pulled > 0)) | ((high <= 0) & (at.slope + pulled < 0))
    # at the optimum the gradients of residuals and prior cancel, except on an active bound
    slope = np.where(outward, at.slope, -pulled)
    nuisances = slice(bench.d, bench.d + bench.q)
    return NuisancePenalty(at.squares, slope, precision, fit.x - centre, nuisances, low, high)
