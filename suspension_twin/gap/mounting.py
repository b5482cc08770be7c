# SPDX-License-Identifier: Apache-2.0
"""A sensor that is turned on its mount, reads too much or is late, and by how much a drive shows.

What shakes a vehicle quickly its IMU alone knows. One that is turned by ten degrees takes a sixth of the braking for
a push to the side, and a vehicle that is simulated with that push rolls when its driver brakes. So where the mount is
to blame, the recording is read once more as that of a sensor that stands so, for the motion that drives the model.
The same goes for one that reads a fifth too much: at rest it reads a fifth more than gravity; and for one that is half
a second late.
"""

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
    "gain_at_rest",
    "gain_of",
    "heading_off",
    "late_of",
    "punctual",
    "regained",
    "turn_of",
    "turn_seen",
    "turned",
]

#: Below this the path alone says how the vehicle is accelerated, Hz.
_SLOW = FilterSpec(2, 0.4)
_LEAST = 0.2  # m/s² rms of slow acceleration that tells a heading
_BIASED = 0.02  # of gravity: what a sound accelerometer may be off by at rest


def heading_off(signals: ImuSignals, trajectory: Trajectory) -> float:
    """Yaw in rad by which an upright sensor is turned against the vehicle, 0 where the drive hardly tells.

    The path says how the vehicle speeds up and turns, slowly; the sensor feels the same, in its own axes.
    """
    pull = zero_phase(_SLOW, signals.rate_hz, signals.force - signals.gravity * signals.up)
    path = np.column_stack([trajectory.ax, trajectory.speed * trajectory.yaw_rate])
    path = zero_phase(_SLOW, signals.rate_hz, path)
    used = trajectory.valid & ~signals.standing
    pull, path = pull[used], path[used]
    if not used.any() or math.sqrt(float(np.mean(np.sum(path**2, axis=1)))) < _LEAST:
        return 0.0
    # the turn that takes one best to the other: least squares in closed form
    along = float(np.sum(pull[:, :2] * path))
    across = float(np.sum(pull[:, 0] * path[:, 1] - pull[:, 1] * path[:, 0]))
    return math.atan2(across, along)


def turn_seen(signals: ImuSignals, trajectory: Trajectory) -> tuple[float, float, float]:
    """Roll, pitch and yaw in rad by which a sensor is turned: gravity tells two of them, the path the third."""
    roll, pitch, _ = level_rpy(signals.up.mean(axis=0))
    level = rpy_matrix((roll, pitch, 0.0)).T
    upright = replace(signals, force=signals.force @ level, up=signals.up @ level)
    return roll, pitch, heading_off(upright, trajectory)


def ahead_of(turn: tuple[float, float, float]) -> tuple[float, float, float]:
    """The vehicle's own axis in the axes of a sensor that is turned by roll, pitch and yaw in rad."""
    x, y, z = rpy_matrix(turn)[0]
    return float(x), float(y), float(z)


def gain_at_rest(signals: ImuSignals) -> float:
    """How many times gravity the sensor reads standing still; 1 where it is its bias or the drive never stands."""
    if not signals.standing.any():
        return 1.0
    rest = signals.force[signals.standing].mean(axis=0) + signals.force_bias
    gain = float(np.linalg.norm(rest)) / signals.gravity
    return gain if abs(gain - 1.0) > _BIASED else 1.0


def gain_of(twin: Twin) -> float:
    """How many times the specific force the twin's effects have the sensor read."""
    hooks = ((load_hook(e.id, twin.model), e.parameters) for e in twin.effects)
    return math.prod(hook.gained(parameters) for hook, parameters in hooks if hook.gained is not None)


def late_of(twin: Twin) -> float:
    """Clock offset in s of the sensor at the first stamp: ``imu.latency`` and what the twin's effects add to it."""
    change = ClockChange(np.zeros(1), np.zeros(1))
    for effect in twin.effects:
        hook = load_hook(effect.id, twin.model)
        if hook.clock is not None:
            hook.clock(change, {name: np.array([value]) for name, value in effect.parameters.items()})
    return float(change.delay[0]) + twin.imu.latency


def punctual(drive: Drive, late: float) -> Drive:
    """The drive as a sensor would have stamped it whose clock is ``late`` s earlier."""
    return replace(drive, imu=replace(drive.imu, t=drive.imu.t - late)) if late else drive


def regained(drive: Drive, gain: float) -> Drive:
    """The drive as a sensor would have recorded it that reads no more than there is."""
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
