# SPDX-License-Identifier: Apache-2.0
"""The identification problem: costs and residuals of candidates over all drives, in batches.

``Problem`` holds the parts of all drives, the search space, the compared channels and the nuisance parameters. One
evaluation is one candidate simulated over all parts, as the car paper counts its 10 842.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.gauss_newton import Quadratic
from suspension_twin.inference.nuisance import NuisancePriors, Nuisances
from suspension_twin.inference.objectives import Measured, Objective, Term
from suspension_twin.inference.space import Space
from suspension_twin.models.parameters import lanes
from suspension_twin.models.simulate import simulate_lanes
from suspension_twin.models.types import LaneResponse
from suspension_twin.vehicle.twin import Twin

__all__ = ["FitProblem", "Interrupted", "Problem", "segments_of"]

_SYNC_STEP, _SYNC_LIMIT = 1e-3, 0.1  # s
# Simulated signals kept at once, in numbers: 25 million are 200 MB.
_LARGEST_BATCH = 25_000_000


class Interrupted(Exception):
    """Raised where a caller asked to stop during a simulation."""


def _never() -> bool:
    return False


def segments_of(rows: NDArray[np.intp], offset: int) -> list[slice]:
    """Runs of consecutive samples in ``rows``, as slices of their own numbering from ``offset`` on."""
    if not rows.size:
        return []
    edges = np.flatnonzero(np.diff(rows) > 1) + 1
    bounds = [0, *edges.tolist(), rows.size]
    return [slice(offset + a, offset + b) for a, b in zip(bounds, bounds[1:], strict=False)]


class Problem:
    """One vehicle, its drives, and the distance of candidates from them.

    ``parts`` are observations or parts of them, ``drive_of`` the drive that each belongs to, ``rows`` the samples of
    each that are compared, ``wander`` (m) each drive's own position error (0 for none). ``M`` samples in ``C``
    channels are compared.
    """

    def __init__(
        self,
        twin: Twin,
        space: Space,
        parts: Sequence[Any],
        drive_of: Sequence[int],
        terms: Sequence[Term],
        priors: NuisancePriors,
        wander: Sequence[float],
        rows: Sequence[NDArray[np.intp]],
    ) -> None:
        self.twin, self.space = twin, space
        self.parts, self.drive_of = tuple(parts), tuple(drive_of)
        self.channels = tuple(dict.fromkeys(t.channel for t in terms))
        self.terms = tuple(terms)
        self.channel_weights = np.array(
            [max(t.weight for t in terms if t.channel == c) for c in self.channels]
        )
        self.rows = list(rows)
        self.priors, self.wander = priors, tuple(wander)
        self.nuisances = Nuisances(self.parts, self.drive_of, self.channels, priors, wander)
        measured: list[Floats] = []
        segments: list[slice] = []
        drives: list[int] = []
        offset = 0
        for part, own, drive in zip(self.parts, self.rows, self.drive_of, strict=True):
            measured.append(np.stack([part.measured[c][own] for c in self.channels], axis=1))
            runs = segments_of(own, offset)
            segments += runs
            drives += [drive] * len(runs)
            offset += own.size
        if offset == 0:
            raise InputError("drives", "nothing is left to compare after trimming")
        self.measured = Measured(
            self.channels,
            np.concatenate(measured),
            tuple(segments),
            self.parts[0].rate,
            tuple(drives),
            self.parts[0].bandwidth,
        )
        self.objective = Objective(self.terms, self.measured)
        self.evaluations = 0
        driven = [id(part.excitation) for part in self.parts]
        #: Excitations that several runs share: they are simulated once for all of them.
        self.repeated = {e for e in driven if driven.count(e) > 1}
        #: Asked between pieces of work; True ends them with :class:`Interrupted`.
        self.interrupt: Callable[[], bool] = _never

    @property
    def samples(self) -> int:
        """How many samples of each channel are compared."""
        return len(self.measured.values)

    @property
    def seconds(self) -> float:
        """Simulated seconds of one evaluation."""
        return float(sum(p.t[-1] - p.t[0] for p in self.parts))

    def moved(self, nuisance: Floats) -> Problem:
        """The same problem with clock and map offsets applied to the excitation instead of by interpolation.

        Fitted biases, gains and tilts are unchanged; further offsets are relative to these.
        """
        found = dict(zip(self.nuisances.names, nuisance, strict=True))
        metres = found.get("map_position", 0.0)
        late = found.get("clock_offset", 0.0)
        parts = [p.moved(late + found.get(f"{p.name}.clock_offset", 0.0), metres) for p in self.parts]
        return self.on(parts)

    def on(self, parts: Sequence[Any]) -> Problem:
        """The same problem and samples with other excitations in ``parts``."""
        clone = copy(self)
        clone.parts = tuple(parts)
        return clone

    # -- simulation ----------------------------------------------------------------------------

    def simulate(self, values: Floats) -> tuple[list[Floats], NDArray[np.bool_]]:
        """Conditioned signals (m, C, L) of every part for values (d, L), and which lanes failed (L,)."""
        candidates = lanes(self.twin, self.space.keys, values.T)
        failed = np.zeros(values.shape[1], dtype=bool)
        signals = []
        known: dict[int, LaneResponse] = {}
        for part in self.parts:
            if self.interrupt():
                raise Interrupted
            response = known.get(id(part.excitation))
            if response is None:
                response = simulate_lanes(self.twin, candidates, part.excitation)
            if id(part.excitation) in self.repeated:
                known[id(part.excitation)] = response
            failed |= response.failed
            signals.append(part.conditioner.apply(response.stacked(self.channels)))
        self.evaluations += values.shape[1]
        return signals, failed

    def compared(self, signals: Sequence[Floats], nuisance: Floats) -> Floats:
        """(M, C, L) simulated sensor readings; ``nuisance`` (q, L)."""
        return np.concatenate(
            [
                self.nuisances.apply(number, part, rows, nuisance)
                for number, (part, rows) in enumerate(zip(signals, self.rows, strict=True))
            ]
        )

    def costs(self, values: Floats, nuisance: Floats, synchronise: bool = False) -> Floats:
        """(L,) costs of candidates (d, L) at fixed nuisance parameters (q,); infinite where a lane failed.

        ``synchronise``: the clock offset of each drive is first fitted for each candidate.
        """
        costs = np.empty(values.shape[1])
        for cut in self.batches(values.shape[1]):
            signals, failed = self.simulate(values[:, cut])
            held = np.repeat(nuisance[:, None], failed.size, axis=1)
            if synchronise:
                held = self.synchronised(signals, held)
            found = self.objective.costs(self.compared(signals, held))
            costs[cut] = np.where(failed | ~np.isfinite(found), np.inf, found)
        return costs

    def synchronised(self, signals: Sequence[Floats], nuisance: Floats) -> Floats:
        """``nuisance`` (q, L) with every lane's clock offsets at their least squares values: two
        Gauss-Newton steps, each within a tenth of a second."""
        nuisance = nuisance.copy()
        weights = self.channel_weights[None, :, None]
        for row, numbers in self.nuisances.clocks:
            for _ in range(2):
                ahead = nuisance.copy()
                ahead[row] += _SYNC_STEP
                top, bottom = np.zeros(nuisance.shape[1]), np.zeros(nuisance.shape[1])
                for k in numbers:
                    here = self.nuisances.apply(k, signals[k], self.rows[k], nuisance)
                    there = self.nuisances.apply(k, signals[k], self.rows[k], ahead)
                    wanted = np.stack(
                        [self.parts[k].measured[c][self.rows[k]] for c in self.channels], axis=1
                    )
                    slope = weights * (there - here) / _SYNC_STEP
                    off = weights * (wanted[:, :, None] - here)
                    top += np.einsum("rcl,rcl->l", slope, off, optimize=False)
                    bottom += np.einsum("rcl,rcl->l", slope, slope, optimize=False)
                step = np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), 0.0)
                nuisance[row] += np.clip(step, -_SYNC_LIMIT, _SYNC_LIMIT)
        return nuisance

    def batches(self, lane_count: int) -> list[slice]:
        """Slices of the lanes whose signals fit in memory."""
        samples = sum(len(p.excitation) for p in self.parts)
        size = max(1, _LARGEST_BATCH // (7 * samples))
        return [slice(i, min(i + size, lane_count)) for i in range(0, lane_count, size)]


class FitProblem:
    """A problem for the solver: d search coordinates, then q nuisance parameters.

    ``residuals`` turns compared signals (M, C, L) into (R, L); those of the objective by default. The Jacobian
    columns of characteristics are differences of simulated lanes; those of nuisance parameters need no simulation.
    """

    step = 1e-3

    def __init__(self, problem: Problem, residuals: Callable[[Floats], Floats] | None = None) -> None:
        self.problem = problem
        self.d = len(problem.space)
        self.residuals = residuals or problem.objective.residuals

    def linearise(self, x: Floats) -> tuple[Floats, Floats]:
        """Residuals (R,) and Jacobian (R, d + q) at ``x`` (d + q,)."""
        problem, d = self.problem, self.d
        z, nuisance = x[:d], x[d:]
        shifted = np.repeat(z[:, None], d + 1, axis=1)
        shifted[np.arange(d), np.arange(1, d + 1)] += self.step
        values = problem.space.from_slopes(shifted)
        columns: list[Floats] = []
        base: Floats | None = None
        base_signals: list[Floats] = []
        for cut in problem.batches(d + 1):
            signals, failed = problem.simulate(values[:, cut])
            held = np.repeat(nuisance[:, None], failed.size, axis=1)
            residuals = self.residuals(problem.compared(signals, held))
            if base is None:
                base = residuals[:, 0].copy()
                base_signals = [s[:, :, :1].copy() for s in signals]
            found = (residuals - base[:, None]) / self.step
            columns.append(np.where(failed[None, :], 0.0, found))
        assert base is not None
        physics = np.concatenate(columns, axis=1)[:, 1:]
        steps = problem.nuisances.steps
        moved = np.repeat(nuisance[:, None], steps.size, axis=1)
        moved[np.diag_indices(steps.size)] += steps
        disturbed = self.residuals(problem.compared(base_signals, moved))
        disturbance = (disturbed - base[:, None]) / steps
        return base, np.concatenate([physics, disturbance], axis=1)

    def quadratic(self, x: Floats) -> Quadratic:
        """The quadratic model of the sum of squares about ``x`` (d + q,)."""
        residual, jacobian = self.linearise(x)
        return Quadratic(float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual)

    def sums_of_squares(self, x: Floats) -> Floats:
        """(L,) sums of squared residuals of (d + q, L), infinite where a lane failed."""
        problem = self.problem
        sums = np.empty(x.shape[1])
        values = problem.space.from_slopes(x[: self.d])
        for cut in problem.batches(x.shape[1]):
            signals, failed = problem.simulate(values[:, cut])
            r = self.residuals(problem.compared(signals, x[self.d :, cut]))
            found = np.einsum("rl,rl->l", r, r)
            sums[cut] = np.where(failed | ~np.isfinite(found), np.inf, found)
        return sums
