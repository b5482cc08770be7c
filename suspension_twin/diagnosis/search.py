# SPDX-License-Identifier: Apache-2.0
"""The search through the library: every effect alone, then what has to be added to the best."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.fit import Fit, finished, refit, screened
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis, combined
from suspension_twin.diagnosis.judge import Blocks, Evidence, evidence
from suspension_twin.drive.types import Floats
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.errors import WorkError

__all__ = ["Single", "pairs", "singles"]

_STARTS, _TRIED = 16, 3
_WIDE_STARTS = 16
#: Slopes of springs and dampers, in their search coordinates, beside the baseline's.
_VEHICLES = ((0.0, 0.0), (-0.3, 0.0), (-0.6, 0.0), (0.0, -0.25), (0.0, -0.6), (-0.3, -0.6), (0.0, -1.2))
#: Vehicles, and how early and strong the effect is in spreads of its prior, that are always tried.
_EARLY = (((-0.6, 0.0), 1.0), ((0.0, -0.3), 0.6))
_ROUGH, _DEEP, _FINE = 4, 6, 5
#: How much worse than the best so far a start may be that a fit is begun from.
_WORTH_A_LOOK = 3.0
#: Effects whose Jacobian is simulated anew before they are judged: the best by the rough fit.
_FINALISTS = 7
#: Nats that an effect has to be able to change the signals by at prior strength, to be judged at all.
LEAST_POWER = 5.0


@dataclass(frozen=True, eq=False)
class Single:
    """One effect at its best; ``power`` how many nats it could show at the strengths of its prior;
    ``always`` the same effect as a trait that the vehicle had on the reference drives already."""

    effect: str
    evidence: Evidence
    power: float
    always: Evidence | None = None

    @property
    def fit(self) -> Fit:
        return self.evidence.fit

    @property
    def judged(self) -> bool:
        """Whether the drives excited the effect enough to say anything of it."""
        return self.power >= LEAST_POWER


def singles(
    bench: Bench, base: Fit, anchor: Fit, library: dict[str, list[Hypothesis]], blocks: Blocks, seed: int,
    tell: Callable[[float, str], None],
) -> tuple[Fit, list[Single]]:  # fmt: skip
    """Every effect of the library, refitted jointly with characteristics and nuisances; and the baseline,
    which may take over any vehicle that an effect's fit has come to."""
    rough = []
    for number, (effect, variants) in enumerate(library.items()):
        tell(number / len(library) * 0.65, effect.replace("_", " "))
        best, power = None, 0.0
        for v in variants:
            tried = screened(bench, anchor, v, v.starts(_STARTS, seed))
            power = max(power, tried.power)
            if best is None or tried.cost[0] < best[0].cost[0]:
                best = (tried, v)
        assert best is not None
        tried, v = best
        starts = [*tried.x[:_TRIED], np.concatenate([base.x, v.neutral()])]
        x, cost = refit(bench, v, starts, anchor.at.jacobian, _ROUGH)
        if not math.isfinite(cost):
            raise WorkError(f"the twin cannot be simulated with {effect}")
        for begun, start in _wide(bench, base, v, seed):
            if begun < _WORTH_A_LOOK * cost:
                y, other = refit(bench, v, [start], None, _DEEP)
                x, cost = (y, other) if other < cost else (x, cost)
        rough.append((cost, effect, v, x, power))
    base = _rebased(bench, base, [r[3] for r in rough])
    order = sorted(range(len(rough)), key=lambda i: rough[i][0])
    out: dict[int, Single] = {}
    for place, i in enumerate(order):
        cost, effect, v, x, power = rough[i]
        always = None
        if place < _FINALISTS:
            tell(0.65 + 0.35 * place / _FINALISTS, f"{effect.replace('_', ' ')}, once more")
            u = x[bench.d + bench.q :]
            x, cost = refit(bench, v, [x, np.concatenate([base.x, u])], None, _FINE)
            if not all(bench.active):
                always = _always(bench, v, x, base, blocks)
        if cost >= base.cost:
            x = np.concatenate([base.x, v.neutral()])
        out[i] = Single(effect, evidence(bench, finished(bench, v, x), blocks), power, always)
    return base, [out[i] for i in range(len(rough))]


def _rebased(bench: Bench, base: Fit, found: Sequence[Floats]) -> Fit:
    """The baseline from wherever effects' fits have taken the vehicle, so that none is credited with that."""
    p = bench.d + bench.q
    x, cost = refit(bench, BASELINE, [base.x, *(y[:p] for y in found)], None, 2 * _ROUGH)
    return finished(bench, BASELINE, x) if cost < base.cost else base


def _always(bench: Bench, hypothesis: Hypothesis, x: Floats, base: Fit, blocks: Blocks) -> Evidence:
    """The effect as a trait of the vehicle on all drives: what a model's own error looks like to it."""
    every = replace(bench, active=(True,) * len(bench.active))
    u = x[bench.d + bench.q :]
    starts = [x, np.concatenate([base.x, u]), np.concatenate([base.x, hypothesis.neutral()])]
    y, _ = refit(every, hypothesis, starts, None, _ROUGH)
    # judged with the noise levels of shown and reference drives kept apart, as every other hypothesis is
    return evidence(every, finished(every, hypothesis, y), blocks, bench.active)


def _wide(bench: Bench, base: Fit, hypothesis: Hypothesis, seed: int) -> list[tuple[float, Floats]]:
    """Costs and unknowns of a few strengths of an effect, each with what suits it best of softer springs and
    weaker dampers than the baseline has.

    A calibration that never saw friction, a stop or a bar has made up for it elsewhere, too far for a
    linear step to undo. Only for effects that act where characteristics do.
    """
    if EFFECTS[hypothesis.effects[-1]].where not in ("strut", "tyre", "body"):
        return []
    p = bench.d + bench.q

    def vehicle(springs: float, dampers: float) -> Floats:
        z = base.x[:p].copy()
        for curve in bench.problem.space.curves:
            rows = [r for r in curve.rows if r >= 0]
            z[rows] += springs if curve.key.endswith("spring") else dampers
        return z

    starts = hypothesis.starts(_WIDE_STARTS, seed + 1)
    many = [vehicle(*v) for v in _VEHICLES]
    x = np.concatenate([np.concatenate([np.repeat(z[:, None], _WIDE_STARTS, axis=1), starts]) for z in many], axis=1)
    # a stop that hardly touches costs least at first and leads nowhere: one that touches early gets its tries too
    ways = _EARLY if hypothesis.touches else ()
    early = [np.concatenate([vehicle(*v), hypothesis.early(far)])[:, None] for v, far in ways]
    x = bench.clipped(hypothesis, np.concatenate([x, *early], axis=1))
    costs = bench.costs(hypothesis, x)
    first = costs.size - len(early)
    tried = [int(np.argmin(costs[:first])), *range(first, costs.size)]
    return [(float(costs[i]), x[:, i]) for i in tried if np.isfinite(costs[i])]


def pairs(
    bench: Bench, first: Evidence, library: dict[str, list[Hypothesis]], blocks: Blocks, seed: int,
    tell: Callable[[float, str], None], skip: Sequence[str] = (),
) -> list[Evidence]:  # fmt: skip
    """The best additions of one more effect to what is there, the best first."""
    there = first.fit.hypothesis
    rough = []
    others = [e for e in library if e not in there.effects and e not in skip]
    for number, effect in enumerate(others):
        tell(number / len(others) * 0.7, f"{there.name} and {effect}".replace("_", " "))
        for v in library[effect]:
            both = combined(there, v)
            tried = screened(bench, first.fit, both, v.starts(_STARTS // 2, seed))
            rough.append((tried.cost[0], both, tried.x[:2]))
    rough.sort(key=lambda r: r[0])
    found, seen = [], set()
    for _, both, starts in rough:
        if both.effects in seen:
            continue
        seen.add(both.effects)
        tell(0.7 + 0.1 * len(seen), f"{both.name}, jointly".replace("_", " "))
        x, _ = refit(bench, both, starts, first.fit.at.jacobian[:, : bench.d + bench.q], _ROUGH)
        x, _ = refit(bench, both, [x], None, 2)
        found.append(evidence(bench, finished(bench, both, x), blocks))
        if len(seen) == 3:
            break
    return sorted(found, key=lambda e: -float(e.score.sum()) + 0.5 * e.occam)
