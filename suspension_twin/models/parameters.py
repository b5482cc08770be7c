# SPDX-License-Identifier: Apache-2.0
"""The numbers of a twin: what is known of each before a drive, all as one vector, and many candidates side by side.

A row has the dotted key that it has in the twin file: ``vehicle.mass``,
``vehicle.front.spring.force.2``, ``imu.position.0``, ``effects.strut_friction.front_force``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.models.hooks import Hook, Values, load_hook
from suspension_twin.models.parts import OPTIONAL_PARTS, Part
from suspension_twin.models.registry import model_of
from suspension_twin.vehicle.twin import Twin, value_at

__all__ = ["Parameter", "ParameterLayout", "Prior", "has_number", "lanes", "layout", "pack", "twin_value"]


@dataclass(frozen=True)
class Prior:
    """Normal prior of a parameter about ``typical``.

    ``spread`` is its standard deviation, in the parameter's unit ("linear") or of its logarithm ("log"), or the factor
    of one standard deviation ("factor"). ``usual`` is how far from neutral the parameter lies in sound vehicles,
    sensors and clocks.
    """

    typical: float
    spread: float
    scale: Literal["linear", "log", "factor"] = "linear"
    usual: float = 0.0

    @property
    def log(self) -> bool:
        """Whether it is normal in the logarithm."""
        return self.scale != "linear"

    @property
    def deviation(self) -> float:
        """Standard deviation of the parameter or, where ``log``, of its logarithm."""
        return float(np.log(self.spread)) if self.scale == "factor" else self.spread


@dataclass(frozen=True)
class Parameter:
    """One number that can be free: of a vehicle, a sensor, a clock, a map or an effect.

    ``key`` is its dotted key; an effect declares its own by name, without ``effects.<id>.`` before it. ``bounds`` are
    physical, in ``unit``. ``neutral`` is the value of an effect's parameter where the twin file says nothing.
    ``choices`` lists the values of a discrete one. ``each_drive``: it differs from drive to drive, as the phase of a
    tone does; a twin file has that of one. A point of a characteristic has a prior of the logarithm of the slope of the
    segment before it.
    """

    key: str
    bounds: tuple[float, float]
    prior: Prior
    unit: str = ""
    doc: str = ""
    neutral: float = 0.0
    choices: tuple[float, ...] = ()
    each_drive: bool = False

    @property
    def name(self) -> str:
        """The last part of the key."""
        return self.key.rpartition(".")[2]

    @property
    def lower(self) -> float:
        """Lower bound."""
        return self.bounds[0]

    @property
    def upper(self) -> float:
        """Upper bound."""
        return self.bounds[1]

    def check(self, effect: str, value: float) -> float:
        """``value`` as it is, or InputError that names the effect and the parameter."""
        if self.choices:
            good, must = value in self.choices, f"one of {', '.join(f'{c:g}' for c in self.choices)}"
        else:
            good = value == self.neutral or self.lower <= value <= self.upper
            must = f"between {self.lower:g} and {self.upper:g} {self.unit}".rstrip()
        if not good:
            raise InputError("twin", f"effects.{effect}.{self.name}", f"must be {must}, is {value:g}")
        return value

    def coordinate(self, value: float) -> float:
        """Search coordinate of a value: its distance from typical in standard deviations of the prior."""
        prior = self.prior
        away = np.log(value / prior.typical) if prior.log else value - prior.typical
        return float(away / prior.deviation)

    def value(self, coordinate: Floats) -> Floats:
        """Values for search coordinates (n,), inside the bounds."""
        prior = self.prior
        if prior.log:
            factor = prior.spread if prior.scale == "factor" else np.exp(prior.spread)
            plain = prior.typical * factor**coordinate
        else:
            plain = prior.typical + prior.spread * coordinate
        return np.asarray(np.clip(plain, *self.bounds))

    def about(self, key: str, value: float, bounds: tuple[float, float] | None = None) -> Parameter:
        """The parameter of a twin, with its prior about the twin's ``value``; other ``bounds`` where they are given.

        One that is searched in the logarithm has to be above zero: it starts from what is typical if ``value`` is not.
        """
        low, high = bounds or self.bounds
        prior = self.prior if low > 0 else replace(self.prior, scale="linear")
        start = prior.typical if prior.log and value <= 0 else value
        return replace(
            self, key=key, bounds=(low, high), prior=replace(prior, typical=min(max(start, low), high))
        )


@dataclass(frozen=True)
class ParameterLayout:
    """Keys of the rows of a parameter vector, the hooks of the effects and optional parts in it by id, the ``parts``
    among them, and the sensor's mounting: roll, pitch and yaw in rad."""

    names: tuple[str, ...]
    model: str = "full_car"
    hooks: Mapping[str, Hook] = field(default_factory=dict)
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    parts: Mapping[str, Part] = field(default_factory=dict)

    @cached_property
    def index(self) -> dict[str, int]:
        """Row of each dotted key."""
        return {name: row for row, name in enumerate(self.names)}

    def rows(self, prefix: str) -> list[int]:
        """Rows of ``prefix.0``, ``prefix.1``, … in order."""
        found: list[int] = []
        while (row := self.index.get(f"{prefix}.{len(found)}")) is not None:
            found.append(row)
        return found

    def values(self, name: str, numbers: Mapping[str, Floats]) -> Values:
        """Parameters (L,) of the effect or optional part ``name``, of both together where the twin has both.

        ``numbers`` (L,) by dotted key; what they do not hold is neutral.
        """
        neutral = self.hooks[name].neutral
        count = next(iter(numbers.values())).size
        effect = {
            key: numbers[f"effects.{name}.{key}"]
            if f"effects.{name}.{key}" in numbers
            else np.full(count, value)
            for key, value in neutral.items()
        }
        part = self.parts.get(name)
        return effect if part is None else part.values(numbers, effect)


def layout(twin: Twin) -> ParameterLayout:
    """The layout of this twin's parameter vector."""
    model = model_of(twin)
    names = list(model.numbers(twin))
    known = set(names)
    parts = {name: part for name, part in OPTIONAL_PARTS.items() if not known.isdisjoint(part.keys.values())}
    hooks = {name: part.hook(twin.model) for name, part in parts.items()}
    for name, hook in hooks.items():
        if twin.model not in hook.models:
            key = next(key for key in parts[name].keys.values() if key in known)
            raise InputError("twin", key, f"the model {twin.model} has no such part")
    for effect in twin.effects:
        hook = hooks[effect.id] = load_hook(effect.id, twin.model)
        if twin.model not in hook.models and not (model.opaque and hook.outside):
            why = ", which has equations of its own" if model.opaque else ""
            raise InputError(
                "twin", "effects", f"{effect.id} is not an effect of the model {twin.model}{why}"
            )
        if any(model not in load_hook(effect.id, model).models for model in twin.acted_on[1:]):
            raise InputError("twin", "effects", f"{effect.id} does not act where the wheel's motion is given")
        for name in effect.parameters:
            if name not in hook.neutral:
                own = ", ".join(hook.neutral)
                raise InputError("twin", f"effects.{effect.id}.{name}", f"is not a parameter of it: {own}")
        if hook.check is not None:
            hook.check(effect.parameters)
        names += [f"effects.{effect.id}.{name}" for name in hook.neutral]
    return ParameterLayout(tuple(names), twin.model, hooks, twin.imu.rpy, parts)


def _of_effects(twin: Twin) -> dict[str, float]:
    """Parameters of the twin's effects by their dotted keys: as the file gives them, else neutral."""
    return {
        f"effects.{effect.id}.{name}": float(value)
        for effect in twin.effects
        for name, value in {**load_hook(effect.id, twin.model).neutral, **effect.parameters}.items()
    }


def twin_value(twin: Twin, key: str) -> Any:
    """The value behind a dotted key of the twin file, neutral for a parameter that an effect does not give; raises
    InputError that names the key."""
    if not key.startswith("effects."):
        return value_at(twin, key, "parameters")
    known = _of_effects(twin)
    if key not in known:
        raise InputError("parameters", key, "the twin has no such effect parameter")
    return known[key]


def has_number(twin: Twin, key: str) -> bool:
    """Whether the twin has a number of that key."""
    return key in layout(twin).index


def pack(twin: Twin) -> Floats:
    """(P,) the twin's numbers in the order of ``layout(twin).names``, SI units."""
    names, effects = layout(twin).names, _of_effects(twin)
    return np.array(
        [effects[key] if key in effects else value_at(twin, key) for key in names], dtype=np.float64
    )


def lanes(twin: Twin, keys: Sequence[str], values: Floats) -> Floats:
    """(P, L) candidates that differ from the twin in ``keys``, one row of ``values`` (L, k) each; they cannot be
    written to.

    Raises InputError for a key that the twin has not, or that a candidate cannot change.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(keys):
        raise InputError("candidates", f"values must be (L, {len(keys)}), are {values.shape}")
    index, fixed = layout(twin).index, model_of(twin).fixed
    rows = []
    for key in keys:
        if key in fixed:
            raise InputError("twin", key, "cannot differ between candidates: the road was looked up for it")
        if key not in index:
            raise InputError("twin", key, "is not a number of this twin that can be changed")
        rows.append(index[key])
    out = np.repeat(pack(twin)[:, None], values.shape[0], axis=1)
    out[rows] = values.T
    out.flags.writeable = False
    return out
