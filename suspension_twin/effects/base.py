# SPDX-License-Identifier: Apache-2.0
"""Effects: changes that a model can be given beyond what vehicles usually have.

An effect is an object ``EFFECT`` in a file of its own in this folder, of the same name. It has an id, parameters
with their units, bounds and priors, signals that excite it and causes that it is easily confused with; how it
changes a model is its ``hook`` (see ``models.hooks``). With its severity at the neutral value an
effect changes no bit of any result. This module also hands on what the files of effects are written with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, inlined
from suspension_twin.errors import InputError
from suspension_twin.models import rows
from suspension_twin.models.corner import travel_rate
from suspension_twin.models.hooks import (
    ClockChange,
    CornerChange,
    Hook,
    KernelTerms,
    MarkerExcitation,
    RoadChange,
    SignalStage,
    Values,
)
from suspension_twin.models.parameters import Parameter, Prior
from suspension_twin.models.rows import AXLE, CORNER, LANE, WIDTH, Fields, fma
from suspension_twin.units import plain
from suspension_twin.vehicle.corners import AXLES, WHEELS

__all__ = [
    "AXLE",
    "CORNER",
    "LANE",
    "WIDTH",
    "Bools",
    "ClockChange",
    "CornerChange",
    "Effect",
    "Fields",
    "Floats",
    "Given",
    "Harmonic",
    "Hook",
    "KernelTerms",
    "MarkerExcitation",
    "Parameter",
    "Prior",
    "RoadChange",
    "SignalStage",
    "Values",
    "Variant",
    "Where",
    "axles",
    "by_corner",
    "changed",
    "compiled",
    "fma",
    "inlined",
    "listed",
    "more",
    "of_one_corner",
    "of_wheel",
    "plain",
    "rows",
    "travel_rate",
]

Bools = NDArray[np.bool_]
#: Parameters of one effect by name.
Given = Mapping[str, float]

Where = Literal["strut", "tyre", "track", "body", "sensor", "time", "road"]


@dataclass(frozen=True)
class Harmonic:
    """A harmonic effect, whose angle is 2 pi (f t + n s) + phase at the time t and the travelled distance s.

    ``strength`` names the parameter that it is proportional to, ``phase`` that of the angle at the start.
    ``frequencies`` Hz of f and ``wavenumbers`` 1/m of n are ranges to search, f or n alone where the other's is (0, 0);
    ``parameters`` gives the parameters for f and n; readings of the strength grow with that ``power`` of the speed.
    ``with_floor`` gives those of a tone of the frequency max(f, n v), where the effect can be one. ``corner`` names the
    parameter that says which wheel's way s is; empty for the car's.
    """

    strength: str
    phase: str
    frequencies: tuple[float, float]
    wavenumbers: tuple[float, float]
    parameters: Callable[[float, float], Mapping[str, float]]
    power: int = 0
    with_floor: Callable[[float, float], Mapping[str, float]] | None = None
    corner: str = ""


@dataclass(frozen=True)
class Variant:
    """Differences of an effect on one more model: parameters of the same names and meaning, and the hook where it is
    not the effect's own."""

    parameters: tuple[Parameter, ...]
    hook: Hook | None = None


@dataclass(frozen=True)
class Description:
    """An effect in words. ``excited_by`` lists signals that move it, ``confused_with`` causes with similar symptoms."""

    id: str
    title: str
    where: Where
    doc: str
    excited_by: tuple[str, ...]
    confused_with: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Effect(Description):
    """One effect. ``severity`` names the parameters that switch it off when all are neutral.

    ``usual_share`` is the severity that a sound vehicle has (a driver, a tank), as a share of its mass. ``order``
    places it among the effects: terms of one stage of the kernel act in this order, and lists are in it. ``variants``
    by model hold what is different on models that ``hook`` is not for. ``tone`` describes a harmonic effect.
    ``finding`` says in words what the effect with given parameters is, as the end of a sentence: "the front left
    damper has lost 40 % of its force".
    """

    parameters: tuple[Parameter, ...]
    severity: tuple[str, ...]
    hook: Hook
    usual_share: float = 0.0
    order: int = 1000
    variants: Mapping[str, Variant] = field(default_factory=dict)
    finding: Callable[[Mapping[str, float]], str] | None = None
    tone: Harmonic | None = None

    def __post_init__(self) -> None:
        neutral = {p.name: p.neutral for p in self.parameters}
        hook = replace(self.hook, neutral=neutral, severity=self.severity, check=self.values)
        object.__setattr__(self, "hook", hook)

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models that it applies to."""
        return (*self.hook.models, *self.variants)

    def on(self, model: str) -> Effect:
        """The effect as it is on a model: itself, or with that model's parameters and hook."""
        own = self.variants.get(model)
        if own is None:
            return self
        names = {p.name for p in own.parameters}
        return replace(
            self,
            parameters=own.parameters,
            severity=tuple(name for name in self.severity if name in names),
            hook=replace(own.hook or self.hook, models=(model,)),
            usual_share=0.0,
            variants={},
        )

    def parameter(self, name: str) -> Parameter:
        """The parameter called ``name``."""
        return next(p for p in self.parameters if p.name == name)

    def values(self, given: Mapping[str, float]) -> dict[str, float]:
        """All parameters: what is ``given``, else neutral. InputError names what is not one or out of bounds."""
        known = {p.name: p for p in self.parameters}
        for name in given:
            if name not in known:
                raise InputError(
                    "twin", f"effects.{self.id}.{name}", f"is not a parameter of it: {', '.join(known)}"
                )
        return {name: p.check(self.id, float(given.get(name, p.neutral))) for name, p in known.items()}


def of_one_corner(parameters: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    """Of the ``parameters`` of two axles those of one corner: the front's, and what both share."""
    return tuple(p for p in parameters if not p.name.startswith("rear"))


def by_corner(front: Floats, rear: Floats) -> Floats:
    """(4, L) the axles' values (L,) at each corner."""
    return np.stack([front, front, rear, rear])


def listed(words: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def axles(p: Given, suffix: str, unit: str) -> str:
    """``180 N at the front and 90 N at the rear``, of parameters ``front<suffix>`` and ``rear<suffix>``."""
    known = [(axle, p[f"{axle}{suffix}"]) for axle in AXLES if f"{axle}{suffix}" in p]
    there = [(axle, plain(value, unit)) for axle, value in known if value]
    written = {text for _, text in there}
    if len(known) == 1 or not there:  # a single corner, or neither
        return plain(known[0][1], unit)
    if len(there) == 2 and len(written) == 1:
        return f"{written.pop()} at front and rear"
    return listed([f"{text} at the {axle}" for axle, text in there])


def of_wheel(p: Given, part: str) -> str:
    """``the front left damper``."""
    return f"the {WHEELS[round(p['corner'])]} {part}" if "corner" in p else f"the {part}"


def changed(share: float, quantity: str) -> str:
    """``has lost 40 % of its force``."""
    verb = "has lost" if share < 0 else "has gained"
    return f"{verb} {plain(abs(share), '')} of its {quantity}"


def more(value: float, unit: str, above: str, below: str) -> str:
    """The size of a value and the word for its sign: ``60 cm ahead of``."""
    return f"{plain(abs(value), unit)} {above if value >= 0 else below}"
