# SPDX-License-Identifier: Apache-2.0
"""Pre-existing effects: those that act on reference drives and on drives with the gap alike.

Model discrepancy repeats on every drive, and some effects explain a part of it: a low-pass, a contact patch, a little
friction. Fitted to the drives with the gap alone, such an effect can gain more evidence than a small new effect.
Effects that improve the prediction of all drives are therefore fitted to all of them first, and the evidence of an
effect is its gain beyond these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.evidence import Blocks, Evidence, evidence
from suspension_twin.diagnosis.fit import DEEP, ROUGH, Fit, approximated, fitted, linearised_fit, refit
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis, combined

__all__ = ["as_preexisting", "beyond_preexisting"]

#: Tempered nats that a pre-existing effect has to gain on all drives and may lose on reference drives: new effects lose
#: 4 to 13 there, pre-existing ones less than 1.
_LEAST_GAIN = 1.0
_LONG = 8  # iterations at most of the fit of all pre-existing effects
_REBASE_GAIN = 1.0  # -2 log posterior that a baseline has to improve by for the other fits to be repeated


def as_preexisting(bench: Bench, hypothesis: Hypothesis, x: Floats, base: Fit, blocks: Blocks) -> Evidence:
    """Evidence of an effect, fitted at ``x`` (d + q + k,) to drives with the gap, as a pre-existing effect of all
    drives.

    Not for clock offset, map position and tilt: on all drives these are nuisance parameters.
    """
    existing, u = hypothesis.on_all_drives(), x[bench.d + bench.q :]
    starts = [x, np.concatenate([base.x, u]), np.concatenate([base.x, hypothesis.neutral()])]
    return evidence(bench, fitted(bench, existing, starts, ROUGH), blocks)


def beyond_preexisting(
    bench: Bench,
    base: Evidence,
    found: dict[int, Fit],
    existing: Sequence[Evidence],
    temper: float,
    blocks: Blocks,
    on_progress: Callable[[float, int], None],
) -> tuple[Evidence, dict[int, Evidence]] | None:
    """Evidence of the baseline with the pre-existing effects of ``existing``, and of each effect of ``found`` beyond
    them.

    None where there are none. An effect that is pre-existing as well may have another size on drives with the gap.
    """
    extended, x, cost = _with_preexisting(bench, base, existing if found else (), temper)
    if extended is bench:
        return None
    p = bench.d + bench.q
    known = linearised_fit(extended, BASELINE, x)

    def beside(i: int) -> Floats:
        own, u = found[i].hypothesis, found[i].x[p:]
        starts = [np.concatenate(pair) for pair in ((x, u), (x, own.neutral()), (found[i].x[:p], u))]
        there = [e for e in extended.problem.twin.effects if e.id in own.effects]
        if there and not own.fixed:
            starts.append(np.concatenate([x, own.at(there[0])]))
        return refit(extended, own, starts, known.at, DEEP)[0]

    fits = dict(zip(found, bench.partial.side_by_side(beside, list(found), on_progress), strict=True))
    # the baseline is refitted from the vehicle of each effect, and if it improves the others follow
    fresh = fitted(extended, BASELINE, [x, *(z[:p] for z in fits.values())], _LONG)
    y, better = fresh.x, fresh.cost

    def judged(i: int) -> Evidence:
        own, z = found[i].hypothesis, fits[i]
        if better < cost - _REBASE_GAIN:
            starts = [z, np.concatenate([y, z[p:]]), np.concatenate([y, own.neutral()])]
            z, _ = refit(extended, own, starts, fresh.at, DEEP)
        return evidence(extended, approximated(extended, own, [z], fresh), blocks)

    evidences = bench.partial.side_by_side(judged, list(found), on_progress)
    return evidence(extended, fresh, blocks), dict(zip(found, evidences, strict=True))


def _gain_on_reference(bench: Bench, existing: Evidence, base: Evidence) -> float:
    """Nats that a pre-existing effect gains on reference drives; a new effect, fitted to all drives, loses there."""
    whitener, gain = bench.whitener, 0.0
    before = ~np.array(bench.active)[whitener.drive]
    for (c, with_gap), level in base.level.items():
        if not with_gap:
            count = bench.problem.measured.independent * float(
                np.count_nonzero(before & (whitener.channel == c))
            )
            gain += 0.5 * count * float(np.log(level / existing.level[c, with_gap]))
    return gain


def _with_preexisting(
    bench: Bench, base: Evidence, existing: Sequence[Evidence], temper: float
) -> tuple[Bench, Floats, float]:
    """The bench of a vehicle with all effects that improve the prediction of all drives and do not degrade that of
    reference drives; unknowns and cost of its baseline."""
    existing_effects = [
        e
        for e in existing
        if temper * e.over(base) > _LEAST_GAIN and temper * _gain_on_reference(bench, e, base) > -_LEAST_GAIN
    ]
    if not existing_effects:
        return bench, base.fit.x, base.fit.cost
    existing_effects.sort(key=lambda e: -e.over(base))
    p, whole = bench.d + bench.q, combined(*(e.fit.hypothesis for e in existing_effects))
    starts = [np.concatenate([existing_effects[0].fit.x[:p], *(e.fit.x[p:] for e in existing_effects)])]
    for one in existing_effects:
        others = [e.fit.x[p:] if e is one else e.fit.hypothesis.neutral() for e in existing_effects]
        starts.append(np.concatenate([one.fit.x[:p], *others]))
    x, _ = refit(bench, whole, starts, None, _LONG)
    problem = copy(bench.problem)
    specs = whole.spec(whole.values(x[p:, None])[:, 0])
    problem.twin = problem.twin.model_copy(update={"effects": (*problem.twin.effects, *specs)})
    extended = replace(bench, problem=problem)
    return extended, *refit(extended, BASELINE, [x[:p]], None, _LONG)
