# SPDX-License-Identifier: Apache-2.0
"""Uncertainty: posterior, intervals and excited ranges of the parameters.

The posterior about the best fit is Gaussian in slope coordinates (Laplace), with the curvature of whitened residuals.
It is widened where the scores of blocks scatter more (sandwich): blocks of road, with all channels and passes, on which
model discrepancy is the same, and blocks of a second. The static compression of a spring is a direction in which
Laplace fails: the likelihood is evaluated on a grid there (``spring_position``). Intervals of forces are quantiles of
draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.inference.noise import Whitener
from suspension_twin.inference.problem import CORRELATION, Noise, Problem
from suspension_twin.inference.space import Curve
from suspension_twin.inference.spring_position import Slide, changes, slides
from suspension_twin.models.parameters import twin_value
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import Twin

__all__ = ["DRAWS", "Posterior", "Travel", "drawn_curve", "forces_at", "posterior", "span_of", "travel"]

#: Draws of a posterior: the ends of a 90 % interval to 3 % of a standard deviation.
DRAWS = 4000
_BLOCK_SECONDS = 1.0
_REACHED = 0.05  # s that have to lie beyond a point before it counts as excited


@dataclass(frozen=True, eq=False)
class Travel:
    """Motion of the suspension on the compared samples, by axle (both wheels): ``compression`` m, ``velocity`` m/s
    (jounce positive), ``static`` compression m; sampled at ``rate`` Hz."""

    compression: dict[str, Floats]
    velocity: dict[str, Floats]
    static: dict[str, float]
    rate: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """``draws`` (d, N) of the parameters' values, ``sigma`` (q,) of the nuisances, ``covariance``
    (d + q, d + q) in the solver's coordinates; ``better`` coordinates of a point that fits better
    than the one asked about, or None."""

    draws: Floats
    sigma: Floats
    covariance: Floats
    better: Floats | None


def travel(twin: Twin, problem: Problem) -> Travel:
    """Simulate ``twin`` over the parts of a problem and collect its suspension travel; empty for a vehicle without
    axles."""
    if not twin.axles:
        return Travel({}, {}, {}, problem.measured.rate)
    compression: dict[str, list[Floats]] = {axle: [] for axle in twin.axles}
    velocity: dict[str, list[Floats]] = {axle: [] for axle in twin.axles}
    static = dict.fromkeys(twin.axles, 0.0)
    for part, rows in zip(problem.data.parts, problem.data.rows, strict=True):
        response = simulate_twin(twin, part.road_excitation)
        at = np.clip(np.searchsorted(response.t, part.t[rows]), 0, response.t.size - 1)
        for axle, own in twin.axles.items():
            compression[axle].append(response.deflection[at, own.columns].ravel())
            velocity[axle].append(response.deflection_rate[at, own.columns].ravel())
            static[axle] = float(response.deflection[0, own.columns].mean())
    return Travel(
        {k: np.concatenate(v) for k, v in compression.items()},
        {k: np.concatenate(v) for k, v in velocity.items()},
        static,
        problem.measured.rate,
    )


def span_of(curve: Curve, where: Travel) -> tuple[float, float]:
    """The range of a curve's abscissa that the drives excited; (NaN, NaN) if none was."""
    if curve.part == "spring":
        values = where.compression[curve.axle]
    else:
        values = where.velocity[curve.axle] * (1.0 if curve.part == "damper_push" else -1.0)
        values = values[values > 0]
    beyond = max(1, round(2 * _REACHED * where.rate))
    if values.size < 3 * beyond:
        return float("nan"), float("nan")
    ordered = np.sort(values)
    low = float(ordered[beyond - 1]) if curve.part == "spring" else 0.0
    return low, float(ordered[-beyond])


def drawn_curve(curve: Curve, twin: Twin, draws: Floats) -> tuple[Floats, Floats]:
    """Abscissa (k,) and forces (k, N) of a characteristic of ``twin`` with its free points as in ``draws`` (d, N)."""
    x, force = twin_value(twin, curve.key).points
    forces = np.repeat(force[:, None], draws.shape[1], axis=1)
    for i, row in enumerate(curve.rows):
        if row >= 0:
            forces[i] = draws[row]
    return x, forces


def forces_at(at: Floats | float, x: Floats, force: Floats) -> Floats:
    """Forces of N curves (k, N) through (0, 0), going on with their first and last slopes.

    (N,) at one abscissa; (g, N) for ``at`` (g,) for all of them, or (g, N) each its own."""
    edges = np.concatenate([[0.0], x])
    values = np.concatenate([np.zeros((1, force.shape[1])), force])
    segment = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, x.size - 1)
    share = (at - edges[segment]) / (edges[segment + 1] - edges[segment])
    if np.ndim(at) < 2:
        return np.asarray(values[segment] + share[..., None] * (values[segment + 1] - values[segment]))
    below, above = (np.take_along_axis(values, i, axis=0) for i in (segment, segment + 1))
    return np.asarray(below + share * (above - below))


def posterior(
    problem: Problem,
    noise: Noise,
    x: Floats,
    precision: Floats,
    where: Travel,
    seed: int,
    *,
    placed: Floats,
    doubt: Floats | None = None,
) -> Posterior:
    """The posterior around ``x`` (d + q,), the best fit with a ``noise`` model and the prior ``precision``.

    ``placed`` (q,) is what the excitation holds of the nuisances; ``doubt`` (d + q,) is one more standard deviation, of
    all coordinates together.
    """
    fit = problem.weighed(noise)
    at = fit.linearise(x)
    jacobian = at.jacobian
    information = jacobian.T @ jacobian + precision
    # scores belong to an optimum: where a search was cut short, that of the linearised problem
    away = x - np.concatenate([problem.space.z0, -placed])
    residual = at.residual - jacobian @ np.linalg.solve(
        information, jacobian.T @ at.residual + precision @ away
    )
    sample = noise.row if isinstance(noise, Whitener) else np.arange(residual.size) % len(problem.data.block)
    inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    seconds = np.arange(residual.size) // max(8, int(_BLOCK_SECONDS * problem.measured.rate))
    blocks = [problem.data.block[sample], *([seconds] if seconds[-1] >= 2 * len(inverse) else [])]
    covariance = _widened(inverse, jacobian, residual, precision, blocks)
    if doubt is not None:
        covariance = covariance + np.outer(doubt, doubt)
    d = len(problem.space)
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(covariance[:d, :d] + 1e-14 * np.eye(d))
    scatter = np.einsum("ij,jn->in", root, rng.standard_normal((d, DRAWS)), optimize=False)
    middle = np.repeat(x[:d, None], DRAWS, axis=1)
    cost = float(np.sum(at.residual**2)) + _penalty(problem, x[:d, None], precision)[0]
    better: Floats | None = None
    for curve in problem.space.curves:
        if not curve.key.endswith("spring") or min(curve.rows) < 0:
            continue
        rows = list(curve.rows)
        seen = np.quantile(where.compression[curve.axle], np.linspace(0.002, 0.998, 200))
        found = slides(curve.x, x[rows], problem.space.z0[rows], CORRELATION, where.static[curve.axle], seen)
        if not found:
            continue
        costs = _slide_costs(fit, x, rows, found, precision)
        lowest = int(np.argmin(costs))
        if costs[lowest] < cost - 0.5:
            better = x.copy() if better is None else better
            better[rows] = found[lowest].z
        _mix(middle, scatter, rows, found, (costs - cost, covariance), rng)
    z = middle + scatter
    draws = problem.space.from_slopes(z)
    return Posterior(draws, np.sqrt(np.diag(covariance)[d:]), covariance, better)


def _widened(
    covariance: Floats,
    jacobian: Floats,
    residual: Floats,
    precision: Floats,
    blocks: Sequence[NDArray[np.intp]],
) -> Floats:
    """The covariance with each deviation at least that by the scores of each of the ``blocks`` (R,) of residuals
    (sandwich), each score over the root of what is not its own block's share: unbiased where the model is right (CR2 of
    Bell and McCaffrey, Survey Methodology 28, 2002)."""
    root, ratio = np.linalg.cholesky(covariance), np.ones(len(covariance))
    for block in blocks:
        order, count = np.argsort(block, kind="stable"), int(block.max()) + 1
        if count < 2:  # nothing tells how a fit to other data would differ
            continue
        moved = np.zeros((count, len(covariance)))
        for b, rows in enumerate(np.split(order, np.searchsorted(block[order], np.arange(1, count)))):
            own = jacobian[rows] @ root
            share, axes = np.linalg.eigh(own.T @ own)
            left = np.sqrt(np.maximum(1.0 - share, 1e-9))
            moved[b] = root @ (axes @ ((axes.T @ (own.T @ residual[rows])) / left))
        robust = moved.T @ moved + covariance @ precision @ covariance
        ratio = np.maximum(ratio, np.sqrt(np.diag(robust) / np.diag(covariance)))
    widened = covariance * ratio[:, None] * ratio[None, :]
    return np.asarray(0.5 * (widened + widened.T))


def _penalty(problem: Problem, z: Floats, precision: Floats) -> Floats:
    d = len(problem.space)
    away = z - problem.space.z0[:, None]
    return np.asarray(np.einsum("il,ij,jl->l", away, precision[:d, :d], away, optimize=False))


def _slide_costs(
    problem: Problem, x: Floats, rows: list[int], found: Sequence[Slide], precision: Floats
) -> Floats:
    """(s,) -2 log posterior of every slide, all other coordinates as they are."""
    candidates = np.repeat(x[:, None], len(found), axis=1)
    for lane, slide in enumerate(found):
        candidates[rows, lane] = slide.z
    sums = problem.sums_of_squares(candidates)
    return np.asarray(sums + _penalty(problem, candidates[: len(problem.space)], precision))


def _mix(
    middle: Floats,
    noise: Floats,
    rows: list[int],
    found: Sequence[Slide],
    posterior: tuple[Floats, Floats],
    rng: np.random.Generator,
) -> None:
    """Move a share of the draws, which are ``middle`` + ``noise`` (d, N), to slides, by their posterior weight, in
    place; ``posterior``: by how much the -2 log posterior of each slide (s,) exceeds that of the fit, and the
    covariance."""
    worse, covariance = posterior
    least = min(0.0, float(np.min(worse)))
    weights = np.where(np.isfinite(worse), np.exp(-0.5 * (worse - least)), 0.0)
    weights = weights * np.array([s.density for s in found])
    # The fit counts as one grid step with the density of its nearest slide, and as the best: where a slide is better,
    # the fit is moved there, or it minimises another objective, and is what is reported.
    nearest = int(np.argmin([abs(s.shift) for s in found]))
    total = float(weights.sum()) + found[nearest].density
    share = float(weights.sum()) / total
    if share < 0.02:
        return
    count = middle.shape[1]
    chosen = np.flatnonzero(rng.random(count) < share)
    slide = np.asarray(rng.choice(len(found), size=count, p=weights / weights.sum()))[chosen]
    jitter = np.asarray(rng.uniform(-0.5, 0.5, count))[chosen]
    low = int(rows[0])
    # given the static compression, the slope of the unexcited segment is independent of the others
    regression = covariance[: middle.shape[0], low] / covariance[low, low]
    moved = np.stack([s.z for s in found], axis=1)
    middle[np.ix_(np.array(rows), chosen)] = moved[:, slide] + changes(found)[:, slide] * jitter
    noise[:, chosen] -= regression[:, None] * noise[low, chosen]
