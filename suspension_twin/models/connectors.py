# SPDX-License-Identifier: Apache-2.0
"""What a vehicle model takes and gives, by name: what ``export`` writes into an FMU, and ``model: fmu`` reads.

Inputs in the order of ``models.one_lane``, outputs in that of ``models.observe``. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.corners import CORNERS

__all__ = ["INPUTS", "OUTPUTS", "Variable", "inputs_of"]


@dataclass(frozen=True)
class Variable:
    """One number."""

    name: str
    unit: str
    description: str


def _each(name: str, unit: str, description: str) -> tuple[Variable, ...]:
    """One for every corner."""
    return tuple(Variable(f"{name}_{c}", unit, f"{description}, {c.replace('_', ' ')}") for c in CORNERS)


def _axes(name: str, unit: str, description: str) -> tuple[Variable, ...]:
    """One for every axis."""
    return tuple(Variable(f"{name}_{axis}", unit, f"{description}, {axis}") for axis in "xyz")


_POINT = "of the point above the origin of base_link at the height of the centre of gravity"
#: Road heights, then ``one_lane.MOTION``.
INPUTS: Final = (
    *_each("road_height", "m", "Height of the road under the wheel"),
    Variable("longitudinal_acceleration", "m/s2", f"Acceleration ahead, {_POINT}"),
    Variable("lateral_acceleration", "m/s2", f"Acceleration to the left, {_POINT}"),
    Variable("yaw_rate", "rad/s", "Yaw rate, to the left positive"),
    Variable("yaw_acceleration", "rad/s2", "Derivative of the yaw rate"),
    Variable("speed", "m/s", "Speed ahead of the origin of base_link"),
    Variable("lateral_speed", "m/s", "Speed to the left of the origin of base_link"),
)
#: In the order of ``models.observe``.
OUTPUTS: Final = (
    Variable(
        "heave", "m", "Height of the sprung centre of gravity above its place at standstill on a road at 0"
    ),
    Variable("roll", "rad", "Roll, left side up positive"),
    Variable("pitch", "rad", "Pitch, nose down positive"),
    Variable("z", "m", "Height of the origin of base_link"),
    *_each("wheel_z", "m", "Height of the wheel's centre"),
    *_each("deflection", "m", "Compression of the spring from its free length"),
    *_each("deflection_rate", "m/s", "Rate of that compression"),
    *_each("tyre_force", "N", "Vertical force of the tyre"),
    *_axes("specific_force", "m/s2", "Specific force at the IMU in base_link axes"),
    *_axes("angular_rate", "rad/s", "Angular rate at the IMU in base_link axes"),
    Variable("vertical_acceleration", "m/s2", "Specific force z at the IMU without gravity"),
    Variable("heave_acceleration", "m/s2", "Second derivative of heave"),
    Variable("roll_acceleration", "rad/s2", "Second derivative of roll"),
    Variable("pitch_acceleration", "rad/s2", "Second derivative of pitch"),
    *_each("wheel_acceleration", "m/s2", "Second derivative of the wheel's height"),
)


def inputs_of(driven: Excitation, road: Floats | None = None) -> Floats:
    """(m, 10) INPUTS at every row of the road of an excitation, or of another ``road`` (m, 4) m seen instead."""
    count = np.maximum(driven.substeps, 1)
    at = np.arange(len(driven)).repeat(count)
    share = ((np.arange(at.size) - driven.first[at] + 1) / count[at])[:, None]
    before = np.where(driven.substeps[at] > 0, at - 1, at)
    planar = driven.motion[:, 1:7]
    mixed = planar[before] + share * (planar[at] - planar[before])
    # moments are linear in the square of the yaw rate
    square, yaw = planar[:, 2:3] ** 2, planar[at, 2:3]
    mixed[:, 2:3] = np.sign(yaw) * np.sqrt(square[before] + share * (square[at] - square[before]))
    return np.hstack([driven.road if road is None else road, mixed])
