# SPDX-License-Identifier: Apache-2.0
"""The offline IMU path: a whole recording to bias-free signals in ``base_link`` axes, unfiltered."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.signals.attitude import (
    carried_up,
    level_rpy,
    normal_gravity,
    rpy_matrix,
    smooth_up,
    tilt_of,
)
from suspension_twin.signals.checks import (
    Finding,
    check_axes,
    check_mounting,
    check_rate,
    check_units,
    recognise_units,
    saturated_samples,
)
from suspension_twin.signals.clock import Cleaned, clean_stamps, find_gaps, nominal_rate
from suspension_twin.signals.ground import NO_FIX, Ground, ground_motion
from suspension_twin.signals.settings import ImuSettings
from suspension_twin.signals.standstill import MAX_TILT_DIFFERENCE, rest_bias, standstill_mask
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import Place

__all__ = ["ImuSignals", "ingest_drive"]


@dataclass(frozen=True, eq=False)
class ImuSignals:
    """A drive's IMU in ``base_link`` axes at the sensor's place, at the ``n`` stamps kept, unfiltered.

    ``t`` (n,) s strictly rising, ``keep`` (n,) their indices in the recording, ``force`` (n, 3) m/s²
    specific force with gravity, ``rate`` (n, 3) rad/s, biases removed from both;
    ``vertical_acceleration`` (n,) m/s² gravity removed; ``up`` (n, 3) unit vector opposite to gravity;
    ``force_bias`` and ``rate_bias`` (3,) what was subtracted, ``base_link`` axes; ``gravity`` m/s²;
    ``rate_hz``; ``standing``, ``saturated`` (n,); ``gaps`` (k, 2) start and end in s; ``findings``;
    ``place`` of the sensor.
    """

    t: Floats
    keep: NDArray[np.intp]
    force: Floats
    rate: Floats
    vertical_acceleration: Floats
    up: Floats
    force_bias: Floats
    rate_bias: Floats
    gravity: float
    rate_hz: float
    standing: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    gaps: Floats
    findings: list[Finding]
    place: Place

    def __len__(self) -> int:
        return int(self.t.size)


def ingest_drive(drive: Drive, place: Place, settings: ImuSettings | None = None) -> ImuSignals:
    """Clean the IMU of a whole drive: axes, units, biases, the vertical.

    Parameters
    ----------
    drive : Drive
        The recording.
    place : Place
        Position and mounting of the sensor in ``base_link``, from the twin file.
    settings : ImuSettings, optional
        How the IMU is treated.

    Returns
    -------
    ImuSignals
        Specific force and rates in ``base_link`` axes at the sensor's place, unfiltered. ``findings`` of
        level "error" mean that the signals must not be used for calibration.

    Raises
    ------
    InputError
        No usable IMU samples.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> signals = ingest_drive(read_drive("bags/bump_15kmh"), load_twin("bags/bump_15kmh/twin.yaml").imu)
    >>> round(signals.rate_hz)
    100
    """
    settings = settings or ImuSettings()
    imu = drive.imu
    if len(imu) == 0:
        raise InputError(drive.name, "imu", "has no IMU samples: is the topic's name right?")
    finite = np.isfinite(np.hstack([imu.specific_force, imu.angular_rate])).all(axis=1)
    cleaned = clean_stamps(imu.t, np.asarray(finite))
    t = cleaned.stamps
    if t.size < 16:
        raise InputError(drive.name, "imu", f"{t.size} usable samples are too few")
    rate_hz = nominal_rate(t)
    gaps = find_gaps(t, rate_hz)
    findings = _clock_findings(cleaned, t, gaps, rate_hz)
    raw_force, raw_rate = imu.specific_force[cleaned.keep], imu.angular_rate[cleaned.keep]
    findings += check_axes(raw_force, raw_rate)

    units = recognise_units(raw_force)
    findings += _listed(check_units(units, float(np.linalg.norm(raw_force.mean(axis=0)))))
    scale = STANDARD_GRAVITY if units == "g" else 1.0
    saturated = saturated_samples(scale * raw_force, settings.full_scale)
    saturated |= saturated_samples(raw_rate, settings.full_scale_rate)
    if saturated.any():
        text = f"{int(saturated.sum())} of {t.size} samples sit at the end of the range: set a larger range"
        findings.append(Finding("warn", "saturated", text))

    turn = rpy_matrix(place.rpy)
    force, rate = scale * raw_force @ turn.T, raw_rate @ turn.T
    ground = ground_motion(drive)
    speed = ground.least_speed(t) if ground.known else None
    standing = standstill_mask(rate_hz, force, rate, settings.still, speed)
    if len(drive.velocity) < 4 and units != "gravity removed":
        standing &= ~_accelerating(t, force, rate, rate_hz, settings.attitude_time)
    stands = int(standing.sum()) >= 0.5 * rate_hz
    rate_bias = rate[standing].mean(axis=0) if stands else _driving_bias(ground, t, rate)
    rate = rate - rate_bias
    if not stands:
        text = "the drive has no standstill: biases come from its mean, less surely"
        findings.append(Finding("warn", "no_standstill", text))
    planar = np.zeros_like(force)
    if ground.known:
        planar = ground.acceleration(t, rate[:, 2], place.position)
        planar[standing] = 0.0

    gravity, max_bias = normal_gravity(_latitude(drive, settings)), settings.max_bias
    rest = force[standing].mean(axis=0) if stands else (force - planar).mean(axis=0)
    if units == "gravity removed":
        force_bias = rest
        up = np.tile([0.0, 0.0, 1.0], (t.size, 1))
        force = force - force_bias + (gravity * up if settings.restore_gravity else 0.0)
        vertical = force[:, 2] - (gravity if settings.restore_gravity else 0.0)
    else:
        small = max_bias / gravity
        findings += _listed(check_mounting(rest, place.rpy, small))
        level, tilt = settings.level, tilt_of(rest)
        if (level == "gross" and tilt > math.pi / 4) or (level == "always" and tilt > small):
            turn = rpy_matrix(level_rpy(rest))
            force, rate, rate_bias, rest = force @ turn.T, rate @ turn.T, turn @ rate_bias, turn @ rest
        force_bias = rest_bias(rest, gravity, max_bias)
        force = force - force_bias
        length = np.where(standing, 0.1 * settings.attitude_time, settings.attitude_time)
        up = smooth_up(t, force - planar, rate, gravity, length)
        vertical = force[:, 2] - gravity * up[:, 2]
    unit = 1.0 if settings.convert_units else scale  # a sensor in g that is to be left so
    return ImuSignals(
        t=t,
        keep=cleaned.keep,
        force=force / unit,
        rate=rate,
        vertical_acceleration=vertical / unit,
        up=up,
        force_bias=force_bias / unit,
        rate_bias=rate_bias,
        gravity=gravity / unit,
        rate_hz=rate_hz,
        standing=standing,
        saturated=saturated,
        gaps=gaps,
        findings=findings,
        place=place,
    )


def _accelerating(t: Floats, force: Floats, rate: Floats, rate_hz: float, time: float) -> NDArray[np.bool_]:
    """(n,) True where the specific force is tilted against the vertical that the gyro gives: a constant
    acceleration, which looks like standstill. Roll and pitch rates average to their bias."""
    steady = rate - rate.mean(axis=0) * np.array([1.0, 1.0, 0.0])
    gravity = float(np.median(np.linalg.norm(force, axis=1)))
    mean = gaussian_filter1d(force, 0.25 * rate_hz, axis=0, mode="nearest")
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    up, _ = carried_up(t, force, steady, gravity, np.full(t.size, time))
    return np.asarray(np.linalg.norm(mean - up, axis=1) > MAX_TILT_DIFFERENCE, dtype=np.bool_)


def _driving_bias(ground: Ground, t: Floats, rate: Floats) -> Floats:
    """(3,) gyro bias of a drive that never stands: roll and pitch come back to where they were, and the yaw
    turns as the course does, if that is known."""
    about_z = ground.yaw_rate_bias(t, rate[:, 2]) if ground.known else None
    return np.array([*rate.mean(axis=0)[:2], 0.0 if about_z is None else about_z])


def _listed(finding: Finding | None) -> list[Finding]:
    return [] if finding is None else [finding]


def _clock_findings(cleaned: Cleaned, t: Floats, gaps: Floats, rate_hz: float) -> list[Finding]:
    found = _listed(check_rate(rate_hz))
    for count, code, what in (
        (cleaned.invalid, "invalid", "samples with NaN or without a stamp were dropped"),
        (cleaned.duplicates, "duplicates", "samples with a repeated stamp were dropped"),
        (cleaned.reordered, "reordered", "samples came out of order and were sorted"),
        (cleaned.other_loops, "looped", "samples of other loops were dropped: the clock was set back"),
    ):
        if count:
            found.append(Finding("warn", code, f"{count} {what}"))
    if cleaned.duplicates > 0.2 * (t.size + cleaned.duplicates):
        text = "more than a fifth of the stamps repeat: the recorder's clock is stuck or too coarse"
        found.append(Finding("error", "stamps_stuck", text))
    if len(gaps):
        lost = float(np.sum(gaps[:, 1] - gaps[:, 0]))
        text = (
            f"{len(gaps)} gaps, {lost:.2f} s in all, the longest {float(np.max(np.diff(gaps, axis=1))):.2f} s"
        )
        found.append(Finding("warn", "gaps", text))
    return found


def _latitude(drive: Drive, settings: ImuSettings) -> float | None:
    if settings.latitude is not None:
        return settings.latitude
    usable = np.isfinite(drive.fix.latitude) & (drive.fix.status != NO_FIX)
    return float(np.median(drive.fix.latitude[usable])) if usable.any() else None
