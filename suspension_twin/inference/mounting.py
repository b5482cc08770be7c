# SPDX-License-Identifier: Apache-2.0
"""Mounting error, gain error and clock offset of the IMU: their estimates, and recordings corrected for them.

The fast part of the planar motion that excites the model comes from the IMU. A yaw of 10° of the sensor turns a sixth
of the braking into a lateral acceleration, and the simulated vehicle rolls under braking. A hypothesis with such an
error is therefore simulated with the motion of a corrected recording."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from suspension_twin.drive.types import Drive
from suspension_twin.models.hooks import ClockChange, load_hook
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.attitude import level_rpy, matrix_rpy, rpy_matrix
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Place, Twin

__all__ = [
    "ahead_of",
    "clock_offset_of",
    "gain_at_rest",
    "gain_of",
    "heading_off",
    "mounting_error",
    "regained",
    "turn_of",
    "turned",
    "without_clock_offset",
]

#: Low-pass below which the path gives the planar acceleration.
_SLOW = FilterSpec(2, 0.4)
_LEAST = 0.2  # m/s² rms of the slow acceleration needed for a yaw
_BIASED = 0.02  # of gravity: bias of an accelerometer without fault


def heading_off(signals: ImuSignals, trajectory: Trajectory) -> float:
    """Yaw in rad of an upright sensor against the vehicle, by its slow planar acceleration against that of the path; 0
    where the drive has too little of it."""
    pull = zero_phase(_SLOW, signals.rate_hz, signals.force - signals.gravity * signals.up)
    path = np.column_stack([trajectory.ax, trajectory.speed * trajectory.yaw_rate])
    path = zero_phase(_SLOW, signals.rate_hz, path)
    used = trajectory.valid & ~signals.standing
    pull, path = pull[used], path[used]
    if not used.any() or math.sqrt(float(np.mean(np.sum(path**2, axis=1)))) < _LEAST:
        return 0.0
    # rotation by least squares, in closed form
    along = float(np.sum(pull[:, :2] * path))
    across = float(np.sum(pull[:, 0] * path[:, 1] - pull[:, 1] * path[:, 0]))
    return math.atan2(across, along)


def mounting_error(signals: ImuSignals, trajectory: Trajectory) -> tuple[float, float, float]:
    """Roll, pitch (from gravity) and yaw (from the path) in rad of the mounting error of the sensor."""
    roll, pitch, _ = level_rpy(signals.up.mean(axis=0))
    level = rpy_matrix((roll, pitch, 0.0)).T
    upright = replace(signals, force=signals.force @ level, up=signals.up @ level)
    return roll, pitch, heading_off(upright, trajectory)


def ahead_of(turn: tuple[float, float, float]) -> tuple[float, float, float]:
    """The x axis of the vehicle in the axes of a sensor turned by roll, pitch and yaw in rad."""
    x, y, z = rpy_matrix(turn)[0]
    return float(x), float(y), float(z)


def gain_at_rest(signals: ImuSignals) -> float:
    """Gain of the accelerometer from its reading at standstill over gravity; 1 within the usual bias or without
    standstill."""
    if not signals.standing.any():
        return 1.0
    rest = signals.force[signals.standing].mean(axis=0) + signals.force_bias
    gain = float(np.linalg.norm(rest)) / signals.gravity
    return gain if abs(gain - 1.0) > _BIASED else 1.0


def gain_of(twin: Twin) -> float:
    """Gain of the accelerometer by the effects of the twin."""
    hooks = ((load_hook(e.id, twin.model), e.parameters) for e in twin.effects)
    return math.prod(hook.gained(parameters) for hook, parameters in hooks if hook.gained is not None)


def clock_offset_of(twin: Twin) -> float:
    """Clock offset in s of the sensor at the first stamp: ``imu.latency`` and what the twin's effects add to it."""
    change = ClockChange(np.zeros(1), np.zeros(1))
    for effect in twin.effects:
        hook = load_hook(effect.id, twin.model)
        if hook.clock is not None:
            hook.clock(change, {name: np.array([value]) for name, value in effect.parameters.items()})
    return float(change.delay[0]) + twin.imu.latency


def without_clock_offset(drive: Drive, late: float) -> Drive:
    """The drive with the clock offset ``late`` s taken out of the IMU stamps."""
    return replace(drive, imu=replace(drive.imu, t=drive.imu.t - late)) if late else drive


def regained(drive: Drive, gain: float) -> Drive:
    """The drive with the ``gain`` taken out of the specific force."""
    if gain == 1.0:
        return drive
    return replace(drive, imu=replace(drive.imu, specific_force=drive.imu.specific_force / gain))


def turn_of(twin: Twin) -> tuple[float, float, float] | None:
    """Roll, pitch and yaw in rad by which the twin's effects turn the sensor against the mounting in its file."""
    hooks = ((load_hook(e.id, twin.model), e.parameters) for e in twin.effects)
    return next((hook.turned(parameters) for hook, parameters in hooks if hook.turned is not None), None)


def turned(place: Place, rpy: tuple[float, float, float]) -> Place:
    """A sensor's ``place`` turned further, by roll, pitch and yaw in rad as ``turn_of`` has them."""
    return place.model_copy(update={"rpy": matrix_rpy(rpy_matrix(rpy) @ rpy_matrix(place.rpy))})
