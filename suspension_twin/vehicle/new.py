# SPDX-License-Identifier: Apache-2.0
"""A first twin file from a few numbers: a ready twin, resized."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Twin, parse_twin

__all__ = ["Sizes", "resized"]

#: Characteristics whose forces grow with the mass.
_FORCES = ("spring", "damper_push", "damper_pull")


@dataclass(frozen=True)
class Sizes:
    """A car in numbers: ``mass`` kg with everybody on board; the others m; ``imu`` and ``gps`` in ``base_link``."""

    name: str
    mass: float
    wheelbase: float
    front_track: float
    rear_track: float
    imu: tuple[float, float, float]
    gps: tuple[float, float, float]


def resized(base: Twin, sizes: Sizes) -> Twin:
    """The twin of a car of these sizes, from that of another car.

    Forces, stiffnesses and wheel masses are scaled by the mass, so that natural frequencies and damping ratios stay;
    inertias by mass and the square of length or width. A starting point for a calibration, not a result.

    Raises InputError that names the key for sizes that no car has.
    """
    data: dict[str, Any] = base.model_dump(mode="python")
    vehicle = data["vehicle"]
    old = base.vehicle
    heavier, longer = sizes.mass / old.mass, sizes.wheelbase / old.wheelbase
    wider = (sizes.front_track + sizes.rear_track) / (old.front_track + old.rear_track)
    vehicle |= {
        "name": sizes.name,
        "mass": sizes.mass,
        "wheelbase": sizes.wheelbase,
        "front_track": sizes.front_track,
        "rear_track": sizes.rear_track,
        "cog": (round(old.cog[0] * longer, 3), 0.0, old.cog[2]),
    }
    inertia = old.sprung_inertia
    vehicle["sprung_inertia"] = {
        "roll": _rounded(inertia.roll * heavier * wider**2),
        "pitch": _rounded(inertia.pitch * heavier * longer**2),
    }
    vehicle["tyre"]["vertical_stiffness"] = _rounded(old.tyre.vertical_stiffness * heavier)
    for axle in AXLES:
        part = vehicle[axle]
        part["unsprung_mass"] = _rounded(part["unsprung_mass"] * heavier)
        for curve in _FORCES:
            part[curve]["force"] = [_rounded(force * heavier) for force in part[curve]["force"]]
    data["imu"]["position"], data["gps"]["position"] = sizes.imu, sizes.gps
    return parse_twin(data, source=sizes.name)


def _rounded(value: float) -> float:
    """To four digits: more would pretend to be known."""
    return float(f"{value:.4g}")
