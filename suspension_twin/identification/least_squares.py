# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt in batches: the Jacobian is one batch, a ladder of damped steps another.

A batched simulator prices an iteration by batches, not by lanes, so every iteration tries several
dampings at once and takes the best. The prior enters as a quadratic penalty. Reductions run in a
fixed order in plain loops: the result does not depend on how many threads a BLAS would use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled

__all__ = ["LeastSquares", "LeastSquaresProblem", "LmSettings", "gram", "solve_positive", "squared"]

_ROWS = 64  # that are summed at a time, a multiple of eight


class LeastSquaresProblem(Protocol):
    """What the solver needs of a problem with ``d`` unknowns and R residuals."""

    def linearise(self, x: Floats) -> tuple[Floats, Floats, int]:
        """Residuals (R,), Jacobian (R, d) and the number of simulations spent at ``x`` (d,)."""

    def sums_of_squares(self, x: Floats) -> tuple[Floats, int]:
        """Sum of squared residuals (L,) of candidates (d, L) and the simulations spent."""


@dataclass(frozen=True)
class LmSettings:
    """``ladder``: dampings tried at once, as factors of the current one. An iteration is calm that lowers
    the cost by less than the share ``tolerance`` or by less than ``absolute``; ``patience`` of them in
    a row end the search."""

    iterations: int = 30
    tolerance: float = 1e-5
    absolute: float = 0.0
    patience: int = 2
    damping: float = 1e-2
    ladder: tuple[float, ...] = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 1e3)
    largest_damping: float = 1e9
    largest_step: float = 2.0


def gram(a: Floats, b: Floats) -> Floats:
    """a.T @ b for tall arrays (R, p) and (R, q), summed in one fixed order on one thread: the same bits
    whatever a BLAS would use, and no threads of it waiting for each other on a busy machine."""
    return np.asarray(_gram(np.ascontiguousarray(a), np.ascontiguousarray(b)))


def squared(a: Floats) -> Floats:
    """a.T @ a for a tall array (R, p), on one thread as ``gram`` and by half the work or less."""
    return np.asarray(_squared(np.ascontiguousarray(a)))


@compiled
def _squared(a: Floats) -> Floats:  # pragma: no cover - compiled
    """A block of rows at a time, those of its columns side by side that are not all zero: a drive's bias is nothing in
    the rows of other drives and channels."""
    rows, p = a.shape
    out = np.zeros((p, p))
    block, sums = np.zeros((_ROWS, p + -p % 8)), np.zeros((p, p + -p % 8))
    there, before = np.zeros(p, dtype=np.bool_), np.zeros(p, dtype=np.bool_)
    columns = np.empty(0, dtype=np.intp)
    for start in range(0, rows, _ROWS):
        part = a[start : start + _ROWS]
        for j in range(p):
            r = 0
            while r < part.shape[0] and part[r, j] == 0.0:
                r += 1
            there[j] = r < part.shape[0]
        if (there != before).any() or part.shape[0] < _ROWS:
            _spread(sums, columns, out)
            columns = np.flatnonzero(there)
            before[:] = there
            block[:] = 0.0
        for r in range(part.shape[0]):
            for k in range(columns.size):
                block[r, k] = part[r, columns[k]]
        wide = columns.size + -columns.size % 8  # whole vectors
        for r in range(0, _ROWS, 8):
            b0, b1, b2, b3 = block[r], block[r + 1], block[r + 2], block[r + 3]
            b4, b5, b6, b7 = block[r + 4], block[r + 5], block[r + 6], block[r + 7]
            for i in range(columns.size):
                f0, f1, f2, f3, f4, f5, f6, f7 = b0[i], b1[i], b2[i], b3[i], b4[i], b5[i], b6[i], b7[i]
                to = sums[i]
                for j in range(i - i % 8, wide):
                    more = f0 * b0[j] + f1 * b1[j] + f2 * b2[j] + f3 * b3[j]
                    to[j] += more + f4 * b4[j] + f5 * b5[j] + f6 * b6[j] + f7 * b7[j]
    _spread(sums, columns, out)
    for i in range(p):
        for j in range(i):
            out[i, j] = out[j, i]
    return out


@compiled
def _spread(sums: Floats, columns: NDArray[np.intp], out: Floats) -> None:  # pragma: no cover - compiled
    """Add what was summed of some columns where it belongs, and begin again."""
    for i in range(columns.size):
        for j in range(i, columns.size):
            out[columns[i], columns[j]] += sums[i, j]
    sums[:] = 0.0


@compiled
def _gram(a: Floats, b: Floats) -> Floats:  # pragma: no cover - compiled
    """Four rows at a time, so that a sum is loaded and stored for four products, not for each."""
    out = np.zeros((a.shape[1], b.shape[1]))
    whole = a.shape[0] - a.shape[0] % 4
    for r in range(0, whole, 4):
        b0, b1, b2, b3 = b[r], b[r + 1], b[r + 2], b[r + 3]
        for i in range(a.shape[1]):
            f0, f1, f2, f3 = a[r, i], a[r + 1, i], a[r + 2, i], a[r + 3, i]
            to = out[i]
            for j in range(b.shape[1]):
                to[j] = to[j] + f0 * b0[j] + f1 * b1[j] + f2 * b2[j] + f3 * b3[j]
    for r in range(whole, a.shape[0]):
        for i in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[r, i] * b[r, j]
    return out


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solve a symmetric, at least positive semidefinite system, scaled to a unit diagonal."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix * scale[:, None] * scale[None, :]
    scaled[np.diag_indices_from(scaled)] += 1e-13
    right = right * (scale[:, None] if right.ndim == 2 else scale)
    solution = np.linalg.solve(scaled, right)
    return np.asarray(solution * (scale[:, None] if right.ndim == 2 else scale))


@dataclass
class LeastSquares:
    """One minimisation of ``sum(r**2) + (x - centre).T @ precision @ (x - centre)``."""

    problem: LeastSquaresProblem
    x: Floats
    precision: Floats
    centre: Floats
    settings: LmSettings = field(default_factory=LmSettings)
    damping: float = 0.0
    cost: float = np.inf
    fit: float = np.inf
    iteration: int = 0
    evaluations: int = 0
    calm: int = 0
    finished: bool = False

    def __post_init__(self) -> None:
        if self.damping == 0.0:
            self.damping = self.settings.damping

    def penalty(self, x: Floats) -> Floats:
        """The prior's share of the cost, (L,) for candidates (d, L)."""
        away = x - self.centre[:, None]
        return np.asarray(np.einsum("il,ij,jl->l", away, self.precision, away, optimize=False))

    def step(self) -> None:
        """One iteration: linearise, try the ladder, take the best step or raise the damping."""
        s = self.settings
        residual, jacobian, spent = self.problem.linearise(self.x)
        self.evaluations += spent
        self.fit = float(np.einsum("r,r->", residual, residual, optimize=False))
        self.cost = self.fit + float(self.penalty(self.x[:, None])[0])
        hessian = squared(jacobian) + self.precision
        away = self.x - self.centre
        gradient = gram(residual[:, None], jacobian)[0]
        gradient = gradient + np.einsum("ij,j->i", self.precision, away, optimize=False)
        self.iteration += 1
        while True:
            dampings = self.damping * np.array(s.ladder)
            candidates = np.stack([self.x + self._direction(hessian, gradient, d) for d in dampings], axis=1)
            fits, spent = self.problem.sums_of_squares(candidates)
            self.evaluations += spent
            costs = np.where(np.isfinite(fits), fits, np.inf) + self.penalty(candidates)
            best = int(np.argmin(costs))
            if costs[best] < self.cost:
                gain = self.cost - float(costs[best])
                calm = gain < max(s.tolerance * self.cost, s.absolute)
                self.x, self.cost, self.fit = (
                    candidates[:, best].copy(),
                    float(costs[best]),
                    float(fits[best]),
                )
                self.damping = max(float(dampings[best]), 1e-12)
                self.calm = self.calm + 1 if calm else 0
                break
            self.damping = float(dampings[-1]) * 10.0
            if self.damping > s.largest_damping:
                self.damping = s.damping
                self.calm = s.patience
                break
        self.finished = self.calm >= s.patience or self.iteration >= s.iterations

    def _direction(self, hessian: Floats, gradient: Floats, damping: float) -> Floats:
        damped = hessian + damping * np.diag(np.diag(hessian))
        step = -solve_positive(damped, gradient)
        return step * min(1.0, self.settings.largest_step / max(float(np.abs(step).max()), 1e-300))

    def run(self, stop: Callable[[], bool], each: Callable[[LeastSquares], None] | None = None) -> None:
        """Iterate until converged, out of iterations or told to stop."""
        while not self.finished and not stop():
            self.step()
            if each is not None:
                each(self)

    def state(self) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Arrays and plain values for ``restore``."""
        names = ("damping", "cost", "fit", "iteration", "evaluations", "calm", "finished")
        return {"x": self.x, "centre": self.centre}, {name: getattr(self, name) for name in names}

    def restore(self, arrays: Mapping[str, Floats], plain: Mapping[str, Any]) -> None:
        """Continue where ``state`` was taken."""
        self.x = np.array(arrays["x"])
        self.centre = np.array(arrays["centre"])
        for name, value in plain.items():
            setattr(self, name, value)
