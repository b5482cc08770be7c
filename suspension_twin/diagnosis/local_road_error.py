# SPDX-License-Identifier: Apache-2.0
"""Local road errors: a remaining residual that is concentrated on one section of road.

Model discrepancy follows the motion and is spread over the road. A residual concentrated on one section, on every pass,
is an error of the road file there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.shrink import RemainingResidual, drives_of
from suspension_twin.inference.fit import DEEP, refit
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.problem import Problem, counting, whitener_of

__all__ = [
    "RoadErrorMatch",
    "RoadSection",
    "concentrated_section",
    "no_concentration",
    "no_road_error",
    "road_error_matches",
]

#: Length in m of the cells of a section.
_METRES = 4.0
#: Excess of the share of the residual on a section over its share of the motion, on every pass, with a probability of a
#: local road error of 0.5 (up to 0.27 on cars and roads without any error), and factor of one standard deviation.
_CONCENTRATED, _CONCENTRATED_SPREAD = 0.38, 1.15
#: Share of the largest excess within which a shorter section is preferred.
_TOLERANCE = 0.1
#: m before a section where the front wheels reach it, and after it until the free oscillation has decayed.
_BEFORE, _AFTER = 4.0, 15.0
#: Grid points over the range of a road error, of one without a sign (a length of smoothing), and about the best.
_COARSE, _COARSE_UNSIGNED, _FINE = 201, 41, 21
_LANES = 32  # simulated at once
#: Shrink of the residual on a section by an error of the road file, with a probability of that error of 0.5, and factor
#: of one standard deviation; nats by which a reported error may be worse than the best.
_TAKEN, _TAKEN_SPREAD, _AS_GOOD = 0.25, 1.3, 3.0
_LEAST_SHARE = 0.05  # shrink from which on an error is reported


@dataclass(frozen=True)
class RoadSection:
    """``start`` and ``end`` in m along the road, the ``share`` of the remaining residual on it (mean square), and its
    excess ``beyond`` the share of the motion there, on the drive where that is smallest."""

    start: float
    end: float
    share: float
    beyond: float


@dataclass(frozen=True)
class RoadErrorMatch:
    """An ``effect`` of the road on a section only: its parameter ``values`` by key, and the ``shrink`` of the
    residual of the vertical acceleration there."""

    effect: str
    values: dict[str, float]
    shrink: float


def concentrated_section(
    problem: Problem, remaining: RemainingResidual, noise: dict[str, float]
) -> RoadSection | None:
    """The section, at most half of the road, with the largest excess of residual over motion in vertical acceleration.

    The excess is the smallest of all drives with the gap, less the mean of the reference drives. None without a
    vertical acceleration or where the drives have no section in common.
    """
    measured = problem.measured
    if "vertical_acceleration" not in measured.channels:
        return None
    c = measured.channels.index("vertical_acceleration")
    position = _positions(problem)
    first = float(np.floor(position.min() / _METRES))
    cell = (np.floor(position / _METRES) - first).astype(int)
    count, drive, floor = int(cell.max()) + 1, drives_of(problem), noise["vertical_acceleration"] ** 2
    with_gap: list[tuple[Floats, Floats, Floats]] = []
    before: list[tuple[Floats, Floats, Floats]] = []
    for number, active in enumerate(problem.data.active):
        own = drive == number
        passed = np.bincount(cell[own], minlength=count).astype(float)
        squares, motion = (
            np.bincount(cell[own], v[own, c] ** 2, count).astype(float)
            for v in (remaining.difference, measured.values)
        )
        rest = np.maximum(squares - passed * floor, 0.0)
        holds = _cumulated(rest)
        (with_gap if active else before).append((_cumulated(passed), holds, holds - _cumulated(motion)))
    starts, ends = np.triu_indices(count + 1, 1)
    short = ends - starts <= max(count // 2, 1)
    starts, ends = starts[short], ends[short]
    beyond = np.min(np.stack([b[ends] - b[starts] for _, _, b in with_gap]), axis=0)
    for _, _, b in before:
        beyond -= np.maximum(b[ends] - b[starts], 0.0) / len(before)
    seen = np.all([p[ends] > p[starts] for p, _, _ in with_gap], axis=0)
    if not seen.any():
        return None
    most = float(beyond[seen].max())
    # the shortest section within the tolerance of the largest excess
    near = np.flatnonzero(seen & (beyond >= most - _TOLERANCE * abs(most)))
    best = int(near[np.lexsort((-beyond[near], (ends - starts)[near]))[0]])
    low, high = int(starts[best]), int(ends[best])
    share = float(np.mean([holds[high] - holds[low] for _, holds, _ in with_gap]))
    return RoadSection(_METRES * (first + low), _METRES * (first + high), share, most)


def no_concentration(found: RoadSection | None) -> float:
    """Probability that the residual is spread over the road as model discrepancy is."""
    if found is None:
        return 1.0
    return float(norm.sf(np.log(max(found.beyond, 1e-3) / _CONCENTRATED) / np.log(_CONCENTRATED_SPREAD)))


def no_road_error(found: list[RoadErrorMatch]) -> float:
    """Probability that the road file has no error on the section of these matches, best first."""
    most = max((one.shrink for one in found[:1]), default=0.0)
    return float(norm.sf(np.log(max(most, 1e-3) / _TAKEN) / np.log(_TAKEN_SPREAD)))


def road_error_matches(
    problem: Problem, x: Floats, there: RoadSection, effects: list[Hypothesis], temper: float
) -> list[RoadErrorMatch]:
    """The ``effects`` of the road, applied on the section only, that explain its residual, the best first.

    Vehicle and nuisance parameters are fitted to the other sections of the road, from ``x`` (d + q,). Each effect has
    one parameter, which is evaluated on a grid over its range. ``temper`` is the share of the residual that is noise.
    """
    row = _positions(problem)[whitener_of(problem).row]
    near = (row > there.start - _BEFORE) & (row < there.end + _AFTER)
    own = (row >= there.start) & (row < there.end) & np.array(problem.data.active)[whitener_of(problem).drive]
    x, _ = refit(counting(problem, ~near), [x], None, DEEP)
    inside = counting(problem, own)
    vertical = whitener_of(problem).channel == problem.channels.index("vertical_acceleration")

    def remaining(hypothesis: Hypothesis, points: Floats) -> tuple[Floats, Floats]:
        """Sums of squares (n,) on the section, of all channels and of the vertical acceleration."""
        unknowns = np.vstack([np.repeat(x[:, None], points.size, axis=1), points])
        every, upright = np.empty(points.size), np.empty(points.size)
        for begin in range(0, points.size, _LANES):
            cut = slice(begin, begin + _LANES)
            residual, failed = inside.having(hypothesis).residuals(unknowns[:, cut])
            squares = residual[own] ** 2
            every[cut] = np.where(failed, np.inf, squares.sum(axis=0))
            upright[cut] = squares[vertical[own]].sum(axis=0)
        return every, upright

    base = float(np.sum(inside.residuals(x[:, None])[0][vertical] ** 2))

    def best_of(hypothesis: Hypothesis) -> tuple[float, RoadErrorMatch]:
        """The cost of an effect at its best on the section, and the match."""
        (low,), (high,) = hypothesis.bounds()
        parameter = hypothesis.searched[0][1]
        signed = not parameter.log and parameter.low < parameter.neutral < parameter.high
        points = np.linspace(low, high, _COARSE if signed else _COARSE_UNSIGNED)
        best = points[int(np.argmin(remaining(hypothesis, points)[0]))]
        step = points[1] - points[0]
        points = np.clip(np.linspace(best - step, best + step, _FINE), low, high)
        every, upright = remaining(hypothesis, points)
        at = int(np.argmin(every))
        values = dict(
            zip(hypothesis.keys, hypothesis.values(points[at : at + 1, None].T)[:, 0].tolist(), strict=True)
        )
        shrink = 1.0 - float(np.sqrt(upright[at] / max(base, 1e-12)))
        return float(every[at]), RoadErrorMatch(hypothesis.effects[0], values, shrink)

    found = side_by_side(best_of, [h for h in effects if len(h) == 1])
    if not found:
        return []
    least = min(cost for cost, _ in found)
    ranked = sorted(found, key=lambda f: f[0])
    return [f for cost, f in ranked if 0.5 * temper * (cost - least) < _AS_GOOD and f.shrink > _LEAST_SHARE]


def _positions(problem: Problem) -> Floats:
    """(M,) m along the road of every compared sample."""
    return np.concatenate(
        [part.position[rows] for part, rows in zip(problem.data.parts, problem.data.rows, strict=True)]
    )


def _cumulated(values: Floats) -> Floats:
    """(n + 1,) cumulative share of the sum; zeros where the sum is zero."""
    total = float(values.sum())
    return np.concatenate([[0.0], np.cumsum(values) / total if total > 0.0 else np.zeros(values.size)])
