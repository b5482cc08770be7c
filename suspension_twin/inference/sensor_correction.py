# SPDX-License-Identifier: Apache-2.0
"""Errors of the IMU that are taken out of a recording before its motion excites a model.

The fast part of the planar motion that excites the model comes from the IMU. A yaw of 10° of the sensor turns a sixth
of the braking into a lateral acceleration, and the simulated vehicle rolls under braking. A hypothesis with such an
error is therefore simulated with the motion of a corrected recording. What is compared, the measured signals, is not
corrected: there the effect itself acts on the simulated signals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from suspension_twin.drive.types import Drive
from suspension_twin.inference.priors import SINGLE
from suspension_twin.models.hooks import ClockChange, load_hook, upright_with
from suspension_twin.pose.planar_denoising import SLOW
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.attitude import level_rpy, matrix_rpy, rpy_matrix
from suspension_twin.signals.filters import zero_phase
from suspension_twin.signals.ingest import ImuSettings
from suspension_twin.signals.offline import ImuSignals, ingest_drive
from suspension_twin.vehicle.twin import Place, Twin

__all__ = ["SensorCorrection", "Turn", "gain_at_rest", "heading_error", "mounting_error", "turned"]

#: Roll, pitch and yaw in rad by which a sensor is turned against the mounting in the twin file.
Turn = tuple[float, float, float]

_LEAST = 0.2  # m/s² rms of the slow acceleration needed for a yaw


@dataclass(frozen=True)
class SensorCorrection:
    """How a recording is to be read.

    ``turn`` of the sensor on its mount (rad; None: as the twin file mounts it), ``gain`` of its accelerometer,
    ``clock`` s by which its stamps are late, and ``upright``: the vehicle has zero static attitude, so that a static
    tilt is that of the sensor (this moves antenna and wheel paths).
    """

    turn: Turn | None = None
    gain: float = 1.0
    clock: float = 0.0
    upright: bool = False

    @classmethod
    def of_twin(cls, twin: Twin) -> SensorCorrection:
        """The errors that the twin file states, by ``imu.latency`` and by its effects."""
        hooks = [(load_hook(e.id, twin.model), e.parameters) for e in twin.effects]
        change = ClockChange(np.zeros(1), np.zeros(1))
        for hook, parameters in hooks:
            if hook.clock is not None:
                hook.clock(change, {name: np.array([value]) for name, value in parameters.items()})
        return cls(
            next((hook.turned(p) for hook, p in hooks if hook.turned is not None), None),
            math.prod(hook.gained(p) for hook, p in hooks if hook.gained is not None),
            float(change.delay[0]) + twin.imu.latency,
            upright_with(e.id for e in twin.effects),
        )

    def timed(self, drive: Drive) -> Drive:
        """The drive with the clock offset taken out of the IMU's stamps."""
        return replace(drive, imu=replace(drive.imu, t=drive.imu.t - self.clock)) if self.clock else drive

    def signals(self, drive: Drive, place: Place, settings: ImuSettings) -> ImuSignals:
        """The IMU of a drive that is ``timed`` already, with turn and gain of the sensor taken out."""
        if self.gain != 1.0:
            force = drive.imu.specific_force / self.gain
            drive = replace(drive, imu=replace(drive.imu, specific_force=force))
        return ingest_drive(drive, place if self.turn is None else turned(place, self.turn), settings)


def turned(place: Place, turn: Turn) -> Place:
    """A sensor's ``place`` turned further, by roll, pitch and yaw in rad."""
    return place.model_copy(update={"rpy": matrix_rpy(rpy_matrix(turn) @ rpy_matrix(place.rpy))})


def heading_error(signals: ImuSignals, trajectory: Trajectory) -> float:
    """Yaw in rad of an upright sensor against the vehicle, by its slow planar acceleration against that of the path; 0
    where the drive has too little of it."""
    pull = zero_phase(SLOW, signals.rate_hz, signals.force - signals.gravity * signals.up)
    path = np.column_stack([trajectory.acceleration[:, 0], trajectory.speed * trajectory.yaw_rate])
    path = zero_phase(SLOW, signals.rate_hz, path)
    used = trajectory.valid & ~signals.standing
    pull, path = pull[used], path[used]
    if not used.any() or math.sqrt(float(np.mean(np.sum(path**2, axis=1)))) < _LEAST:
        return 0.0
    # rotation by least squares, in closed form
    along = float(np.sum(pull[:, :2] * path))
    across = float(np.sum(pull[:, 0] * path[:, 1] - pull[:, 1] * path[:, 0]))
    return math.atan2(across, along)


def mounting_error(signals: ImuSignals, trajectory: Trajectory) -> Turn:
    """Roll, pitch (from gravity) and yaw (from the path) in rad of the mounting error of the sensor."""
    roll, pitch, _ = level_rpy(signals.up.mean(axis=0))
    level = rpy_matrix((roll, pitch, 0.0)).T
    upright = replace(signals, force=signals.force @ level, up=signals.up @ level)
    return roll, pitch, heading_error(upright, trajectory)


def gain_at_rest(signals: ImuSignals) -> float:
    """Gain of the accelerometer from its reading at standstill over gravity; 1 within the usual bias or without
    standstill."""
    if not signals.standing.any():
        return 1.0
    rest = signals.force[signals.standing].mean(axis=0) + signals.force_bias
    gain = float(np.linalg.norm(rest)) / signals.gravity
    return gain if abs(gain - 1.0) > SINGLE["sensor_bias"] else 1.0
