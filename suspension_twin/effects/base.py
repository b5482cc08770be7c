# SPDX-License-Identifier: Apache-2.0
"""What an effect is: something a model can be given that it did not have.

An effect is an object ``EFFECT`` in a file of its own in this folder, of the same name. It has an id, parameters
with their units, bounds and priors, signals that excite it and causes that it is easily confused with; how it
changes a model is its ``hook`` (see ``models.hooks``). With its severity at the neutral value an
effect changes no bit of any result. This module also hands on what the files of effects are written with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    RoadChange,
    SignalStage,
    Values,
)
from suspension_twin.models.rows import AXLE, CORNER, LANE, WIDTH, Fields, fma

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
    "Hook",
    "KernelTerms",
    "Parameter",
    "RoadChange",
    "SignalStage",
    "Tone",
    "Values",
    "Variant",
    "Where",
    "by_corner",
    "compiled",
    "fma",
    "inlined",
    "of_one_corner",
    "rows",
    "travel_rate",
]

Bools = NDArray[np.bool_]

Where = Literal["strut", "tyre", "track", "body", "sensor", "time", "road"]


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    ``low`` and ``high`` are physical bounds in ``unit``. ``neutral`` is what it is where the twin
    file says nothing. The prior is normal about ``typical`` with ``spread``, in the logarithm
    where ``log`` (then ``spread`` is a factor). ``choices`` lists the values of a discrete one. ``usual`` is how far
    from neutral it lies in sound vehicles, sensors and clocks. ``each_drive``: it differs from drive to drive, as the
    phase of a tone does; a twin file has that of one.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float
    typical: float
    spread: float
    doc: str
    log: bool = False
    choices: tuple[float, ...] = ()
    usual: float = 0.0
    each_drive: bool = False

    def check(self, effect: str, value: float) -> float:
        """``value`` as it is, or InputError that names the effect and the parameter."""
        if self.choices:
            good, must = value in self.choices, f"one of {', '.join(f'{c:g}' for c in self.choices)}"
        else:
            good = value == self.neutral or self.low <= value <= self.high
            must = f"between {self.low:g} and {self.high:g} {self.unit}".rstrip()
        if not good:
            raise InputError("twin", f"effects.{effect}.{self.name}", f"must be {must}, is {value:g}")
        return value


@dataclass(frozen=True)
class Tone:
    """A harmonic effect, whose angle is 2 pi (f t + n s) + phase at the time t and the travelled distance s.

    ``strength`` names the parameter that it is proportional to, ``phase`` that of the angle at the start.
    ``frequencies`` Hz of f and ``wavenumbers`` 1/m of n are ranges to search, f or n alone where the other's is (0, 0);
    ``parameters`` gives the parameters for f and n; the strength that is felt grows with that ``power`` of the speed.
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
    """What differs of an effect on one more model: parameters of the same names and meaning, and the hook where it is
    not the effect's own."""

    parameters: tuple[Parameter, ...]
    hook: Hook | None = None


@dataclass(frozen=True)
class Effect:
    """One effect. ``severity`` names the parameters that switch it off when all are neutral.

    ``excited_by`` lists signals that move it, ``confused_with`` causes with similar symptoms. ``usual_share`` is the
    severity that a sound vehicle has (a driver, a tank), as a share of its mass. ``order`` places it among the effects:
    terms of one stage of the kernel act in this order, and lists are in it. ``variants`` by model
    hold what is different on models that ``hook`` is not for. ``tone`` says what is harmonic in it. ``finding`` says in
    words what the effect with given parameters is, as the end of a sentence: "the front left damper has lost 40 % of
    its force".
    """

    id: str
    title: str
    where: Where
    doc: str
    parameters: tuple[Parameter, ...]
    severity: tuple[str, ...]
    excited_by: tuple[str, ...]
    confused_with: tuple[str, ...]
    hook: Hook
    usual_share: float = 0.0
    order: int = 1000
    variants: Mapping[str, Variant] = field(default_factory=dict)
    finding: Callable[[Mapping[str, float]], str] | None = None
    tone: Tone | None = None

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
