# SPDX-License-Identifier: Apache-2.0
"""Words of a diagnosis: effects, parameters, wheels, channels, and the answer in a sentence.

All text for people is made here, for the page, the command line and the nodes alike. The meaning of an effect with its
parameters is put into words by the effect itself (``Effect.finding``).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from suspension_twin.effects.base import Parameter, listed
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.inference.gap import channel_unit
from suspension_twin.units import plain

__all__ = [
    "NOTHING",
    "UNKNOWN",
    "Document",
    "answer",
    "capital",
    "chance",
    "channel_name",
    "channel_of",
    "effect_at",
    "effect_name",
    "finding",
    "leading",
    "listed",
    "message",
    "moved_words",
    "parameter_name",
    "parameter_value",
    "parameters_of",
    "percent",
    "place_name",
    "remarks",
    "said",
]

#: The content of ``diagnosis.json``, or of one of its causes.
Document = Mapping[str, Any]

NOTHING, UNKNOWN = "nothing is wrong", "something that is not in the library"
_WORDS: Final = json.loads(Path(__file__).with_name("wording.json").read_text(encoding="utf-8"))
#: Calibrated language for probabilities (IPCC, Guidance Note on Consistent Treatment of Uncertainties, 2010), and words
#: for parameters whose names say little.
_LIKELY: Final[list[tuple[float, str]]] = _WORDS["likely"]
_OTHER: Final = ("lower", "higher")
_PLAIN: Final[Mapping[str, str]] = _WORDS["parameters"]


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


def channel_name(name: str) -> str:
    """``vertical acceleration`` for ``vertical_acceleration``."""
    return name.replace("_", " ")


def place_name(name: str) -> str:
    """``front left`` for the corner ``front_left``, ``road wheel 3`` for ``station_3``."""
    return re.sub(r"^station ", "road wheel ", name.replace("_", " "))


def effect_name(name: str) -> str:
    """A short name of an effect, of ``no_gap`` or of ``unknown``."""
    known = {"no_gap": NOTHING, "unknown": UNKNOWN, **{e: effect.title for e, effect in EFFECTS.items()}}
    return known.get(name, name.replace("_", " "))


def _parameter(effect: str, name: str) -> Parameter | None:
    """A parameter of an effect, on any model."""
    if effect not in EFFECTS:
        return None
    own = EFFECTS[effect]
    known = [*own.parameters, *(p for v in own.variants.values() for p in v.parameters)]
    return next((p for p in known if p.name == name), None)


def parameter_name(effect: str, name: str) -> str:
    """``clearance, front`` for ``front_clearance``, ``wheel`` for ``corner``, ``lost force, front`` for ``front``."""
    known = _parameter(effect, name)
    words = name.removesuffix(f"_{known.unit}").split("_") if known else name.split("_")
    if words[0] in ("front", "rear") and len(words) > 1:
        words = [*words[1:-1], f"{words[-1]},", words[0]]
    return _PLAIN.get(f"{effect}.{name}", _PLAIN.get(name, " ".join(words)))


def parameter_value(effect: str, name: str, value: float) -> str:
    """A parameter's value with its unit; of a choice its name (``front left``)."""
    known = _parameter(effect, name)
    if known is None:
        return f"{value:.3g}".replace("-", "\N{MINUS SIGN}")
    if not known.prior.log and abs(value - known.neutral) < 1e-3 * _scale(known):
        value = known.neutral  # rounding errors of a fit are no finding
    if known.choices:
        names: dict[int, str] = {int(k): v.strip() for k, v in re.findall(r"\b(\d+) ([^,]+)", known.doc)}
        return names.get(round(value), f"{value:g}")
    return plain(value, known.unit, 3)


def effect_at(effect: str, place: str) -> str:
    """Name of an effect with its place: ``one odd damper, front left`` for the place ``corner 0``."""
    name, _, value = place.partition(" ")
    return effect_name(effect) + (f", {parameter_value(effect, name, float(value))}" if value else "")


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
    """An effect with its parameters in words: "the front left damper has lost 40 % of its force"."""
    known = EFFECTS.get(effect)
    if known is not None and _nothing(effect, parameters):
        return f"no sign of this: {known.title}"
    if known is not None and known.finding is not None and parameters:
        return known.finding(parameters)
    values = [f"{parameter_name(effect, k)} {parameter_value(effect, k, v)}" for k, v in parameters.items()]
    return effect_name(effect) + (f" ({', '.join(values)})" if values else "")


def _nothing(effect: str, parameters: Mapping[str, float]) -> bool:
    """Whether an effect is a hundredth of its usual size, or less."""
    severities = [_parameter(effect, name) for name in EFFECTS[effect].severity if name in parameters]
    return bool(severities) and all(
        p is not None and not p.prior.log and abs(parameters[p.name] - p.neutral) <= 0.01 * _scale(p)
        for p in severities
    )


def _scale(parameter: Parameter) -> float:
    """Usual size of a parameter: the larger of the spread of its prior and its typical distance from neutral."""
    return max(parameter.prior.spread, abs(parameter.prior.typical - parameter.neutral))


def channel_of(document: Document, cause: Document | None = None) -> str:
    """Id of the channel whose gap a cause closes; that of the whole gap without one."""
    return str((cause or document["gap"])["channel"])


def _named(document: Document) -> list[Document]:
    """The causes that the answer names, in its order."""
    causes = {c["effect"]: c for c in document["causes"]}
    return [causes[e] for e in document["combination"] if e in causes]


def leading(document: Document) -> Document | None:
    """The most probable of the causes that the answer names."""
    return max(_named(document), key=_presence, default=None)


def _presence(cause: Document) -> float:
    """Probability of a cause over all sets that hold it."""
    return float(cause.get("presence", cause["probability"]))


def _certain(cause: Document) -> dict[str, float]:
    """Parameters of a cause; one of several sizes whose interval holds no change counts as none."""
    values, ends = dict(cause["parameters"]), cause.get("parameter_intervals", {})
    sizes = [
        p for n in EFFECTS[cause["effect"]].severity if (p := _parameter(cause["effect"], n)) and n in values
    ]
    open_ = [p for p in sizes if p.name in ends and ends[p.name][0] <= p.neutral <= ends[p.name][1]]
    return values | ({p.name: p.neutral for p in open_} if len(open_) < len(sizes) else {})


def said(cause: Document) -> str:
    """A cause with its parameters in words, of those that are certain; of an effect that the twin file has, both
    sizes."""
    effect, held = cause["effect"], cause.get("held", {})
    words = finding(effect, _certain(cause) if effect in EFFECTS and not held else cause["parameters"])
    if not held:
        return words
    size = EFFECTS[effect].severity if effect in EFFECTS else held
    before = listed([f"{parameter_name(effect, n)} {parameter_value(effect, n, held[n])}" for n in size])
    return f"{words} (in the twin file: {before})"


def _otherwise(document: Document, named: Sequence[Document]) -> list[tuple[float, str]]:
    """Other answers, of at least 5 %, the most probable first."""
    left = [c for c in document["causes"] if c not in named]
    others = [(_presence(c), said(c)) for c in sorted(left, key=_presence, reverse=True)[:1]]
    others += [
        (float(document["unknown_probability"]), UNKNOWN),
        (float(document["no_gap_probability"]), NOTHING),
    ]
    return sorted((o for o in others if o[0] >= 0.05), key=lambda o: -o[0])


def _chances(others: Sequence[tuple[float, str]]) -> str:
    return listed([f"{words} ({chance(p)})" for p, words in others])


def answer(document: Document) -> str:
    """The answer and how sure it is, in one sentence."""
    verdict, probability, named = document["verdict"], float(document["probability"]), _named(document)
    likely = capital(next(word for least, word in _LIKELY if probability >= least))
    sure = f"{likely} ({chance(probability)})"
    if verdict == "suspected":
        # more probable than any other answer, whatever the number
        word = "Probably" if probability >= 0.5 else "Perhaps"
        found = "; and ".join(said(c) for c in named)
        others = _otherwise(document, named)
        return f"{word} ({chance(probability)}): {found}" + (
            f"; or else: {_chances(others)}." if others else "."
        )
    if named:
        found = "; and ".join(said(c) for c in named)
        more = ", but that is not all" if verdict == "partly" else ""
        return f"{sure}: {found}{more}."
    others = _otherwise(document, [])
    if verdict == "unknown":
        wrong = 1.0 - float(document["no_gap_probability"])
        if others and others[0][1] != UNKNOWN:
            return f"Something is wrong ({chance(wrong)}), no cause is certain enough to be named: {_chances(others)}."
        return f"{sure}: something is wrong, but nothing in the library of causes explains it."
    if probability < 0.5:  # no answer is more probable than not
        return f"These drives do not settle it: {_chances(others)}."
    if verdict == "recalibration":
        largest = [one for one in document["recalibrated"] if one["share"] >= 0.1] or document["recalibrated"]
        moved = listed([moved_words(one) for one in largest[:2]])
        return f"{sure}: no effect is missing, but the twin's own values are off: {moved}."
    return f"{sure}: {NOTHING} that these drives could show."


def moved_words(one: Document) -> str:
    """A value that recalibration moved, in words: ``rear damper, both ways: 50 % weaker (44 to 55)``."""
    name, change, (low, high) = str(one["characteristic"]), float(one["change"]), one["interval"]
    words = (
        ("weaker", "stronger") if "damper" in name else ("softer", "stiffer") if "spring" in name else _OTHER
    )
    word = words[change > 0.0]
    ends = sorted((abs(low), abs(high)))
    if one["relative"]:
        return f"{name}: {percent(abs(change))} {word} ({' to '.join(f'{100.0 * end:.0f}' for end in ends)})"
    unit = one["unit"]
    size, *rest = (plain(v, unit) if unit else f"{v:.2g}" for v in (abs(change), *ends))
    return f"{name}: {size} {word} ({' to '.join(rest)})"


def remarks(document: Document) -> list[str]:
    """Sentences below the answer: by how much the gap falls, what else it could be, what cannot be judged."""
    verdict, lines = document["verdict"], []
    if document["combination"]:
        lines += _closing(document)
    elif verdict == "no_gap":
        lines.append("Twin and car differ by no more than sensor noise and the usual error of a model.")
    elif verdict == "recalibration":
        lines += _recalibration(document)
    else:
        lines.append(capital(_remaining(document)) + ".")
    if verdict not in ("recalibration", "no_gap") and document.get("recalibrated"):
        moved = listed([moved_words(one) for one in document["recalibrated"][:3]])
        lines.append(f"Recalibration alone would change: {moved}.")
    if verdict in ("partly", "suspected") and document["unexplained"] > 0.0:
        lines.append(f"{percent(document['unexplained'])} of the gap stay unexplained.")
    candidates = [effect_name(c) for c in document["candidates"]]
    if len(candidates) > 1:
        lines.append(f"In nine cases of ten like this one the truth is among: {', '.join(candidates)}.")
    if "earlier" in document:
        lines.append(f"Before the last drive: {document['earlier']['answer']}")
    if document.get("before_and_after"):
        lines.append("Not new: before and after alike.")
    weak = [effect_name(e) for e in document["cannot_be_judged"]]
    if weak:
        lines.append(f"Cannot be judged, as these drives do not excite them: {', '.join(weak)}.")
    return lines


def _recalibration(document: Document) -> list[str]:
    """The part of the gap that recalibration closes, and what tells wear from a wrong start."""
    r, unit = document["recalibration"], channel_unit(document["gap"]["channel"])
    low, high = (percent(v) for v in r["shrink_interval"])
    lines = [
        f"Recalibrated, the twin's gap falls from {r['gap_before']:.2g} to {r['gap_after']:.2g} {unit}, by "
        f"{percent(r['shrink'])} ({low} to {high} at 90 % confidence), on stretches that the fit has not used."
    ]
    shares = [(one, float(one["share"])) for one in document["recalibrated"]]
    lines += [
        f"{capital(moved_words(o))}, which closes {percent(p)} of it alone." for o, p in shares if p >= 0.01
    ]
    others = [moved_words(one) for one, share in shares if share < 0.01]
    if others:
        lines.append(f"Moved as well, to little effect: {'; '.join(others)}.")
    if document.get("reference"):
        lines.append("The reference drives ask for the same values: the file was off before the gap came.")
    elif all(one.get("stated") for one, share in shares if share >= 0.01):
        lines.append("The twin file states how sure it was of these values: they have changed since.")
    else:
        lines.append(
            "Wear, or a file that was never right: a reference drive from before the gap tells which."
        )
    return lines


def _remaining(document: Document) -> str:
    """An unexplained gap in words: its size, and the shapes and errors that it resembles."""
    unit, signature = channel_unit(document["gap"]["channel"]), document.get("signature", {})
    gap = float(document["gap_after"])
    beyond = f"{gap:.2g} {unit} of the gap remain"
    words = [beyond if gap > 0.0 else "no more of the gap remains than the noise of the sensor"]
    for like in signature.get("resembles", [])[:1]:
        words.append(f"they resemble {effect_name(like['effect'])}")
    there = signature.get("stretch")
    if there:
        text = f"{percent(there['share'])} of it lies from {there['start_m']:.0f} to {there['end_m']:.0f} m of the road"
        if there["like"]:
            text += f", where it is like {effect_name(there['resembles'][0]['effect'])}"
        words.append(text)
    return "; ".join(words)


def message(document: Document) -> str:
    """The answer in one plain sentence, with how far a cause closes the gap and how much remains of an unknown one."""
    text, lead = answer(document).rstrip("."), leading(document)
    if lead is not None:
        low, high = (percent(v) for v in lead["shrink_beyond_recalibration_interval"])
        text += (
            f"; the gap in {channel_name(lead['channel'])} is {percent(lead['shrink_beyond_recalibration'])} smaller "
            f"({low} to {high} on these drives) than by recalibration alone"
        )
        if document.get("before_and_after"):
            text += "; it is so before and after alike, so it is not what changed"
    elif document["verdict"] == "unknown":
        text += f"; {_remaining(document)}"
    return text


def _closing(document: Document) -> list[str]:
    """By how much the causes that are named close the gap, and what they cannot be distinguished from."""
    named, lead = _named(document), leading(document)
    assert lead is not None
    before, channel = float(lead["gap_before"]), channel_of(document, lead)
    if len(named) > 1:
        share = 1.0 - float(document["unexplained"])
        words, after, interval = "With them", before * (1.0 - share), ""
    else:
        share, after = float(lead["shrink"]), float(lead["gap_after"])
        low, high = (percent(v) for v in lead["shrink_interval"])
        words, interval = "With it", f" ({low} to {high} on one more drive, at 90 % confidence)"
    change = "falls" if share > 0.0 else "does not fall: it goes"
    by = f", by {percent(share)}{interval}" if share > 0.0 else ""
    lines = [
        f"{words} in the twin the gap in {channel_name(channel)} {change} from {before:.2g} to {after:.2g} "
        f"{channel_unit(channel)}{by}, on stretches that the fit has not used."
    ]
    like = dict.fromkeys(effect_name(e) for c in named for e in c["indistinguishable_from"])
    if like:
        lines.append(f"These drives cannot distinguish it from: {listed(list(like))}.")
    return lines
