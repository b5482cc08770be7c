# SPDX-License-Identifier: Apache-2.0
"""The verdict: probabilities of the gates, of effects, no gap and unknown, and the decision (``verdict_of``)."""

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
#: Residual of a calibrated seven-degree-of-freedom model as a share of the rms of the motion, nuisance parameters as
#: fitted: median and factor of one standard deviation for model discrepancy alone (0.09 to 0.17 on cars of four makes
#: without any fault), and where an effect is missing.
_DISCREPANCY, _DISCREPANCY_SPREAD = 0.14, 1.4
_MISSING_EFFECT, _MISSING_EFFECT_SPREAD = 0.3, 1.8
#: Mean shrink beyond recalibration by the best effect of a library without the true one (ten cases).
_SUBSTITUTE_SHARE = 0.23
#: Residual as a share of the motion below which its spectrum is not tested, and below which a gap is not material.
LITTLE, SLIGHT = 0.1, 0.06
#: Held-out mean square in units of the noise model from the reference, with a probability of 0.5 that the model is
#: adequate: on drives with the gap and on the reference; factor of one standard deviation; usual value. Adequate models
#: have 1.2 to 2.3 and 1.0 to 1.7.
_ADEQUATE_WITH_GAP, _ADEQUATE_REFERENCE, _ADEQUATE_SPREAD, _USUAL_LEVEL = 2.3, 2.0, 1.2, 1.5
#: Ratio of the residual share in half an octave to that of its neighbours with a probability of 0.5 that the model is
#: adequate: the share of model discrepancy is smooth over frequency, within a factor of two.
_STANDS_OUT, _STANDS_OUT_SPREAD = 2.8, 1.15
#: Prominence of a tonal component with a probability of 0.5 that it is model discrepancy, which has up to 10.
_TONE, _TONE_SPREAD = 16.0, 1.2
#: Rms of the clock offsets of the drives in standard deviations of their prior (bound: 3) with a probability of 0.5
#: that they compensate for an effect.
_CLOCKS_AT_LIMIT, _CLOCKS_AT_LIMIT_SPREAD = 2.92, 0.04
#: Prior tail probability of the clock and map offsets at which compensation and chance are equally probable.
_CHANCE = 0.01
_HALF_OCTAVES = 1.0 * 2.0 ** (0.5 * np.arange(9))  # Hz
_LEAST_TEMPER = 0.03
#: Ratio of the evidence gain of the best effect to that of the next from which on it is dominant, and the smallest
#: library for that. Wrong leads, resonances apart, had ratios below 3 (one of 4), right ones up to 30.
_DOMINANT_RATIO, _LEAST_LIBRARY = 3.0, 10
#: Odds against no gap and unknown together from which on a cause is named without a reference: of seven causes between
#: even odds and these, five were wrong.
_NAMED_FROM = 1.5
#: Change of clock and position errors over a drive, from +2 to -2 standard deviations: a slow drift of the GNSS
#: position resembles a clock drift.
_BETWEEN_ENDS = 4.0
_WANDERS = (".clock_offset", ".map_position")
#: Factor of one standard deviation of the usual error of a twin file.
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
    """Rms of the residual above the noise as a share of that of the motion, over the ``driven`` channels, on drives
    ``with_gap`` or on the others; ``with_nuisances`` as fitted or at zero."""
    rows, rest_of = (
        gap_rows(bench) == with_gap,
        remaining.with_nuisances if with_nuisances else remaining.difference,
    )
    measured = bench.problem.measured
    columns = [(c, noise[name] ** 2) for c, name in enumerate(measured.channels) if name in driven]
    floors = np.array([floor for _, floor in columns])
    excess = np.array([max(float(np.var(rest_of[rows, c])) - floor, 0.0) for c, floor in columns])
    motion = np.array([max(float(np.var(measured.values[rows, c])) - floor, 1e-12) for c, floor in columns])
    # channels are weighted by their signal to noise ratio
    weight = motion / floors
    return float(np.sqrt(np.sum(weight * (excess / motion)) / weight.sum()))


def adequate_without_reference(level: float, noise_share: float, taken: float | None = None) -> float:
    """Probability that a residual ``level`` (share of the motion) is model discrepancy, without a reference.

    By the distributions of the level with and without a missing effect, and by ``taken``, the largest shrink of a
    channel by the cause: a substitute for the true effect has a small one.
    """
    level = max(level, 1e-3)
    if level < noise_share:
        return 1.0
    likely = 1.0
    if taken is not None:  # the prior of the true effect is uniform
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
    """Probability that the spectrum of the residual of the vertical acceleration is that of model discrepancy.

    A missing resonance or order exceeds the neighbouring bands as a share of the motion.
    """
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
        # limited from below by the noise
        shares.append(max(float(rest[own].mean()) - white, white) / float(motion[own].mean()))
    level = 0.5 * np.log(shares)
    others = [np.delete(level[max(b - 2, 0) : b + 3], min(b, 2)) for b in range(level.size)]
    most = max(float(level[b] - np.median(o)) for b, o in enumerate(others))
    return float(norm.sf((most - np.log(_STANDS_OUT)) / np.log(_STANDS_OUT_SPREAD)))


def free_of_tones(bench: Bench, remaining: RemainingResidual) -> tuple[float, Tone | None]:
    """Probability that the residual has no tonal component, and the most prominent one of at least a tenth of the
    gap."""
    tone = strongest_tone(bench, remaining, MATERIAL)
    if tone is None:
        return 1.0, None
    return float(norm.sf(np.log(tone.strength / _TONE) / np.log(_TONE_SPREAD))), tone


def clocks_within_limits(bench: Bench, found: Evidence, temper: float) -> float:
    """Probability that the clock offsets of the drives do not compensate for an effect.

    One clock may be at its bound by chance, all of them are where timing is wrong. The tail probability of the tempered
    nuisance penalty is the probability of chance.
    """
    own = [i for i, n in enumerate(bench.problem.nuisances.names) if n.endswith(".clock_offset")]
    if not own:
        return 1.0
    off = found.fit.x[bench.d + np.array(own)] / bench.problem.nuisances.spread[own]
    late = float(norm.cdf((float(np.sqrt(np.mean(off**2))) - _CLOCKS_AT_LIMIT) / _CLOCKS_AT_LIMIT_SPREAD))
    placed = sum(n.endswith(("clock_offset", "map_position")) for n in bench.problem.nuisances.names)
    chance = 0.0 if found.penalty is None else float(chi2.sf(2.0 * found.penalty.at(temper)[0], placed))
    return 1.0 - late * _CHANCE / (_CHANCE + chance)


def adequate_with_reference(found: Evidence, channels: Sequence[int]) -> float:
    """Probability that no further effect is missing, with a reference: the held-out residual is within the noise
    model of the reference, on drives with the gap and on the reference itself."""
    with_gap = max(found.level[c, True] for c in channels)
    return float(
        norm.sf(np.log(with_gap / _ADEQUATE_WITH_GAP) / np.log(_ADEQUATE_SPREAD))
        * reference_unaffected(found, channels)
    )


def temper_of(bench: Bench, best: RemainingResidual, noise: dict[str, float]) -> float:
    """Share of the mean square residual of the best hypothesis that is sensor noise."""
    rows = gap_rows(bench)
    c = 0
    remaining = float(np.mean(best.difference[rows, c] ** 2))
    return float(np.clip(noise[bench.problem.channels[c]] ** 2 / max(remaining, 1e-12), _LEAST_TEMPER, 1.0))


def plausible(bench: Bench, found: Evidence) -> float:
    """Probability that the parameters are within their prior, off their bounds, and of the same sign in all folds.
    Set-up errors (clock, map, mount) may have any size within their range."""
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
    """Probability that each effect is larger than the usual error of a twin file. ``changed``: a reference of the same
    vehicle exists; then only effects of time are tested, which differ from drive to drive."""
    hypothesis = found.fit.hypothesis
    values = hypothesis.values(found.fit.x[bench.d + bench.q :, None])[:, 0]
    given, likely = dict(zip(hypothesis.keys, values, strict=True)), 1.0
    for effect in (hypothesis.effect(e) for e in hypothesis.effects):
        share = effect.usual_share
        model_weights = share * bench.problem.twin.vehicle.mass if share else 0.0
        usual = {name: effect.parameter(name).usual or model_weights for name in effect.severity}
        if effect.id == "clock_drift":
            usual = {name: max(least, _apparent_drift(bench)) for name, least in usual.items()}
        if (changed and effect.where != "time") or not all(usual.values()):
            continue
        most = max(abs(given[f"effects.{effect.id}.{name}"]) / usual[name] for name in effect.severity)
        likely *= float(norm.cdf(np.log(max(most, 1e-12)) / np.log(_USUAL_SHARE_SPREAD)))
    return likely


def _apparent_drift(bench: Bench) -> float:
    """Apparent clock drift in ppm by clock and position errors of opposite sign at both ends of the longest drive
    with the gap, within their priors; 0 where neither is fitted."""
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
    """(E,) dominance, 0 to 1, of the evidence gain (nats) of each effect over that of all others, decoys included:

        max(0, 1 - _DOMINANT_RATIO * next / gain).

    Where the true effect is not in the library, several others gain about the same.
    """
    if gains.size < _LEAST_LIBRARY:
        return np.zeros(gains.size)
    gained = np.maximum(np.concatenate([gains, decoy_gains]), 1e-9)
    second, best = np.sort(gained)[-2:]
    others = np.where(gained >= best, second, best)
    return np.asarray(np.clip(1.0 - _DOMINANT_RATIO * others / gained, 0.0, 1.0))[: gains.size]


def retained_share(gate: Gates, explained_share: float, dominance: float = 0.0) -> float:
    """Share of the weight of a hypothesis that it retains: a + (1 - a) max(e^2, dominance), with the probability a
    that it is adequate and the explained share e of the recalibrated gap. Unknown has the other part."""
    kept = max(float(np.clip(explained_share, 0.0, 1.0)) ** 2, dominance)
    return gate.adequate + (1.0 - gate.adequate) * kept


def explained_share(found: Evidence, base: Evidence, channels: Sequence[int]) -> float:
    """Share of the excess of the residual over the noise model of the reference that ``found`` explains, of the mean
    square, over all ``channels`` and all drives: a missing effect degrades the fit on the reference as well."""

    def beyond(one: Evidence) -> float:
        return sum(max(v - _USUAL_LEVEL, 0.0) for (c, _), v in one.level.items() if c in channels)

    before = beyond(base)
    return float(np.clip(1.0 - beyond(found) / before, 0.0, 1.0)) if before > 0.0 else 0.0


def explained_level_share(level: float, before: float) -> float:
    """The same without a reference: ``before`` and ``level`` are residuals as shares of the rms of the motion, the
    excess is that over the usual model discrepancy."""
    beyond = max(before**2 - _DISCREPANCY**2, 0.0)
    return (
        float(np.clip(1.0 - max(level**2 - _DISCREPANCY**2, 0.0) / beyond, 0.0, 1.0)) if beyond > 0.0 else 0.0
    )


def reference_unaffected(found: Evidence, channels: Sequence[int]) -> float:
    """Probability that the residual on reference drives is within their noise model: else the drives with the gap,
    fitted jointly, need another vehicle. 1 without a reference."""
    there = max(found.level.get((c, False), 0.0) for c in channels)
    return float(norm.sf(np.log(max(there, 1e-12) / _ADEQUATE_REFERENCE) / np.log(_ADEQUATE_SPREAD)))


def masses(
    weights: Floats, gates: Sequence[Gates], explained_share: Floats, undetectable: Floats, dominance: Floats
) -> tuple[Floats, float, float]:
    """Probabilities of the effects (E,), of no gap and of unknown, from weights (1 + E,), baseline first.

    The weight of an effect that is not material or not plausible goes to the answers without a cause. That of an effect
    that is not adequate is shared with unknown by ``retained_share``, from its ``explained_share`` (E,) and
    ``dominance`` (E,). ``undetectable`` (E,) are the prior odds, to no effect, of each effect at a size that the
    drives do not show.
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
    """The decision: effect or partly where a cause has more probability than no gap and unknown together (1.5 times as
    much without a reference); else the more probable of no_gap and unknown. Indistinguishable effects (``groups``)
    count together. ``remaining`` is the share of the gap that the named twin does not explain."""
    named = max((float(sum(effects[i] for i in g)) for g in groups), default=0.0)
    if named <= (1.0 if referenced else _NAMED_FROM) * (no_gap + unknown):
        return "no_gap" if no_gap >= unknown else "unknown"
    return "effect" if adequate >= 0.3 or remaining < MATERIAL else "partly"
