# SPDX-License-Identifier: Apache-2.0
"""Effects as hypotheses: search coordinates of their parameters, and where a search starts.

A coordinate is the parameter's distance from its typical value in spreads of its prior, so that the
prior is a standard normal in each. A parameter that counts (``choices``) is no coordinate: every value
of it is a hypothesis of its own, a variant, and the best speaks for the effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter
from suspension_twin.effects.registry import EFFECTS
from suspension_twin.vehicle.twin import EffectSpec, Twin

__all__ = ["BASELINE", "NORMAL_PART", "SETTINGS", "Hypothesis", "combined", "decoys", "library"]

_WIDTH = 1.4  # of the starting points, in spreads of the prior
#: Where effects act that any size of is a matter of what was set, not of what a part can be like.
SETTINGS = ("time", "road", "sensor")
#: Nuisances that are in small what an effect is in large.
NORMAL_PART = {
    "sensor_tilt": ("tilt_roll", "tilt_pitch"),
    "time_offset": ("clock_offset",),
    "position_offset": ("map_position",),
}
#: Effects that the planar motion shows without any road under the wheels. What fixes at a few hertz can
#: hold says nothing of a sensor's bandwidth or range.
WITHOUT_ROAD = ("time_offset", "clock_drift", "sensor_tilt", "sensor_scale")
#: Shapes that many things have: coils, rubber, air, worn bushes, torn oil. One that explains the gap best says that no
#: effect with a name does, and what the unknown one looks like. Named only where they are asked for.
DECOYS = ("progressive_spring", "damper_play")


@dataclass(frozen=True)
class Hypothesis:
    """Some effects, possibly none, with the parameters that are searched and those that are fixed.

    ``fixed`` (key, value) holds choices; ``keys`` the dotted keys of the searched ones. ``around`` are the
    coordinates about which the prior lies, where something is off by far more than what is typical; empty for zeros.
    ``everywhere`` names those of its effects that the vehicle has on the drives from before as well. ``model``: whose
    variants of the effects these are.
    """

    effects: tuple[str, ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()
    around: tuple[float, ...] = ()
    everywhere: tuple[str, ...] = ()
    model: str = ""

    def effect(self, name: str) -> Effect:
        """One of its effects, as it is on the model."""
        return EFFECTS[name].on(self.model)

    @property
    def name(self) -> str:
        return " + ".join(self.effects) or "none"

    @property
    def searched(self) -> tuple[tuple[str, Parameter], ...]:
        """Dotted key and description of every searched parameter."""
        held = dict(self.fixed)
        return tuple(
            (f"effects.{e}.{p.name}", p)
            for e in self.effects
            for p in self.effect(e).parameters
            if f"effects.{e}.{p.name}" not in held
        )

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(key for key, _ in self.searched)

    def __len__(self) -> int:
        return len(self.searched)

    def centre(self) -> Floats:
        """(k,) coordinates about which the prior lies."""
        return np.array(self.around) if self.around else np.zeros(len(self))

    def without(self, effect: str) -> Hypothesis:
        """The others of its effects."""
        return self._with(tuple(e for e in self.effects if e != effect))

    def before(self) -> Hypothesis:
        """What of it there is on the drives from before."""
        return self._with(self.everywhere)

    def always(self) -> Hypothesis:
        """The same as traits of the vehicle, on all drives."""
        return replace(self, everywhere=self.effects)

    def _with(self, kept: tuple[str, ...]) -> Hypothesis:
        return Hypothesis(
            kept,
            tuple(pair for pair in self.fixed if pair[0].split(".")[1] in kept),
            tuple(u for i, u in enumerate(self.around) if self._owner(i) in kept),
            tuple(e for e in self.everywhere if e in kept),
            self.model,
        )

    def rows(self, part: Hypothesis) -> list[int]:
        """Which of its coordinates are those of ``part``."""
        return [self.keys.index(key) for key in part.keys]

    def bounds(self) -> tuple[Floats, Floats]:
        """(k,) lowest and highest coordinates."""
        low, high = [], []
        for _, p in self.searched:
            if p.log:
                ends = [np.log(v / p.typical) / np.log(p.spread) for v in (p.low, p.high)]
            else:
                ends = [(v - p.typical) / p.spread for v in (p.low, p.high)]
            low.append(ends[0])
            high.append(ends[1])
        return np.array(low), np.array(high)

    def values(self, u: Floats) -> Floats:
        """(k, L) parameters for coordinates (k, L), inside their bounds."""
        out = np.empty_like(u, dtype=float)
        for i, (_, p) in enumerate(self.searched):
            plain = p.typical * p.spread ** u[i] if p.log else p.typical + p.spread * u[i]
            out[i] = np.clip(plain, p.low, p.high)
        return out

    def neutral(self) -> Floats:
        """(k,) coordinates of a severity of zero; others at their typical value."""
        low, high = self.bounds()
        at = np.zeros(len(self))
        for i, (_, p) in enumerate(self.searched):
            if p.name in self.effect(self._owner(i)).severity and not p.log:
                at[i] = (p.neutral - p.typical) / p.spread
        return np.clip(at, low, high)

    def slightest(self) -> Floats:
        """(k, n) where the effect may be next to none: severities of zero, and those that go by factors at either
        end: a low-pass is least at its highest cutoff, a contact patch at its shortest."""
        low, high = self.bounds()
        ends = np.repeat(self.neutral()[:, None], 2, axis=1)
        for i, (_, p) in enumerate(self.searched):
            if p.name in self.effect(self._owner(i)).severity and p.log:
                ends[i] = low[i], high[i]
        return np.unique(ends, axis=1)

    @property
    def touches(self) -> bool:
        """Whether an effect acts only past a distance."""
        return any(p.log and p.unit == "m" and "clearance" in p.name for _, p in self.searched)

    def early(self, far: float) -> Floats:
        """(k,) an effect that acts early and strongly, ``far`` spreads of its prior from what is typical."""
        low, high = self.bounds()
        at = self.neutral()
        for i, (_, p) in enumerate(self.searched):
            if p.name in self.effect(self._owner(i)).severity and not p.log:
                at[i] += far
            elif p.log and p.unit == "m":
                at[i] = -far
        return np.clip(at, low, high)

    def scan(self, count: int) -> tuple[int, Floats] | None:
        """For an effect that resonates: the row of its strength, and ``count`` points (k, count) with resonances all
        over their bounds; None for any other effect."""
        names = [p.name for _, p in self.searched]
        severe = [i for i, n in enumerate(names) if n in self.effect(self._owner(i)).severity]
        if "frequency" not in names or len(severe) != 1:
            return None
        low, high = self.bounds()
        tone, row = names.index("frequency"), severe[0]
        points = np.zeros((len(self), count))
        points[tone] = np.linspace(low[tone], high[tone], count)
        points[row] = points[row] if self.neutral()[row] != 0.0 else 1.0
        return row, np.asarray(np.clip(points, low[:, None], high[:, None]))

    def _owner(self, index: int) -> str:
        return self.keys[index].split(".")[1]

    def spec(self, values: Floats) -> tuple[EffectSpec, ...]:
        """The effects as a twin file has them, for values (k,)."""
        known = {**dict(self.fixed), **dict(zip(self.keys, (float(v) for v in values), strict=True))}
        return tuple(
            EffectSpec(
                id=e,
                parameters={p.name: known[f"effects.{e}.{p.name}"] for p in self.effect(e).parameters},
            )
            for e in self.effects
        )

    def twin(self, base: Twin) -> Twin:
        """``base`` with the effects in its file, in place of its own such, so that candidates can differ in them."""
        if not self.effects:
            return base
        specs = self.spec(self.values(self.neutral()[:, None])[:, 0])
        others = [e for e in base.effects if e.id not in self.effects]
        return base.model_copy(update={"effects": (*others, *specs)})

    def at(self, spec: EffectSpec) -> Floats:
        """(k,) coordinates of an effect as a twin file has it."""
        known = [(p, spec.parameters[p.name]) for _, p in self.searched]
        return np.array(
            [
                np.log(v / p.typical) / np.log(p.spread) if p.log else (v - p.typical) / p.spread
                for p, v in known
            ]
        )

    def starts(self, count: int, seed: int) -> Floats:
        """(k, count) coordinates spread over the prior, severities away from zero and from small to large."""
        if not len(self):
            return np.zeros((0, 1))
        low, high = self.bounds()
        cube = qmc.Sobol(len(self), scramble=True, seed=seed).random(count).T
        normal = _WIDTH * ndtri(np.clip(cube, 1e-3, 1 - 1e-3))
        at = self.neutral()
        out = normal.copy()
        for i, (_, p) in enumerate(self.searched):
            if p.name in self.effect(self._owner(i)).severity and not p.log and low[i] >= at[i] - 1e-12:
                out[i] = at[i] + np.abs(normal[i])
        return np.clip(out, low[:, None], high[:, None])


BASELINE = Hypothesis()


def variants(effect: Effect, twin: Twin) -> list[Hypothesis]:
    """The hypotheses that an effect stands for on a twin: one, or one for each combination of its choices that the
    twin can have."""
    counting = [p for p in effect.parameters if p.choices]
    keys = [f"effects.{effect.id}.{p.name}" for p in counting]
    possible = effect.hook.possible or (lambda twin, given: True)
    return [
        Hypothesis((effect.id,), tuple(zip(keys, chosen, strict=True)), model=twin.model)
        for chosen in product(*(p.choices for p in counting))
        if possible(twin, {p.name: c for p, c in zip(counting, chosen, strict=True)})
    ]


def library(twin: Twin, excited: bool, only: Sequence[str] = ()) -> dict[str, list[Hypothesis]]:
    """The hypotheses of every effect that this twin can be given, by id; ``excited``: what excites it is known.

    An effect that the twin already has is its own: it is not offered twice.
    """
    return _offered(twin, excited, only or [name for name in EFFECTS if name not in DECOYS])


def decoys(twin: Twin, excited: bool, only: Sequence[str] = ()) -> dict[str, list[Hypothesis]]:
    """Those of ``DECOYS`` that this twin can be given and ``only`` does not name."""
    return _offered(twin, excited, [name for name in DECOYS if name not in only])


def _offered(twin: Twin, excited: bool, names: Sequence[str]) -> dict[str, list[Hypothesis]]:
    own = {e.id for e in twin.effects}
    return {
        name: variants(effect.on(twin.model), twin)
        for name, effect in EFFECTS.items()
        if twin.model in effect.models
        and name not in own
        and (excited or name in WITHOUT_ROAD)
        and name in names
    }


def combined(*parts: Hypothesis) -> Hypothesis:
    """Several effects at once."""
    around = tuple(float(u) for p in parts for u in p.centre()) if any(p.around for p in parts) else ()
    return Hypothesis(
        tuple(e for p in parts for e in p.effects),
        tuple(pair for p in parts for pair in p.fixed),
        around,
        tuple(e for p in parts for e in p.everywhere),
        parts[0].model,
    )
