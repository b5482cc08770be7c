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
_ROUGH, _FINE = 4, 3
#: How much worse than the best so far a start may be that a fit is begun from.
_WORTH_A_LOOK = 1.5
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
        wide = _wide(bench, base, v, seed)
        if wide is not None and wide[0] < _WORTH_A_LOOK * cost:
            y, other = refit(bench, v, [wide[1]], None, _ROUGH)
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


def _wide(bench: Bench, base: Fit, hypothesis: Hypothesis, seed: int) -> tuple[float, Floats] | None:
    """The best of many strengths of an effect with weaker dampers and other springs than the baseline has.

    A calibration that never saw friction, a stop or a bar has made up for it elsewhere, too far for a
    linear step to undo. Only for effects that act where characteristics do.
    """
    if EFFECTS[hypothesis.effects[-1]].where not in ("strut", "tyre", "body"):
        return None
    p = bench.d + bench.q
    starts = hypothesis.starts(8, seed + 1)
    columns = []
    for dampers in (-1.2, -0.6, -0.25):
        for springs in (-0.3, 0.0):
            z = base.x[:p].copy()
            for curve in bench.problem.space.curves:
                rows = [r for r in curve.rows if r >= 0]
                z[rows] += springs if curve.key.endswith("spring") else dampers
            columns.append(np.concatenate([np.repeat(z[:, None], starts.shape[1], axis=1), starts]))
    x = np.concatenate(columns, axis=1)
    costs = bench.costs(hypothesis, x)
    best = int(np.argmin(costs))
    return (float(costs[best]), x[:, best]) if np.isfinite(costs[best]) else None


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
