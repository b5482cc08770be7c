# SPDX-License-Identifier: Apache-2.0
"""Pre-existing effects: those that act on reference drives and on drives with the gap alike.

Model discrepancy repeats on every drive, and some effects explain a part of it: a low-pass, a contact patch, a little
friction. Fitted to the drives with the gap alone, such an effect can gain more evidence than a small new effect.
Effects that improve the prediction of all drives are therefore fitted to all of them first, and the evidence of an
effect is its gain beyond these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.inference.cross_validation import Blocks, Evidence, evidence
from suspension_twin.inference.fit import DEEP, LONG, ROUGH, Fit, approximated, fitted, linearised_fit, refit
from suspension_twin.inference.hypothesis import Hypothesis, combined, having_effects
from suspension_twin.inference.problem import Problem, whitener_of

if TYPE_CHECKING:
    from suspension_twin.diagnosis.search import Search

__all__ = ["LEAST_GAIN", "REBASE_GAIN", "as_preexisting", "beyond_preexisting"]

#: Tempered nats that count as a gain: an effect starts no set of effects with less, and a pre-existing
#: one has to gain it on all drives and may lose it on reference drives, where new effects lose 4 to 13.
LEAST_GAIN = 1.0
#: -2 log posterior that a baseline has to improve by for the fits of effects to be repeated from it.
REBASE_GAIN = 3.0


def as_preexisting(
    problem: Problem, hypothesis: Hypothesis, x: Floats, base: Fit, blocks: Blocks
) -> Evidence:
    """Evidence of an effect, fitted at ``x`` (d + q + k,) to drives with the gap, as a pre-existing effect of all
    drives.

    Not for clock offset, map position and tilt: on all drives these are nuisance parameters.
    """
    existing, u = hypothesis.on_all_drives(), x[problem.shared :]
    starts = [x, np.concatenate([base.x, u]), np.concatenate([base.x, hypothesis.neutral()])]
    on_all = problem.having(existing)
    return evidence(on_all, fitted(on_all, starts, ROUGH), blocks)


def beyond_preexisting(
    problem: Problem,
    base: Evidence,
    found: dict[int, Fit],
    existing: Sequence[Evidence],
    temper: float,
    search: Search,
    *,
    on_progress: Callable[[float, int], None],
) -> tuple[Evidence, dict[int, Evidence]] | None:
    """Evidence of the baseline with the pre-existing effects of ``existing``, and of each effect of ``found`` beyond
    them.

    None where there are none. An effect that is pre-existing as well may have another size on drives with the gap.
    """
    extended, x, cost = _with_preexisting(problem, base, existing if found else (), temper)
    if extended is problem:
        return None
    p = problem.shared
    known = linearised_fit(extended, x)

    def beside(i: int) -> Floats:
        own, u = found[i].hypothesis, found[i].x[p:]
        starts = [np.concatenate(pair) for pair in ((x, u), (x, own.neutral()), (found[i].x[:p], u))]
        there = [e for e in extended.twin.effects if e.id in own.effects]
        if there and not own.fixed:
            starts.append(np.concatenate([x, own.at(there[0])]))
        return refit(extended.having(own), starts, known.at, DEEP)[0]

    fits = dict(
        zip(
            found,
            search.rounds.side_by_side("beside pre-existing effects", beside, list(found), on_progress),
            strict=True,
        )
    )
    # the baseline is refitted from the vehicle of each effect, and if it improves the others follow
    fresh = fitted(extended, [x, *(z[:p] for z in fits.values())], LONG)
    y, better = fresh.x, fresh.cost

    def judged(i: int) -> Evidence:
        own, z = found[i].hypothesis, fits[i]
        if better < cost - REBASE_GAIN:
            starts = [z, np.concatenate([y, z[p:]]), np.concatenate([y, own.neutral()])]
            z, _ = refit(extended.having(own), starts, fresh.at, DEEP)
        return evidence(extended.having(own), approximated(extended.having(own), [z], fresh), search.blocks)

    evidences = search.rounds.side_by_side("beyond pre-existing effects", judged, list(found), on_progress)
    return evidence(extended, fresh, search.blocks), dict(zip(found, evidences, strict=True))


def _gain_on_reference(problem: Problem, existing: Evidence, base: Evidence) -> float:
    """Nats that a pre-existing effect gains on reference drives; a new effect, fitted to all drives, loses there."""
    whitener, gain = whitener_of(problem), 0.0
    before = ~np.array(problem.data.active)[whitener.drive]
    for (c, with_gap), level in base.level.items():
        if not with_gap:
            count = problem.measured.independent * float(np.count_nonzero(before & (whitener.channel == c)))
            gain += 0.5 * count * float(np.log(level / existing.level[c, with_gap]))
    return gain


def _with_preexisting(
    problem: Problem, base: Evidence, existing: Sequence[Evidence], temper: float
) -> tuple[Problem, Floats, float]:
    """The problem of a vehicle with all effects that improve the prediction of all drives and do not degrade that of
    reference drives; unknowns and cost of its baseline."""
    existing_effects = [
        e
        for e in existing
        if temper * e.over(base) > LEAST_GAIN and temper * _gain_on_reference(problem, e, base) > -LEAST_GAIN
    ]
    if not existing_effects:
        return problem, base.fit.x, base.fit.cost
    existing_effects.sort(key=lambda e: -e.over(base))
    p, whole = problem.shared, combined(*(e.fit.hypothesis for e in existing_effects))
    starts = [np.concatenate([existing_effects[0].fit.x[:p], *(e.fit.x[p:] for e in existing_effects)])]
    for one in existing_effects:
        others = [e.fit.x[p:] if e is one else e.fit.hypothesis.neutral() for e in existing_effects]
        starts.append(np.concatenate([one.fit.x[:p], *others]))
    x, _ = refit(problem.having(whole), starts, None, LONG)
    specs = whole.spec(whole.values(x[p:, None])[:, 0])
    extended = problem.with_twin(having_effects(problem.twin, specs))
    return extended, *refit(extended, [x[:p]], None, LONG)
