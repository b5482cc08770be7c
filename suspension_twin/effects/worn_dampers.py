# SPDX-License-Identifier: Apache-2.0
"""Dampers of an axle that have lost a share of their force."""

from __future__ import annotations

from suspension_twin.effects.base import (
    Effect,
    Floats,
    Hook,
    Parameter,
    Prior,
    Values,
    Variant,
    axles,
    of_one_corner,
)

_loss = ((0.0, 0.98), Prior(0.0, 0.3, usual=0.1), "")
_PARAMETERS = (
    Parameter("front", *_loss, "share of the front dampers' force that is lost"),
    Parameter("rear", *_loss, "the same at the rear"),
)


def _weaken(numbers: dict[str, Floats], prefix: str, loss: Floats) -> None:
    force = {key: values for key, values in numbers.items() if key.startswith(prefix) and ".force." in key}
    numbers.update({key: values * (1.0 - loss) for key, values in force.items()})


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    _weaken(numbers, "vehicle.front.damper_", p["front"])
    _weaken(numbers, "vehicle.rear.damper_", p["rear"])


def _corner(numbers: dict[str, Floats], p: Values) -> None:
    _weaken(numbers, "vehicle.damper_", p["front"])


EFFECT = Effect(
    id="worn_dampers",
    title="worn dampers",
    where="strut",
    doc="Both dampers of an axle have (1 - loss) times the force of their characteristic, in push and in pull: oil "
    "that has been lost, valves that have worn.",
    parameters=_PARAMETERS,
    order=95,
    severity=("front", "rear"),
    excited_by=("body resonance, 1 to 2 Hz", "wheel hop", "bumps at speed"),
    confused_with=("the whole damper curve", "damper_fade", "corner_damper", "semi_active_damper"),
    hook=Hook(vehicle=_vehicle, models=("full_car", "msd")),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS), Hook(vehicle=_corner))},
    finding=lambda p: f"the dampers are worn and have lost {axles(p, '', '')} of their force",
)
