# SPDX-License-Identifier: Apache-2.0
"""What a parameter is called for people, and its unit."""

from __future__ import annotations

from suspension_twin.effects.registry import effect
from suspension_twin.vehicle.twin import Twin

__all__ = ["parameter_label", "parameter_unit"]

#: By a part of the key; what is not named here is a length.
_UNITS = {
    "force": "N",
    "mass": "kg",
    "unsprung_mass": "kg",
    "sprung_inertia": "kg m²",
    "vertical_stiffness": "N/m",
    "rpy": "rad",
    "latency": "s",
}


def parameter_label(twin: Twin, key: str) -> str:
    """``vehicle.front.damper_push.force.2`` as ``front damper push 0.35 m/s``."""
    curve, _, index = key.rpartition(".force.")
    if not curve:
        return key.removeprefix("vehicle.").removeprefix("effects.").replace("_", " ").replace(".", " ")
    _, axle, part = curve.split(".")
    x = getattr(getattr(twin.vehicle, axle), part).points[0][int(index)]
    return f"{axle} {part.replace('_', ' ')} {x:g} {'m' if part == 'spring' else 'm/s'}"


def parameter_unit(key: str) -> str:
    """``N`` for ``vehicle.front.damper_push.force.2``."""
    parts = key.split(".")
    if parts[0] == "effects":
        return effect(parts[1]).parameter(parts[2]).unit
    return next((unit for part, unit in _UNITS.items() if part in parts), "m")
