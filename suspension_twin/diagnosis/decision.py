# SPDX-License-Identifier: Apache-2.0
"""The learnt decision: a conditional logit over the causes, sets of causes, no gap and unknown.

Every answer a has a utility u_a = w . phi_a and the probability exp(u_a) / sum_b exp(u_b) (McFadden 1974). The
features phi are computed from the rows of ``evidence.json``; physics dictates the sign of each weight. The weights w
are in ``decision.json``, made by ``benchmarks/train_decision.py`` from cases of simulators that share no code with the
package.

The decision is made cause by cause. What counts is the presence q of a cause: its probability over all sets that hold
it. With the costs ``wrong`` of a name that is not true and ``unknown`` of a cause that is kept back, a cause is sure
where (1 - q) wrong <= q unknown. A cause that is not sure, but more probable than any other answer, is suspected.

Beside it stands the conformal set of answers that holds the truth in 90 % of cases (Sadinle, Lei, Wasserman 2019):
every answer of at least the probability that 90 % of true answers have in realities that were left out of the
learning.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import Json

__all__ = [
    "FEATURES",
    "FORMAT",
    "USES",
    "Answer",
    "Costs",
    "Decision",
    "Json",
    "Weights",
    "answers_of",
    "decide",
    "learnt",
    "prior_means",
    "single",
    "usual",
    "usual_level",
]


#: Version of the rows of ``evidence.json``: others are refused.
FORMAT = 1
#: Features of the answers and their meaning. Features that did not lower the loss on realities left out of the learning
#: were dropped. Their weights, with prior means whose sign physics dictates, are in ``decision.json``.
FEATURES: Mapping[str, str] = {
    # of a cause or a set of causes
    "number": "log of the number of effects in the library, which share the prior",
    "gain": "evidence over recalibration",
    "margin": "evidence over the next best",
    "beside": "evidence over recalibration that remains beside the usual errors of every car",
    "beside_margin": "that evidence over the next best",
    "shrink": "shrink beyond recalibration, in the best driven channel",
    "proven": "lower end of the shrink beyond recalibration, in the best channel",
    "throughout": "lower end of that shrink in the worst driven channel",
    "chance": "share of the gain in the fit that is lost on held-out road",
    "tone": "log of the fall of the strongest tone",
    "explained": "share of the residual beyond the expected discrepancy",
    "complete": "reduction of the residual over the largest by any hypothesis",
    "excess": "log of the remaining residual over that of a complete model, times the unexplained share",
    "above_reference": "log of the remaining residual over that on the reference",
    "lost": "growth of the gap in another channel",
    "usual": "as small as errors of twin files are",
    "far": "distance of its parameters beyond their prior",
    "bound": "whether a parameter is on a bound",
    "size": "effects beyond the first",
    "added": "evidence over the best smaller set",
    "added_proven": "lower end of the shrink that each of its effects adds",
    # of no gap
    "none_excess": "log of the remaining residual over that of a complete model",
    "none_above_reference": "log of the remaining residual over that on the reference",
    "none_gain": "evidence of the best hypothesis that is larger than usual errors of twin files",
    "none_pattern": "tone, band and place beyond those of model discrepancy",
    "none_clocks": "clock offsets near their bounds",
    # of unknown
    "unknown": "a constant",
    "unknown_blind": "no reference",
    "unknown_best_excess": "log of the remaining residual of the best cause over that of a complete model",
    "unknown_above_reference": "log of the least remaining residual of any hypothesis over that on the reference",
    "unknown_open": "evidence of the best set over the best single effect",
}
#: Severity over the usual error of a twin file up to which an effect is as small as such errors are: half a standard
#: deviation beyond one.
_USUAL_RATIO = 1.5


@cache
def _file() -> Json:
    """Content of ``decision.json``, which ``benchmarks/train_decision.py --write`` makes.

    ``discrepancy`` is the residual of cars without any fault: the median of its held-out mean ``square`` in units of
    the noise model of the reference, and of its ``level`` as a share of the motion; the largest prominence of a
    ``tone``, unevenness of a ``band`` and concentration on a ``place``.
    """
    known: Json = json.loads(Path(__file__).with_name("decision.json").read_text(encoding="utf-8"))
    return known


def usual(name: str) -> float:
    """A figure of the model discrepancy of cars without any fault."""
    return float(_file()["discrepancy"][name])


@dataclass(frozen=True)
class Costs:
    """Costs of a verdict, the unit being a cause that is there and not named.

    ``wrong``: a cause is named for sure that is not there. ``missed``: "no gap" is said where there is one.
    ``unknown``: "unknown" is said where nothing is wrong, or a cause is kept back. ``vague``: "unknown" is said, with
    the causes by their probability, where one of the library's is true.
    """

    wrong: float = 4.0
    missed: float = 1.0
    unknown: float = 1.0
    vague: float = 0.5

    @classmethod
    def parsed(cls, text: str) -> Costs:
        """From a use (``workshop``, ``release``) or ``wrong=4,missed=1``; InputError names a cost that is unknown or no
        positive number."""
        if text.strip() in USES:
            return USES[text.strip()]
        known = {f.name for f in fields(cls)}
        given: dict[str, float] = {}
        for item in filter(None, (i.strip() for i in text.split(","))):
            name, _, value = (part.strip() for part in item.partition("="))
            if name not in known:
                uses = " or ".join(USES)
                raise InputError(
                    "costs", name, f"is not one of {', '.join(sorted(known))}, nor a use ({uses})"
                )
            try:
                given[name] = float(value)
            except ValueError:
                raise InputError("costs", name, f"{value!r} is no number") from None
            if not 0.0 <= given[name] < np.inf:
                raise InputError("costs", name, "has to be a number of at least 0")
        return cls(**given)

    @property
    def sure(self) -> float:
        """Least presence of a cause that is named for sure; 1 where naming can only cost."""
        return self.wrong / (self.wrong + self.unknown) if self.unknown else 1.0

    def nothing(self, no_gap: float, unknown: float) -> bool:
        """Whether "no gap" is expected to cost less than "unknown", by the probabilities of both."""
        return self.missed * (1.0 - no_gap) <= self.unknown * no_gap + self.vague * (1.0 - no_gap - unknown)


#: Costs by use. In a workshop a look at the wrong part costs as much as a part not looked at: what is more probable
#: than not is sure. Before a release a wrong name costs most: 19 of 20 have to be true.
USES: Mapping[str, Costs] = {"workshop": Costs(wrong=1.0), "release": Costs(wrong=19.0)}


@dataclass(frozen=True, eq=False)
class Weights:
    """Learnt ``values`` (F,) by feature, the smallest probability of a member of a ``conformal`` set, and the
    ``source`` of both: command, cases, seeds, commit."""

    values: Floats
    conformal: float
    source: Json


def learnt() -> Weights:
    """The weights that ship with the package."""
    known = _file()
    return Weights(_vector(known["weights"]), float(known["conformal_probability"]), known["source"])


def prior_means() -> Floats:
    """(F,) prior means of the weights. Learning keeps their signs, which physics dictates; 0 leaves the sign free.

    Evidence of a few nats has a weight of a few.
    """
    return _vector(_file()["prior_means"])


@dataclass(frozen=True, eq=False)
class Answer:
    """One possible answer: ``causes`` (empty for no gap, ``("unknown",)``), its row and features (F,).

    The answer of a decoy is unknown.
    """

    causes: tuple[str, ...]
    row: Json | None
    features: Floats


@dataclass(frozen=True, eq=False)
class Decision:
    """``probability`` (A,) of each of the ``answers``, ``masses`` of each different one by its causes.

    ``chosen``: the causes that are named, () for no gap and ``("unknown",)``; ``sure`` whether at least one of them is;
    ``row`` the row that holds them. ``effects``: probability of each effect of the library, a set's in equal parts for
    its members: with those of no gap and unknown the sum is 1. ``candidates``: the conformal set, the most probable
    first.
    """

    answers: list[Answer]
    probability: Floats
    masses: dict[tuple[str, ...], float]
    chosen: tuple[str, ...]
    sure: bool
    row: Json | None
    effects: dict[str, float]
    candidates: list[tuple[str, ...]]

    @property
    def no_gap(self) -> float:
        """Probability that there is no gap."""
        return self.masses[()]

    @property
    def unknown(self) -> float:
        """Probability of something that is not in the library."""
        return self.masses[("unknown",)]

    def presence(self, effect: str) -> float:
        """Probability of an effect over all sets that hold it."""
        return float(sum(p for causes, p in self.masses.items() if effect in causes))


def decide(evidence: Json, costs: Costs | None = None, weights: Weights | None = None) -> Decision:
    """The verdict by the presence of each cause and the costs.

    Parameters
    ----------
    evidence : mapping
        Content of ``evidence.json``.
    costs : Costs, optional
        Costs of wrong and missing answers.
    weights : Weights, optional
        Those that ship with the package if not given.

    Raises
    ------
    InputError
        The evidence is of another version.

    Examples
    --------
    >>> import json
    >>> decide(json.load(open("out/evidence.json"))).chosen  # doctest: +SKIP
    ('strut_friction',)
    """
    known, costs = weights or learnt(), costs or Costs()
    answers = answers_of(evidence)
    utility = np.stack([a.features for a in answers]) @ known.values
    probability = np.exp(utility - utility.max())
    if evidence["case"].get("foreign_reference"):  # nothing that was expected of this vehicle holds
        probability = np.array([float(a.causes == ("unknown",) and a.row is None) for a in answers])
    probability /= probability.sum()
    masses: dict[tuple[str, ...], float] = {}
    for answer, p in zip(answers, probability, strict=True):
        masses[answer.causes] = masses.get(answer.causes, 0.0) + float(p)
    effects = {r["effects"][0]: 0.0 for r in evidence["hypotheses"] if single(r)}
    for causes, p in masses.items():
        for effect in causes if causes != ("unknown",) else ():
            effects[effect] = effects.get(effect, 0.0) + p / len(causes)
    ranked = sorted(masses, key=lambda c: -masses[c])
    candidates = [c for c in ranked if masses[c] >= known.conformal] or ranked[:1]
    rows = {a.causes: a.row for a in answers if a.row is not None and not a.row["decoy"] and _shrinks(a.row)}
    chosen, sure = _chosen(masses, rows, costs)
    return Decision(answers, probability, masses, chosen, sure, rows.get(chosen), effects, candidates)


def _chosen(
    masses: Mapping[tuple[str, ...], float], rows: Mapping[tuple[str, ...], Json], costs: Costs
) -> tuple[tuple[str, ...], bool]:
    """The causes that are named, and whether at least one of them is sure.

    Beside a sure or a suspected cause those are named that are more probable than not. A cause or a set without a row
    whose shrink excludes zero is not named.
    """
    no_gap, unknown = masses[()], masses[("unknown",)]
    presence: dict[str, float] = {}
    for causes in rows:
        for effect in causes:
            presence[effect] = sum(p for c, p in masses.items() if effect in c)
    best = max(presence, key=lambda e: presence[e], default=None)
    sure = best is not None and presence[best] >= costs.sure
    if best is not None and (sure or presence[best] > max(no_gap, unknown)):
        named = {e for e, q in presence.items() if q > 0.5} | {best}
        held = [c for c in rows if best in c and set(c) <= named] or [c for c in rows if best in c]
        return max(held, key=lambda c: (len(set(c) & named), masses[c])), sure
    return ((), False) if costs.nothing(no_gap, unknown) else (("unknown",), False)


def single(row: Json) -> bool:
    """Whether a row is that of one effect of the library, no decoy."""
    return len(row["effects"]) == 1 and not row["decoy"]


def _shrinks(row: Json) -> bool:
    """Whether the shrink beyond recalibration has, in some channel, an interval that excludes zero."""
    return any(c["low"] > 0.0 for c in row["channels"].values())


def answers_of(evidence: Json) -> list[Answer]:
    """All possible answers with their features: no gap, unknown, and every hypothesis."""
    if evidence.get("format") != FORMAT:
        raise InputError(
            "evidence.json", f"is of format {evidence.get('format')}, not {FORMAT}: diagnose again"
        )
    case, base, rows = evidence["case"], evidence["base"], _rivals(evidence)
    gains = [_gain(r, base.get("since")) for r in rows]
    beside = [_beside(r, g) for r, g in zip(rows, gains, strict=True)]
    unusual = [g for g, r in zip(gains, rows, strict=True) if _unusual(r)]
    singles = [g for g, r in zip(gains, rows, strict=True) if len(r["effects"]) == 1]
    best = max(rows, key=lambda r: _explained(case, base, r), default=base)
    none = {
        "none_excess": _excess(case, base),
        "none_above_reference": _above_reference(case, base),
        "none_gain": _compressed(max([0.0, *unusual])),
        "none_pattern": _pattern(base),
        "none_clocks": _clocks(base),
    }
    unknown = {
        "unknown": 1.0,
        "unknown_blind": float(not case["reference"]),
        "unknown_best_excess": min(_excess(case, best), _excess(case, base)),
        "unknown_above_reference": min(_above_reference(case, r) for r in (rows or [base])),
        "unknown_open": _compressed(max([0.0, *gains]) - max([0.0, *singles])),
    }
    found = [Answer((), None, _vector(none)), Answer(("unknown",), None, _vector(unknown))]
    # an effect that a request leaves out of the library may be the cause as well: that is "unknown"
    number = max(case.get("library", 0), sum(map(single, rows)), 1)
    most, least = _square(case, base), min(_square(case, r) for r in (base, *rows))
    plain, remaining = list(zip(rows, gains, strict=True)), list(zip(rows, beside, strict=True))
    for row, gain, further in zip(rows, gains, beside, strict=True):
        values = {
            "number": float(np.log(number)),
            "complete": max(most - _square(case, row), 0.0) / (most - least) if most > least else 0.0,
            **_of_cause(case, base, row),
            **_of_rivalry(case, row, gain, plain),
            "beside": _compressed(further),
            "beside_margin": _compressed(further - _of_best_rival(row, remaining)),
        }
        causes = ("unknown",) if row["decoy"] else tuple(sorted(row["effects"]))
        found.append(Answer(causes, row, _vector(values)))
    return found


def _rivals(evidence: Json) -> list[Json]:
    """Rows that are answers of their own.

    A set with an effect that may add nothing, or that is as small as errors of twin files, is none. Without a road the
    few set-up errors occur together: a part of the set that none can be taken out of is no rival.
    """
    rows = [
        r for r in evidence["hypotheses"] if len(r["effects"]) == 1 or (r["added_low"] > 0.0 and _unusual(r))
    ]
    if evidence["case"]["kind"] == "planar":
        joint = [set(r["effects"]) for r in rows if len(r["effects"]) > 1]
        rows = [r for r in rows if not any(set(r["effects"]) < whole for whole in joint)]
    return rows


def _unusual(row: Json) -> bool:
    """Whether an effect is larger than usual errors of twin files."""
    return row["usual"] is None or row["usual"] > _USUAL_RATIO


def _of_cause(case: Json, base: Json, row: Json) -> dict[str, float]:
    """Features of a cause by its own row."""
    explained = _explained(case, base, row)
    driven = [c for name, c in row["channels"].items() if case["channels"][name]["driven"]]
    usual = _USUAL_RATIO if row["usual"] is None else max(row["usual"], 1e-3)
    parameters = [p for values in row["parameters"].values() for p in values.values()]
    return {
        "shrink": float(np.clip(max((c["shrink"] for c in driven), default=0.0), 0.0, 1.0)),
        "proven": float(np.clip(max(c["low"] for c in row["channels"].values()), 0.0, 1.0)),
        "throughout": float(np.clip(min((c["low"] for c in driven), default=0.0), -1.0, 1.0)),
        "chance": float(np.clip(1.0 - row["gain"] / max(row["gain_fitted"], 1e-9), 0.0, 2.0)),
        "tone": _fall_of_tone(base, row),
        "explained": explained,
        "excess": _excess(case, row) * (1.0 - explained),
        "above_reference": _above_reference(case, row),
        "lost": _lost(case, row),
        "usual": float(np.clip(np.log(_USUAL_RATIO / usual), 0.0, 3.0)),
        "far": max([0.0, *(p.get("far", 0.0) - 2.0 for p in parameters)]),
        "bound": float(any(p.get("bound") for p in parameters)),
    }


def _of_rivalry(case: Json, row: Json, gain: float, others: list[tuple[Json, float]]) -> dict[str, float]:
    """Features of a cause beside the ``others``, rows with their gains."""
    own = set(row["effects"])
    values = {"gain": _compressed(gain), "margin": _compressed(gain - _of_best_rival(row, others))}
    if len(own) > 1:
        smaller = [g for r, g in others if set(r["effects"]) < own]
        values["size"] = float(len(own) - 1) * (case["kind"] != "planar")
        values["added"] = _compressed(gain - max([0.0, *smaller]))
        values["added_proven"] = float(np.clip(row.get("added_low", 0.0), 0.0, 1.0))
    return values


def _of_best_rival(row: Json, others: list[tuple[Json, float]]) -> float:
    """Evidence of the best rival, at least 0. A hypothesis is nested in one of more effects: neither is a rival of the
    other."""
    own = set(row["effects"])
    rivals = [g for r, g in others if not (own <= set(r["effects"]) or set(r["effects"]) < own)]
    return max([0.0, *rivals])


def _beside(row: Json, gain: float) -> float:
    """Nats over recalibration that remain beside the usual errors of every car: at most the plain ``gain``, and that
    where nothing was linearised."""
    known = row.get("beside")
    return gain if known is None else min(float(known), gain)


def _compressed(gain: float) -> float:
    """Evidence as it counts: below a nat in proportion, above by its logarithm, because simulations that are wrong in
    the same way gain hundreds of nats alike."""
    return float(np.arcsinh(gain))


def _vector(values: Json) -> Floats:
    return np.array([float(values.get(name, 0.0)) for name in FEATURES])


def _gain(row: Json, base_since: float | None) -> float:
    """Nats over recalibration, marginal over a vehicle with and without pre-existing effects."""
    own = float(row["tempered_gain"])
    if base_since is None:
        return own
    beyond = base_since + (row.get("since") or 0.0)
    return float(np.logaddexp(own, beyond) - np.logaddexp(0.0, base_since))


def usual_level(case: Json) -> float:
    """Residual as a share of the motion that a complete model leaves: that on the reference, or the usual one."""
    return float(case["level_on_reference"] if case["reference"] else usual("level"))


def _driven_squares(case: Json, row: Json) -> list[float]:
    """Held-out mean squares of the driven channels in units of the noise model of the reference."""
    return [v for c, v in row["mean_squares"].items() if case["channels"][c]["driven"]]


def _excess(case: Json, row: Json) -> float:
    """Log of the remaining residual over that of a complete model, and over the noise; 0 where it is less."""
    main, level = next(iter(case["channels"].values())), max(row["level_fitted"], 1e-3)
    if case["reference"]:
        over = 0.5 * np.log(max([1e-9, *_driven_squares(case, row)]) / usual("square"))
    else:
        over = np.log(level / usual("level"))
    noisy = np.log(level * main["motion"] / (2.0 * main["noise"]))
    return float(np.clip(min(over, noisy), 0.0, 3.0))


def _above_reference(case: Json, row: Json) -> float:
    """Log of the held-out residual, as a share of the motion, over that on the reference; 0 where it is less."""
    if not case["reference"]:
        return 0.0
    return float(np.clip(np.log(max(row["level"], 1e-3) / max(case["level_on_reference"], 1e-3)), 0.0, 3.0))


def _explained(case: Json, base: Json, row: Json) -> float:
    """Share of the residual beyond the expected discrepancy that a hypothesis explains, of the mean square.

    A mean square m counts as m^2 / (m + m_0) beside the expected m_0: about m where it is larger, little where it is
    smaller.
    """

    def beyond(one: Json) -> float:
        if case["reference"]:
            return float(sum(v**2 / (v + usual("square")) for v in _driven_squares(case, one)))
        square = one["level_fitted"] ** 2
        return float(square**2 / (square + usual("level") ** 2))

    return float(np.clip(1.0 - beyond(row) / max(beyond(base), 1e-12), 0.0, 1.0))


def _square(case: Json, row: Json) -> float:
    """Mean square of the remaining residual: in units of the noise model of the reference, or of the motion."""
    return float(sum(_driven_squares(case, row)) if case["reference"] else row["level_fitted"] ** 2)


def _lost(case: Json, row: Json) -> float:
    """Largest relative growth of the gap in a driven channel, where it is above the noise."""
    lost = [
        -c["worst"]
        for name, c in row["channels"].items()
        if c["worst"] is not None and max(c["before"], c["after"]) > case["channels"][name]["noise"]
    ]
    return float(np.clip(max([0.0, *lost]), 0.0, 2.0))


def _pattern(row: Json) -> float:
    """By how much tone, band and place exceed those of model discrepancy, as a sum of logarithms."""
    if "tone" not in row:
        return 0.0
    over = (np.log(max(row[name], 1e-3) / usual(name)) for name in ("tone", "band", "place"))
    return float(sum(np.clip(o, 0.0, 1.5) for o in over))


def _fall_of_tone(base: Json, row: Json) -> float:
    """Log of the fall of the strongest tone, as far as it is above those of model discrepancy; 0 to 2."""
    if "tone" not in row or "tone" not in base:
        return 0.0
    return float(np.clip(np.log(max(base["tone"], 1e-3) / max(row["tone"], usual("tone"))), 0.0, 2.0))


def _clocks(row: Json) -> float:
    """Clocks near their bounds that are not so by chance: 0 to 1."""
    if "clocks" not in row:
        return 0.0
    near = float(np.clip(row["clocks"] - 2.0, 0.0, 1.0))
    return near * float(np.clip(-0.5 * np.log10(max(row["clocks_by_chance"], 1e-12)), 0.0, 1.0))
