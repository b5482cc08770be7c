# SPDX-License-Identifier: Apache-2.0
"""Fits and cross-validated evidence of every hypothesis: single effects, decoys, and sets of effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.case import Case, with_noise_of
from suspension_twin.diagnosis.coarse_search import NO_MATCH
from suspension_twin.diagnosis.excerpt import excerpt_of
from suspension_twin.diagnosis.library import decoys, library
from suspension_twin.diagnosis.preexisting import LEAST_GAIN, beyond_preexisting
from suspension_twin.diagnosis.request import DiagnosisProgress, DiagnosisRequest
from suspension_twin.diagnosis.search import (
    LEAST_POWER,
    Search,
    Single,
    joint_fit,
    pairs,
    singles,
    without_one,
)
from suspension_twin.diagnosis.shrink import (
    RemainingResidual,
    gap_rows,
    relative_residual,
    remaining_residual,
    uncalibrated_residual,
)
from suspension_twin.errors import InputError
from suspension_twin.inference.checkpoint import Rounds
from suspension_twin.inference.cross_validation import Blocks, Evidence, blocks_of, evidence, held_out
from suspension_twin.inference.fit import LONG, LinearisedFit, fitted, linearised_fit
from suspension_twin.inference.hypothesis import BASELINE, Hypothesis
from suspension_twin.inference.noise import USUAL_SHARE
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.problem import Problem, counting, whitener_of

__all__ = [
    "ADDED",
    "Candidate",
    "Judged",
    "candidate",
    "detectable",
    "judge",
    "tempered_gain",
    "with_joint_noise",
]

#: Share of the gain of the first lead that the second needs, and number of leads.
_LEAD_SHARE, _LEADS = 0.25, 2
_MOST_EFFECTS = 3  # of a set
#: Nats that decide between two hypotheses, odds of 20 to 1: that one more effect has to add for the search to go on.
ADDED = 3.0
#: Lower limit of the share of the remaining residual that is noise.
_LEAST_TEMPER = 0.03
#: Rounds of noise estimation from the residual of all effects together, without a road: after a coarse search (a sensor
#: mounted backwards) the first estimates are far off.
_NOISE_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis with its cross-validated evidence and its held-out ``remaining`` residual.

    ``since``: evidence on a vehicle with pre-existing effects, None where it was not computed. ``powers`` (S,):
    detectability in nats at sizes over the prior of a single effect; ``decoy``: whether it is no cause but a shape that
    many mechanisms share.
    """

    found: Evidence
    remaining: RemainingResidual
    since: Evidence | None = None
    powers: Floats | None = None
    decoy: bool = False

    @property
    def hypothesis(self) -> Hypothesis:
        """Its hypothesis."""
        return self.found.fit.hypothesis

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids of its effects."""
        return self.hypothesis.effects


@dataclass(frozen=True, eq=False)
class Scale:
    """The scales that gains are judged by: ``noise`` rms by channel; ``uncalibrated`` residual of the twin as given;
    ``reference``, the residual on reference drives as a share of the motion (None without); and ``temper``, the share
    of the remaining residual that is noise: model discrepancy is no independent evidence at every sample."""

    noise: dict[str, float]
    uncalibrated: RemainingResidual
    reference: float | None
    temper: float


@dataclass(frozen=True, eq=False)
class Judged:
    """All hypotheses on a ``problem``: ``base`` (recalibration alone), ``singles`` (decoys included) and ``sets``;
    ``base_since`` is the baseline with pre-existing effects."""

    problem: Problem
    search: Search
    scale: Scale
    base: Candidate
    base_since: Evidence | None = None
    singles: tuple[Candidate, ...] = ()
    sets: tuple[Candidate, ...] = ()


def judge(
    request: DiagnosisRequest,
    case: Case,
    problem: Problem,
    fits: tuple[LinearisedFit, LinearisedFit],
    rounds: Rounds,
    report: Callable[[DiagnosisProgress], None],
) -> Judged:
    """Fit every effect of the library, and sets of effects where one leaves more than expected.

    ``fits`` are the baseline on all drives and the vehicle fitted to the reference drives, from which searches start.
    """
    base, anchor = fits
    effects = library(case.twin, case.excited, case.named(request.effects), len(case.drives))
    if not effects:
        raise InputError("effects", "none of the library is left to try on this twin")
    blocks = blocks_of(problem)
    with_gap = [d for d, a in zip(case.drives, case.active, strict=True) if a]
    noise = {c: float(np.sqrt(np.mean([d.noise_rms[c] ** 2 for d in with_gap]))) for c in problem.channels}
    reference = _reference(case, problem, anchor, blocks, noise)
    beside = decoys(case.twin, case.excited, request.effects)
    no_match = _no_match(case, problem, base, blocks, noise)
    search = Search(blocks, request.seed, rounds, case.turn, no_match, excerpt_of(problem, base.x))
    base, found = singles(
        problem,
        base,
        anchor,
        {**effects, **beside},
        search,
        lambda done, note: report(DiagnosisProgress("effects", 0.15 + 0.55 * done, note)),
    )
    own = evidence(problem, base, blocks)
    remaining = side_by_side(
        lambda e: remaining_residual(problem, e.fit.hypothesis, e.unknowns, blocks),
        [own, *(s.evidence for s in found)],
    )
    rows = gap_rows(problem)
    least = min(float(np.mean(r.difference[rows, 0] ** 2)) for r in remaining)
    noisy = noise[problem.channels[0]] ** 2
    temper = float(np.clip(noisy / max(least, 1e-12), _LEAST_TEMPER, 1.0))
    base_since, since = _since(problem, own, found, temper, search, report)
    candidates = tuple(
        Candidate(s.evidence, r, since.get(i), s.powers, s.effect in beside)
        for i, (s, r) in enumerate(zip(found, remaining[1:], strict=True))
    )
    scale = Scale(noise, uncalibrated_residual(problem), reference, temper)
    judged = Judged(problem, search, scale, Candidate(own, remaining[0]), base_since, candidates)
    if case.excited:
        return replace(judged, sets=tuple(_grown(request, case, judged, report)))
    return _with_sets(judged, _shrunk(request, case, judged))


def tempered_gain(judged: Judged, found: Evidence, base: Evidence | None = None) -> float:
    """Nats of tempered evidence over ``base`` (recalibration alone if not given).

    T = temper (held-out gain) + nuisance penalty saved - freedom / 2. The freedom is Occam's factor at the tempered
    curvature; half of it counts, because held-out scores contain the cost of freedom already. The prior of nuisance
    parameters is independent of model discrepancy and not tempered.
    """
    base = base or judged.base.found
    # a held-out gain of more than twice the gain in the fit is chance
    held = min(float(found.score.sum() - base.score.sum()), 2.0 * max(found.fitted - base.fitted, 0.0))
    if found.penalty is None or base.penalty is None:
        return judged.scale.temper * held
    (spent, free), (spent_before, free_before) = (
        p.at(judged.scale.temper) for p in (found.penalty, base.penalty)
    )
    return judged.scale.temper * held + spent_before - spent - 0.5 * max(free - free_before, 0.0)


def _since(
    problem: Problem,
    own: Evidence,
    found: Sequence[Single],
    temper: float,
    search: Search,
    report: Callable[[DiagnosisProgress], None],
) -> tuple[Evidence | None, dict[int, Evidence]]:
    """Evidence of the baseline with pre-existing effects and of the finalists beyond them."""
    asked = {i: s.fit for i, s in enumerate(found) if s.finalist}
    known = [s.preexisting for s in found if s.preexisting is not None]
    beyond = beyond_preexisting(
        problem,
        own,
        asked,
        known,
        temper,
        search,
        on_progress=lambda done, i: report(
            DiagnosisProgress("effects", 0.72, f"{found[i].effect}, since".replace("_", " "))
        ),
    )
    return (None, {}) if beyond is None else beyond


def candidate(judged: Judged, found: Evidence) -> Candidate:
    """A hypothesis with its remaining residual."""
    remaining = remaining_residual(judged.problem, found.fit.hypothesis, found.unknowns, judged.search.blocks)
    return Candidate(found, remaining)


def _grown(
    request: DiagnosisRequest, case: Case, judged: Judged, report: Callable[[DiagnosisProgress], None]
) -> list[Candidate]:
    """Sets of two and three effects, grown from the effects of highest evidence.

    With two causes, the effect of highest evidence may be neither of them. A set is not grown where its first effects
    leave no more than a complete model does; beside the best effect alone, one is fitted there all the same if a first
    look shows what a further effect has to add.
    """
    effects = library(case.twin, case.excited, case.named(request.effects), len(case.drives))
    known = [c for c in judged.singles if not c.decoy]
    gains = np.array([tempered_gain(judged, c.found) for c in known])
    weak = [c.effects[0] for c in known if c.powers is not None and not detectable(c.powers)]
    gains[[c.effects[0] in weak for c in known]] = -np.inf
    expected = USUAL_SHARE if judged.scale.reference is None else judged.scale.reference
    found: dict[tuple[str, ...], Candidate] = {}
    for place, i in enumerate(np.argsort(-gains, kind="stable")[:_LEADS]):
        if gains[i] < max(LEAST_GAIN, _LEAD_SHARE * float(gains.max())):
            continue
        chosen, gain = known[i], float(gains[i])
        while len(chosen.effects) < min(_MOST_EFFECTS, len(effects)):
            complete = _level(case, judged, chosen) <= expected
            if complete and (place or len(chosen.effects) > 1):
                break
            tried = pairs(
                judged.problem,
                chosen.found,
                effects,
                judged.search,
                lambda done, note: report(DiagnosisProgress("combinations", 0.76 + 0.18 * done, note)),
                skip=weak,
                temper=judged.scale.temper,
                least=ADDED if complete else -np.inf,
            )
            if not tried:
                break
            for one in tried:
                found.setdefault(tuple(sorted(one.fit.hypothesis.effects)), candidate(judged, one))
            best = max(tried, key=lambda one: tempered_gain(judged, one))
            better = tempered_gain(judged, best)
            if better < gain + ADDED:
                break
            chosen, gain = found[tuple(sorted(best.fit.hypothesis.effects))], better
    return list(found.values())


def detectable(powers: Floats) -> bool:
    """Whether the drives excite an effect enough for a judgement, somewhere over its prior."""
    return bool(powers.max() >= LEAST_POWER)


def _level(case: Case, judged: Judged, one: Candidate) -> float:
    return relative_residual(
        judged.problem, one.remaining, judged.scale.noise, case.driven, True, judged.scale.reference is None
    )


def _shrunk(request: DiagnosisRequest, case: Case, judged: Judged) -> list[Candidate]:
    """Without a road: the set that is left of all effects once those are taken out that add nothing, and the sets of
    one effect less; none where one effect is left.

    The few effects mask each other (a clock drift resembles a clock offset; a tilt shows only with the right clock),
    so that sets grown from one effect would start from a wrong one.
    """
    problem, blocks = judged.problem, judged.search.blocks
    known = library(case.twin, False, request.effects, len(case.drives))
    possible = [c.effects[0] for c in judged.singles if c.powers is not None and detectable(c.powers)]
    if not possible:
        return []
    fit = joint_fit(
        problem,
        [known[e][0] for e in possible],
        judged.base.found.fit,
        request.seed,
        case.turn,
    )
    chosen = evidence(problem, fit, blocks)
    while len(chosen.fit.hypothesis.effects) > 1:
        parts = without_one(problem, chosen, blocks)
        fewer = max(parts, key=lambda one: tempered_gain(judged, one))
        if tempered_gain(judged, fewer) < tempered_gain(judged, chosen) - ADDED:
            return [candidate(judged, one) for one in (chosen, *parts)]
        chosen = fewer
    return []


def _with_sets(judged: Judged, found: Sequence[Candidate]) -> Judged:
    """With sets and the effects that remain of them alone, which are the better of two fits of the same hypothesis."""
    alone = {c.effects[0]: c for c in found if len(c.effects) == 1}

    def better(one: Candidate) -> Candidate:
        other = alone.get(one.effects[0])
        if other is None or tempered_gain(judged, other.found) <= tempered_gain(judged, one.found):
            return one
        return replace(one, found=other.found, remaining=other.remaining)

    sets = tuple(c for c in found if len(c.effects) > 1)
    return replace(judged, singles=tuple(better(c) for c in judged.singles), sets=sets)


def _no_match(
    case: Case, problem: Problem, base: LinearisedFit, blocks: Blocks, noise: dict[str, float]
) -> bool:
    """Whether the held-out response of the recalibrated twin does not match the motion at all."""
    remaining = remaining_residual(problem, BASELINE, held_out(problem, base, blocks).unknowns, blocks)
    return relative_residual(problem, remaining, noise, case.driven, with_gap=True) > NO_MATCH


def _reference(
    case: Case, problem: Problem, anchor: LinearisedFit, blocks: Blocks, noise: dict[str, float]
) -> float | None:
    """Residual of the calibrated vehicle on the reference drives as a share of its motion; None without a reference."""
    active = problem.data.active
    if all(active):
        return None
    before = ~np.array(active)[whitener_of(problem).drive]
    reference_only = counting(problem, before)
    alone = evidence(reference_only, linearised_fit(reference_only, anchor.x), blocks)
    remaining = remaining_residual(problem, BASELINE, alone.unknowns, blocks)
    return relative_residual(problem, remaining, noise, case.driven, with_gap=False)


def with_joint_noise(
    request: DiagnosisRequest, case: Case, problem: Problem, base: LinearisedFit
) -> tuple[Problem, LinearisedFit]:
    """Without a road: the problem and the baseline with the noise estimated at the joint fit of all effects.

    The residual of the baseline contains the effects, for example a clock offset, and would overestimate the noise.
    """
    effects = [
        v[0] for v in library(case.twin, case.excited, case.named(request.effects), len(case.drives)).values()
    ]
    every, fit = range(len(problem.data.active)), base
    for number in range(_NOISE_ROUNDS if effects else 0):
        if number:
            fit = fitted(problem.having(fit.hypothesis), [fit.x], LONG)
        else:
            fit = joint_fit(problem, effects, base, request.seed, case.turn)
        problem = with_noise_of(problem.having(fit.hypothesis), fit.x, every).having(BASELINE)
    return problem, fitted(problem, [base.x], LONG)
