# SPDX-License-Identifier: Apache-2.0
"""What the vehicle had before already: traits, which the reference drives show as well as those with the gap.

A model's own error comes again on every drive, and some effects make up for a part of it: a low-pass, a contact patch,
a little friction. Fitted to the drives with the gap alone, such an effect looks as if it had come since, and gains more
than a faint one that has. So whatever speaks for itself on all drives is fitted to all of them first, and what counts
for an effect is what it gains beyond that.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.fit import Fit, finished, refit
from suspension_twin.diagnosis.hypotheses import BASELINE, NORMAL_PART, Hypothesis, combined
from suspension_twin.diagnosis.judge import Blocks, Evidence, evidence
from suspension_twin.drive.types import Floats

__all__ = ["as_trait", "beyond", "settled"]

#: Nats, counted by the share of what is left that is noise, from which on an effect is a trait.
_SPEAKS = 2.0
_ROUGH, _LONG, _FINE = 4, 8, 6


def as_trait(bench: Bench, hypothesis: Hypothesis, x: Floats, base: Fit, blocks: Blocks) -> Evidence:
    """An effect, at unknowns ``x`` (d + q + k,) on the drives with the gap, as a trait of the vehicle on all drives."""
    always, u = hypothesis.always(), x[bench.d + bench.q :]
    starts = [x, np.concatenate([base.x, u]), np.concatenate([base.x, hypothesis.neutral()])]
    y, _ = refit(bench, always, starts, None, _ROUGH)
    return evidence(bench, finished(bench, always, y), blocks)


def settled(
    bench: Bench, base: Evidence, found: Sequence[Evidence], temper: float, blocks: Blocks
) -> tuple[Bench, Evidence] | None:
    """The bench of a vehicle that has all traits of ``found`` that speak for themselves, and its baseline; None where
    none does.

    A clock, a place on the map or a lean that there always was is a nuisance already.
    """
    speaking = [e for e in found if temper * e.over(base) > _SPEAKS and e.fit.hypothesis.effects[0] not in NORMAL_PART]
    if not speaking:
        return None
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
    y, _ = refit(having, BASELINE, [x[:p]], None, _ROUGH)
    return having, evidence(having, finished(having, BASELINE, y), blocks)


def beyond(having: Bench, base: Evidence, single: Fit, blocks: Blocks) -> Evidence:
    """An effect on the drives with the gap of a vehicle ``having`` its traits, ``base`` without the effect; one that is
    a trait itself has another size there than on those from before."""
    own, p = single.hypothesis, having.d + having.q
    x, u = base.fit.x, single.x[p:]
    starts = [np.concatenate(pair) for pair in ((x, u), (x, own.neutral()), (single.x[:p], u))]
    there = [e for e in having.problem.twin.effects if e.id in own.effects]
    if there and not own.fixed:
        starts.append(np.concatenate([x, own.at(there[0])]))
    y, _ = refit(having, own, starts, None, _FINE)
    return evidence(having, finished(having, own, y), blocks)
