# SPDX-License-Identifier: Apache-2.0
"""The search through the library: every effect by itself, then pairs with the best."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis import coarse_search
from suspension_twin.diagnosis.excerpt import Excerpt
from suspension_twin.diagnosis.library import NUISANCE_COUNTERPART, SETUP_CATEGORIES
from suspension_twin.diagnosis.preexisting import REBASE_GAIN, as_preexisting
from suspension_twin.diagnosis.tone_search import tone_peaks, tone_starts
from suspension_twin.errors import WorkError
from suspension_twin.inference.checkpoint import Rounds, stored
from suspension_twin.inference.cross_validation import Blocks, Evidence, evidence
from suspension_twin.inference.fit import (
    DEEP,
    LONG,
    ROUGH,
    Fit,
    LinearisedFit,
    approximated,
    coordinate_scan,
    fitted,
    linearised_fit,
    refit,
    resonance_scan,
    screen,
    twin_of,
)
from suspension_twin.inference.gauss_newton import Quadratic, bounded_step
from suspension_twin.inference.hypothesis import Hypothesis, combined
from suspension_twin.inference.parallel import side_by_side
from suspension_twin.inference.posterior import travel
from suspension_twin.inference.problem import Linearised, Problem
from suspension_twin.inference.sensor_correction import Turn

__all__ = ["FINALISTS", "Search", "Single", "joint_fit", "pairs", "singles", "without_one"]

#: Sobol points of one effect, and of all effects together; starts, peaks and sets that are fitted: the best of them.
_STARTS, _JOINT_STARTS, _TRIED = 16, 128, 3
_SCANNED = 32  # frequencies of a resonance scan
#: Changes of the log slopes of springs from the baseline, of dampers up to twice that, as starting vehicles.
_SOFTER = (0.0, -0.3, -0.6)
#: Quantile of the size of the travel at which an effect with a clearance touches in its start: a stop that touches in a
#: fifth of the drive leaves the characteristics their part.
_TOUCHES = 0.8
#: Ratio of the cost of a start to the best cost so far up to which a fit is run from it.
_COST_RATIO = 3.0
#: Effects whose fit is repeated with all columns of the Jacobian: those with a share of the best gain of the first
#: search, at least the first number and at most the second.
_FINALIST_GAIN, FINALISTS = 0.2, (3, 7)
_VARIANTS = 2  # of an effect that are fitted: the best by screening
#: Nats by which an effect has to change the signals, somewhere over its prior, to be judged.
LEAST_POWER = 5.0


@dataclass(frozen=True, eq=False)
class Search:
    """Choices and aids of a search: ``blocks`` of the cross-validation, ``seed``, ``rounds`` of work kept on disk, the
    ``turn`` of the sensor that the drives show, ``no_match`` where the simulation does not match the motion (then
    set-up errors are searched over their whole range), and the ``excerpt`` for first looks, if there is one."""

    blocks: Blocks
    seed: int = 0
    rounds: Rounds = Rounds()
    turn: Turn = (0.0, 0.0, 0.0)
    no_match: bool = False
    excerpt: Excerpt | None = None


@stored
@dataclass(frozen=True, eq=False)
class Single:
    """The best fit of one effect.

    ``powers`` (S,): detectability in nats at sizes over its prior; ``finalist``: whether its Jacobian was simulated
    again; ``preexisting``: evidence of the same effect on all drives.
    """

    effect: str
    evidence: Evidence
    powers: Floats
    finalist: bool = True
    preexisting: Evidence | None = None

    @property
    def fit(self) -> Fit:
        return self.evidence.fit


@stored
@dataclass(frozen=True, eq=False)
class _FirstSearch:
    """The first search of an effect."""

    cost: float
    effect: str
    hypothesis: Hypothesis
    x: Floats
    powers: Floats


def singles(
    problem: Problem,
    base: LinearisedFit,
    anchor: LinearisedFit,
    library: dict[str, list[Hypothesis]],
    search: Search,
    on_progress: Callable[[float, str], None],
) -> tuple[LinearisedFit, list[Single]]:
    """Fit every effect of the library jointly with vehicle and nuisance parameters.

    Returns the baseline, which is refitted from the vehicle of each effect, and the effects. The first search goes over
    the excerpt, if there is one.
    """
    begun, excerpt, rounds = base, search.excerpt, search.rounds
    if excerpt is not None:
        short = linearised_fit(excerpt.problem, base.x)
        short_anchor = short if anchor is base else linearised_fit(excerpt.problem, anchor.x)

    def first(effect: str) -> _FirstSearch:
        variants = library[effect]
        if excerpt is not None and not _since_the_start(variants[0], effect):
            looked = _first_search(excerpt.problem, short, short_anchor, variants, search)
            best = min(
                (_on_whole_drives(problem, begun, anchor, one, excerpt.share) for one in looked),
                key=lambda one: one.cost,
            )
            if math.isfinite(best.cost):
                return best
        best = min(_first_search(problem, begun, anchor, variants, search), key=lambda one: one.cost)
        if not math.isfinite(best.cost):
            raise WorkError(f"the twin cannot be simulated with {effect}")
        return best

    rough = rounds.side_by_side(
        "first search",
        first,
        list(library),
        lambda done, name: on_progress(0.6 * done, name.replace("_", " ")),
    )
    base = _rebased_baseline(problem, base, [r.x for r in rough])
    moved = base.cost < begun.cost - REBASE_GAIN
    rough = rounds.side_by_side(
        "from the better baseline",
        lambda r: _restarted(problem, base, moved, r, search.seed),
        rough,
        lambda done, _: on_progress(0.6 + 0.05 * done, "baseline"),
    )
    gains = np.array([base.cost - r.cost for r in rough])
    count = int(np.count_nonzero(gains >= _FINALIST_GAIN * max(gains.max(), 0.0)))
    finalists = np.argsort(-gains, kind="stable")[: int(np.clip(count, *FINALISTS))].tolist()

    def judge(i: int) -> Single:
        r, final = rough[i], i in finalists
        v, whole, preexisting = r.hypothesis, problem.having(r.hypothesis), None
        starts = [r.x, np.concatenate([base.x, r.x[problem.shared :]])]
        at = fitted(whole, starts, DEEP) if final else approximated(whole, starts, base)
        if final and not all(problem.data.active) and not v.differs and r.effect not in NUISANCE_COUNTERPART:
            preexisting = as_preexisting(problem, v, at.x, base, search.blocks)
        if at.cost >= base.cost:
            ends = v.negligible()
            none = np.concatenate([np.repeat(base.x[:, None], ends.shape[1], axis=1), ends])
            at = approximated(whole, list(none.T), base)
        other = coordinate_scan(whole, at) if final else None
        if other is not None:
            at = fitted(whole, [other], DEEP)
        # far from the best one, the linearisation says enough of what a fold takes away
        own = evidence(whole, at, search.blocks, linear=not final)
        return Single(r.effect, own, r.powers, final, preexisting)

    return base, rounds.side_by_side(
        "finalists",
        judge,
        range(len(rough)),
        lambda done, i: on_progress(0.65 + 0.35 * done, f"{rough[i].effect.replace('_', ' ')}, once more"),
    )


def _since_the_start(hypothesis: Hypothesis, name: str) -> bool:
    """Whether an effect depends on the time since the start of a drive: a part of it shows another one."""
    effect = hypothesis.effect(name)
    return effect.tone is not None or effect.where == "time"


def _on_whole_drives(
    problem: Problem,
    base: LinearisedFit,
    anchor: LinearisedFit,
    part: _FirstSearch,
    share: float,
) -> _FirstSearch:
    """A first search over an excerpt with ``share`` of the information, fitted to the whole drives."""
    v, p = part.hypothesis, problem.shared
    u = part.x[p:]
    starts = [part.x, *(np.concatenate([x, u]) for x in (base.x, anchor.x))]
    starts.append(np.concatenate([base.x, v.neutral()]))
    x, cost = refit(problem.having(v), starts, anchor.at, ROUGH)
    cost += coarse_search.MISALIGNMENT_PENALTY * bool(v.around)
    return replace(part, cost=cost, x=x, powers=part.powers / share)


def _first_search(
    problem: Problem,
    base: LinearisedFit,
    anchor: LinearisedFit,
    variants: Sequence[Hypothesis],
    search: Search,
) -> list[_FirstSearch]:
    """The best variants of an effect from many starts, mostly with the vehicle Jacobian at ``anchor``; includes the
    coarse search for set-up errors."""
    effect, seed = variants[0].effects[-1], search.seed
    screens = [screen(problem.having(v), anchor, v.starts(_STARTS, seed)) for v in variants]
    powers = np.concatenate([s.power for s in screens])
    peaks = _peaks(problem, anchor, effect, variants)
    # with the vehicle of all drives as well, from which the effect is else started at nothing
    heard = [
        [
            x
            for vehicle in ((anchor,) if base is anchor else (anchor, base))
            for x in tone_starts(problem, vehicle, v, effect, own)
        ]
        for v, own in zip(variants, peaks, strict=True)
    ]
    costs = [
        min([s.cost[0], *(problem.having(v).costs(np.stack(x, axis=1)).tolist() if x else ())])
        for v, s, x in zip(variants, screens, heard, strict=True)
    ]
    order = sorted(range(len(variants)), key=lambda i: costs[i])
    found = []
    # a weak damper at one corner and a strong one at the other are similar to first order: both are fitted
    for i in order[:_VARIANTS]:
        v, tried = variants[i], screens[i]
        # beside the peak of a tone no scattered start is of use
        scattered = [] if heard[i] else tried.x[:_TRIED]
        starts = [*scattered, *_resonant(problem, anchor, v, v), *heard[i]]
        starts.append(np.concatenate([base.x, v.neutral()]))
        x, cost = refit(problem.having(v), starts, anchor.at, ROUGH)
        if not math.isfinite(cost):
            # a recalibrated baseline may be so far off that no effect can be simulated on it
            starts = [
                np.concatenate([problem.prior.centre, u]) for u in (v.neutral(), *v.starts(_STARTS, seed).T)
            ]
            x, cost = refit(problem.having(v), starts, None, DEEP)
        far = coarse_search.coarse_fit(problem, v, search.turn, search.no_match)
        if far is not None and far[2] < cost:
            v, x, cost = far
        misset = None if problem.simulation.fused else coarse_search.misset_fit(problem, v, x, cost)
        if misset is not None:
            v, x, cost = misset
        whole = [
            start for begun, start in _softened_starts(problem, base, v, seed) if begun < _COST_RATIO * cost
        ]
        for start in (*_typical_start(problem, base, v), *whole):
            y, other = refit(problem.having(v), [start], None, DEEP, alternate_jacobian=True)
            x, cost = (y, other) if other < cost else (x, cost)
        found.append(_FirstSearch(cost, effect, v, x, powers))
    return found


def _peaks(
    problem: Problem, start: LinearisedFit, effect: str, variants: Sequence[Hypothesis]
) -> list[list[Mapping[str, float]]]:
    """The strongest tones for each variant of an effect, which may turn with another wheel than the next one."""
    found: dict[int, list[Mapping[str, float]]] = {}
    own, corners = variants[0].effect(effect), [v.corner(effect) for v in variants]
    for corner in corners:
        if corner not in found:
            found[corner] = tone_peaks(problem, start.at.residual, own, corner)
    return [found[corner] for corner in corners]


def _resonant(
    problem: Problem, base: LinearisedFit, hypothesis: Hypothesis, added: Hypothesis
) -> list[Floats]:
    """The start at the best resonance frequency of ``added``, the last effect of the hypothesis; empty without one."""
    scan = added.scan(_SCANNED)
    found = None if scan is None else resonance_scan(problem.having(hypothesis), base, scan)
    return [] if found is None else [found]


def _rebased_baseline(problem: Problem, base: LinearisedFit, found: Sequence[Floats]) -> LinearisedFit:
    """The baseline refitted from the vehicle of each effect, so that no effect is credited with a better vehicle."""
    p = problem.shared
    better = fitted(problem, [base.x, *(y[:p] for y in found)], LONG)
    return better if better.cost < base.cost else base


def _restarted(
    problem: Problem, base: LinearisedFit, moved: bool, rough: _FirstSearch, seed: int
) -> _FirstSearch:
    """Repeat the search of an effect from the improved baseline, if that has ``moved``.

    Set-up effects are also fitted with the nuisance parameters of the same action frozen: these can share a clock
    offset among them and form a separate local minimum.
    """
    v, u = rough.hypothesis, rough.x[problem.shared :]
    starts = [np.concatenate([base.x, u]), np.concatenate([base.x, v.neutral()])]
    if rough.cost >= base.cost:
        starts += screen(problem.having(v), base, v.starts(_STARTS, seed)).x[:_TRIED]
    found = [refit(problem.having(v), starts, base.at, ROUGH)] if moved else [(rough.x, rough.cost)]
    if rough.hypothesis.effect(rough.effect).where in SETUP_CATEGORIES:
        same = tuple(n for names in NUISANCE_COUNTERPART.values() for n in names)
        names = tuple(n for n in problem.nuisances.names if n.endswith(same))
        frozen = replace(problem, prior=replace(problem.prior, frozen=names))
        begun, _ = refit(frozen.having(v), starts, base.at, ROUGH)
        found.append(refit(problem.having(v), [begun], base.at, ROUGH))
    x, cost = min(found, key=lambda f: f[1])
    return replace(rough, x=x, cost=cost) if cost < rough.cost else rough


def _typical_start(problem: Problem, base: Fit, hypothesis: Hypothesis) -> list[Floats]:
    """The effect at its typical size in the baseline vehicle, for effects whose size is not centred on nothing.

    Where characteristics have taken over the part of a massless wheel or a stiff mount, every size of the effect is
    worse than nothing until they have moved: the lowest cost is no guide among starts.
    """
    effect, neutral = hypothesis.effect(hypothesis.effects[-1]), hypothesis.neutral()
    names, typical = [key.split(".")[2] for key in hypothesis.keys], hypothesis.typical()
    if all(neutral[i] == typical[i] for i, name in enumerate(names) if name in effect.severity):
        return []
    start = np.concatenate([base.x[: problem.shared], typical])
    return [np.asarray(problem.having(hypothesis).clipped(start[:, None])[:, 0])]


def _softened_starts(
    problem: Problem, base: Fit, hypothesis: Hypothesis, seed: int
) -> list[tuple[float, Floats]]:
    """Costs and unknowns of starts with softer springs and weaker dampers than the baseline.

    A calibration without friction, stop or anti-roll bar compensates for them in the characteristics, further than a
    linear step corrects. Only for effects of strut, tyre and body that are no tones: a tone adds to the motion, and no
    characteristic compensates for it.
    """
    effect = hypothesis.effect(hypothesis.effects[-1])
    if effect.where not in ("strut", "tyre", "body") or effect.tone is not None:
        return []
    p, whole = problem.shared, problem.having(hypothesis)
    softer = product(_SOFTER, repeat=2) if problem.space.curves else [(0.0, 0.0)]
    vehicles = [problem.space.shifted(base.x[:p], springs, 2.0 * dampers) for springs, dampers in softer]
    starts = [hypothesis.starts(_STARTS // 2, seed + 1)]
    # a stop that hardly touches has the lowest cost but no gradient: starts that touch are added
    if hypothesis.has_clearance:
        known = travel(twin_of(problem, base), problem)
        far = {
            axle: float(np.quantile(np.abs(x - known.static[axle]), _TOUCHES))
            for axle, x in known.compression.items()
        }
        starts.append(hypothesis.early_contact(far)[:, None])
    found = []
    for own in starts:
        lanes = [np.concatenate([np.repeat(z[:, None], own.shape[1], axis=1), own]) for z in vehicles]
        x = whole.clipped(np.concatenate(lanes, axis=1))
        costs = whole.costs(x)
        best = int(np.argmin(costs))
        found.append((float(costs[best]), x[:, best]))
    return found


def pairs(
    problem: Problem,
    first: Evidence,
    library: dict[str, list[Hypothesis]],
    search: Search,
    on_progress: Callable[[float, str], None],
    *,
    skip: Sequence[str] = (),
    temper: float = 1.0,
    least: float = -math.inf,
) -> list[Evidence]:
    """Evidence of the sets with one more effect than ``first`` that a first look finds best, over the excerpt if there
    is one; of those alone that gain at least so many nats there.

    The look weighs the residual by ``temper``, as the evidence does: what the nuisance parameters take over (a clock)
    costs their prior alone, which is not tempered.
    """
    excerpt, seed, rounds = search.excerpt, search.seed, search.rounds
    there = first.fit.hypothesis
    begun = linearised_fit(problem.having(there), first.fit.x)
    known = begun.at.first(problem.shared)
    others = [e for e in library if e not in there.effects and e not in skip]
    if any(_since_the_start(there, e) for e in there.effects):
        excerpt = None
    whole = _tempered(problem, begun, temper)
    part = whole
    if excerpt is not None:
        short = linearised_fit(excerpt.problem.having(there), first.fit.x)
        part = _tempered(excerpt.problem, short, temper / excerpt.share)

    def look(effect: str) -> list[tuple[float, Hypothesis, list[Floats]]]:
        """By variant: nats that it gains on the whole drives by a first look, and the best starts."""
        own = whole if _since_the_start(library[effect][0], effect) else part
        return _looked(*own, effect, library[effect], seed)

    looked = rounds.side_by_side(
        f"beside {there.name}",
        look,
        others,
        lambda done, name: on_progress(0.7 * done, f"{there.name} and {name}".replace("_", " ")),
    )
    rough = sorted((r for some in looked for r in some if r[0] > least), key=lambda r: -r[0])
    best: dict[tuple[str, ...], tuple[Hypothesis, list[Floats]]] = {}
    for _, both, starts in rough:
        best.setdefault(both.effects, (both, starts))

    def join(at: tuple[Hypothesis, list[Floats]]) -> Evidence:
        both, starts = at
        if excerpt is not None:  # in the vehicle of the whole drives as well
            own = first.fit.x.size
            starts = [*starts, *(np.concatenate([first.fit.x, x[own:]]) for x in starts)]
        joint = problem.having(both)
        x, _ = refit(joint, starts, known, ROUGH)
        return evidence(joint, fitted(joint, [x], ROUGH), search.blocks)

    return rounds.side_by_side(
        f"joined to {there.name}",
        join,
        list(best.values())[:_TRIED],
        lambda done, at: on_progress(0.7 + 0.3 * done, f"{at[0].name}, jointly".replace("_", " ")),
    )


def _tempered(problem: Problem, start: LinearisedFit, share: float) -> tuple[Problem, LinearisedFit, float]:
    """A problem and a fit with a ``share`` of the weight of every residual's square, and the cost that a linear step
    leaves of the fit."""
    known, root = problem.likelihood.weight, math.sqrt(share)
    weight = np.ones(start.at.residual.size) if known is None else known
    light = problem.weighed(problem.likelihood.noise, weight=root * weight)
    at = Linearised(start.x, root * start.at.residual, root * start.at.jacobian)
    own = light.having(start.hypothesis)
    cost = start.cost - (1.0 - share) * float(start.at.residual @ start.at.residual)
    moved = _linear_step(own, at.model, start.x)
    alone = min(cost, float(own.costs(moved[:, None])[0]))
    return light, LinearisedFit(start.hypothesis, start.x, cost, at), alone


def _looked(
    problem: Problem,
    start: LinearisedFit,
    alone: float,
    effect: str,
    variants: Sequence[Hypothesis],
    seed: int,
) -> list[tuple[float, Hypothesis, list[Floats]]]:
    """A first look at the sets of ``start`` with a variant of one more effect: gain in nats over the cost ``alone``,
    hypothesis and starts of each."""
    there = start.hypothesis
    tried = [(combined(there, v), v.starts(_STARTS // 2, seed)) for v in variants]
    screens = [(both, screen(problem.having(both), start, starts)) for both, starts in tried]
    more = [
        [
            _from_nothing(problem.having(both), start, v),
            *_resonant(problem, start, both, v),
            *tone_starts(problem, start, both, effect, own),
        ]
        for (both, _), v, own in zip(tried, variants, _peaks(problem, start, effect, variants), strict=True)
    ]
    # these starts are ranked by their simulated cost
    costs = [
        problem.having(both).costs(np.stack(found, axis=1)).tolist()
        for (both, _), found in zip(tried, more, strict=True)
    ]
    return [
        (0.5 * (alone - min([s.cost[0], *cost])), both, [*s.x[:_TRIED], *found])
        for (both, s), cost, found in zip(screens, costs, more, strict=True)
    ]


def _from_nothing(problem: Problem, start: LinearisedFit, added: Hypothesis) -> Floats:
    """Unknowns one linear step from ``start`` and none of the ``added`` effect: scattered starts miss a size that the
    drives show to a hundredth of its prior, as they do that of a clock offset."""
    x = np.concatenate([start.x, added.neutral()])
    model = start.at.with_effects(*problem.effect_columns(x, known=start.x.size - problem.shared))
    return _linear_step(problem, model, x)


def _linear_step(problem: Problem, model: Quadratic, x: Floats) -> Floats:
    """``x`` and one bounded step of the quadratic ``model``."""
    precision, centre = problem.joint_prior()
    gradient = model.slope + precision @ (x - centre)
    step = bounded_step(model.squares + precision, gradient[:, None], *problem.room(x))[:, 0]
    return np.asarray(problem.clipped((x + step)[:, None])[:, 0])


def joint_fit(
    problem: Problem, parts: Sequence[Hypothesis], base: Fit, seed: int, turn: Turn
) -> LinearisedFit:
    """Joint fit of all ``parts``: from neutral, and from the best of many starts, those of a coarse search included."""
    p = problem.shared
    together = combined(*parts)
    far = coarse_search.joint_grid(together, turn)
    many = np.concatenate([together.neutral()[:, None], together.starts(_JOINT_STARTS, seed), far], axis=1)
    starts = np.concatenate([np.repeat(base.x[:p, None], many.shape[1], axis=1), many])
    # with a large set-up error the baseline vehicle is wrong: start from the twin file
    starts[:p, many.shape[1] - far.shape[1] :] = problem.prior.centre[:, None]
    order = np.argsort(
        problem.having(together).costs(starts) - coarse_search.waived_penalty(together, many), kind="stable"
    )
    tried = [
        (coarse_search.recentred(together, many[:, i]), starts[:, i])
        for i in sorted({0, *order[:_TRIED].tolist()})
    ]
    fits = side_by_side(lambda at: refit(problem.having(at[0]), [at[1]], None, LONG), tried)
    found = [(h, *fit) for (h, _), fit in zip(tried, fits, strict=True)]
    best, x, _ = min(found, key=lambda f: f[2] + coarse_search.MISALIGNMENT_PENALTY * bool(f[0].around))
    return linearised_fit(problem.having(best), x)


def without_one(problem: Problem, whole: Evidence, blocks: Blocks) -> list[Evidence]:
    """Evidence without each effect of ``whole`` in turn, in the order of its effects."""
    there, p = whole.fit.hypothesis, problem.shared

    def fewer(effect: str) -> Evidence:
        kept = [i for i, key in enumerate(there.keys) if key.split(".")[1] != effect]
        start = np.concatenate([whole.fit.x[:p], whole.fit.x[p:][kept]])
        rest = there.without(effect)
        less = problem.having(rest)
        return evidence(less, fitted(less, [start], LONG), blocks)

    return side_by_side(fewer, there.effects)
