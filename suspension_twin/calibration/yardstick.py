# SPDX-License-Identifier: Apache-2.0
"""The yardstick of a calibration: what the twin explains of data that it was not fitted to, beside a linear model.

Explained variance of the main channel, 1 - var(measured - simulated) / var(measured), on parts of the data that are
held out in turn: whole runs, both halves of a single run, or every fifth block of road; where one bump makes most of
the motion, so that the road without it shows nothing, whole passes. The twin without a part is one Gauss-Newton step
from the fit to all data; where the drive was and how its sensor read it stays as found in all of it, for this is found
anew on every drive. Beside it stand the given twin, place and sensor fitted to all data, and, fitted to the same parts:
for a rig the linear corner of ``inference.linear_corner``, for a car the twin with straight springs and dampers; and
what a run explains of a repeat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.calibration.presets import PRESETS, build_space
from suspension_twin.calibration.recorder import SearchOutcome
from suspension_twin.calibration.request import Yardstick
from suspension_twin.calibration.setup import Setup, problem_of
from suspension_twin.calibration.squares import FAINT
from suspension_twin.inference.cross_validation import FOLDS
from suspension_twin.inference.gap import main_channel
from suspension_twin.inference.gauss_newton import GaussNewton, GaussNewtonSettings
from suspension_twin.inference.linear_corner import CORNER_CHANNELS, linear_corner
from suspension_twin.inference.observation import Observation
from suspension_twin.inference.problem import Problem
from suspension_twin.inference.runs import repeats
from suspension_twin.inference.space import CURVES, curve_keys
from suspension_twin.models.parameters import twin_value
from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.twin import Twin

__all__ = ["straight", "yardstick"]

#: Keys that are free with the slopes of a car with straight characteristics.
_BESIDE = ("vehicle.tyre.vertical_stiffness", "vehicle.front.unsprung_mass", "vehicle.rear.unsprung_mass")
_MOST_RUNS = 4  # parts that runs are held out in (numerics: one more costs a fit)
_DESCENT = GaussNewtonSettings(iterations=6, tolerance=1e-3)


@dataclass(frozen=True, eq=False)
class _Plain:
    """Residuals of all channels, sample by sample, in units of ``scale`` (C,)."""

    measured: Floats
    scale: Floats

    def residuals(self, simulated: Floats) -> Floats:
        """(M C, L) of candidates (M, C, L)."""
        whole = (simulated - self.measured[:, :, None]) / self.scale[:, None]
        return np.ascontiguousarray(whole.reshape(-1, whole.shape[2]))


def yardstick(setup: Setup, outcome: SearchOutcome, kept: NDArray[np.bool_]) -> Yardstick | None:
    """The yardstick of a calibration whose ``kept`` (d,) parameters are at their start; None where nothing can be held
    out."""
    problem = outcome.problem
    channel = main_channel(problem.channels)
    part, held_out = _parts(setup, problem, channel)
    if part.max() < 1:
        return None
    x = np.concatenate([problem.space.to_slopes(outcome.values), outcome.nuisance - outcome.placed])
    fixed = np.append(kept, np.ones(problem.q, dtype=bool))
    weight = {term.channel: term.weight for term in setup.objective.terms}
    weights = np.array([weight[name] for name in problem.channels])
    simulated = _held_out(problem, x, part, fixed, weights)
    measured = problem.measured.values[:, problem.channels.index(channel)]

    def share(candidate: Floats) -> float:
        parts = [part == f for f in range(part.max() + 1)]
        left, motion = (
            sum(x[own].var() * own.sum() for own in parts) for x in (measured - candidate, measured)
        )
        return 1.0 - float(left / motion)

    column = problem.channels.index(channel)
    linear = float("nan")
    if channel not in CORNER_CHANNELS and curve_keys(setup.twin):
        linear = share(_of_straight(setup, problem, x, part)[:, column])
    elif channel in CORNER_CHANNELS:
        linear = share(_of_corner(problem, part, channel))
    return Yardstick(
        channel=channel,
        held_out=held_out,
        twin=share(simulated[:, column]),
        given=share(_of_given(problem, outcome.placed, x, weights)[:, column]),
        linear=linear,
        repeat=_of_repeats(problem.data.parts, channel),
    )


def _explained(measured: Floats, simulated: Floats) -> float:
    return 1.0 - float(np.var(measured - simulated)) / max(float(np.var(measured)), 1e-300)


def _parts(setup: Setup, problem: Problem, channel: str) -> tuple[NDArray[np.intp], str]:
    """(M,) the part of each compared sample that is held out at once, and what the parts are; one part where nothing
    can be held out: less of the motion would be left to learn from than is held out."""
    data = problem.data
    if setup.on_road:
        blocks = np.concatenate([p.usage.block[rows] for p, rows in zip(data.parts, data.rows, strict=True)])
        _, block = np.unique(blocks, return_inverse=True)
        stretch = np.asarray(block % min(FOLDS, int(block.max()) + 1))
        measured = problem.measured
        values = measured.values[:, problem.channels.index(channel)]
        power = (values - values.mean()) ** 2
        if np.bincount(stretch, power).max() <= 0.5 * power.sum():
            return stretch, "road"
        segments = measured.segments
        return np.repeat(np.arange(len(segments)) % FOLDS, [s.stop - s.start for s in segments]), "passes"
    sizes = [rows.size for rows in data.rows]
    if len(sizes) == 1:
        return np.arange(sizes[0]) // -(-sizes[0] // 2), "half a run"
    return np.repeat(np.arange(len(sizes)) % _MOST_RUNS, sizes), "runs"


def _held_out(
    problem: Problem, x: Floats, part: NDArray[np.intp], fixed: NDArray[np.bool_], weights: Floats
) -> Floats:
    """(M, C) readings of the fit at ``x`` (d + q,) with ``weights`` (C,) of the channels, each part from a fit without
    it; ``fixed`` unknowns stay."""
    measured = problem.measured
    at = problem.weighed(_plain(problem, x, weights)).linearise(x)
    precision, centre = problem.joint_prior()
    row = np.repeat(part, len(problem.channels))
    free = np.flatnonzero(~fixed)

    def step(rows: NDArray[np.bool_]) -> Floats:
        jacobian, residual = at.jacobian[rows], at.residual[rows]
        squares = measured.independent * (jacobian.T @ jacobian) + precision
        slope = measured.independent * (jacobian.T @ residual) + precision @ (x - centre)
        return np.asarray(np.linalg.solve(squares[np.ix_(free, free)], slope[free]))

    # the fit is the optimum of another objective: only what a missing part changes counts
    whole = step(np.ones(row.size, dtype=bool))
    unknowns = np.repeat(x[:, None], part.max() + 1, axis=1)
    for f in range(part.max() + 1):
        unknowns[free, f] -= np.clip(step(row != f) - whole, -1.0, 1.0)
    compared = problem.compared(problem.clipped(unknowns))
    return np.asarray(np.take_along_axis(compared, part[:, None, None], axis=2)[:, :, 0])


def _plain(problem: Problem, x: Floats, weights: Floats) -> _Plain:
    """Residuals in units of their own size at ``x`` (d + q,), with ``weights`` (C,) of the channels."""
    measured = problem.measured.values
    weighted = (problem.readings(x) - measured) * weights
    return _Plain(measured, max(float(np.std(weighted)), 1e-12) / weights)


def _of_given(problem: Problem, placed: Floats, x: Floats, weights: Floats) -> Floats:
    """(M, C) readings of the given twin with its own nuisances, searched from those at ``x`` (d + q,) on; ``placed``
    (q,) are simulated beside them."""
    start = np.concatenate([problem.space.z0, x[problem.d :]])
    precision = problem.prior.precision / problem.measured.independent
    centre = np.concatenate([problem.space.z0, -placed])
    known = np.arange(start.size) < problem.d
    low, high = (np.where(known, start, side) for side in (-np.inf, np.inf))
    residuals = problem.weighed(_plain(problem, start, weights))
    solver = GaussNewton(residuals, start, precision, centre, low, high, settings=_DESCENT)
    solver.run()
    return problem.readings(solver.x)


def _of_corner(problem: Problem, part: NDArray[np.intp], channel: str) -> Floats:
    """(M,) of the linear corner, each part from a fit without it."""
    data, out = problem.data, np.empty(part.size)
    ends = np.cumsum([0, *(rows.size for rows in data.rows)])
    for f in range(part.max() + 1):
        kept = [
            (p, np.flatnonzero(part[a:b] != f)) for p, a, b in zip(data.parts, ends, ends[1:], strict=False)
        ]
        used = [(p, slice(int(rows[0]), int(rows[-1]) + 1)) for p, rows in kept if rows.size]
        corner, _ = linear_corner([p for p, _ in used], [channel], [rows for _, rows in used])
        for p, a, b in zip(data.parts, ends, ends[1:], strict=False):
            own = np.flatnonzero(part[a:b] == f)
            if own.size:
                out[a + own] = corner.signals(p)[channel][own]
    return out


def _of_straight(setup: Setup, problem: Problem, x: Floats, part: NDArray[np.intp]) -> Floats:
    """(M, C) of the car with straight springs and dampers, each part from a fit without it."""
    twin = straight(problem.space.applied(setup.twin, problem.space.from_slopes(x[: problem.d])))
    space = build_space(twin, PRESETS["fast"], [*curve_keys(twin), *_BESIDE])
    fresh, _ = problem_of(
        twin, space, problem.data, setup.objective.terms, problem.nuisances.priors, problem.simulation.stop
    )
    scale = np.std(problem.measured.values, axis=0)
    start = np.concatenate([space.z0, x[problem.d :]])
    solver = GaussNewton(
        fresh.weighed(_Plain(problem.measured.values, scale)),
        start,
        FAINT * fresh.prior.precision,
        np.concatenate([space.z0, x[problem.d :]]),
        settings=_DESCENT,
    )
    solver.run()
    return _held_out(fresh, solver.x, part, np.arange(start.size) >= fresh.d, 1.0 / scale)


def straight(twin: Twin) -> Twin:
    """The twin with straight characteristics: springs of their rate at standstill, dampers of their mean slope."""
    changes: dict[str, object] = {}
    for key in CURVES:
        if not curve_keys(twin, [key]):
            continue
        at, force = twin_value(twin, key).points
        slope = force[-1] / at[-1]
        name = "velocity"
        if key.endswith("spring"):
            axle = key.removeprefix("vehicle.").rpartition(".")[0]
            static, name = twin.axles[axle].static_compression, "compression"
            edges, values = (np.concatenate([[0.0], v]) for v in (at, force))
            segment = min(int(np.searchsorted(at, static)), at.size - 1)
            slope = (values[segment + 1] - values[segment]) / (edges[segment + 1] - edges[segment])
        changes[f"{key}.{name}"] = (float(at[-1]),)
        changes[f"{key}.force"] = (float(max(slope * at[-1], 1.0)),)
    return twin.with_changes(changes)


def _of_repeats(runs: Sequence[Observation], channel: str) -> float:
    """Share that a run explains of a repeat, the mean over all pairs; NaN without repeats."""
    found = []
    for i, one in enumerate(runs):
        if not isinstance(one.excitation, Excitation) or one.reading is not None:
            continue
        for j, other in enumerate(runs):
            if i != j and repeats(one, other):
                found.append(
                    _explained(one.measured[channel], np.interp(one.t, other.t, other.measured[channel]))
                )
    return float(np.mean(found)) if found else float("nan")
