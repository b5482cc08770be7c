# SPDX-License-Identifier: Apache-2.0
"""Gross faults: a sensor that stands sideways, a clock half a second late, a map metres off.

With one of these the twin follows nothing of the motion, and from there no slope leads anywhere: the fault's valley is
some 50 ms or 20 cm wide, and a calibration has gone astray on what it could not follow. So where the recalibrated twin
leaves most of the motion, whatever a user may have set wrong is tried all over its range, with the vehicle as the file
has it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.fit import refit
from suspension_twin.diagnosis.hypotheses import SETUP_CATEGORIES, Hypothesis

__all__ = ["MISALIGNMENT_PENALTY", "NO_MATCH", "coarse_fit", "joint_grid", "recentred", "waived_penalty"]

#: Share of the motion's rms that a twin leaves on stretches it has not seen, from which on it follows nothing.
NO_MATCH = 0.7
#: Places of a coordinate all over its range, by how many of them an effect has.
_GRID, _GRID_OF_SEVERAL = 201, 41
_LONG = 12
#: Spreads of its prior beyond which a setting is not one that is off but another altogether. Its prior then lies where
#: it is found, and -2 log of the probability that anything is so wrong is the price.
_FAR, MISALIGNMENT_PENALTY = 3.0, 12.0
_TIMES = 41  # of a clock, where everything is looked for at once


def recentred(hypothesis: Hypothesis, u: Floats) -> Hypothesis:
    """The hypothesis with its prior about those of the coordinates (k,) that no prior about zero allows."""
    far = np.where(np.abs(u) > _FAR, u, 0.0)
    return replace(hypothesis, around=tuple(far.tolist())) if far.any() else hypothesis


def waived_penalty(u: Floats) -> Floats:
    """(n,) what a prior about zero charges coordinates (k, n) for being far from there, less its price."""
    far = np.where(np.abs(u) > _FAR, u, 0.0)
    return np.asarray(np.sum(far**2, axis=0) - MISALIGNMENT_PENALTY * far.any(axis=0))


def coarse_fit(
    bench: Bench, hypothesis: Hypothesis, no_match: bool
) -> tuple[Hypothesis, Floats, float] | None:
    """Hypothesis, unknowns and cost of a fit from the best of all strengths of a fault, however large, of a twin that
    is ``lost``; else from how far the sensor is seen to be turned, if that is far. None for what is no setting."""
    points = _severity_grid(bench, hypothesis) if no_match else _measured_turn(bench, hypothesis)
    if points is None:
        return None
    x = np.concatenate([np.repeat(bench.centre[:, None], points.shape[1], axis=1), points])
    costs = bench.costs(hypothesis, x) - waived_penalty(points)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    there = recentred(hypothesis, points[:, best])
    y, cost = refit(bench, there, [x[:, best]], None, _LONG)
    return there, y, cost + MISALIGNMENT_PENALTY * bool(there.around)


def joint_grid(bench: Bench, together: Hypothesis) -> Floats:
    """(k, n) coordinates of several effects: clocks all over their range, a sensor turned as far as it is seen to
    be, and nothing else."""
    keys = list(together.keys)
    low, high = together.bounds()
    points = together.neutral()[:, None]
    if "effects.time_offset.offset" in keys:
        i = keys.index("effects.time_offset.offset")
        points = np.repeat(points, _TIMES, axis=1)
        points[i] = np.linspace(low[i], high[i], _TIMES)
    if "effects.sensor_tilt.roll" in keys:
        rows = [keys.index(f"effects.sensor_tilt.{a}") for a in ("roll", "pitch", "yaw")]
        spreads = np.array([together.searched[i][1].spread for i in rows])
        points[rows] = (np.array(bench.turn) / spreads)[:, None]
    return np.asarray(np.clip(points, low[:, None], high[:, None]))


def _severity_grid(bench: Bench, hypothesis: Hypothesis) -> Floats | None:
    """(k, n) coordinates: each severity in turn all over its bounds, and as far as a sensor is seen to be turned."""
    effect = hypothesis.effect(hypothesis.effects[-1])
    if effect.where not in SETUP_CATEGORIES or hypothesis.scan(1) is not None:
        return None
    severe = [i for i, (_, p) in enumerate(hypothesis.searched) if p.name in effect.severity and not p.log]
    if not severe:
        return None
    low, high = hypothesis.bounds()
    count = _GRID if len(severe) == 1 else _GRID_OF_SEVERAL
    points = np.repeat(hypothesis.neutral()[:, None], count * len(severe), axis=1)
    for place, i in enumerate(severe):
        points[i, place * count : (place + 1) * count] = np.linspace(low[i], high[i], count)
    seen = _measured_turn(bench, hypothesis)
    return points if seen is None else np.column_stack([points, seen])


def _measured_turn(bench: Bench, hypothesis: Hypothesis) -> Floats | None:
    """(k, 1) a sensor turned as far as gravity and the path show, if that is far."""
    if hypothesis.effects[-1] != "sensor_tilt":
        return None
    turn = np.array(bench.turn) / [p.spread for _, p in hypothesis.searched]
    return turn[:, None] if (np.abs(turn) > _FAR).any() else None
