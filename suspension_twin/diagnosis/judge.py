# SPDX-License-Identifier: Apache-2.0
"""Cross-validated evidence, gates and posterior weights of every hypothesis."""

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

#: Prior probability that an effect of the library causes the gap, the same for each.
_EFFECT_PRIOR = 0.65
_DECOY_SHARE = 0.25  # share of the gap of a channel that a decoy has to explain without a reference
_LEAST_MATERIAL = 0.05  # probability of the gate below which an effect has a prior of zero
#: Weight from which on an effect is compared with a vehicle that has pre-existing effects.
_LEAST_WEIGHT = 0.01
#: Rounds of noise estimation from the residual of all effects together, without a road.
_NOISE_ROUNDS, _NOISE_ROUNDS_COARSE = 2, 6
_OTHER_VEHICLE_LEVEL = (
    0.6  # residual on the reference as a share of its motion, above which it is of another vehicle
)


@dataclass(frozen=True, eq=False)
class Decoys:
    """Decoy hypotheses beside the library: ``probability`` (W,) of each, and its ``remaining`` residual."""

    singles: list[Single]
    probability: Floats
    remaining: list[RemainingResidual]


@dataclass(frozen=True, eq=False)
class Judged:
    """The library's hypotheses on a bench, one effect each.

    ``remaining`` residuals, ``weights`` and ``gates`` hold the baseline first, then ``singles``; ``win_rate``
    (1 + E, 1 + E) is the rate at which one has the higher evidence. ``noise`` is the noise rms by channel,
    ``uncalibrated_residual`` that of the twin as given, ``reference`` the residual on reference drives as a share of
    the motion (None without), ``temper`` the share of the remaining residual that is noise; ``dominance`` and
    ``undetectable`` (E,) as in ``verdict.masses``.
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
    """Fit every effect and compute its evidence, gates and weight.

    Searches start from ``anchor``, the vehicle fitted to the reference drives.
    """
    seed, effects = request.seed, library(case.twin, case.excited, request.effects, len(case.drives))
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
    # a resonance can stand in for any other one, in the library or not
    dominance[[s.fit.hypothesis.scan(1) is not None for s in found[:count]]] = 0.0
    # a decoy explains a part of any model discrepancy
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
    # an effect without a material share cannot be named: it must not take weight from others
    each = _EFFECT_PRIOR / len(found)
    prior = np.array(
        [1.0 - _EFFECT_PRIOR, *(each if g.material > _LEAST_MATERIAL else 0.0 for g in gates[1:])]
    )
    weight, win_rate = model_weights(bench, blocks, seed, temper, own, everything, prior, found, report)
    weight[1:][[not s.judged for s in found]] = 0.0
    weight /= weight.sum()
    # the weight of decoys goes to unknown
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
    """(1 + E,) weights of the baseline and all effects, and their win rates.

    With a reference, both are averaged over a vehicle with and one without pre-existing effects, of equal prior.
    """
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
    # a large new effect biases the pre-existing ones: the comparison without them then has the higher evidence
    both, _ = weights([*everything, *since], 0.5 * np.concatenate([prior, likely]), temper, seed)
    if float(both[: len(everything)].sum()) < 0.5:
        _, win_rate = weights(since, likely, temper, seed)
    return both.reshape(2, -1).sum(axis=0), win_rate


def _no_match(case: Case, bench: Bench, base: LinearisedFit, blocks: Blocks, noise: dict[str, float]) -> bool:
    """Whether the held-out response of the recalibrated twin does not match the motion at all."""
    remaining = remaining_residual(bench, BASELINE, held_out(bench, base, blocks).unknowns, blocks)
    return verdict.relative_residual(bench, remaining, noise, case.driven, with_gap=True) > NO_MATCH


def _reference(
    case: Case, bench: Bench, anchor: LinearisedFit, blocks: Blocks, noise: dict[str, float]
) -> float | None:
    """Residual of the calibrated vehicle on the reference drives as a share of its motion; None without a reference.

    Raises InputError where it is that of another vehicle.
    """
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
    """Without a road: the bench and the baseline with the noise estimated at the joint fit of all effects.

    The residual of the baseline contains the effects, for example a clock offset, and would overestimate the noise.
    """
    effects = [v[0] for v in library(case.twin, case.excited, request.effects, len(case.drives)).values()]
    every, fit = range(len(bench.active)), base
    for number in range(_NOISE_ROUNDS_COARSE if effects else 0):
        fit = refitted_under_noise(bench, fit) if number else joint_fit(bench, effects, base, request.seed)
        bench = with_noise_of(case, bench, fit.hypothesis, fit.x, every)
        # after a coarse search (a sensor mounted backwards) the estimate needs more rounds
        if number + 1 >= _NOISE_ROUNDS and not fit.hypothesis.around:
            break
    return bench, fitted(bench, BASELINE, [base.x], 8)
