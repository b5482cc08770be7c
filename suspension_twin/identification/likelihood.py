# SPDX-License-Identifier: Apache-2.0
"""What is left between car and twin, as a random process: autoregressive noise in each channel.

Filtered noise, GNSS errors and unmodelled motion are anything but white. Weighing residuals as if
they were makes the estimate worse and its intervals far too narrow (on synthetic drives 90 %
intervals cover some 60 %). An autoregressive model of each channel's residual, fitted to the
residual itself, whitens residuals and Jacobian alike: generalised least squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from suspension_twin.arrays import Floats
from suspension_twin.errors import WorkError
from suspension_twin.identification.objectives import Measured, Objective
from suspension_twin.identification.problem import FitProblem, Problem

__all__ = ["INDEPENDENT", "NEAR_FLOOR", "Likelihood", "Squares", "autoregression"]

ORDER = 16
#: Residuals in floors (the median of the channels) up to which what is left is taken for noise.
NEAR_FLOOR = 3.0
#: Share of Nyquist's band that the default filter passes: samples count for half as many independent ones.
INDEPENDENT = 0.5
_ENOUGH = 30  # samples for each coefficient


def autoregression(parts: list[Floats], order: int) -> tuple[Floats, float]:
    """Prediction-error filter (order + 1,) and innovation standard deviation of stretches of one process.

    Yule-Walker on the pooled autocovariance, which always gives a stable model.
    """
    count = sum(len(p) for p in parts)
    covariance = np.zeros(order + 1)
    for part in parts:
        for lag in range(min(order + 1, len(part))):
            covariance[lag] += float(np.einsum("i,i->", part[: len(part) - lag], part[lag:], optimize=False))
    covariance /= max(count, 1)
    covariance[0] = covariance[0] * (1 + 1e-9) + 1e-300
    weights = linalg.solve_toeplitz(covariance[:order], covariance[1:])
    innovation = covariance[0] - float(np.einsum("i,i->", weights, covariance[1:], optimize=False))
    return np.concatenate([[1.0], -weights]), float(np.sqrt(max(innovation, 1e-300)))


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Residuals made white and of unit variance; their sum of squares is -2 log likelihood up to a constant.

    ``filters`` (G, C, order + 1) and ``sigmas`` (G, C) of each drive (``group`` of every stretch).
    """

    measured: Measured
    group: tuple[int, ...]
    filters: Floats
    sigmas: Floats

    @classmethod
    def fitted(cls, measured: Measured, simulated: Floats, order: int = ORDER) -> Likelihood:
        """From the residuals that ``simulated`` (M, C) leaves; a drive too short for a model of its own
        shares one with all."""
        stretches = measured.stretches
        drives = measured.drives or (0,) * len(stretches)
        length = {
            d: sum(s.stop - s.start for s, e in zip(stretches, drives, strict=True) if e == d) for d in drives
        }
        own = [d for d in dict.fromkeys(drives) if length[d] >= _ENOUGH * order]
        if set(own) != set(drives):
            own = []
        group = tuple(own.index(d) if own else 0 for d in drives)
        count = max(1, len(own))
        filters = np.empty((count, len(measured.channels), order + 1))
        sigmas = np.empty((count, len(measured.channels)))
        for c in range(len(measured.channels)):
            residual = simulated[:, c] - measured.values[:, c]
            for g in range(count):
                parts = [
                    residual[s] - residual[s].mean() for s, k in zip(stretches, group, strict=True) if k == g
                ]
                filters[g, c], sigmas[g, c] = autoregression(parts, order)
        return cls(measured, group, filters, sigmas)

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) whitened residuals of candidates (M, C, L); each stretch loses its first samples."""
        parts = []
        order = self.filters.shape[2] - 1
        for c in range(len(self.measured.channels)):
            difference = simulated[:, c, :] - self.measured.values[:, c, None]
            for stretch, g in zip(self.measured.stretches, self.group, strict=True):
                if stretch.stop - stretch.start > 2 * order:
                    parts.append(_whitened(self.filters[g, c], difference[stretch]) / self.sigmas[g, c])
        if not parts:
            raise WorkError("the compared stretches are too short to tell noise from motion")
        return np.concatenate(parts)


def _whitened(taps: Floats, x: Floats) -> Floats:
    """(n - order, L) the moving average ``taps`` (order + 1,), newest sample first, of (n, L)."""
    order = len(taps) - 1
    white = taps[0] * x[order:]
    for k in range(1, order + 1):
        white += taps[k] * x[order - k : len(x) - k]
    return np.asarray(white)


@dataclass(frozen=True, eq=False)
class Squares:
    """An objective's residuals in units of what is left of them: least squares as a rough likelihood."""

    objective: Objective
    scale: float

    @classmethod
    def at(cls, problem: Problem, x: Floats) -> Squares:
        """With the scale that the residuals have at coordinates ``x`` (d + q,)."""
        sums = FitProblem(problem).sums_of_squares(x[:, None])
        count = len(problem.objective.residuals(problem.measured.values[:, :, None]))
        return cls(problem.objective, float(np.sqrt(max(float(sums[0]) / count / INDEPENDENT, 1e-300))))

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) of candidates (M, C, L)."""
        return np.asarray(self.objective.residuals(simulated) / self.scale)
