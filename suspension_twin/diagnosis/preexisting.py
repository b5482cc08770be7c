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
from suspension_twin.diagnosis.fit import Fit, fitted, linearised_fit, refit
from suspension_twin.diagnosis.hypotheses import BASELINE, Hypothesis, combined
from suspension_twin.identification.parallel import side_by_side

__all__ = ["as_preexisting", "beyond_preexisting"]

#: Nats, counted by the share of the remaining residual that is noise, that a pre-existing effect gains at least on all
#: drives and loses at most on those from before: of effects that came since these lost 4 to 13, of others less than 1.
_LEAST_GAIN = 1.0
_ROUGH, _LONG, _FINE = 4, 8, 6
_REBASE_GAIN = (
    1.0  # -2 log posterior by which a baseline has to be better for what was compared with it to go on
)


def as_preexisting(bench: Bench, hypothesis: Hypothesis, x: Floats, base: Fit, blocks: Blocks) -> Evidence:
    """An effect, at unknowns ``x`` (d + q + k,) on the drives with the gap, as a pre-existing effect on all drives.

    Not for a clock, a place on the map or a lean: that there always was one is a nuisance already.
    """
    existing, u = hypothesis.existing(), x[bench.d + bench.q :]
    starts = [x, np.concatenate([base.x, u]), np.concatenate([base.x, hypothesis.neutral()])]
    return evidence(bench, fitted(bench, existing, starts, _ROUGH), blocks)


def beyond_preexisting(
    bench: Bench,
    base: Evidence,
    found: dict[int, Fit],
    existing: Sequence[Evidence],
    temper: float,
    blocks: Blocks,
    on_progress: Callable[[float, int], None],
) -> tuple[Evidence, dict[int, Evidence]] | None:
    """The baseline of a vehicle that has the pre-existing effects of ``always``, and what each effect of ``found`` does
    on the drives with the gap beyond them; None where there is none of either. An effect that is pre-existing as well
    may have another size there than on those from before."""
    extended, x, cost = _with_preexisting(bench, base, existing if found else (), temper)
    if extended is bench:
        return None
    p = bench.d + bench.q

    def beside(i: int) -> Floats:
        own, u = found[i].hypothesis, found[i].x[p:]
        starts = [np.concatenate(pair) for pair in ((x, u), (x, own.neutral()), (found[i].x[:p], u))]
        there = [e for e in extended.problem.twin.effects if e.id in own.effects]
        if there and not own.fixed:
            starts.append(np.concatenate([x, own.at(there[0])]))
        return refit(extended, own, starts, None, _FINE)[0]

    fits = dict(zip(found, side_by_side(beside, list(found), on_progress), strict=True))
    # the baseline takes over any vehicle that an effect's fit has come to, and the others go on from there
    y, better = refit(extended, BASELINE, [x, *(z[:p] for z in fits.values())], None, _LONG)

    def judged(i: int) -> Evidence:
        own, z = found[i].hypothesis, fits[i]
        if better < cost - _REBASE_GAIN:
            starts = [z, np.concatenate([y, z[p:]]), np.concatenate([y, own.neutral()])]
            return evidence(extended, fitted(extended, own, starts, _FINE), blocks)
        return evidence(extended, linearised_fit(extended, own, z), blocks)

    evidences = side_by_side(judged, list(found), on_progress)
    return evidence(extended, linearised_fit(extended, BASELINE, y), blocks), dict(
        zip(found, evidences, strict=True)
    )


def _gain_on_reference(bench: Bench, existing: Evidence, base: Evidence) -> float:
    """Nats that a pre-existing effect gains on the drives from before: one that has come since is pulled at by all
    drives, and these lose by it."""
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
    """The bench of a vehicle that has all effects that improve the prediction of all drives and do not worsen that of
    the drives from before, and its unknowns and cost."""
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
