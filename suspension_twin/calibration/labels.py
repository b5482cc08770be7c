# SPDX-License-Identifier: Apache-2.0
"""Names of parameters for people, and their units."""

from __future__ import annotations

from suspension_twin.effects.registry import effect
from suspension_twin.inference.priors import prior_of
from suspension_twin.models.parameters import twin_value
from suspension_twin.vehicle.twin import Twin

__all__ = ["parameter_label", "parameter_unit"]

#: By the end of the key, the first that fits; a number that is not named here is a length.
_UNITS = {
    "force": "N",
    "velocity": "m/s",
    "mass": "kg",
    "unsprung_mass": "kg",
    "sprung_mass": "kg",
    "link_mass": "kg",
    "sprung_inertia.roll": "kg m²",
    "sprung_inertia.pitch": "kg m²",
    "vertical_stiffness": "N/m",
    "rpy": "rad",
    "latency": "s",
    "track.links": "",
    "track.stiffness": "N/m",
    "track.damping": "N s/m",
    "track.bending_stiffness": "N m/rad",
    "track.bending_damping": "N m s/rad",
    "idler.setting": "mm",
    "idler.taut_at": "mm",
    "wheel.rubber": "N/m²",
    "wheel.rubber_damping": "N s/m²",
    "arm.stiffness": "N m/rad",
    "arm.stop_stiffness": "N m/rad",
    "arm.standing_angle": "rad",
    "arm.free_angle": "rad",
    "arm.jounce_stop": "rad",
    "arm.rebound_stop": "rad",
    "stations.damping": "N m s/rad",
    "stations.sag": "rad",
    "ground.stiffness": "N/m²",
    "ground.damping": "N s/m²",
    "driver.gain": "",
    "driver.reset": "1/s",
    "driver.droop": "m/s per N",
    "markers.A": "mm",
    "markers.B": "mm",
    "markers.C": "mm",
}
#: Parameters of an FMU: it alone knows their units.
_OPAQUE = "fmu.parameters."


def parameter_label(twin: Twin, key: str) -> str:
    """``vehicle.front.damper_push.force.2`` as ``front damper push 0.35 m/s``."""
    curve, _, index = key.rpartition(".force.")
    if key.startswith(_OPAQUE):
        return key.removeprefix(_OPAQUE).removesuffix(".value").replace("_", " ")
    if not curve:
        return key.removeprefix("vehicle.").removeprefix("effects.").replace("_", " ").replace(".", " ")
    x = twin_value(twin, curve).points[0][int(index)]
    name = curve.removeprefix("vehicle.").replace("_", " ").replace(".", " ")
    return f"{name} {x:g} {'m' if curve.endswith('spring') else 'm/s'}"


def parameter_unit(key: str) -> str:
    """``N`` for ``vehicle.front.damper_push.force.2``."""
    parts = key.split(".")
    if key.startswith(_OPAQUE):
        return ""
    if parts[0] == "effects":
        return effect(parts[1]).parameter(parts[2]).unit
    if (prior := prior_of(key)) is not None:
        return prior.unit
    named = "." + ".".join(part for part in parts if not part.isdigit())
    return next((unit for end, unit in _UNITS.items() if named.endswith(f".{end}")), "m")
