# SPDX-License-Identifier: Apache-2.0
"""Pre-existing effects: those that the reference drives show as well as those with the gap.

The discrepancy of a model comes again on every drive, and some effects make up for a part of it: a low-pass, a contact
patch, a little friction. Fitted to the drives with the gap alone, such an effect looks as if it had come since, and
gains more than a faint one that has. So whatever improves the prediction of all drives is fitted to all of them first,
and what counts for an effect is what it gains beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.evidence import Blocks, Evidence, evidence
from suspension_twin.diagnosis.fit import Fit, finished, fitted, refit
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis, combined
from suspension_twin.identification.parallel import side_by_side

__all__ = ["as_preexisting", "beyond_preexisting"]

#: Nats, counted by the share of the remaining residual that is noise, that a pre-existing effect gains at least on all
#: drives and loses at most on those from before: of effects that came since these lost 4 to 13, of others less than 1.
_SPEAKS = 1.0
_ROUGH, _LONG, _FINE = 4, 8, 6
_BEHIND = 1.0  # -2 log posterior by which a baseline has to be better for what was compared with it to go on


def as_preexisting(bench: Bench, hypothesis: Hypothesis, x: Floats, base: Fit, blocks: Blocks) -> Evidence:
    """An effect, at unknowns ``x`` (d + q + k,) on the drives with the gap, as a pre-existing effect on all drives.

    Not for a clock, a place on the map or a lean: that there always was one is a nuisance already.
    """
    always, u = hypothesis.always(), x[bench.d + bench.q :]
    starts = [x, np.concatenate([base.x, u]), np.concatenate([base.x, hypothesis.neutral()])]
    return evidence(bench, fitted(bench, always, starts, _ROUGH), blocks)


def beyond_preexisting(
    bench: Bench,
    base: Evidence,
    found: dict[int, Fit],
    always: Sequence[Evidence],
    temper: float,
    blocks: Blocks,
    tell: Callable[[float, int], None],
) -> tuple[Evidence, dict[int, Evidence]] | None:
    """The baseline of a vehicle that has the pre-existing effects of ``always``, and what each effect of ``found`` does
    on the drives with the gap beyond them; None where there is none of either. An effect that is pre-existing as well
    may have another size there than on those from before."""
    having, x, cost = _settled(bench, base, always if found else (), temper)
    if having is bench:
        return None
    p = bench.d + bench.q

    def beside(i: int) -> Floats:
        own, u = found[i].hypothesis, found[i].x[p:]
        starts = [np.concatenate(pair) for pair in ((x, u), (x, own.neutral()), (found[i].x[:p], u))]
        there = [e for e in having.problem.twin.effects if e.id in own.effects]
        if there and not own.fixed:
            starts.append(np.concatenate([x, own.at(there[0])]))
        return refit(having, own, starts, None, _FINE)[0]

    fits = dict(zip(found, side_by_side(beside, list(found), tell), strict=True))
    # the baseline takes over any vehicle that an effect's fit has come to, and the others go on from there
    y, better = refit(having, BASELINE, [x, *(z[:p] for z in fits.values())], None, _LONG)

    def judged(i: int) -> Evidence:
        own, z = found[i].hypothesis, fits[i]
        if better < cost - _BEHIND:
            starts = [z, np.concatenate([y, z[p:]]), np.concatenate([y, own.neutral()])]
            return evidence(having, fitted(having, own, starts, _FINE), blocks)
        return evidence(having, finished(having, own, z), blocks)

    told = side_by_side(judged, list(found), tell)
    return evidence(having, finished(having, BASELINE, y), blocks), dict(zip(found, told, strict=True))


def _before(bench: Bench, existing: Evidence, base: Evidence) -> float:
    """Nats that a pre-existing effect gains on the drives from before: one that has come since is pulled at by all
    drives, and these lose by it."""
    whitener, gain = bench.whitener, 0.0
    before = ~np.array(bench.active)[whitener.drive]
    for (c, shown), level in base.level.items():
        if not shown:
            count = bench.problem.measured.independent * float(
                np.count_nonzero(before & (whitener.channel == c))
            )
            gain += 0.5 * count * float(np.log(level / existing.level[c, shown]))
    return gain


def _settled(
    bench: Bench, base: Evidence, always: Sequence[Evidence], temper: float
) -> tuple[Bench, Floats, float]:
    """The bench of a vehicle that has all effects that improve the prediction of all drives and do not worsen that of
    the drives from before, and its unknowns and cost."""
    speaking = [
        e for e in always if temper * e.over(base) > _SPEAKS and temper * _before(bench, e, base) > -_SPEAKS
    ]
    if not speaking:
        return bench, base.fit.x, base.fit.cost
    speaking.sort(key=lambda e: -e.over(base))
    p, whole = bench.d + bench.q, combined(*(e.fit.hypothesis for e in speaking))
    starts = [np.concatenate([speaking[0].fit.x[:p], *(e.fit.x[p:] for e in speaking)])]
    for one in speaking:
        others = [e.fit.x[p:] if e is one else e.fit.hypothesis.neutral() for e in speaking]
        starts.append(np.concatenate([one.fit.x[:p], *others]))
    x, _ = refit(bench, whole, starts, None, _LONG)
    problem = copy(bench.problem)
    specs = whole.spec(whole.values(x[p:, None])[:, 0])
    problem.twin = problem.twin.model_copy(update={"effects": (*problem.twin.effects, *specs)})
    having = replace(bench, problem=problem)
    return having, *refit(having, BASELINE, [x[:p]], None, _LONG)
