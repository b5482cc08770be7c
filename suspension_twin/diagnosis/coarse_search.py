# SPDX-License-Identifier: Apache-2.0
"""Coarse search for set-up errors: a sensor mounted sideways, a clock offset of 0.5 s, a map that is metres off.

With such an error the simulated signal is uncorrelated with the measured one, and a local search fails: the basin of
attraction is about 50 ms or 20 cm wide, and the calibration that came before has moved the vehicle to wrong values.
Where the remaining residual of the recalibrated twin is most of the motion, each set-up parameter is therefore
evaluated on a grid over its range, with the vehicle of the twin file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.library import SETUP_CATEGORIES
from suspension_twin.inference.fit import LONG, refit
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.problem import REACH, Problem
from suspension_twin.inference.sensor_correction import Turn

__all__ = [
    "GRID",
    "GRID_OF_SEVERAL",
    "MISALIGNMENT_PENALTY",
    "NO_MATCH",
    "coarse_fit",
    "joint_grid",
    "misset_fit",
    "recentred",
    "waived_penalty",
]

#: Held-out residual as a share of the rms of the motion, from which on simulation and measurement do not match.
NO_MATCH = 0.7
#: Grid points of a coordinate where an effect has one severity, and where it has several: the basin of attraction of a
#: clock is about 50 ms wide, that of a map 20 cm.
GRID, GRID_OF_SEVERAL = 201, 41
#: Tolerances: times at most that a prior follows a fit, and standard deviations by which it moves less when that ends.
_RECENTRED, _SETTLED = 6, 0.25
#: Beyond ``REACH`` standard deviations a set-up parameter counts as misset: its prior is centred where it is found, and
#: -2 log of the probability of a misset parameter is added to the cost.
MISALIGNMENT_PENALTY = 12.0


def recentred(hypothesis: Hypothesis, u: Floats) -> Hypothesis:
    """The hypothesis with its prior centred at those of the coordinates (k,) that are beyond ``REACH``."""
    home = hypothesis.typical()
    far = np.abs(u - home) > REACH
    return replace(hypothesis, around=tuple(np.where(far, u, home).tolist())) if far.any() else hypothesis


def waived_penalty(hypothesis: Hypothesis, u: Floats) -> Floats:
    """(n,) prior cost of coordinates (k, n) beyond ``REACH``, less ``MISALIGNMENT_PENALTY`` that replaces it."""
    away = u - hypothesis.typical()[:, None]
    far = np.where(np.abs(away) > REACH, away, 0.0)
    return np.asarray(np.sum(far**2, axis=0) - MISALIGNMENT_PENALTY * far.any(axis=0))


def coarse_fit(
    problem: Problem, hypothesis: Hypothesis, turn: Turn, no_match: bool
) -> tuple[Hypothesis, Floats, float] | None:
    """Hypothesis, unknowns and cost of a fit from the best grid point; None for effects that are no set-up error.

    The grid covers the whole range if there is ``no_match``; otherwise it is the measured mounting error alone, where
    that is large.
    """
    points = _severity_grid(hypothesis, turn) if no_match else _measured_turn(hypothesis, turn)
    if points is None:
        return None
    x = np.concatenate([np.repeat(problem.prior.centre[:, None], points.shape[1], axis=1), points])
    costs = problem.having(hypothesis).costs(x) - waived_penalty(hypothesis, points)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    there = recentred(hypothesis, points[:, best])
    y, cost = refit(problem.having(there), [x[:, best]], None, LONG)
    return there, y, cost + MISALIGNMENT_PENALTY * bool(there.around)


def misset_fit(
    problem: Problem, hypothesis: Hypothesis, x: Floats, cost: float
) -> tuple[Hypothesis, Floats, float] | None:
    """Hypothesis, unknowns and cost of a fit whose prior is centred where the fit ``x`` of a set-up error is, and goes
    with it; None where it is within ``REACH``, for other effects, and where the fit is none the better for it.
    """
    p = problem.shared
    if hypothesis.effect(hypothesis.effects[-1]).where not in SETUP_CATEGORIES:
        return None
    there, y, other = hypothesis, x, np.inf
    for _ in range(_RECENTRED):
        there = recentred(hypothesis, y[p:])
        if not there.around:
            return None
        before = y
        y, other = refit(problem.having(there), [before], None, LONG)
        if np.max(np.abs(y[p:] - before[p:])) < _SETTLED:
            break
    other += MISALIGNMENT_PENALTY
    return (there, y, other) if other < cost else None


def joint_grid(together: Hypothesis, turn: Turn) -> Floats:
    """(k, n) grid for several effects together: the clock offset over its range, the sensor at its measured mounting
    error, all other coordinates neutral."""
    keys = list(together.keys)
    low, high = together.bounds()
    points = together.neutral()[:, None]
    if "effects.time_offset.offset" in keys:
        i = keys.index("effects.time_offset.offset")
        points = np.repeat(points, GRID_OF_SEVERAL, axis=1)
        points[i] = np.linspace(low[i], high[i], GRID_OF_SEVERAL)
    if "effects.sensor_tilt.roll" in keys:
        rows = [keys.index(f"effects.sensor_tilt.{a}") for a in ("roll", "pitch", "yaw")]
        spreads = np.array([together.searched[i][1].prior.spread for i in rows])
        points[rows] = (np.array(turn) / spreads)[:, None]
    return np.asarray(np.clip(points, low[:, None], high[:, None]))


def _severity_grid(hypothesis: Hypothesis, turn: Turn) -> Floats | None:
    """(k, n) coordinates: each severity in turn over its bounds, and the measured mounting error."""
    effect = hypothesis.effect(hypothesis.effects[-1])
    if effect.where not in SETUP_CATEGORIES or hypothesis.scan(1) is not None:
        return None
    severe = [
        i for i, (_, p) in enumerate(hypothesis.searched) if p.name in effect.severity and not p.prior.log
    ]
    if not severe:
        return None
    low, high = hypothesis.bounds()
    count = GRID if len(severe) == 1 else GRID_OF_SEVERAL
    points = np.repeat(hypothesis.neutral()[:, None], count * len(severe), axis=1)
    for place, i in enumerate(severe):
        points[i, place * count : (place + 1) * count] = np.linspace(low[i], high[i], count)
    seen = _measured_turn(hypothesis, turn)
    return points if seen is None else np.column_stack([points, seen])


def _measured_turn(hypothesis: Hypothesis, turn: Turn) -> Floats | None:
    """(k, 1) mounting error of the sensor measured by gravity and path; None where it is within ``REACH``."""
    if hypothesis.effects[-1] != "sensor_tilt":
        return None
    at = np.array(turn) / [p.prior.spread for _, p in hypothesis.searched]
    return at[:, None] if (np.abs(at) > REACH).any() else None
