# SPDX-License-Identifier: Apache-2.0
"""From what strength on an effect of a tracked vehicle would show in the runs that there are.

An effect that these runs do not excite is not absent, it cannot be judged. Asked is the model: what an effect of some
strength changes of these runs, over noise, doubt and the model's own roughness, and of that the share that the model
is known to tell right. It shows where that is more than what counts as no gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.diagnosis.tracked_fit import Bench, Hypothesis, align, expect, moved
from suspension_twin.effects.tracked_effects import TRACKED_EFFECTS

__all__ = ["SHOWS", "Visible", "as_table", "changes_of", "visible_from", "words"]

SHOWS: Final = 0.75  # level of a change, in units of noise and doubt, from which on it shows
_STRONGEST: Final = 2.0  # spreads of an effect's parameter beyond which nobody would expect it
_STEPS: Final = (0.25, 0.5, 1.0)  # of the strongest
#: Share of the change that the model tells right where that is not nearly all: what of it is alike in the vehicle of 97
#: links, by the gains and correlations of ``benchmarks/tracked_changes.py``.
_TRUST: Final = {"track_tension": 0.2, "track_wear": 0.2}
_LEAST: Final = {"track_wear": 0.2}  # what is left of the stiffness of a track that still goes
_MAIN: Final = {"track_wear": "stiffness", "station_damper": "share", "station_bar": "sag"}


@dataclass(frozen=True)
class Visible:
    """``judged``: the strongest that one would expect shows. ``start``: the least strength of ``parameter`` that does,
    else the strongest; the worst place of those at which it shows at all."""

    effect: str
    parameter: str
    unit: str
    neutral: float
    start: float
    judged: bool


def visible_from(bench: Bench, name: str, hypotheses: Sequence[Hypothesis]) -> Visible:
    """Ask the model at some strengths of each variant of an effect, the rest of its parameters neutral."""
    effect = TRACKED_EFFECTS[name]
    parameters = {p.name: p for p in effect.parameters}
    main = parameters[_MAIN.get(name, next(p.name for p in effect.parameters if not p.choices))]
    down = name in ("track_wear", "station_damper")  # what is left of something
    farthest = main.neutral + (-1 if down else 1) * _STRONGEST * main.spread
    farthest = float(np.clip(farthest, _LEAST.get(name, main.low), main.high))
    starts: list[float] = []
    for h in hypotheses:
        fixed = {k.split(".")[1]: v for k, v in h.fixed}
        given = [{name: {**fixed, main.name: main.neutral + a * (farthest - main.neutral)}} for a in _STEPS]
        levels = _TRUST.get(name, 1.0) * changes_of(bench, given)
        if levels[-1] >= SHOWS:
            rising = np.maximum.accumulate([0.0, *levels]) + 1e-9 * np.arange(len(_STEPS) + 1)
            starts.append(float(np.interp(SHOWS, rising, (0.0, *_STEPS))))
    share = max(starts, default=1.0)
    away = float(f"{share * (farthest - main.neutral):.2g}")
    return Visible(name, main.name, main.unit, main.neutral, round(main.neutral + away, 9), bool(starts))


def words(found: Visible) -> str:
    """Such as "payload below 1600 kg" or "station damper with share above 0.5"."""
    what = found.effect.replace("_", " ")
    unit = f" {found.unit}" if found.unit else ""
    if not found.judged:
        return f"{what} cannot be judged (not even {found.parameter} {found.start:g}{unit})"
    if found.start < found.neutral or found.neutral:
        side = "above" if found.start < found.neutral else "below"
        return f"{what} with {found.parameter} {side} {found.start:g}{unit}"
    return f"{what} below {found.start:g}{unit}"


def as_table(found: Sequence[Visible]) -> dict[str, dict[str, float]]:
    """For the document: effect, parameter, least strength that shows."""
    return {v.effect: {v.parameter: v.start} for v in found if v.judged}


def changes_of(bench: Bench, givens: Sequence[dict[str, dict[str, float]]]) -> Floats:
    """For each set of effects the rms of what it changes of the runs, in units of noise and doubt, when the clocks
    have taken what they can; infinite where the vehicle cannot be or diverges."""
    none = np.zeros(0)
    asked = [
        Hypothesis(
            tuple(g),
            tuple((f"{e}.{k}", v) for e, own in g.items() for k, v in own.items()),
            (),
            none,
            none,
            none,
            none,
        )
        for g in ({}, *givens)
    ]
    usual, *told = expect(bench, [(h, none) for h in asked])
    assert usual is not None  # the bench would not be
    levels = []
    for changed in told:
        if changed is None:
            levels.append(np.inf)
            continue
        rest = []
        for run, scale, a, b in zip(bench.runs, bench.scale, usual, changed, strict=True):
            clock = align(b, a, run.t, scale)
            rest.append(((b - moved(a, run.t, *-clock)) / scale).ravel())
        levels.append(float(np.sqrt(np.mean(np.concatenate(rest) ** 2))))
    return np.array(levels)
