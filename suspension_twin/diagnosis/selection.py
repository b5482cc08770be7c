# SPDX-License-Identifier: Apache-2.0
"""The smallest set of effects that closes the gap."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import verdict
from suspension_twin.diagnosis.case import Case
from suspension_twin.diagnosis.evidence import Evidence, evidence, weights
from suspension_twin.diagnosis.fit import fitted
from suspension_twin.diagnosis.hypotheses import NUISANCE_COUNTERPART, library
from suspension_twin.diagnosis.judge import Judged
from suspension_twin.diagnosis.nuisance_penalty import penalty_gains
from suspension_twin.diagnosis.request import DiagnosisRequest, Progress
from suspension_twin.diagnosis.search import joint_fit, pairs, without_one
from suspension_twin.diagnosis.shrink import RemainingResidual, remaining_residual

__all__ = ["Candidate", "Findings", "pays", "select"]

#: For one more effect to join a set: win rate over the smaller set, and share of the gap of a channel that it explains;
#: without a reference also its share of the remaining residual there with the nuisance parameters as fitted, because
#: some effect explains a part of any model discrepancy.
_SURE, _WORTH, _WORTH_OF_THE_REMAINING = 0.95, verdict.MATERIAL, 0.2
#: The same share without a road: a clock offset explains most of a clock drift.
_WORTH_BARE = 0.5 * _WORTH
_MOST_EFFECTS = 3
_LEADS = (0.2, 0.1)  # weights from which on the first and the second effect start a set
#: -2 log posterior by which the fit may be worse with the nuisance parameters of the same action frozen.
_SAME_FIT = 20.0
#: Nats of nuisance penalty that one more effect has to save where it takes clocks off their bounds, and where it
#: reduces the nuisance penalty more than the remaining residual.
_SAVED, _SAVED_MUCH = 1.0, float(np.log(_SURE / (1.0 - _SURE)))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A set of effects with its cross-validated evidence and its ``remaining`` residual."""

    found: Evidence
    remaining: RemainingResidual

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids of its effects."""
        return self.found.fit.hypothesis.effects


@dataclass(frozen=True, eq=False)
class Findings:
    """Input of the verdict: the library ``judged``, the set ``chosen`` with its ``gates`` and its ``explained_share``
    of the recalibrated residual, and the ``explained_shares`` (E,) of each effect of the library."""

    judged: Judged
    chosen: Candidate
    gates: verdict.Gates
    explained_share: float
    explained_shares: Floats


def _candidate(judged: Judged, found: Evidence) -> Candidate:
    """A set with its remaining residual on the bench of the library."""
    fit = found.fit
    return Candidate(found, remaining_residual(judged.bench, fit.hypothesis, found.unknowns, judged.blocks))


def select(
    request: DiagnosisRequest, case: Case, judged: Judged, report: Callable[[Progress], None]
) -> Findings:
    """Choose the set of effects that can be named."""
    if case.excited:
        chosen = _with_nuisance_part(judged, _best_set(request, case, judged, report))
    else:
        chosen = _backward_elimination(request, case, judged)
        judged = _weights_of_set(request, judged, chosen)
    keeper = judged.keeper
    singles = zip(judged.singles, judged.remaining[1:], strict=True)
    return Findings(
        judged,
        chosen,
        keeper.gates(chosen.found, chosen.remaining),
        keeper.explained_share(chosen.found, chosen.remaining),
        np.array([keeper.explained_share(s.evidence, remaining) for s, remaining in singles]),
    )


def _best_set(
    request: DiagnosisRequest, case: Case, judged: Judged, report: Callable[[Progress], None]
) -> Candidate:
    """The best set grown from the most probable effects.

    With two causes, the effect of highest evidence may be neither of them, and each may explain too little by itself.
    """
    missing, seed = judged.gates[0].adequate < 0.5, request.seed
    none = best = Candidate(judged.base, judged.remaining[0])
    for place, at in enumerate(np.argsort(-judged.weights[1:], kind="stable")[: len(_LEADS)]):
        single, gates = judged.singles[at], judged.gates[1 + at]
        material = gates.material >= 0.5
        if (
            judged.weights[1 + at] < _LEADS[place]
            or not (material or missing)
            or single.effect in best.effects
        ):
            continue
        lead = Candidate(single.evidence, judged.remaining[1 + at])
        chosen = _forward_selection(request, case, judged, lead, gates, report)
        size, largest = len(chosen.effects), len(best.effects)
        if size == 1 and not (material and best is none):
            continue
        if (
            best is none
            or (size == largest and chosen.found.over(judged.base) > best.found.over(judged.base))
            or (size > largest and pays(case, judged, best, chosen, seed))
        ):
            best = chosen
    return best


def _forward_selection(
    request: DiagnosisRequest,
    case: Case,
    judged: Judged,
    chosen: Candidate,
    gates: verdict.Gates,
    report: Callable[[Progress], None],
) -> Candidate:
    """Greedy forward selection from one effect, as long as one more pays."""
    effects = library(case.twin, case.excited, request.effects, len(case.drives))
    weak = [s.effect for s in judged.singles if not s.judged]
    # without a reference the model discrepancy is unknown: growth ends where no effect pays
    while len(chosen.effects) < min(_MOST_EFFECTS, len(effects)) and (
        judged.reference is None or gates.adequate < 0.5
    ):
        tried = pairs(
            judged.bench,
            chosen.found,
            effects,
            judged.blocks,
            request.seed,
            lambda done, note: report(Progress("combinations", 0.76 + 0.18 * done, note)),
            weak,
        )
        # the pair of highest evidence may explain a little everywhere and not pay: then the next
        joined = next(_additions(request, case, judged, chosen, tried), None)
        if joined is None:
            break
        chosen = joined
        gates = judged.keeper.gates(chosen.found, chosen.remaining)
    return chosen


def _additions(
    request: DiagnosisRequest, case: Case, judged: Judged, few: Candidate, tried: list[Evidence]
) -> Iterator[Candidate]:
    """The candidates of ``tried`` that pay, the best first."""
    for more in tried:
        if verdict.beyond_usual(judged.bench, more, judged.reference is not None) > 0.5:
            many = _candidate(judged, more)
            if pays(case, judged, few, many, request.seed):
                yield many


def pays(case: Case, judged: Judged, few: Candidate, many: Candidate, seed: int) -> bool:
    """Whether the larger set ``many`` has surely the higher evidence than ``few`` and explains enough more of the gap.

    Enough is a share of the recalibrated gap of some channel; without a road, of the remaining residual of ``few``.
    """
    bench, keeper, temper = judged.bench, judged.keeper, judged.temper
    _, win_rate = weights([few.found, many.found], np.array([0.5, 0.5]), temper, seed)
    if win_rate[1, 0] < _SURE:
        return False
    unreferenced = case.excited and judged.reference is None
    if case.excited and not unreferenced:
        still = [np.sqrt(1.0 - keeper.explained_share(one.found, one.remaining)) for one in (few, many)]
        # an effect that only explains model discrepancy explains little of the excess over the reference
        if still[0] - still[1] < _WORTH:
            return False
    saved = penalty_gains([few.found.penalty, many.found.penalty], temper)[1] if unreferenced else 0.0
    # clocks that are all on their bounds compensate for a missing effect
    if saved > _SAVED and (
        verdict.clocks_within_limits(bench, few.found, temper)
        < 0.5
        <= verdict.clocks_within_limits(bench, many.found, temper)
    ):
        return True
    for column, channel in enumerate(bench.problem.channels):
        before = judged.remaining[0] if case.excited else few.remaining
        one, two = (keeper.shrink(before, remaining, column) for remaining in (few.remaining, many.remaining))
        if column not in keeper.driven or one.after < judged.noise[channel]:
            continue
        if one.after - two.after >= (_WORTH if case.excited else _WORTH_BARE) * one.before and (
            not unreferenced
            or saved > _SAVED_MUCH  # model discrepancy does not move clocks and map by that much
            or keeper.shrink(few.remaining, many.remaining, column, with_nuisances=True).shrink
            >= _WORTH_OF_THE_REMAINING
        ):
            return True
    return False


def _with_nuisance_part(judged: Judged, chosen: Candidate) -> Candidate:
    """The set refitted with the nuisance parameters of the same action frozen, so that its parameters hold the whole
    error.

    With a reference that part belongs to the state before the change and is left to the nuisance parameters.
    """
    bench, hypothesis = judged.bench, chosen.found.fit.hypothesis
    frozen_nuisances = tuple(n for e in hypothesis.effects for n in NUISANCE_COUNTERPART.get(e, ()))
    if judged.reference is not None or not frozen_nuisances:
        return chosen
    unreferenced = replace(bench, frozen_nuisances=frozen_nuisances)
    fit = fitted(unreferenced, hypothesis, [chosen.found.fit.x], 10)
    if fit.cost > chosen.found.fit.cost + _SAME_FIT:
        return chosen
    whole = evidence(unreferenced, fit, judged.blocks)
    return _candidate(judged, whole)


def _backward_elimination(request: DiagnosisRequest, case: Case, judged: Judged) -> Candidate:
    """Backward elimination, without a road: the joint fit of all effects, then one less as long as that loses nothing.

    The few effects mask each other (a clock drift resembles a clock offset; a tilt shows only with the right clock), so
    that forward selection would start from a wrong one. The model discrepancy is unknown there.
    """
    bench, blocks = judged.bench, judged.blocks
    known = library(case.twin, False, request.effects)
    possible = [s for s in judged.singles if s.judged]
    if not possible:
        return Candidate(judged.base, judged.remaining[0])

    fit = joint_fit(bench, [known[s.effect][0] for s in possible], judged.base.fit, request.seed)
    chosen = _candidate(judged, evidence(bench, fit, blocks))
    while chosen.effects:
        fewer = [_candidate(judged, e) for e in without_one(bench, chosen.found, blocks)]
        dispensable = [one for one in fewer if not pays(case, judged, one, chosen, request.seed)]
        if not dispensable:
            break
        chosen = max(dispensable, key=lambda one: float(one.found.score.sum()) - 0.5 * one.found.occam)
    return chosen


def _weights_of_set(request: DiagnosisRequest, judged: Judged, chosen: Candidate) -> Judged:
    """Weights and gates of a set that was judged jointly: each member has those of the set."""
    _, win_rate = weights([judged.base, chosen.found], np.array([0.5, 0.5]), judged.temper, request.seed)
    members = [1 + i for i, s in enumerate(judged.singles) if s.effect in chosen.effects]
    weight, gates = np.zeros_like(judged.weights), list(judged.gates)
    weight[members] = win_rate[1, 0] / max(len(members), 1)
    weight[0] = 1.0 - weight.sum()
    for i in members:
        gates[i] = judged.keeper.gates(chosen.found, chosen.remaining)
    return replace(judged, weights=weight, gates=gates)
