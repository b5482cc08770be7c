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
from suspension_twin.diagnosis.coarse_search import NO_MATCH
from suspension_twin.diagnosis.evidence import Blocks, Evidence, blocks_of, evidence, held_out, weights
from suspension_twin.diagnosis.fit import LinearisedFit, fitted, linearised_fit
from suspension_twin.diagnosis.gates import Gatekeeper
from suspension_twin.diagnosis.hypotheses import BASELINE, decoys, library
from suspension_twin.diagnosis.preexisting import beyond_preexisting
from suspension_twin.diagnosis.request import DiagnosisRequest, Progress
from suspension_twin.diagnosis.search import Single, joint_fit, refitted_under_noise, singles
from suspension_twin.diagnosis.shrink import (
    RemainingResidual,
    gap_rows,
    remaining_residual,
    uncalibrated_residual,
)
from suspension_twin.errors import InputError
from suspension_twin.identification.parallel import side_by_side

__all__ = ["Decoys", "Judged", "judge", "model_weights", "with_joint_noise"]

#: Prior probability that some effect of the library is behind a gap; all are alike at first.
_EFFECT_PRIOR = 0.65
_DECOY_SHARE = 0.25  # share of a channel's gap that a decoy has to take where there is no reference
_LEAST_MATERIAL = 0.05  # probability of being material below which an effect is out of the question
#: Weight from which on it is asked what an effect gains beyond pre-existing ones.
_LEAST_WEIGHT = 0.01
#: Rounds in which the noise without a road is learnt from what all effects together leave.
_NOISE_ROUNDS, _NOISE_ROUNDS_COARSE = 2, 6
_OTHER_VEHICLE_LEVEL = (
    0.6  # share of its motion that a reference leaves at the best fit, above which it is another car's
)


@dataclass(frozen=True, eq=False)
class Decoys:
    """Decoy hypotheses: shapes beside the library. ``probability`` (W,) that the gap is like each, and what each
    leaves."""

    singles: list[Single]
    probability: Floats
    remaining: list[RemainingResidual]


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
    uncalibrated_residual: RemainingResidual
    reference: float | None
    temper: float
    keeper: Gatekeeper
    base: Evidence
    singles: list[Single]
    remaining: list[RemainingResidual]
    weights: Floats
    win_rate: Floats
    gates: list[verdict.Gates]
    dominance: Floats
    undetectable: Floats
    decoys: Decoys


def judge(
    request: DiagnosisRequest,
    case: Case,
    bench: Bench,
    base: LinearisedFit,
    anchor: LinearisedFit,
    report: Callable[[Progress], None],
) -> Judged:
    """Fit and judge every effect; searches start from ``anchor``, the vehicle that the reference shows."""
    seed, effects = request.seed, library(case.twin, case.excited, request.effects)
    if not effects:
        raise InputError("effects", "none of the library is left to try on this twin")
    blocks = blocks_of(bench, case.kind)
    with_gap = [d for d, a in zip(case.drives, bench.active, strict=True) if a]
    noise = {
        c: float(np.sqrt(np.mean([d.noise_rms[c] ** 2 for d in with_gap]))) for c in bench.problem.channels
    }
    reference = _reference(case, bench, anchor, blocks, noise)
    beside = decoys(case.twin, case.excited, request.effects)
    base, found = singles(
        bench,
        base,
        anchor,
        {**effects, **beside},
        blocks,
        seed,
        _no_match(case, bench, base, blocks, noise),
        lambda done, note: report(Progress("effects", 0.15 + 0.6 * done, note)),
    )
    own, count = evidence(bench, base, blocks), len(effects)
    everything = [own, *(s.evidence for s in found)]
    remaining = side_by_side(
        lambda e: remaining_residual(bench, e.fit.hypothesis, e.unknowns, blocks), everything
    )
    best = min(remaining, key=lambda r: float(np.mean(r.difference[gap_rows(bench), 0] ** 2)))
    temper = verdict.temper_of(bench, best, noise)
    gains = np.array([e.over(own) for e in everything[1:]])
    dominance = verdict.dominance_of(gains[:count], gains[count:])
    # one resonance makes up for any other, whether it is in the library or not
    dominance[[s.fit.hypothesis.scan(1) is not None for s in found[:count]]] = 0.0
    # a shape that many things have makes up for a part of any model's discrepancy
    least = verdict.MATERIAL if reference is not None else _DECOY_SHARE
    keeper = Gatekeeper(bench, blocks, noise, reference, temper, case, seed, own, remaining[0])
    given = list(
        zip(
            everything,
            remaining,
            [verdict.MATERIAL] * (1 + count) + [least] * len(beside),
            [0.0, *dominance, *([0.0] * len(beside))],
            strict=True,
        )
    )
    gates = side_by_side(lambda one: keeper.gates(*one), given)
    # what takes nothing material away cannot be the finding, however sure it is: it must not hide another
    each = _EFFECT_PRIOR / len(found)
    prior = np.array(
        [1.0 - _EFFECT_PRIOR, *(each if g.material > _LEAST_MATERIAL else 0.0 for g in gates[1:])]
    )
    weight, win_rate = model_weights(bench, blocks, seed, temper, own, everything, prior, found, report)
    weight[1:][[not s.judged for s in found]] = 0.0
    weight /= weight.sum()
    # what decoys explain is unknown: it is taken from the library
    passed = np.array([g.material * g.plausible for g in gates[1 + count :]])
    decoy_gains = weight[1 + count :] * passed
    weight[0] += float((weight[1 + count :] - decoy_gains).sum())
    return Judged(
        bench=bench,
        blocks=blocks,
        noise=noise,
        uncalibrated_residual=uncalibrated_residual(bench),
        reference=reference,
        temper=temper,
        keeper=keeper,
        base=own,
        singles=found[:count],
        remaining=remaining[: 1 + count],
        weights=weight[: 1 + count],
        win_rate=win_rate[: 1 + count, : 1 + count],
        gates=gates[: 1 + count],
        dominance=dominance,
        undetectable=each
        / (1.0 - _EFFECT_PRIOR)
        * np.array([s.undetectable_share(temper) for s in found[:count]]),
        decoys=Decoys(found[count:], decoy_gains, remaining[1 + count :]),
    )


def model_weights(
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
    weight, win_rate = weights(everything, prior, temper, seed)
    known = [s.preexisting for s in found if s.preexisting is not None]
    worth = prior[1:] * [w > _LEAST_WEIGHT or s.finalist for w, s in zip(weight[1:], found, strict=True)]
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
        return weight, win_rate
    base, since_evidence = beyond
    likely = np.array([prior[0], *(p if i in since_evidence else 0.0 for i, p in enumerate(prior[1:]))])
    since = [base, *(since_evidence.get(i, base) for i in range(len(found)))]
    # what came since and is large bends what all drives share: then it says more without pre-existing effects
    both, _ = weights([*everything, *since], 0.5 * np.concatenate([prior, likely]), temper, seed)
    if float(both[: len(everything)].sum()) < 0.5:
        _, win_rate = weights(since, likely, temper, seed)
    return both.reshape(2, -1).sum(axis=0), win_rate


def _no_match(case: Case, bench: Bench, base: LinearisedFit, blocks: Blocks, noise: dict[str, float]) -> bool:
    """Whether the recalibrated twin follows nothing of the motion."""
    remaining = remaining_residual(bench, BASELINE, held_out(bench, base, blocks).unknowns, blocks)
    return verdict.relative_residual(bench, remaining, noise, case.driven, with_gap=True) > NO_MATCH


def _reference(
    case: Case, bench: Bench, anchor: LinearisedFit, blocks: Blocks, noise: dict[str, float]
) -> float | None:
    """What the calibrated vehicle leaves of its motion on the reference drives; refuses another vehicle's."""
    if all(bench.active):
        return None
    reference_only = replace(bench, counted_drives=tuple(i for i, a in enumerate(bench.active) if not a))
    dominance = evidence(reference_only, linearised_fit(reference_only, BASELINE, anchor.x), blocks)
    remaining = remaining_residual(bench, BASELINE, dominance.unknowns, blocks)
    level = verdict.relative_residual(bench, remaining, noise, case.driven, with_gap=False)
    if level > _OTHER_VEHICLE_LEVEL:
        names = ", ".join(d.name for d, a in zip(case.drives, bench.active, strict=True) if not a)
        raise InputError(
            names,
            f"calibrated on it alone, the twin still misses {100 * level:.0f} % of its motion: it is of another "
            "vehicle, another road or another mounting than the twin file says; leave it out or give the right one",
        )
    return level


def with_joint_noise(
    request: DiagnosisRequest, case: Case, bench: Bench, base: LinearisedFit
) -> tuple[Bench, LinearisedFit]:
    """Without a road: the bench and the baseline under the noise that all effects together leave.

    The residual of a clock offset is no noise: taken for it, the noise would be as large as what is looked for.
    """
    effects = [v[0] for v in library(case.twin, case.excited, request.effects).values()]
    every, fit = range(len(bench.active)), base
    for number in range(_NOISE_ROUNDS_COARSE if effects else 0):
        fit = refitted_under_noise(bench, fit) if number else joint_fit(bench, effects, base, request.seed)
        bench = with_noise_of(case, bench, fit.hypothesis, fit.x, every)
        # what a sensor that stands backwards leaves is far from noise: that takes longer
        if number + 1 >= _NOISE_ROUNDS and not fit.hypothesis.around:
            break
    return bench, fitted(bench, BASELINE, [base.x], 8)
