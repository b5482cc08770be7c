# SPDX-License-Identifier: Apache-2.0
"""How far clocks, map and mount are asked to be from what is normal of them.

What is left on the road is mostly the model's own error, which comes again at every sample and counts as little
evidence; what is known of clocks and mounts beforehand does not come again, and counts in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench, Curved, Linearised
from suspension_twin.identification.gauss_newton import Linear, room, within

__all__ = ["Strain", "relieved", "strain_of"]


@dataclass(frozen=True, eq=False)
class Strain:
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
        """Nats that the nuisances cost where residuals count by ``temper`` and the nuisances are what suits both best,
        with what the residuals lose by it; and nats that the freedom of all unknowns costs there."""
        own, given = self.nuisances, temper * self.precision
        given[own, own] = self.precision[own, own]
        hessian = temper * self.curvature + given
        gradient = temper * self.slope + np.einsum("ij,j->i", given, self.away, optimize=False)
        step = within(hessian, gradient[:, None], self.low, self.high)[:, 0]
        # what the residuals lose by it is the price of sparing the nuisances
        changed = float(gradient @ step + 0.5 * step @ hessian @ step)
        spent = 0.5 * float(self.away[own] @ self.precision[own, own] @ self.away[own]) + changed
        full = temper * self.curvature + self.precision
        freedom = 0.5 * (np.linalg.slogdet(full)[1] - np.linalg.slogdet(self.precision)[1])
        return max(spent, 0.0), float(freedom)


def strain_of(bench: Bench, fit: Linear, at: Linearised | Curved) -> Strain:
    """That of a fit, ``at`` its place, with every residual in units of what is left."""
    precision, centre = bench.prior(fit.hypothesis)
    low, high = room(bench, fit.hypothesis, fit.x)
    pulled = np.einsum("ij,j->i", precision, fit.x - centre, optimize=False)
    outward = ((low >= 0) & (at.slope + pulled > 0)) | ((high <= 0) & (at.slope + pulled < 0))
    # at its best a fit's residuals and its prior pull alike, but for what a limit holds
    slope = np.where(outward, at.slope, -pulled)
    nuisances = slice(bench.d, bench.d + bench.q)
    return Strain(at.squares, slope, precision, fit.x - centre, nuisances, low, high)


def relieved(strains: Sequence[Strain | None], temper: float) -> Floats:
    """(K,) nats that each hypothesis gains over the first, which is part of all, by what it spares the nuisances: as
    far as that is more than its own freedom costs."""
    if any(s is None for s in strains):
        return np.zeros(len(strains))
    spent, freedom = np.array([s.at(temper) for s in strains if s is not None]).T
    spared, price = spent[0] - spent, np.maximum(freedom - freedom[0], 0.0)
    return np.asarray(np.minimum(spared, np.maximum(spared - price, 0.0)))
