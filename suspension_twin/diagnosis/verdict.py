# SPDX-License-Identifier: Apache-2.0
"""From evidence to an answer: the three gates, the masses on no gap and unknown, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.bench import Bench
from suspension_twin.diagnosis.evidence import Evidence
from suspension_twin.diagnosis.hypotheses import SETUP_CATEGORIES
from suspension_twin.diagnosis.shrink import RemainingResidual, gap_rows
from suspension_twin.diagnosis.tonal import Tone, strongest_tone
from suspension_twin.identification.noise import density

__all__ = [
    "Gates",
    "adequate_with_reference",
    "adequate_without_reference",
    "beyond_usual",
    "clocks_within_limits",
    "dominance_of",
    "explained_level_share",
    "explained_share",
    "free_of_tones",
    "masses",
    "plausible",
    "reference_unaffected",
    "relative_residual",
    "retained_share",
    "smooth_spectrum",
    "temper_of",
    "verdict_of",
]

#: Share of the gap's rms that a cause has to explain.
MATERIAL = 0.1
#: What a calibrated model of seven degrees leaves of a car's motion that it knows, clocks and map where they were
#: fitted, as a share of its rms: median and factor of one standard deviation (cars of four makes that lack nothing
#: have 0.09 to 0.17); and what is left where something is missing.
_DISCREPANCY, _DISCREPANCY_SPREAD = 0.14, 1.4
_MISSING_EFFECT, _MISSING_EFFECT_SPREAD = 0.3, 1.8
#: Mean share of a channel's recalibrated gap that the best of a library takes which lacks the right effect: 0.23 in ten
#: such cases, where those that are right take anything.
_SUBSTITUTE_SHARE = 0.23
#: Shares of the motion below which what is left is too little for its spectrum to tell anything, and below which a
#: channel's gap is not worth a word.
LITTLE, SLIGHT = 0.1, 0.06
#: Held-out squares, in units of the noise that the reference taught, at which a sound model is as likely as
#: not: on the drives with the gap, which are others than it learnt from, and on the reference itself. A
#: sound model's drives lie at 1.2 to 2.3 and at 1.0 to 1.7, about the last of these.
_ADEQUATE_WITH_GAP, _ADEQUATE_REFERENCE, _ADEQUATE_SPREAD, _USUAL_LEVEL = 2.3, 2.0, 1.2, 1.5
#: How far the share that is left in half an octave stands out of its neighbours', at which a sound model is as
#: likely as not: such a share goes smoothly with frequency, to within a factor of two on cars that lack nothing.
_STANDS_OUT, _STANDS_OUT_SPREAD = 2.8, 1.15
#: How often what its neighbourhood holds a line has to hold that a sound model is as likely as not: what is left of
#: cars that lack nothing has up to ten times.
_TONE, _TONE_SPREAD = 16.0, 1.2
#: Rms of the drives' own clock errors, in spreads of what is normal and of which none goes beyond three, at which a
#: sound model is as likely as not.
_CLOCKS_AT_LIMIT, _CLOCKS_AT_LIMIT_SPREAD = 2.92, 0.04
#: Probability of clocks and maps that are off by so much, at which it is as likely as not that they make up for more.
_CHANCE = 0.01
_HALF_OCTAVES = 1.0 * 2.0 ** (0.5 * np.arange(9))  # Hz
_LEAST_TEMPER = 0.03
#: How many times what the next effect gains one has to gain before it stands for itself, with a library of so many at
#: least. Of leads that were wrong, resonances apart, one gained four times what the next did, all others less than
#: three times; those that were right and left much had up to thirty times.
_DOMINANT_RATIO, _LEAST_LIBRARY = 3.0, 10
#: Odds against no gap and unknown together from which on a cause is named where no reference says what a sound model
#: leaves: a wrong name sends somebody to a sound part. Of seven such between even odds and these five are wrong.
_NAMED_FROM = 1.5
#: Spreads of a drive's clock and place that lie between its two ends where they are two off at one and two the other
#: way at the other: a receiver that wanders by centimetres while a slow drive lasts looks like a clock that drifts.
_BETWEEN_ENDS = 4.0
_WANDERS = (".clock_offset", ".map_position")
#: Factor of one standard deviation about what is usual of a twin file that is off.
_USUAL_SHARE_SPREAD = 1.3


@dataclass(frozen=True)
class Gates:
    """Probabilities that a hypothesis passes each gate: ``material``, ``adequate``, ``plausible``."""

    material: float
    adequate: float
    plausible: float


def relative_residual(
    bench: Bench,
    remaining: RemainingResidual,
    noise: dict[str, float],
    driven: Sequence[str],
    with_gap: bool,
    with_nuisances: bool = False,
) -> float:
    """What is left above the noise as a share of the motion's rms, over the ``driven`` channels; ``settled``
    with the nuisances where they were fitted."""
    rows, rest_of = (
        gap_rows(bench) == with_gap,
        remaining.with_nuisances if with_nuisances else remaining.difference,
    )
    measured = bench.problem.measured
    shares, counts, floors = [], [], []
    for c, name in enumerate(measured.channels):
        if name in driven:
            motion = float(np.var(measured.values[rows, c]))
            rest = max(float(np.var(rest_of[rows, c])) - noise[name] ** 2, 0.0)
            shares.append(rest)
            counts.append(max(motion - noise[name] ** 2, 1e-12))
            floors.append(noise[name] ** 2)
    # the loudest channel in units of its own noise counts most
    weight = np.array(counts) / np.array(floors)
    ratio = np.array(shares) / np.array(counts)
    return float(np.sqrt(np.sum(weight * ratio) / weight.sum()))


def adequate_without_reference(level: float, noise_share: float, taken: float | None = None) -> float:
    """Probability that a remaining level is what a sound model leaves, not something missing, where no
    reference says what this one leaves: by what such models leave, and by the share that a cause has ``taken`` of the
    most that it takes of a channel: one that stands in for another takes little."""
    level = max(level, 1e-3)
    if level < noise_share:
        return 1.0
    likely = 1.0
    if taken is not None:  # anything from none to all is as likely of a right one
        most = 1.0 / _SUBSTITUTE_SHARE - 1.0
        likely = 1.0 / (most * (1.0 - float(np.clip(taken, 0.0, 0.95))) ** (most - 1.0))
    usual = (
        likely
        * norm.pdf(max(np.log(level / _DISCREPANCY), 0.0) / np.log(_DISCREPANCY_SPREAD))
        / np.log(_DISCREPANCY_SPREAD)
    )
    amiss = norm.pdf(min(np.log(level / _MISSING_EFFECT), 0.0) / np.log(_MISSING_EFFECT_SPREAD)) / np.log(
        _MISSING_EFFECT_SPREAD
    )
    return float(usual / (usual + amiss))


def smooth_spectrum(bench: Bench, remaining: RemainingResidual, noise: dict[str, float]) -> float:
    """Probability that what is left of the vertical acceleration is a sound model's by its spectrum: an order, a
    resonance that the model lacks stands out of its neighbourhood as a share of the motion there."""
    measured = bench.problem.measured
    if "vertical_acceleration" not in measured.channels:
        return 1.0
    c = measured.channels.index("vertical_acceleration")
    segments = [s for s, d in zip(measured.segments, measured.drives, strict=True) if bench.active[d]]
    rest, motion = (
        density(v[:, c], segments, measured.rate) for v in (remaining.difference, measured.values)
    )
    f = np.linspace(0.0, 0.5 * measured.rate, rest.size)
    band = np.digitize(f, _HALF_OCTAVES)
    white = 2.0 * noise["vertical_acceleration"] ** 2 / measured.rate / measured.independent
    shares = []
    for b in range(1, _HALF_OCTAVES.size):
        own = band == b
        # what little is above the noise says nothing of a shape
        shares.append(max(float(rest[own].mean()) - white, white) / float(motion[own].mean()))
    level = 0.5 * np.log(shares)
    others = [np.delete(level[max(b - 2, 0) : b + 3], min(b, 2)) for b in range(level.size)]
    most = max(float(level[b] - np.median(o)) for b, o in enumerate(others))
    return float(norm.sf((most - np.log(_STANDS_OUT)) / np.log(_STANDS_OUT_SPREAD)))


def free_of_tones(bench: Bench, remaining: RemainingResidual) -> tuple[float, Tone | None]:
    """Probability that nothing periodic of its own is in what is left, and the line that stands out most of those
    that hold a tenth of a channel's gap."""
    tone = strongest_tone(bench, remaining, MATERIAL)
    if tone is None:
        return 1.0, None
    return float(norm.sf(np.log(tone.strength / _TONE) / np.log(_TONE_SPREAD))), tone


def clocks_within_limits(bench: Bench, found: Evidence, temper: float) -> float:
    """Probability that the drives' clocks, each of which may be off by a little, are not asked to make up for
    something: a single one goes to its limit on a sound car, all of them do where the time is wrong. Where residuals
    that count by ``temper`` hardly ask for it, it is chance: as probable as clocks and maps are together."""
    own = [i for i, n in enumerate(bench.problem.nuisances.names) if n.endswith(".clock_offset")]
    if not own:
        return 1.0
    off = found.fit.x[bench.d + np.array(own)] / bench.problem.nuisances.spread[own]
    late = float(norm.cdf((float(np.sqrt(np.mean(off**2))) - _CLOCKS_AT_LIMIT) / _CLOCKS_AT_LIMIT_SPREAD))
    placed = sum(n.endswith(("clock_offset", "map_position")) for n in bench.problem.nuisances.names)
    chance = 0.0 if found.penalty is None else float(chi2.sf(2.0 * found.penalty.at(temper)[0], placed))
    return 1.0 - late * _CHANCE / (_CHANCE + chance)


def adequate_with_reference(found: Evidence, channels: Sequence[int]) -> float:
    """Probability that nothing is missing beside what ``found`` has, by what the reference taught of the
    noise: everywhere as quiet as there, and there as quiet as before the effect was asked of the vehicle."""
    with_gap = max(found.level[c, True] for c in channels)
    return float(
        norm.sf(np.log(with_gap / _ADEQUATE_WITH_GAP) / np.log(_ADEQUATE_SPREAD))
        * reference_unaffected(found, channels)
    )


def temper_of(bench: Bench, best: RemainingResidual, noise: dict[str, float]) -> float:
    """Share of what the best hypothesis leaves that is the sensor's noise."""
    rows = gap_rows(bench)
    c = 0
    remaining = float(np.mean(best.difference[rows, c] ** 2))
    return float(np.clip(noise[bench.problem.channels[c]] ** 2 / max(remaining, 1e-12), _LEAST_TEMPER, 1.0))


def plausible(bench: Bench, found: Evidence) -> float:
    """Within its prior, and the same whichever stretch of road is left out. What a clock, a map or a mount is off
    by has no limit but that of its range: any of it can be set wrong."""
    hypothesis = found.fit.hypothesis
    p = bench.d + bench.q
    u = found.fit.x[p:]
    if not u.size:
        return 1.0
    low, high = hypothesis.bounds()
    worst = 1.0
    for i, (key, parameter) in enumerate(hypothesis.searched):
        far = 0.0 if hypothesis.effect(key.split(".")[1]).where in SETUP_CATEGORIES else abs(u[i])
        worst *= float(np.clip(np.exp(-0.5 * max(far - 4.0, 0.0) ** 2 / 16.0), 0.02, 1.0))
        two_sided = not parameter.log and parameter.neutral not in (parameter.low, parameter.high)
        if two_sided and not low[i] + 1e-9 < u[i] < high[i] - 1e-9:
            worst *= 0.3
    held = found.unknowns[p:]
    main = int(np.argmax(np.abs(u)))
    if np.mean(np.sign(held[main]) == np.sign(u[main])) < 0.8:
        worst *= 0.3
    return worst


def beyond_usual(bench: Bench, found: Evidence, changed: bool = False) -> float:
    """Probability that each effect is more than what any vehicle differs from its twin file by. ``changed`` where a
    reference shows the same vehicle: then this goes for what is another on every drive, its clock, alone."""
    hypothesis = found.fit.hypothesis
    values = hypothesis.values(found.fit.x[bench.d + bench.q :, None])[:, 0]
    given, likely = dict(zip(hypothesis.keys, values, strict=True)), 1.0
    for effect in (hypothesis.effect(e) for e in hypothesis.effects):
        model_weights = effect.usual_share * bench.problem.twin.vehicle.mass
        usual = {name: effect.parameter(name).usual or model_weights for name in effect.severity}
        if effect.id == "clock_drift":
            usual = {name: max(least, _apparent_drift(bench)) for name, least in usual.items()}
        if (changed and effect.where != "time") or not all(usual.values()):
            continue
        most = max(abs(given[f"effects.{effect.id}.{name}"]) / usual[name] for name in effect.severity)
        likely *= float(norm.cdf(np.log(max(most, 1e-12)) / np.log(_USUAL_SHARE_SPREAD)))
    return likely


def _apparent_drift(bench: Bench) -> float:
    """ppm by which a clock seems to drift that is early at one end of the longest drive with the gap and late at the
    other within what is normal of clocks and, at that drive's speed, of places; 0 where neither is fitted."""
    problem = bench.problem
    normal = list(zip(problem.nuisances.names, problem.nuisances.spread, strict=True))
    clock, place = (max((float(v) for n, v in normal if n.endswith(e)), default=0.0) for e in _WANDERS)
    seconds, speed = 1.0, 1.0
    for drive in {d for d in problem.drive_of if bench.active[d]}:
        own = [part for part, d in zip(problem.parts, problem.drive_of, strict=True) if d == drive]
        lasts = float(max(part.t[-1] for part in own) - min(part.t[0] for part in own))
        if lasts > seconds:
            seconds, speed = lasts, max(sum(float(np.ptp(part.position)) for part in own) / lasts, 1.0)
    return 1e6 * _BETWEEN_ENDS * float(np.hypot(clock, place / speed)) / seconds


def dominance_of(gains: Floats, decoy_gains: Floats) -> Floats:
    """(E,) from 0 to 1, how far what an effect gains (nats over recalibration alone) stands above what any other does,
    a witness (``strange``) included. Where the right effect is missing, several make up for it about alike; one that
    gains many times as much as the next is there, even if it leaves much."""
    if gains.size < _LEAST_LIBRARY:
        return np.zeros(gains.size)
    gained = np.maximum(np.concatenate([gains, decoy_gains]), 1e-9)
    second, best = np.sort(gained)[-2:]
    others = np.where(gained >= best, second, best)
    return np.asarray(np.clip(1.0 - _DOMINANT_RATIO * others / gained, 0.0, 1.0))[: gains.size]


def retained_share(gate: Gates, explained_share: float, dominance: float = 0.0) -> float:
    """Part of a hypothesis' weight that stays with it: what is not adequate is shared with unknown by the square of the
    share ``gone`` of the recalibrated gap that it takes away, or by how far it stands ``alone``."""
    kept = max(float(np.clip(explained_share, 0.0, 1.0)) ** 2, dominance)
    return gate.adequate + (1.0 - gate.adequate) * kept


def explained_share(found: Evidence, base: Evidence, channels: Sequence[int]) -> float:
    """Share of what the baseline leaves beyond what the reference taught that is gone, of the mean square in units of
    that, all ``channels`` and the drives from before together: one vehicle has to suit both, and where an effect is
    missing it suits neither."""

    def beyond(one: Evidence) -> float:
        return sum(max(v - _USUAL_LEVEL, 0.0) for (c, _), v in one.level.items() if c in channels)

    before = beyond(base)
    return float(np.clip(1.0 - beyond(found) / before, 0.0, 1.0)) if before > 0.0 else 0.0


def explained_level_share(level: float, before: float) -> float:
    """Share of what is left ``before`` beyond the usual, of the mean square, that is gone with a ``level``: shares of
    the motion's rms, where no reference says what a sound model leaves."""
    beyond = max(before**2 - _DISCREPANCY**2, 0.0)
    return (
        float(np.clip(1.0 - max(level**2 - _DISCREPANCY**2, 0.0) / beyond, 0.0, 1.0)) if beyond > 0.0 else 0.0
    )


def reference_unaffected(found: Evidence, channels: Sequence[int]) -> float:
    """Probability that drives from before are as quiet as they were before the effect was asked of the vehicle: else
    the drives after the change have another vehicle still, and both pull at one. 1 without such drives."""
    there = max(found.level.get((c, False), 0.0) for c in channels)
    return float(norm.sf(np.log(max(there, 1e-12) / _ADEQUATE_REFERENCE) / np.log(_ADEQUATE_SPREAD)))


def masses(
    weights: Floats, gates: Sequence[Gates], explained_share: Floats, undetectable: Floats, dominance: Floats
) -> tuple[Floats, float, float]:
    """Probabilities of the effects (E,), of no gap and of unknown, from weights (1 + E,), baseline first.

    An effect that is not material is no finding: its weight goes to the answers without one. What an
    effect that is not adequate leaves is unexplained: its weight is shared with unknown by how much of the gap is
    ``gone`` (E,) with it and how far it stands ``alone`` (E,).
    ``unseen`` (E,) are the prior odds, to no effect at all, of each at a strength that would not have shown: no
    evidence is none against these.
    """
    effects = np.zeros(len(gates) - 1)
    rest, unknown = float(weights[0]), 0.0
    for i, gate in enumerate(gates[1:]):
        w = float(weights[i + 1])
        named = w * gate.material * gate.plausible
        rest += w - named
        good = retained_share(gate, float(explained_share[i]), float(dominance[i]))
        effects[i] = named * good
        unknown += named * (1.0 - good)
    faint = rest * undetectable / (1.0 + float(undetectable.sum()))
    effects += faint
    rest -= float(faint.sum())
    no_gap = rest * gates[0].adequate
    return effects, no_gap, unknown + rest - no_gap


def verdict_of(
    effects: Floats,
    no_gap: float,
    unknown: float,
    adequate: float,
    remaining: float,
    groups: Sequence[Sequence[int]],
    referenced: bool,
) -> str:
    """effect or partly where a cause is likelier than that it is none of the library, without a reference half as
    likely again; else no_gap or unknown, whichever carries more; effects that cannot be told apart (``groups``) carry
    theirs together."""
    named = max((float(sum(effects[i] for i in g)) for g in groups), default=0.0)
    if named <= (1.0 if referenced else _NAMED_FROM) * (no_gap + unknown):
        return "no_gap" if no_gap >= unknown else "unknown"
    return "effect" if adequate >= 0.3 or remaining < MATERIAL else "partly"
