# SPDX-License-Identifier: Apache-2.0
"""``diagnose``: from a request to a result. A pure function of picklable arguments.

It may run in a spawned process: whatever it reads is named in the request, and nothing is written.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import shrink as gaps
from suspension_twin.diagnosis import verdict
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.case import Case, baseline, build, read_case, taught_by
from suspension_twin.diagnosis.coarse_search import LOST
from suspension_twin.diagnosis.conclude import Findings, conclude
from suspension_twin.diagnosis.evidence import Evidence, blocks_of, evidence, held_out, weights
from suspension_twin.diagnosis.fit import Linear, finished, fitted
from suspension_twin.diagnosis.gates import Gatekeeper
from suspension_twin.diagnosis.hypotheses import BASELINE, NORMAL_PART, Hypothesis, library, witnesses
from suspension_twin.diagnosis.nuisance_penalty import penalty_gains
from suspension_twin.diagnosis.preexisting import since
from suspension_twin.diagnosis.request import DiagnosisRequest, DiagnosisResult, Progress
from suspension_twin.diagnosis.search import Single, again, jointly, pairs, singles, without_one
from suspension_twin.errors import InputError
from suspension_twin.identification.parallel import side_by_side

__all__ = ["diagnose"]

_EFFECT_PRIOR = 0.65
#: How surely one more effect has to beat the smaller set, and by which share of a channel's gap, to join it; and by
#: which share of what the smaller set leaves there, its nuisances where they were fitted, while no reference says what
#: a sound model leaves: some effect makes up for a part of any model's own error.
_SURE, _WORTH, _WORTH_OF_THE_REST = 0.95, verdict.MATERIAL, 0.2
#: Without a road, of a channel's gap: a clock that drifts passes almost whole for one that is late.
_WORTH_BARE = 0.5 * _WORTH
_WORTH_OF_A_WITNESS = 0.25  # share of a channel's gap that a witness has to take where there is no reference
_MAYBE = 0.05  # probability of being material below which an effect is out of the question
_MOST_EFFECTS = 3
_LEADS = (0.2, 0.1)  # weights from which on the likeliest effects and the next are tried with others
#: By how much -2 log posterior may differ if an effect takes over from the nuisances that are the same thing.
_SAME_FIT = 20.0
#: Weight from which on an effect is asked what it gains beyond the vehicle's traits.
_ASKED = 0.01
#: Nats that clocks which one more effect frees have to be spared, and that clocks, map and mount have to be where it
#: makes up for what these are asked more than for what is left.
_RELIEF, _MUCH_RELIEF = 1.0, float(np.log(_SURE / (1.0 - _SURE)))
#: Rounds in which the noise without a road is learnt from what all effects together leave.
_CLEARED, _CLEARED_GROSS = 2, 6
_STRANGER = (
    0.6  # share of its motion that a reference leaves at the best fit, above which it is another car's
)


def diagnose(
    request: DiagnosisRequest,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> DiagnosisResult:
    """Say where, why and how far: raises InputError for what cannot be used, WorkError where the work
    fails and ``identification.problem.Interrupted`` where it was told to stop."""
    began = time.monotonic()
    tell = on_progress or (lambda progress: None)
    stop = should_stop or (lambda: False)
    tell(Progress("reading", 0.0))
    case = read_case(request, lambda note: tell(Progress("reading", 0.02, note)), stop)
    bench = build(case, stop)
    tell(Progress("calibrating", 0.08, "the vehicle without any effect"))
    base, anchor = baseline(case, bench)
    found = _Search(request, case, bench, tell)
    found.judge(base, anchor)
    return conclude(request, case, bench, found.findings(), time.monotonic() - began)


@dataclass(eq=False)
class _Search:
    """One diagnosis on the way from a baseline to its findings."""

    request: DiagnosisRequest
    case: Case
    bench: Bench
    tell: Callable[[Progress], None]

    def judge(self, base: Any, anchor: Any) -> None:
        bench, seed = self.bench, self.request.seed
        effects = library(self.case.twin, self.case.road, self.request.effects)
        if not effects:
            raise InputError("effects", "none of the library is left to try on this twin")
        if not self.case.road:
            base = anchor = self._cleared(base, [v[0] for v in effects.values()])
        self.blocks = blocks_of(bench, self.case.road)
        shown = [d for d, a in zip(self.case.drives, bench.active, strict=True) if a]
        self.noise = {
            c: float(np.sqrt(np.mean([d.noise_rms[c] ** 2 for d in shown]))) for c in bench.problem.channels
        }
        self.standing = gaps.standing(bench)
        self.reference = self._reference(anchor)
        strangers = witnesses(self.case.twin, self.case.road, self.request.effects)
        base, found = singles(
            bench,
            base,
            anchor,
            {**effects, **strangers},
            self.blocks,
            seed,
            self._lost(base),
            lambda done, note: self.tell(Progress("effects", 0.15 + 0.6 * done, note)),
        )
        self.base = evidence(bench, base, self.blocks)
        self.singles, self.witnesses = found[: len(effects)], found[len(effects) :]
        everything = [self.base, *(s.evidence for s in found)]
        self.left = side_by_side(
            lambda e: gaps.remainder(bench, e.fit.hypothesis, e.unknowns, self.blocks), everything
        )
        best = min(self.left, key=lambda r: float(np.mean(r.difference[gaps.shown_rows(bench), 0] ** 2)))
        self.temper = verdict.temper_of(bench, best, self.noise)
        each = _EFFECT_PRIOR / len(found)
        # a shape that many things have makes up for a part of any model's own error
        least = verdict.MATERIAL if self.reference is not None else _WORTH_OF_A_WITNESS
        gains = np.array([e.over(self.base) for e in everything[1:]])
        self.alone = verdict.unmatched(gains[: len(effects)], gains[len(effects) :])
        # one resonance makes up for any other, whether it is in the library or not
        self.alone[[s.fit.hypothesis.scan(1) is not None for s in self.singles]] = 0.0
        leasts = [verdict.MATERIAL] * (1 + len(effects)) + [least] * len(strangers)
        alone = [0.0, *self.alone, *([0.0] * len(strangers))]
        self.keeper = Gatekeeper(
            bench,
            self.blocks,
            self.noise,
            self.reference,
            self.temper,
            self.case.road,
            seed,
            self.base,
            self.left[0],
        )
        given = list(zip(everything, self.left, leasts, alone, strict=True))
        self.gates = side_by_side(lambda one: self.keeper.gates(*one), given)
        # what takes nothing material away cannot be the finding, however sure it is: it must not hide another
        priors = [each if g.material > _MAYBE else 0.0 for g in self.gates[1:]]
        self._weigh(everything, np.array([1.0 - _EFFECT_PRIOR, *priors]), found)
        self.unseen = each / (1.0 - _EFFECT_PRIOR) * np.array([s.hidden(self.temper) for s in self.singles])
        for i, s in enumerate(found):
            if not s.judged:
                self.weights[1 + i] = 0.0
        self.weights /= self.weights.sum()
        self._set_apart()
        if self.case.road:
            chosen, left = self._combine(everything[: 1 + len(self.singles)])
            self.chosen, self.chosen_left = self._whole(chosen, left)
        else:
            self.chosen, self.chosen_left = self._eliminate()
            self._carried_by(self.chosen, self.keeper.gates(self.chosen, self.chosen_left))

    def _weigh(self, everything: list[Evidence], prior: Floats, found: Sequence[Single]) -> None:
        """Weights of the baseline and all effects; where there is a reference, also of what these gain beyond the
        traits that the vehicle always had: that it has some is as likely at first as that it has none."""
        bench, blocks, seed = self.bench, self.blocks, self.request.seed
        self.weights, self.beats = weights(everything, prior, self.temper, seed)
        known = [s.always for s in found if s.always is not None]
        worth = prior[1:] * [w > _ASKED or s.finalist for w, s in zip(self.weights[1:], found, strict=True)]
        asked = {int(i): everything[1 + i].fit for i in np.flatnonzero(worth)}
        told = since(
            bench,
            self.base,
            asked,
            known,
            self.temper,
            blocks,
            lambda done, i: self.tell(
                Progress("effects", 0.75, f"{everything[1 + i].fit.hypothesis.name}, of late")
            ),
        )
        if told is None:
            return
        base, late = told
        likely = np.array([prior[0], *(p if i in late else 0.0 for i, p in enumerate(prior[1:]))])
        beyond = [base, *(late.get(i, base) for i in range(len(found)))]
        # what came since and is large bends what all drives share: then it says more without traits than beside them
        both, _ = weights([*everything, *beyond], 0.5 * np.concatenate([prior, likely]), self.temper, seed)
        self.weights, without = both.reshape(2, -1).sum(axis=0), float(both[: len(everything)].sum())
        if without < 0.5:
            _, self.beats = weights(beyond, likely, self.temper, seed)

    def _lost(self, base: Linear) -> bool:
        """Whether the recalibrated twin follows nothing of the motion."""
        unknowns = held_out(self.bench, base, self.blocks).unknowns
        left = gaps.remainder(self.bench, BASELINE, unknowns, self.blocks)
        return verdict.level_of(self.bench, left, self.noise, shown=True) > LOST

    def _set_apart(self) -> None:
        """Take the witnesses' weights and gates from those of the library: what they explain is unknown."""
        count = 1 + len(self.singles)
        passed = np.array([g.material * g.plausible for g in self.gates[count:]])
        self.strange = self.weights[count:] * passed
        self.weights[0] += float((self.weights[count:] - self.strange).sum())
        self.weights, self.beats = self.weights[:count], self.beats[:count, :count]
        self.strange_left, self.left = self.left[count:], self.left[:count]
        self.gates = self.gates[:count]

    def _cleared(self, base: Linear, effects: list[Hypothesis]) -> Linear:
        """The baseline again under the noise that all effects together leave.

        What a late clock leaves is no noise: taught by it, the noise would be as large as what is looked for.
        """
        every, fit = range(len(self.bench.active)), base
        for number in range(_CLEARED_GROSS):
            fit = again(self.bench, fit) if number else jointly(self.bench, effects, base, self.request.seed)
            taught_by(self.case, self.bench, fit.hypothesis, fit.x, every)
            # what a sensor that stands backwards leaves is far from noise: that takes longer
            if number + 1 >= _CLEARED and not fit.hypothesis.around:
                break
        return fitted(self.bench, BASELINE, [base.x], 8)

    def _carried_by(self, chosen: Evidence, gates: verdict.Gates) -> None:
        """Weights and gates of effects that were judged together: each stands for all of them."""
        _, beats = weights([self.base, chosen], np.array([0.5, 0.5]), self.temper, self.request.seed)
        members = [1 + i for i, s in enumerate(self.singles) if s.effect in chosen.fit.hypothesis.effects]
        self.weights[:] = 0.0
        self.weights[members] = beats[1, 0] / max(len(members), 1)
        self.weights[0] = 1.0 - self.weights.sum()
        for i in members:
            self.gates[i] = gates

    def _reference(self, anchor: Linear) -> float | None:
        """What the calibrated vehicle leaves of its motion on the reference drives; refuses a stranger's."""
        if all(self.bench.active):
            return None
        quiet = replace(self.bench, heard=tuple(i for i, a in enumerate(self.bench.active) if not a))
        alone = evidence(quiet, finished(quiet, BASELINE, anchor.x), self.blocks)
        left = gaps.remainder(self.bench, BASELINE, alone.unknowns, self.blocks)
        level = verdict.level_of(self.bench, left, self.noise, shown=False)
        if level > _STRANGER:
            names = ", ".join(
                d.name for d, a in zip(self.case.drives, self.bench.active, strict=True) if not a
            )
            raise InputError(
                names,
                f"calibrated on it alone, the twin still misses {100 * level:.0f} % of its motion: it is of another "
                "vehicle, another road or another mounting than the twin file says; leave it out or give the right one",
            )
        return level

    def _combine(self, everything: list[Evidence]) -> tuple[Evidence, gaps.Remainder]:
        """The smallest set that closes the gap, from the likeliest effects: of two causes the one that shows most by
        itself may be neither, or too little of the gap while the other is not there."""
        missing = self.gates[0].adequate < 0.5
        best, best_left = self.base, self.left[0]
        for place, at in enumerate(np.argsort(-self.weights[1:], kind="stable")[: len(_LEADS)]):
            lead = int(at) + 1
            material, there = self.gates[lead].material >= 0.5, best.fit.hypothesis.effects
            if (
                self.weights[lead] < _LEADS[place]
                or not (material or missing)
                or self.singles[at].effect in there
            ):
                continue
            chosen, left = self._grown(everything[lead], self.left[lead], self.gates[lead])
            size, largest = len(chosen.fit.hypothesis.effects), len(there)
            if size == 1 and not (material and best is self.base):
                continue
            if (
                best is self.base
                or (size == largest and chosen.over(self.base) > best.over(self.base))
                or (size > largest and self._pays(best, best_left, chosen, left))
            ):
                best, best_left = chosen, left
        return best, best_left

    def _grown(
        self, chosen: Evidence, left: gaps.Remainder, gates: verdict.Gates
    ) -> tuple[Evidence, gaps.Remainder]:
        """What a lead becomes, greedily, one more effect at a time, as long as it pays."""
        effects = library(self.case.twin, self.case.road, self.request.effects)
        weak = [s.effect for s in self.singles if not s.judged]
        # without a reference nobody knows what is left of a sound model: what pays is taken
        while len(chosen.fit.hypothesis.effects) < min(_MOST_EFFECTS, len(effects)) and (
            self.reference is None or gates.adequate < 0.5
        ):
            tried = pairs(
                self.bench,
                chosen,
                effects,
                self.blocks,
                self.request.seed,
                lambda done, note: self.tell(Progress("combinations", 0.76 + 0.18 * done, note)),
                weak,
            )
            # the one that gains most may make up for a little everywhere and close nothing: then the next
            joined = next(self._joining(chosen, left, tried), None)
            if joined is None:
                break
            chosen, left = joined
            gates = self.keeper.gates(chosen, left)
        return chosen, left

    def _joining(
        self, few: Evidence, few_left: gaps.Remainder, tried: list[Evidence]
    ) -> Iterator[tuple[Evidence, gaps.Remainder]]:
        """Those of ``tried`` that pay, the best first, and what they leave."""
        for more in tried:
            if verdict.uncommon(self.bench, more, self.reference is not None) > 0.5:
                rest = gaps.remainder(self.bench, more.fit.hypothesis, more.unknowns, self.blocks)
                if self._pays(few, few_left, more, rest):
                    yield more, rest

    def _pays(
        self, few: Evidence, few_left: gaps.Remainder, many: Evidence, many_left: gaps.Remainder
    ) -> bool:
        """Whether one more effect is sure to be better, and by enough of some channel's recalibrated gap;
        without a road of what the fewer leave there: each channel is another effect's to show."""
        _, beats = weights([few, many], np.array([0.5, 0.5]), self.temper, self.request.seed)
        if beats[1, 0] < _SURE:
            return False
        alone = self.case.road and self.reference is None
        if self.case.road and not alone:
            still = [np.sqrt(1.0 - self.keeper.gone(*one)) for one in ((few, few_left), (many, many_left))]
            # what makes up for a little of the model's own error takes little of what the reference does not show
            if still[0] - still[1] < _WORTH:
                return False
        spared = penalty_gains([few.penalty, many.penalty], self.temper)[1] if alone else 0.0
        # clocks that are all at their ends make up for something: what frees them is worth it, if that is worth it
        if spared > _RELIEF and (
            verdict.punctual(self.bench, few, self.temper)
            < 0.5
            <= verdict.punctual(self.bench, many, self.temper)
        ):
            return True
        for column, channel in enumerate(self.bench.problem.channels):
            before = self.left[0] if self.case.road else few_left
            one, two = (
                self.keeper.shrink(before, few_left, column),
                self.keeper.shrink(before, many_left, column),
            )
            if column not in self.keeper.driven or one.after < self.noise[channel]:
                continue
            if one.after - two.after >= (_WORTH if self.case.road else _WORTH_BARE) * one.before and (
                not alone
                or spared > _MUCH_RELIEF  # no model's own error asks that of clocks and map
                or self.keeper.shrink(few_left, many_left, column, settled=True).shrink >= _WORTH_OF_THE_REST
            ):
                return True
        return False

    def _whole(self, chosen: Evidence, left: gaps.Remainder) -> tuple[Evidence, gaps.Remainder]:
        """What is named with all of it: the part that is normal of any clock, map or mount went to the nuisances while
        causes were compared. With a reference that part is the vehicle's before the change."""
        bench, hypothesis = self.bench, chosen.fit.hypothesis
        barred = tuple(n for e in hypothesis.effects for n in NORMAL_PART.get(e, ()))
        if self.reference is not None or not barred:
            return chosen, left
        alone = replace(bench, barred=barred)
        fit = fitted(alone, hypothesis, [chosen.fit.x], 10)
        if fit.cost > chosen.fit.cost + _SAME_FIT:
            return chosen, left
        whole = evidence(alone, fit, self.blocks)
        return whole, gaps.remainder(bench, hypothesis, whole.unknowns, self.blocks)

    def _eliminate(self) -> tuple[Evidence, gaps.Remainder]:
        """Without a road: all effects that can be judged jointly, then one less for as long as nothing is lost.

        There are few of them, and they hide each other: a clock that drifts looks like one that is late, and
        a tilt is not seen before the clock is right. Starting from one would end with the wrong one. No
        background is known that a remainder could be measured by.
        """
        bench = self.bench
        known = library(self.case.twin, False, self.request.effects)
        judged = [s for s in self.singles if s.judged]
        if not judged:
            return self.base, self.left[0]
        fit = jointly(bench, [known[s.effect][0] for s in judged], self.base.fit, self.request.seed)
        chosen = evidence(bench, fit, self.blocks)
        left = gaps.remainder(bench, chosen.fit.hypothesis, chosen.unknowns, self.blocks)
        while chosen.fit.hypothesis.effects:
            fewer = without_one(bench, chosen, self.blocks)
            rest = [gaps.remainder(bench, e.fit.hypothesis, e.unknowns, self.blocks) for e in fewer]
            spare = [i for i, e in enumerate(fewer) if not self._pays(e, rest[i], chosen, left)]
            if not spare:
                break
            least = max(spare, key=lambda i: float(fewer[i].score.sum()) - 0.5 * fewer[i].occam)
            chosen, left = fewer[least], rest[least]
        return chosen, left

    def findings(self) -> Findings:
        """Everything that the answer is made of."""
        self.tell(Progress("judging", 0.95))
        keeper, chosen, left = self.keeper, self.chosen, self.chosen_left
        gone = [keeper.gone(s.evidence, r) for s, r in zip(self.singles, self.left[1:], strict=True)]
        return Findings(
            self.blocks,
            self.noise,
            self.standing,
            self.base,
            self.singles,
            self.left,
            self.weights,
            np.array(gone),
            self.unseen,
            self.alone,
            self.beats,
            self.gates,
            chosen,
            left,
            keeper.gates(chosen, left),
            keeper.gone(chosen, left),
            self.reference,
            self.temper,
            self.witnesses,
            self.strange,
            self.strange_left,
        )
