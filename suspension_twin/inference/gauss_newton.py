# SPDX-License-Identifier: Apache-2.0
"""Bounded Gauss-Newton in batches: the Jacobian is one batch of simulations, a ladder of damped steps another.

Minimises the negative log posterior, doubled,

    f(x) = r(x)^T r(x) + (x - c)^T P (x - c),   low <= x <= high,

of whitened residuals r and a normal prior of precision P about c. About x the curvature is H = J^T J + P and half the
gradient is g = J^T r + P (x - c). A step solves the damped quadratic model within the bounds,

    min_s  s^T (H + D) s + 2 g^T s,   low <= x + s <= high,

by a primal-dual active set (Hintermueller, Ito, Kunisch 2003), in ``bounded_step``. The cost of a simulation is by
batch, not by candidate: every iteration tries several dampings in one batch and takes the best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.inference.checkpoint import stored

__all__ = [
    "WHITENED",
    "Descent",
    "GaussNewton",
    "GaussNewtonSettings",
    "Quadratic",
    "Residuals",
    "bounded_step",
    "solve_positive",
]

_ROUNDS = 12  # of the active set iteration


@stored
@dataclass(frozen=True, eq=False)
class Quadratic:
    """Sum of squared residuals about a point: ``value`` r^T r, ``squares`` (p, p) J^T J, ``slope`` (p,) J^T r."""

    value: float
    squares: Floats
    slope: Floats


class Residuals(Protocol):
    """Interface of a least squares problem with p unknowns."""

    def quadratic(self, x: Floats) -> Quadratic:
        """The quadratic model of the sum of squares about ``x`` (p,)."""

    def sums_of_squares(self, x: Floats) -> Floats:
        """(L,) sums of squared residuals of candidates (p, L), infinite where one cannot be simulated."""


@dataclass(frozen=True)
class GaussNewtonSettings:
    """``iterations``: how many ladders are tried at most. ``ladder``: dampings tried at once, as factors of the current
    one. An iteration is calm that lowers the cost by less than the share ``tolerance`` or by less than ``absolute``;
    ``patience`` of them in a row end the search.

    ``prior_damping``: weight of the prior precision, over that of the curvature, in the damping matrix D. It limits
    steps in coordinates that the data hardly excite without limiting the others. ``shortened``: share of the step of
    the current damping that is tried as well, 0 for none. ``relaxed``: factor on the damping after a success, None for
    the damping that succeeded. ``raised``: factor after a failure. The search ends where the undamped step (0 in the
    ladder) is predicted to lower the cost by less than ``absolute``.
    """

    iterations: int = 30
    tolerance: float = 1e-5
    absolute: float = 0.0
    patience: int = 2
    damping: float = 1e-2
    ladder: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 1e3)
    least_damping: float = 1e-12
    largest_damping: float = 1e9
    largest_step: float = 2.0
    prior_damping: float = 0.0
    shortened: float = 0.0
    relaxed: float | None = None
    raised: float = 1e4


#: For whitened residuals. The prior damps a step 1e4 times more than the curvature does, so that a parameter that the
#: drive hardly excites does not limit the step of the others. A step that lowers -2 log posterior by less than 0.3 ends
#: the search.
WHITENED = GaussNewtonSettings(
    tolerance=0.0,
    absolute=0.3,
    patience=1,
    ladder=(0.0, 1e-2, 1e-1, 1.0, 10.0),
    least_damping=1e-4,
    largest_damping=1e4,
    prior_damping=1e4,
    shortened=0.3,
    relaxed=0.3,
    raised=100.0,
)


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solve a symmetric, at least positive semidefinite system, scaled to a unit diagonal."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix * scale[:, None] * scale[None, :]
    scaled[np.diag_indices_from(scaled)] += 1e-13
    right = right * (scale[:, None] if right.ndim == 2 else scale)
    solution = np.linalg.solve(scaled, right)
    return np.asarray(solution * (scale[:, None] if right.ndim == 2 else scale))


def bounded_step(hessian: Floats, gradient: Floats, low: Floats, high: Floats) -> Floats:
    """(p, S) steps that minimise s^T H s + 2 g^T s for half gradients (p, S), between ``low`` <= 0 and ``high`` >= 0.

    Primal-dual active set: coordinates beyond a bound are fixed on it, fixed ones whose gradient points inwards are
    released, until the set is stable. The free coordinates are solved for given the fixed ones.
    """
    steps = -solve_positive(hessian, gradient)
    for i in np.flatnonzero(((steps < low[:, None]) | (steps > high[:, None])).any(axis=0)):
        step = steps[:, i]
        below, above = step < low, step > high
        for _ in range(_ROUNDS):
            step = np.where(below, low, np.where(above, high, 0.0))
            free = np.flatnonzero(~(below | above))
            slope = gradient[free, i] + hessian[free] @ step
            step[free] = -solve_positive(hessian[np.ix_(free, free)], slope)
            pull = gradient[:, i] + hessian @ step
            kept, lost = (below & (pull > 0)) | (step < low), (above & (pull < 0)) | (step > high)
            if (kept == below).all() and (lost == above).all():
                break
            below, above = kept, lost & ~kept
        steps[:, i] = np.clip(step, low, high)
    return steps


@dataclass(kw_only=True)
class Descent:
    """State of a minimisation beside its point: the current ``damping``, the ``cost`` with the prior and the sum of
    squares ``fit`` without it, iterations so far and ``calm`` ones in a row."""

    damping: float = 0.0
    cost: float = np.inf
    fit: float = np.inf
    iteration: int = 0
    calm: int = 0
    finished: bool = False


@dataclass
class GaussNewton(Descent):
    """One minimisation from ``x`` (p,) with the prior's ``precision`` (p, p) about ``centre`` (p,), within ``low`` and
    ``high`` (p,), where there are any."""

    problem: Residuals
    x: Floats
    precision: Floats
    centre: Floats
    low: Floats | None = None
    high: Floats | None = None
    settings: GaussNewtonSettings = field(default_factory=GaussNewtonSettings)

    def __post_init__(self) -> None:
        if self.damping == 0.0:
            self.damping = self.settings.damping

    def penalty(self, x: Floats) -> Floats:
        """(L,) cost of the prior, (x - c)^T P (x - c), for candidates (p, L)."""
        away = x - self.centre[:, None]
        return np.asarray(np.einsum("il,il->l", away, self.precision @ away))

    def costs(self, x: Floats) -> tuple[Floats, Floats]:
        """(L,) costs of candidates (p, L), and their sums of squares."""
        fits = self.problem.sums_of_squares(x)
        return np.where(np.isfinite(fits), fits, np.inf) + self.penalty(x), fits

    def begin(self, starts: Floats) -> None:
        """Start from the best of ``starts`` (p, S)."""
        starts = self._clipped(starts)
        costs, fits = self.costs(starts)
        best = int(np.argmin(costs))
        self.x, self.cost, self.fit = starts[:, best].copy(), float(costs[best]), float(fits[best])

    def step(self) -> None:
        """One iteration: linearise, try the ladder of dampings, take the best step or raise the damping and repeat."""
        s, model = self.settings, self.problem.quadratic(self.x)
        if not np.isfinite(self.cost):
            self.fit = model.value
            self.cost = self.fit + float(self.penalty(self.x[:, None])[0])
        hessian = model.squares + self.precision
        gradient = model.slope + self.precision @ (self.x - self.centre)
        while not self.finished:
            self.iteration += 1
            candidates = self._candidates(hessian, gradient)
            if candidates is None:
                self.finished = True
                return
            costs, fits = self.costs(candidates)
            best = int(np.argmin(costs))
            if costs[best] < self.cost:
                gain = self.cost - float(costs[best])
                self.x, self.cost, self.fit = (
                    candidates[:, best].copy(),
                    float(costs[best]),
                    float(fits[best]),
                )
                used = (
                    self.damping * s.ladder[min(best, len(s.ladder) - 1)]
                    if s.relaxed is None
                    else self.damping
                )
                self.damping = max(used * (s.relaxed or 1.0), s.least_damping)
                self.calm = self.calm + 1 if gain < max(s.tolerance * (self.cost + gain), s.absolute) else 0
                self.finished = self.calm >= s.patience or self.iteration >= s.iterations
                return
            self.damping *= s.raised
            self.finished = self.damping > s.largest_damping or self.iteration >= s.iterations

    def _candidates(self, hessian: Floats, gradient: Floats) -> Floats | None:
        """(p, S) candidates of the ladder of dampings; None where the predicted decrease is below ``absolute``."""
        s = self.settings
        low, high = self.room(self.x)
        weight = np.diag(hessian) + s.prior_damping * np.diag(self.precision)
        found, short = [], []
        for factor in s.ladder:
            damped = hessian + self.damping * factor * np.diag(weight)
            step = bounded_step(damped, gradient[:, None], low, high)[:, 0]
            if factor == 0.0 and -2.0 * float(gradient @ step + 0.5 * step @ hessian @ step) < s.absolute:
                return None
            step *= min(1.0, s.largest_step / max(float(np.abs(step).max()), 1e-300))
            found.append(self.x + step)
            if factor == 1.0 and s.shortened:
                short.append(self.x + s.shortened * step)
        return self._clipped(np.stack(found + short, axis=1))

    def room(self, x: Floats) -> tuple[Floats, Floats]:
        """(p,) how far each coordinate may go down and up from ``x``."""
        return (
            np.full(x.size, -np.inf) if self.low is None else np.minimum(self.low - x, 0.0),
            np.full(x.size, np.inf) if self.high is None else np.maximum(self.high - x, 0.0),
        )

    def _clipped(self, x: Floats) -> Floats:
        if self.low is None or self.high is None:
            return x
        return np.asarray(np.clip(x, self.low[:, None], self.high[:, None]))

    def run(
        self, stop: Callable[[], bool] = lambda: False, each: Callable[[GaussNewton], None] | None = None
    ) -> None:
        """Iterate until convergence, the last iteration or ``stop``."""
        while not self.finished and not stop():
            self.step()
            if each is not None:
                each(self)
