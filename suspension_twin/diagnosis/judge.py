# SPDX-License-Identifier: Apache-2.0
"""Held-out evidence, gates and probabilities of every hypothesis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import verdict
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import Case, with_noise_of
from suspension_twin.diagnosis.coarse_search import LOST
from suspension_twin.diagnosis.evidence import Blocks, Evidence, blocks_of, evidence, held_out, weights
from suspension_twin.diagnosis.fit import Linear, finished, fitted
from suspension_twin.diagnosis.gates import Gatekeeper
from suspension_twin.diagnosis.hypotheses import BASELINE, decoys, library
from suspension_twin.diagnosis.preexisting import beyond_preexisting
from suspension_twin.diagnosis.request import DiagnosisRequest, Progress
from suspension_twin.diagnosis.search import Single, again, jointly, singles
from suspension_twin.diagnosis.shrink import Remainder, remainder, shown_rows, standing
from suspension_twin.errors import InputError
from suspension_twin.identification.parallel import side_by_side

__all__ = ["Decoys", "Judged", "judge", "weighed", "without_late_clocks"]

#: Prior probability that some effect of the library is behind a gap; all are alike at first.
_EFFECT_PRIOR = 0.65
_WORTH_OF_A_DECOY = 0.25  # share of a channel's gap that a decoy has to take where there is no reference
_MAYBE = 0.05  # probability of being material below which an effect is out of the question
#: Weight from which on it is asked what an effect gains beyond pre-existing ones.
_ASKED = 0.01
#: Rounds in which the noise without a road is learnt from what all effects together leave.
_CLEARED, _CLEARED_COARSE = 2, 6
_STRANGER = (
    0.6  # share of its motion that a reference leaves at the best fit, above which it is another car's
)


@dataclass(frozen=True, eq=False)
class Decoys:
    """Decoy hypotheses: shapes beside the library. ``probability`` (W,) that the gap is like each, and what each
    leaves."""

    singles: list[Single]
    probability: Floats
    left: list[Remainder]


@dataclass(frozen=True, eq=False)
class Judged:
    """The library's hypotheses on a bench, one effect each.

    ``left``, ``weights`` and ``gates`` count the baseline first, then ``singles``; ``beats`` (1 + E, 1 + E) is how
    often one is better than another. ``noise`` are the channels' floors, ``standing`` what the twin leaves as it
    stands, ``reference`` the share of the motion that is left on reference drives (None without), ``temper`` the share
    of the remaining residual that is noise; ``alone`` and ``unseen`` (E,) as in ``verdict.masses``.
    """

    bench: Bench
    blocks: Blocks
    noise: dict[str, float]
    standing: Remainder
    reference: float | None
    temper: float
    keeper: Gatekeeper
    base: Evidence
    singles: list[Single]
    left: list[Remainder]
    weights: Floats
    beats: Floats
    gates: list[verdict.Gates]
    alone: Floats
    unseen: Floats
    decoys: Decoys


def judge(
    request: DiagnosisRequest,
    case: Case,
    bench: Bench,
    base: Linear,
    anchor: Linear,
    report: Callable[[Progress], None],
) -> Judged:
    """Fit and judge every effect; searches start from ``anchor``, the vehicle that the reference shows."""
    seed, effects = request.seed, library(case.twin, case.excited, request.effects)
    if not effects:
        raise InputError("effects", "none of the library is left to try on this twin")
    blocks = blocks_of(bench, case.kind)
    shown = [d for d, a in zip(case.drives, bench.active, strict=True) if a]
    noise = {c: float(np.sqrt(np.mean([d.noise_rms[c] ** 2 for d in shown]))) for c in bench.problem.channels}
    reference = _reference(case, bench, anchor, blocks, noise)
    beside = decoys(case.twin, case.excited, request.effects)
    base, found = singles(
        bench,
        base,
        anchor,
        {**effects, **beside},
        blocks,
        seed,
        _lost(case, bench, base, blocks, noise),
        lambda done, note: report(Progress("effects", 0.15 + 0.6 * done, note)),
    )
    own, count = evidence(bench, base, blocks), len(effects)
    everything = [own, *(s.evidence for s in found)]
    left = side_by_side(lambda e: remainder(bench, e.fit.hypothesis, e.unknowns, blocks), everything)
    best = min(left, key=lambda r: float(np.mean(r.difference[shown_rows(bench), 0] ** 2)))
    temper = verdict.temper_of(bench, best, noise)
    gains = np.array([e.over(own) for e in everything[1:]])
    alone = verdict.unmatched(gains[:count], gains[count:])
    # one resonance makes up for any other, whether it is in the library or not
    alone[[s.fit.hypothesis.scan(1) is not None for s in found[:count]]] = 0.0
    # a shape that many things have makes up for a part of any model's discrepancy
    least = verdict.MATERIAL if reference is not None else _WORTH_OF_A_DECOY
    keeper = Gatekeeper(bench, blocks, noise, reference, temper, case, seed, own, left[0])
    given = list(
        zip(
            everything,
            left,
            [verdict.MATERIAL] * (1 + count) + [least] * len(beside),
            [0.0, *alone, *([0.0] * len(beside))],
            strict=True,
        )
    )
    gates = side_by_side(lambda one: keeper.gates(*one), given)
    # what takes nothing material away cannot be the finding, however sure it is: it must not hide another
    each = _EFFECT_PRIOR / len(found)
    prior = np.array([1.0 - _EFFECT_PRIOR, *(each if g.material > _MAYBE else 0.0 for g in gates[1:])])
    weight, beats = weighed(bench, blocks, seed, temper, own, everything, prior, found, report)
    weight[1:][[not s.judged for s in found]] = 0.0
    weight /= weight.sum()
    # what decoys explain is unknown: it is taken from the library
    passed = np.array([g.material * g.plausible for g in gates[1 + count :]])
    strange = weight[1 + count :] * passed
    weight[0] += float((weight[1 + count :] - strange).sum())
    return Judged(
        bench=bench,
        blocks=blocks,
        noise=noise,
        standing=standing(bench),
        reference=reference,
        temper=temper,
        keeper=keeper,
        base=own,
        singles=found[:count],
        left=left[: 1 + count],
        weights=weight[: 1 + count],
        beats=beats[: 1 + count, : 1 + count],
        gates=gates[: 1 + count],
        alone=alone,
        unseen=each / (1.0 - _EFFECT_PRIOR) * np.array([s.hidden(temper) for s in found[:count]]),
        decoys=Decoys(found[count:], strange, left[1 + count :]),
    )


def weighed(
    bench: Bench,
    blocks: Blocks,
    seed: int,
    temper: float,
    own: Evidence,
    everything: list[Evidence],
    prior: Floats,
    found: Sequence[Single],
    report: Callable[[Progress], None],
) -> tuple[Floats, Floats]:
    """Weights of the baseline and all effects; where there is a reference, also of what these gain beyond pre-existing
    effects: that the vehicle has some is as likely at first as that it has none."""
    weight, beats = weights(everything, prior, temper, seed)
    known = [s.always for s in found if s.always is not None]
    worth = prior[1:] * [w > _ASKED or s.finalist for w, s in zip(weight[1:], found, strict=True)]
    asked = {int(i): everything[1 + i].fit for i in np.flatnonzero(worth)}
    beyond = beyond_preexisting(
        bench,
        own,
        asked,
        known,
        temper,
        blocks,
        lambda done, i: report(Progress("effects", 0.75, f"{everything[1 + i].fit.hypothesis.name}, since")),
    )
    if beyond is None:
        return weight, beats
    base, late = beyond
    likely = np.array([prior[0], *(p if i in late else 0.0 for i, p in enumerate(prior[1:]))])
    since = [base, *(late.get(i, base) for i in range(len(found)))]
    # what came since and is large bends what all drives share: then it says more without pre-existing effects
    both, _ = weights([*everything, *since], 0.5 * np.concatenate([prior, likely]), temper, seed)
    if float(both[: len(everything)].sum()) < 0.5:
        _, beats = weights(since, likely, temper, seed)
    return both.reshape(2, -1).sum(axis=0), beats


def _lost(case: Case, bench: Bench, base: Linear, blocks: Blocks, noise: dict[str, float]) -> bool:
    """Whether the recalibrated twin follows nothing of the motion."""
    left = remainder(bench, BASELINE, held_out(bench, base, blocks).unknowns, blocks)
    return verdict.level_of(bench, left, noise, case.driven, shown=True) > LOST


def _reference(
    case: Case, bench: Bench, anchor: Linear, blocks: Blocks, noise: dict[str, float]
) -> float | None:
    """What the calibrated vehicle leaves of its motion on the reference drives; refuses another vehicle's."""
    if all(bench.active):
        return None
    quiet = replace(bench, heard=tuple(i for i, a in enumerate(bench.active) if not a))
    alone = evidence(quiet, finished(quiet, BASELINE, anchor.x), blocks)
    left = remainder(bench, BASELINE, alone.unknowns, blocks)
    level = verdict.level_of(bench, left, noise, case.driven, shown=False)
    if level > _STRANGER:
        names = ", ".join(d.name for d, a in zip(case.drives, bench.active, strict=True) if not a)
        raise InputError(
            names,
            f"calibrated on it alone, the twin still misses {100 * level:.0f} % of its motion: it is of another "
            "vehicle, another road or another mounting than the twin file says; leave it out or give the right one",
        )
    return level


def without_late_clocks(
    request: DiagnosisRequest, case: Case, bench: Bench, base: Linear
) -> tuple[Bench, Linear]:
    """Without a road: the bench and the baseline under the noise that all effects together leave.

    The residual of a clock offset is no noise: taken for it, the noise would be as large as what is looked for.
    """
    effects = [v[0] for v in library(case.twin, case.excited, request.effects).values()]
    every, fit = range(len(bench.active)), base
    for number in range(_CLEARED_COARSE if effects else 0):
        fit = again(bench, fit) if number else jointly(bench, effects, base, request.seed)
        bench = with_noise_of(case, bench, fit.hypothesis, fit.x, every)
        # what a sensor that stands backwards leaves is far from noise: that takes longer
        if number + 1 >= _CLEARED and not fit.hypothesis.around:
            break
    return bench, fitted(bench, BASELINE, [base.x], 8)
