# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis says in plain words: effects, parameters, wheels, channels, and the answer in a sentence.

All text for people is made here, for the page, the command line and the nodes alike. What an effect with its
parameters means is said by the effect itself (``Effect.finding``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from suspension_twin.effects.base import Parameter, listed
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.gap import channel_unit
from suspension_twin.units import plain

__all__ = [
    "NOTHING",
    "UNKNOWN",
    "answer",
    "capital",
    "chance",
    "channel_name",
    "channel_of",
    "effect_at",
    "effect_name",
    "finding",
    "how_likely",
    "listed",
    "message",
    "parameter_name",
    "parameter_value",
    "parameters_of",
    "percent",
    "place_name",
    "probability_of",
    "remaining",
    "remarks",
    "subject",
]

Document = Mapping[str, Any]

NOTHING, UNKNOWN = "nothing is wrong", "something that is not in the library"
#: Calibrated language for probabilities (IPCC, Guidance Note on Consistent Treatment of Uncertainties, 2010).
_LIKELY: Final = (
    (0.99, "virtually certain"),
    (0.95, "extremely likely"),
    (0.9, "very likely"),
    (0.66, "likely"),
    (0.5, "more likely than not"),
    (0.33, "about as likely as not"),
    (0.0, "unlikely"),
)

#: Parameters whose names say little.
_PLAIN: Final = {
    "corner": "wheel",
    "station": "road wheel",
    "x": "forward",
    "y": "to the left",
    "z": "up",
    "sigma": "length of smoothing",
}


def capital(text: str) -> str:
    """``text`` with a capital first letter."""
    return text[:1].upper() + text[1:]


def percent(share: float) -> str:
    """A share in per cent, with a true minus sign."""
    if 0.0 < share < 0.005:
        return "less than 1 %"
    return f"{round(100.0 * share) + 0.0:.0f} %".replace("-", "\N{MINUS SIGN}")


def chance(probability: float) -> str:
    """A probability in per cent; nothing is certain or impossible."""
    if probability >= 0.995:
        return "more than 99 %"
    return percent(max(probability, 1e-9))


def how_likely(probability: float) -> str:
    """The usual words for a probability, such as ``very likely``."""
    return next(word for least, word in _LIKELY if probability >= least)


def channel_name(name: str) -> str:
    """``vertical acceleration`` for ``vertical_acceleration``."""
    return name.replace("_", " ")


def place_name(name: str) -> str:
    """``front left`` for the corner ``front_left``, ``road wheel 3`` for ``station_3``."""
    return re.sub(r"^station ", "road wheel ", name.replace("_", " "))


def effect_name(name: str) -> str:
    """A short name of an effect, of ``no_gap`` or of ``unknown``."""
    special = {"no_gap": NOTHING, "unknown": UNKNOWN}
    return special.get(name) or (EFFECTS[name].title if name in EFFECTS else name.replace("_", " "))


def _parameter(effect: str, name: str) -> Parameter | None:
    """What an effect says of one of its parameters, on any model."""
    if effect not in EFFECTS:
        return None
    own = EFFECTS[effect]
    known = [*own.parameters, *(p for v in own.variants.values() for p in v.parameters)]
    return next((p for p in known if p.name == name), None)


def parameter_name(effect: str, name: str) -> str:
    """``clearance, front`` for ``front_clearance``, ``wheel`` for ``corner``."""
    known = _parameter(effect, name)
    words = name.removesuffix(f"_{known.unit}").split("_") if known else name.split("_")
    if words[0] in ("front", "rear") and len(words) > 1:
        words = [*words[1:-1], f"{words[-1]},", words[0]]
    return _PLAIN.get(name, " ".join(words))


def parameter_value(effect: str, name: str, value: float) -> str:
    """A parameter's value with its unit; of a choice its name (``front left``)."""
    known = _parameter(effect, name)
    if known is None:
        return f"{value:.3g}".replace("-", "\N{MINUS SIGN}")
    if known.choices:
        names: dict[int, str] = {int(k): v.strip() for k, v in re.findall(r"\b(\d+) ([^,]+)", known.doc)}
        return names.get(round(value), f"{value:g}")
    return plain(value, known.unit, 3)


def effect_at(effect: str, place: str) -> str:
    """Name of an effect with its place: ``one odd damper, front left`` for the place ``corner 0``."""
    name, _, value = place.partition(" ")
    return (
        f"{effect_name(effect)}, {parameter_value(effect, name, float(value))}"
        if value
        else effect_name(effect)
    )


def parameters_of(cause: Document) -> list[tuple[str, str]]:
    """Names and values of a cause's parameters, with their 90 % intervals where there are any."""
    effect, ends = cause["effect"], cause.get("parameter_intervals", {})
    rows = []
    for name, value in cause["parameters"].items():
        text = parameter_value(effect, name, value)
        if name in ends:
            low, high = (parameter_value(effect, name, end) for end in ends[name])
            text += f" ({low} to {high})"
        rows.append((parameter_name(effect, name), text))
    return rows


def finding(effect: str, parameters: Mapping[str, float]) -> str:
    """What an effect with its parameters is: "the front left damper has lost 40 % of its force"."""
    known = EFFECTS.get(effect)
    if known is not None and _nothing(effect, parameters):
        return f"no sign of this: {known.title}"
    if known is not None and known.finding is not None:
        return known.finding(parameters)
    values = [f"{parameter_name(effect, k)} {parameter_value(effect, k, v)}" for k, v in parameters.items()]
    return effect_name(effect) + (f" ({', '.join(values)})" if values else "")


def _nothing(effect: str, parameters: Mapping[str, float]) -> bool:
    """Whether what was found of an effect is a hundredth of its usual size, or less."""
    severities = [_parameter(effect, name) for name in EFFECTS[effect].severity if name in parameters]
    return bool(severities) and all(
        p is not None
        and not p.log
        and abs(parameters[p.name] - p.neutral) <= 0.01 * max(p.spread, abs(p.typical - p.neutral))
        for p in severities
    )


def channel_of(document: Document, cause: Document | None = None) -> str:
    """Id of the channel whose gap a cause closes; that of the whole gap where nothing else is given."""
    own = cause.get("channel") if cause else None
    return str(own or document.get("channel") or document["gap"]["channel"])


def _named(document: Document) -> list[Document]:
    """The causes that the answer names."""
    causes = {c["effect"]: c for c in document["causes"]}
    return [causes[e] for e in document["combination"] if e in causes]


def probability_of(document: Document) -> float:
    """Probability of the answer: of the causes named together, of no gap, or of an unknown cause."""
    if "probability" in document:
        return float(document["probability"])
    if document["verdict"] in ("no_gap", "unknown"):
        return float(document[f"{document['verdict']}_probability"])
    return min(1.0, sum(float(c["probability"]) for c in _named(document)))


def subject(document: Document) -> str:
    """What the answer is about, in a few words: the names of the causes, or that nothing is wrong."""
    named = [effect_name(c["effect"]) for c in _named(document)]
    if document["verdict"] in ("effect", "partly") and named:
        return capital(listed(named))
    if _likelier(document) is not None:
        return "No cause that is certain enough"
    return capital(NOTHING) if document["verdict"] == "no_gap" else "Unknown cause"


def _likelier(document: Document) -> Document | None:
    """The cause that is more probable than an answer that names none: a wrong name costs more than none."""
    if document["verdict"] not in ("no_gap", "unknown"):
        return None
    lead = max(document["causes"], key=lambda c: float(c["probability"]), default=None)
    sure = probability_of(document)
    return lead if lead is not None and float(lead["probability"]) > sure else None


def answer(document: Document) -> str:
    """The answer and how sure it is, in one sentence."""
    verdict, probability = document["verdict"], probability_of(document)
    sure = f"{capital(how_likely(probability))} ({chance(probability)})"
    named = _named(document)
    if verdict in ("effect", "partly") and named:
        found = "; and ".join(finding(c["effect"], c["parameters"]) for c in named)
        more = ", but that is not all" if verdict == "partly" else ""
        return f"{sure}: {found}{more}."
    likelier = _likelier(document)
    if likelier is not None:
        rest = (("unknown_probability", f"it is {UNKNOWN}"), ("no_gap_probability", NOTHING))
        chances = [
            (float(likelier["probability"]), finding(likelier["effect"], likelier["parameters"])),
            *((float(document[key]), words) for key, words in rest),
        ]
        return f"No cause is certain enough to be named: {listed([f'{chance(p)} that {w}' for p, w in chances])}."
    if verdict == "no_gap":
        return f"{sure}: {NOTHING} that these drives could show."
    return f"{sure}: something is wrong, but nothing in the library of causes explains it."


def remarks(document: Document) -> list[str]:
    """Sentences below the answer: how far it closes the gap, what else it could be, what was there before."""
    verdict, named = document["verdict"], _named(document)
    lines: list[str] = []
    if named and verdict in ("effect", "partly"):
        lines += _closing(document, named)
    elif verdict == "no_gap":
        r = document["recalibration"]
        text = "Twin and car differ by no more than sensor noise and the usual error of a model"
        closed = r["gap_before"] - r["gap_after"]
        if closed > 0.1 * r["gap_before"]:
            text += f", once the twin is recalibrated: that alone closes {percent(r['shrink'])} of the gap"
        lines.append(text + ".")
    else:
        lines.append(capital(remaining(document)) + ".")
    if verdict == "partly":
        lines.append(f"{percent(document['unexplained'])} of the gap stay unexplained.")
    lines += _kept(document)
    return lines


def remaining(document: Document) -> str:
    """What an unexplained gap looks like."""
    unit, signature = channel_unit(document["gap"]["channel"]), document.get("signature", {})
    words = [f"{document.get('gap_after', document['gap']['rms']):.2g} {unit} of the gap remain"]
    for like in signature.get("resembles", [])[:1]:
        words.append(f"they resemble {effect_name(like['effect'])}")
    there = signature.get("stretch")
    if there:
        text = f"{percent(there['share'])} of it lies from {there['start_m']:.0f} to {there['end_m']:.0f} m of the road"
        if there.get("like"):
            text += f", where it is like {effect_name(there['resembles'][0]['effect'])}"
        words.append(text)
    return "; ".join(words)


def message(document: Document) -> str:
    """The answer in one plain sentence, with how far a cause closes the gap and what remains of an unknown one."""
    text = answer(document).rstrip(".")
    named = _named(document)
    if named and document["verdict"] in ("effect", "partly"):
        lead = max(named, key=lambda c: float(c["probability"]))
        low, high = (percent(v) for v in lead["shrink_beyond_recalibration_interval"])
        text += (
            f"; the gap in {channel_name(lead['channel'])} is {percent(lead['shrink_beyond_recalibration'])} smaller "
            f"({low} to {high}) than by recalibration alone"
        )
        if document.get("before_and_after"):
            text += "; it is so before and after alike, so it is not what changed"
    elif document["verdict"] == "unknown":
        text += f"; {remaining(document)}"
    return text


def _closing(document: Document, named: list[Document]) -> list[str]:
    """How far the causes that are named close the gap, and what they cannot be told from."""
    lead = max(named, key=lambda c: float(c["probability"]))
    channel = channel_of(document, lead)
    where = f"the gap in {channel_name(channel)}"
    before = float(lead["gap_before"])
    if len(named) > 1:
        share = 1.0 - float(document["unexplained"])
        words, after, interval = "With them", before * (1.0 - share), ""
    else:
        share, after = float(lead["shrink"]), float(lead["gap_after"])
        low, high = (percent(v) for v in lead["shrink_interval"])
        words, interval = "With it", f" ({low} to {high} at 90 % confidence)"
    change = "falls" if share > 0.0 else "does not fall: it goes"
    by = f", by {percent(share)}{interval}" if share > 0.0 else ""
    lines = [
        f"{words} in the twin {where} {change} from {before:.2g} to {after:.2g} {channel_unit(channel)}{by}, on road "
        "that the fit has not used."
    ]
    like = [effect_name(e) for c in named for e in c.get("indistinguishable_from", ())]
    if like:
        lines.append(f"These drives cannot distinguish it from: {listed(list(dict.fromkeys(like)))}.")
    return lines


def _kept(document: Document) -> list[str]:
    """What the answer is hedged with: the set that holds the truth, and errors that are not new."""
    lines = []
    candidates = [effect_name(str(c)) for c in document.get("candidates", ())]
    if len(candidates) > 1:
        lines.append(f"In nine cases of ten like this one the truth is among: {', '.join(candidates)}.")
    alike = document.get("before_and_after")
    if isinstance(alike, str):
        lines.append(capital(alike.rstrip(".")) + ".")
    elif alike:
        names = [effect_name(str(e)) for e in alike] if isinstance(alike, list | tuple) else []
        lines.append(f"Not new, before and after alike{': ' + listed(names) if names else ''}.")
    return lines
