# SPDX-License-Identifier: Apache-2.0
"""The learnt decision: a conditional logit over the causes, sets of causes, no gap and unknown.

Every answer a has a utility u_a = w . phi_a and the probability exp(u_a) / sum_b exp(u_b) (McFadden 1974). The
features phi are computed from the rows of ``evidence.json``; physics dictates the sign of each weight. The weights w
are in ``decision.json``, made by ``benchmarks/train_decision.py`` from cases of simulators that share no code with the
package. The verdict is the answer of least expected cost.

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
from typing import Any

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = [
    "FEATURES",
    "FORMAT",
    "Answer",
    "Costs",
    "Decision",
    "Row",
    "Weights",
    "answers_of",
    "decide",
    "learnt",
    "usual_level",
]

Row = dict[str, Any]

#: Version of the rows of ``evidence.json``: others are refused.
FORMAT = 1
#: Features by name and the prior mean of their weight. Physics dictates the sign, which learning keeps; 0 is free.
#: What speaks as clearly as a few nats has a weight of a few. Features that did not lower the loss on realities left
#: out of the learning were dropped.
FEATURES: Mapping[str, float] = {
    # of a cause or a set
    "number": -1.0,  # log of the number of effects in the library: they share the prior
    "gain": 0.5,  # evidence over recalibration
    "margin": 0.5,  # evidence over the next best
    "shrink": 1.0,  # beyond recalibration, in the best driven channel
    "proven": 2.0,  # lower end of the shrink beyond recalibration in the best channel
    "throughout": 1.0,  # lower end of that shrink in the worst driven channel
    "chance": -0.5,  # share of the gain in the fit that is lost on held-out road
    "tone": 0.5,  # log of the fall of the strongest tone
    "explained": 2.0,  # share of the residual beyond the expected discrepancy
    "complete": 1.0,  # share of what any hypothesis removes
    "excess": -1.0,  # what remains beside the expected discrepancy
    "above_reference": -1.0,  # log of what remains over what remains on the reference
    "lost": -2.0,  # growth of the gap in another channel
    "usual": -1.0,  # as small as errors of twin files are
    "far": -0.5,  # beyond its prior
    "bound": -0.5,  # on a bound
    "size": -2.0,  # effects beyond the first
    "added": 0.7,  # evidence over the best smaller set
    "added_proven": 2.0,  # lower end of the shrink that each of its effects adds
    # of no gap
    "none_excess": -3.0,
    "none_above_reference": -1.0,
    "none_gain": -1.0,  # evidence of the best hypothesis that is larger than usual errors of twin files
    "none_pattern": -1.0,
    "none_clocks": -1.0,
    # of unknown
    "unknown": -1.0,
    "unknown_blind": 0.0,
    "unknown_best_excess": 1.0,  # what the best cause leaves
    "unknown_above_reference": 1.0,  # the least that any hypothesis leaves over what remains on the reference
    "unknown_open": 0.3,  # evidence of the best set over the best single effect
}
#: Held-out mean square in units of the noise model of the reference, and residual as a share of the motion without a
#: reference, that a complete model leaves: medians over cars without any fault.
_USUAL_SQUARE, _USUAL_LEVEL = 1.5, 0.14
#: Values of a tone's prominence, a band's unevenness and a place's concentration that model discrepancy reaches on
#: cars and roads without any error: their largest.
_USUAL_TONE, _USUAL_BAND, _USUAL_PLACE = 10.0, 2.7, 0.27
#: Severity over the usual error of a twin file up to which an effect is as small as such errors are: half a standard
#: deviation beyond one.
_USUAL_RATIO = 1.5
#: Name of the file with the weights.
_FILE = Path(__file__).with_name("decision.json")


@dataclass(frozen=True)
class Costs:
    """Costs of a verdict, the unit being a cause that is there and not named.

    ``wrong``: a cause is named that is not there. ``missed``: "no gap" is said where there is one. ``unknown``:
    "unknown" is said where it is not so. ``vague``: for each cause too many or too few beside a right one.
    """

    wrong: float = 4.0
    missed: float = 1.0
    unknown: float = 1.0
    vague: float = 0.5

    @classmethod
    def parsed(cls, text: str) -> Costs:
        """From ``wrong=4,missed=1``; InputError names what is not one of them or no positive number."""
        known = {f.name for f in fields(cls)}
        given: dict[str, float] = {}
        for item in filter(None, (i.strip() for i in text.split(","))):
            name, _, value = (part.strip() for part in item.partition("="))
            if name not in known:
                raise InputError("costs", name, f"is not one of {', '.join(sorted(known))}")
            try:
                given[name] = float(value)
            except ValueError:
                raise InputError("costs", name, f"{value!r} is no number") from None
            if not 0.0 <= given[name] < np.inf:
                raise InputError("costs", name, "has to be a number of at least 0")
        return cls(**given)

    def of(self, said: tuple[str, ...], true: tuple[str, ...]) -> float:
        """Cost of an answer; causes are ids of effects, () is no gap and ("unknown",) unknown."""
        if said == true:
            return 0.0
        if said == ("unknown",):
            return self.unknown
        if said == ():
            return self.missed
        right = set(said) & set(true)
        return self.vague * len(set(said) ^ set(true)) if right else self.wrong


@dataclass(frozen=True, eq=False)
class Weights:
    """What was learnt: ``values`` (F,) by feature, the smallest probability of a member of a conformal set, and where
    all of it comes from."""

    values: Floats
    conformal: float
    source: Mapping[str, Any]


@cache
def learnt() -> Weights:
    """The weights that ship with the package."""
    known = json.loads(_FILE.read_text(encoding="utf-8"))
    return Weights(
        np.array([known["weights"].get(name, 0.0) for name in FEATURES]),
        float(known["conformal_probability"]),
        known["source"],
    )


@dataclass(frozen=True, eq=False)
class Answer:
    """One possible answer: ``causes`` (empty for no gap, ``("unknown",)``), its row and features (F,).

    The answer of a decoy is unknown.
    """

    causes: tuple[str, ...]
    row: Row | None
    features: Floats


@dataclass(frozen=True, eq=False)
class Decision:
    """``probability`` (A,) of each of the ``answers``; ``chosen`` is the causes of the answer of least expected cost
    and ``row`` its row; ``effects`` the probability of each effect, a set's in equal parts for its members;
    ``candidates`` the conformal set, the most probable first."""

    answers: list[Answer]
    probability: Floats
    chosen: tuple[str, ...]
    row: Row | None
    effects: dict[str, float]
    no_gap: float
    unknown: float
    candidates: list[tuple[str, ...]]


def decide(
    evidence: Mapping[str, Any], costs: Costs | None = None, weights: Weights | None = None
) -> Decision:
    """The verdict of least expected cost.

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
    probability /= probability.sum()
    masses: dict[tuple[str, ...], float] = {}
    for answer, p in zip(answers, probability, strict=True):
        masses[answer.causes] = masses.get(answer.causes, 0.0) + float(p)
    effects = {
        r["effects"][0]: 0.0 for r in evidence["hypotheses"] if not r["decoy"] and len(r["effects"]) == 1
    }
    for causes, p in masses.items():
        if causes and causes != ("unknown",):
            for effect in causes:
                effects[effect] = effects.get(effect, 0.0) + p / len(causes)
    rows = {a.causes: a.row for a in answers if a.row is not None and not a.row["decoy"]}
    allowed = [(), ("unknown",), *(c for c, r in rows.items() if shrinks(r))]
    # costs are compared to twelve digits, so that a tie falls to the first
    expected = [round(sum(p * costs.of(said, true) for true, p in masses.items()), 12) for said in allowed]
    chosen = allowed[int(np.argmin(expected))]
    ranked = sorted(masses, key=lambda c: -masses[c])
    candidates = [c for c in ranked if masses[c] >= known.conformal] or ranked[:1]
    return Decision(
        answers,
        probability,
        chosen,
        rows.get(chosen),
        effects,
        masses[()],
        masses[("unknown",)],
        candidates,
    )


def shrinks(row: Row) -> bool:
    """Whether the shrink beyond recalibration has, in some channel, an interval that excludes zero."""
    return any(c["low"] > 0.0 for c in row["channels"].values())


def answers_of(evidence: Mapping[str, Any]) -> list[Answer]:
    """All possible answers with their features: no gap, unknown, and every hypothesis."""
    if evidence.get("format") != FORMAT:
        raise InputError(
            "evidence.json", f"is of format {evidence.get('format')}, not {FORMAT}: diagnose again"
        )
    case, base = evidence["case"], evidence["base"]
    # a set with an effect that may add nothing, or that is as small as errors of twin files, is no answer of its own
    rows = [
        r
        for r in evidence["hypotheses"]
        if len(r["effects"]) == 1
        or (r["added_low"] > 0.0 and (r["usual"] is None or r["usual"] > _USUAL_RATIO))
    ]
    if case["kind"] == "planar":
        # the few set-up errors occur together: a part of the set that none can be taken out of is no rival
        joint = [set(r["effects"]) for r in rows if len(r["effects"]) > 1]
        rows = [r for r in rows if not any(set(r["effects"]) < whole for whole in joint)]
    # what a request leaves out of the library may be the cause as well: that is "unknown"
    number = max(case.get("library", 0), sum(len(r["effects"]) == 1 and not r["decoy"] for r in rows), 1)
    gains = [_gain(r, base.get("since")) for r in rows]
    unusual = [g for g, r in zip(gains, rows, strict=True) if r["usual"] is None or r["usual"] > _USUAL_RATIO]
    best = max(rows, key=lambda r: _explained(case, base, r), default=base)
    singles = [g for g, r in zip(gains, rows, strict=True) if len(r["effects"]) == 1]
    most, least = _square(case, base), min(_square(case, r) for r in (base, *rows))
    none = {
        "none_excess": _excess(case, base),
        "none_above_reference": _above_reference(case, base),
        "none_gain": _nats(max([0.0, *unusual])),
        "none_pattern": _pattern(base),
        "none_clocks": _clocks(base),
    }
    unknown = {
        "unknown": 1.0,
        "unknown_blind": float(not case["reference"]),
        "unknown_best_excess": min(_excess(case, best), _excess(case, base)),
        "unknown_above_reference": min(_above_reference(case, r) for r in (rows or [base])),
        "unknown_open": _nats(max([0.0, *gains]) - max([0.0, *singles])),
    }
    found = [Answer((), None, _vector(none)), Answer(("unknown",), None, _vector(unknown))]
    for i, row in enumerate(rows):
        own = set(row["effects"])
        # a hypothesis is nested in one of more effects: neither is a rival of the other
        rivals = [
            g
            for g, r in zip(gains, rows, strict=True)
            if not (own <= set(r["effects"]) or set(r["effects"]) < own)
        ]
        explained = _explained(case, base, row)
        driven = [c for name, c in row["channels"].items() if case["channels"][name]["driven"]]
        usual = _USUAL_RATIO if row["usual"] is None else max(row["usual"], 1e-3)
        parameters = [p for values in row["parameters"].values() for p in values.values()]
        values = {
            "number": float(np.log(number)),
            "gain": _nats(gains[i]),
            "margin": _nats(gains[i] - max([0.0, *rivals])),
            "shrink": float(np.clip(max((c["shrink"] for c in driven), default=0.0), 0.0, 1.0)),
            "proven": float(np.clip(max(c["low"] for c in row["channels"].values()), 0.0, 1.0)),
            "throughout": float(np.clip(min((c["low"] for c in driven), default=0.0), -1.0, 1.0)),
            "chance": float(np.clip(1.0 - row["gain"] / max(row["gain_fitted"], 1e-9), 0.0, 2.0)),
            "tone": _hushed(base, row),
            "explained": explained,
            "complete": max(most - _square(case, row), 0.0) / (most - least) if most > least else 0.0,
            "excess": _excess(case, row) * (1.0 - explained),
            "above_reference": _above_reference(case, row),
            "lost": _lost(case, row),
            "usual": float(np.clip(np.log(_USUAL_RATIO / usual), 0.0, 3.0)),
            "far": max([0.0, *(p.get("far", 0.0) - 2.0 for p in parameters)]),
            "bound": float(any(p.get("bound") for p in parameters)),
        }
        if len(own) > 1:
            smaller = [g for g, r in zip(gains, rows, strict=True) if set(r["effects"]) < own]
            values["size"] = float(len(own) - 1) * (case["kind"] != "planar")
            values["added"] = _nats(gains[i] - max([0.0, *smaller]))
            values["added_proven"] = float(np.clip(row.get("added_low", 0.0), 0.0, 1.0))
        causes = ("unknown",) if row["decoy"] else tuple(sorted(own))
        found.append(Answer(causes, row, _vector(values)))
    return found


def _nats(gain: float) -> float:
    """Evidence as it counts: below a nat in proportion, above by its logarithm, because simulations that are wrong in
    the same way gain hundreds of nats alike."""
    return float(np.arcsinh(gain))


def _vector(values: Mapping[str, float]) -> Floats:
    return np.array([float(values.get(name, 0.0)) for name in FEATURES])


def _gain(row: Row, base_since: float | None) -> float:
    """Nats over recalibration, marginal over a vehicle with and without pre-existing effects."""
    own = float(row["tempered_gain"])
    if base_since is None:
        return own
    beyond = base_since + (row.get("since") or 0.0)
    return float(np.logaddexp(own, beyond) - np.logaddexp(0.0, base_since))


def usual_level(case: Row) -> float:
    """Residual as a share of the motion that a complete model leaves: that on the reference, or the usual one."""
    return float(case["level_on_reference"] if case["reference"] else _USUAL_LEVEL)


def _excess(case: Row, row: Row) -> float:
    """Log of the remaining residual over what a complete model leaves, and over the noise; 0 where it is less."""
    main = next(c for c in case["channels"].values())
    if case["reference"]:
        driven = [v for c, v in row["mean_squares"].items() if case["channels"][c]["driven"]]
        over = 0.5 * np.log(max([1e-9, *driven]) / _USUAL_SQUARE)
    else:
        over = np.log(max(row["level_fitted"], 1e-3) / _USUAL_LEVEL)
    noisy = np.log(max(row["level_fitted"], 1e-3) * main["motion"] / (2.0 * main["noise"]))
    return float(np.clip(min(over, noisy), 0.0, 3.0))


def _above_reference(case: Row, row: Row) -> float:
    """Log of the held-out residual, as a share of the motion, over that on the reference; 0 where it is less."""
    if not case["reference"]:
        return 0.0
    return float(np.clip(np.log(max(row["level"], 1e-3) / max(case["level_on_reference"], 1e-3)), 0.0, 3.0))


def _explained(case: Row, base: Row, row: Row) -> float:
    """Share of the residual beyond the expected discrepancy that a hypothesis explains, of the mean square.

    A mean square m counts as m^2 / (m + m_0) beside the expected m_0: about m where it is larger, little where it is
    smaller.
    """

    def beyond(one: Row) -> float:
        if case["reference"]:
            squares = one["mean_squares"].items()
            return float(sum(v**2 / (v + _USUAL_SQUARE) for c, v in squares if case["channels"][c]["driven"]))
        square = one["level_fitted"] ** 2
        return float(square**2 / (square + _USUAL_LEVEL**2))

    return float(np.clip(1.0 - beyond(row) / max(beyond(base), 1e-12), 0.0, 1.0))


def _square(case: Row, row: Row) -> float:
    """Mean square of the remaining residual: in units of the noise model of the reference, or of the motion."""
    if not case["reference"]:
        return float(row["level_fitted"] ** 2)
    return float(sum(v for c, v in row["mean_squares"].items() if case["channels"][c]["driven"]))


def _lost(case: Row, row: Row) -> float:
    """Largest relative growth of the gap in a driven channel, where it is above the noise."""
    lost = [
        -c["worst"]
        for name, c in row["channels"].items()
        if c["worst"] is not None and max(c["before"], c["after"]) > case["channels"][name]["noise"]
    ]
    return float(np.clip(max([0.0, *lost]), 0.0, 2.0))


def _pattern(row: Row) -> float:
    """By how much tone, band and place exceed what model discrepancy has, as a sum of logarithms."""
    if "tone" not in row:
        return 0.0
    over = (
        np.log(max(row["tone"], 1e-3) / _USUAL_TONE),
        np.log(max(row["band"], 1e-3) / _USUAL_BAND),
        np.log(max(row["place"], 1e-3) / _USUAL_PLACE),
    )
    return float(sum(np.clip(o, 0.0, 1.5) for o in over))


def _hushed(base: Row, row: Row) -> float:
    """Log of the fall of the strongest tone, as far as it is above those of model discrepancy; 0 to 2."""
    if "tone" not in row or "tone" not in base:
        return 0.0
    return float(np.clip(np.log(max(base["tone"], 1e-3) / max(row["tone"], _USUAL_TONE)), 0.0, 2.0))


def _clocks(row: Row) -> float:
    """Clocks near their bounds that are not so by chance: 0 to 1."""
    if "clocks" not in row:
        return 0.0
    near = float(np.clip(row["clocks"] - 2.0, 0.0, 1.0))
    return near * float(np.clip(-0.5 * np.log10(max(row["clocks_by_chance"], 1e-12)), 0.0, 1.0))
