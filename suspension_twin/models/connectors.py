# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a vehicle model by name, and how the outputs follow from the states of a kernel.

``export`` writes them into an FMU, and ``model: fmu`` reads them from one. SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.models import rows
from suspension_twin.models.rows import ARM_X, ARM_Y, DAMPER, SPRUNG, STATIC, WIDTH, sin_cos
from suspension_twin.models.types import Excitation
from suspension_twin.vehicle.corners import CORNERS

__all__ = [
    "COLUMNS",
    "INPUTS",
    "OBSERVED",
    "OUTPUTS",
    "Variable",
    "inputs_of",
    "motion_between",
    "observe",
    "see",
]


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
#: Road heights, then the columns of ``Excitation.motion`` after the step.
INPUTS: Final = (
    *_each("road_height", "m", "Height of the road under the wheel"),
    Variable("longitudinal_acceleration", "m/s2", f"Acceleration ahead, {_POINT}"),
    Variable("lateral_acceleration", "m/s2", f"Acceleration to the left, {_POINT}"),
    Variable("yaw_rate", "rad/s", "Yaw rate, to the left positive"),
    Variable("yaw_acceleration", "rad/s2", "Derivative of the yaw rate"),
    Variable("speed", "m/s", "Speed ahead of the origin of base_link"),
    Variable("lateral_speed", "m/s", "Speed to the left of the origin of base_link"),
)
#: In the order of ``models.connectors``.
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


def motion_between(before: Floats, after: Floats, share: Floats) -> Floats:
    """(m, 6) planar motion at a ``share`` (m, 1) of intervals with these motions (m or 1, 6) at their ends."""
    out: Floats = before + share * (after - before)
    # moments are linear in the square of the yaw rate
    square = before[:, 2:3] ** 2
    square = square + share * (after[:, 2:3] ** 2 - square)
    out[:, 2:3] = np.sign(after[:, 2:3]) * np.sqrt(square)
    return out


def inputs_of(driven: Excitation, road: Floats | None = None) -> Floats:
    """(m, 10) INPUTS at every row of the road of an excitation, or of another ``road`` (m, 4) m seen instead."""
    count = np.maximum(driven.substeps, 1)
    at = np.arange(len(driven)).repeat(count)
    share = ((np.arange(at.size) - driven.first[at] + 1) / count[at])[:, None]
    before = np.where(driven.substeps[at] > 0, at - 1, at)
    planar = driven.motion[:, 1:7]
    mixed = motion_between(planar[before], planar[at], share)
    return np.hstack([driven.road if road is None else road, mixed])


#: Columns of what ``observe`` fills, by the name they have in Response and LiveState.
COLUMNS: dict[str, slice | int] = {
    "heave": 0,
    "roll": 1,
    "pitch": 2,
    "z": 3,
    "wheel_z": slice(4, 8),
    "deflection": slice(8, 12),
    "deflection_rate": slice(12, 16),
    "tyre_force": slice(16, 20),
    "force": slice(20, 23),
    "rate": slice(23, 26),
    "vertical_acceleration": 26,
    "acceleration": slice(27, 34),
}
OBSERVED = 34


@compiled
def observe(states: Floats, signals: Floats, values: Floats, radius: float, rigid: bool, out: Floats) -> None:
    """Fill ``out`` (n, OBSERVED) from one lane, the first of its block.

    ``states`` (n, STATES, lanes) and ``signals`` (n, 7, lanes) as the kernel wrote them, ``values``
    (rows,) the lane's constants, ``radius`` m of the tyre. Where the body is not ``rigid`` its corners need not lie in
    a plane: the states hold the springs' compressions themselves.
    """
    sx, sy, sz = values[SPRUNG], values[SPRUNG + 1], values[SPRUNG + 2]
    for k in range(states.shape[0]):
        state = states[k, :, 0]
        heave, roll, pitch = state[rows.HEAVE], state[rows.ROLL], state[rows.PITCH]
        out[k, 0], out[k, 1], out[k, 2] = heave, roll, pitch
        # base_link's origin hangs under the sprung centre of gravity of the turned body
        above = math.cos(pitch) * (math.sin(roll) * sy + math.cos(roll) * sz) - math.sin(pitch) * sx
        out[k, 3] = heave + sz - above
        for i in range(4):
            x, y = values[ARM_X + i // 2], values[ARM_Y + i]
            wheel = state[rows.WHEEL + i]
            out[k, 4 + i] = wheel - values[STATIC + i] + radius if rigid else wheel + radius
            body = heave + y * roll - x * pitch
            body_rate = state[rows.HEAVE_RATE] + y * state[rows.ROLL_RATE] - x * state[rows.PITCH_RATE]
            out[k, 8 + i] = wheel - body if rigid else values[STATIC + i] + state[DAMPER + i]
            out[k, 12 + i] = (
                state[rows.WHEEL_RATE + i] - body_rate if rigid else state[rows.DEFLECTION_RATE + i]
            )
            out[k, 16 + i] = state[rows.CONTACT + i]
        for q in range(7):
            out[k, 20 + q] = signals[k, q, 0]
            out[k, 27 + q] = state[rows.ACCELERATION + q]


def see(w: Floats, out: Floats) -> None:
    """Pose of the body, tyre forces, readings of the sensor and accelerations of the body, of a lane by itself."""
    heave, roll, pitch = w[rows.HEAVE * WIDTH], w[rows.ROLL * WIDTH], w[rows.PITCH * WIDTH]
    sx, sy, sz = w[rows.SPRUNG * WIDTH], w[(rows.SPRUNG + 1) * WIDTH], w[(rows.SPRUNG + 2) * WIDTH]
    sr, cr = sin_cos(roll)
    sp, cp = sin_cos(pitch)
    out[0], out[1], out[2] = heave, roll, pitch
    out[3] = heave + sz - (cp * (sr * sy + cr * sz) - sp * sx)
    for c in range(4):
        out[16 + c] = w[(rows.CONTACT + c) * WIDTH]
    for q in range(7):
        out[20 + q] = w[(rows.SIGNAL + q) * WIDTH]
    for q in range(3):
        out[27 + q] = w[(rows.ACCELERATION + q) * WIDTH]
