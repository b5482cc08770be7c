# SPDX-License-Identifier: Apache-2.0
"""What the vehicle had before already: traits, which the reference drives show as well as those with the gap.

A model's own error comes again on every drive, and some effects make up for a part of it: a low-pass, a contact patch,
a little friction. Fitted to the drives with the gap alone, such an effect looks as if it had come since, and gains more
than a faint one that has. So whatever speaks for itself on all drives is fitted to all of them first, and what counts
for an effect is what it gains beyond that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.fit import Fit, finished, refit
from suspension_twin.diagnosis.hypotheses import NORMAL_PART, Hypothesis, combined
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


def settled(bench: Bench, base: Evidence, found: Sequence[Evidence], temper: float, blocks: Blocks) -> Evidence | None:
    """The baseline with all traits of ``found`` that speak for themselves; None where none does.

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
    return evidence(bench, finished(bench, whole, x), blocks)


def beyond(bench: Bench, traits: Evidence, single: Fit, blocks: Blocks) -> Evidence:
    """An effect on the drives with the gap beyond the ``traits`` that it is none of itself: it came since, or it was
    there already."""
    p, whole, own = bench.d + bench.q, traits.fit.hypothesis, single.hypothesis
    others, x = whole.without(own.effects[0]), traits.fit.x
    rest = x[p:][whole.rows(others)]
    starts = [(x, single.x[p:]), (x, own.neutral()), (single.x, single.x[p:])]
    if own.effects[0] in whole.effects and len(whole) - len(others) == len(own):
        starts.append((x, np.delete(x[p:], whole.rows(others))))
    both = combined(own, others)
    y, _ = refit(bench, both, [np.concatenate([z[:p], u, rest]) for z, u in starts], None, _FINE)
    return evidence(bench, finished(bench, both, y), blocks)
