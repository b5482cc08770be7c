# SPDX-License-Identifier: Apache-2.0
"""Drives that a calibration cannot use are refused, with the reason and what to do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from suspension_twin.drive.checks import UNTIMED
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.excited_segments import TrimSettings
from suspension_twin.inference.observation import NO_DATUM, Observation
from suspension_twin.inference.placement import SAME_ROAD

__all__ = [
    "LEAST_EXCITED",
    "check_agreement",
    "check_drive",
    "check_on_road",
    "check_parts",
    "check_recording",
]

#: Seconds of excited driving below which nothing is fitted: two periods of a body's bounce at 1.3 Hz.
LEAST_EXCITED = 1.5
_FASTEST_PARKED = 1.0  # m/s


def check_recording(drive: Drive) -> None:
    """Refuse a recording of a parked car, and one whose samples have no times."""
    if UNTIMED in drive.warnings:
        raise InputError(drive.name, f"{UNTIMED}: record with the sensor's own stamps, not those of arrival")
    speed = np.hypot(drive.velocity.enu[:, 0], drive.velocity.enu[:, 1])
    seen = np.isfinite(speed)
    if np.count_nonzero(seen) < 2:
        return
    period = float(np.median(np.diff(np.sort(drive.velocity.t[seen]))))
    # a receiver's velocity jumps now and then: a second of it counts
    if np.count_nonzero(speed[seen] > _FASTEST_PARKED) * period < 1.0:
        raise _parked(drive.name, float(np.median(speed[seen])))


def _parked(name: str, speed: float) -> InputError:
    return InputError(
        name, f"the car is parked ({speed:.1f} m/s): record a drive over the road of the twin file"
    )


def check_drive(drive: Observation) -> None:
    """Refuse a drive that stands still, or is not on the road of the twin file."""
    fastest = float(np.max(np.abs(drive.speed)))
    if fastest < _FASTEST_PARKED:
        raise _parked(drive.name, fastest)
    moving = np.abs(drive.speed) > 0.8
    on_road = float(drive.inside[moving].mean())
    if on_road < 0.02:
        never = f"never drives on the road {drive.road.name} ({_distance(drive):.0f} m away at the nearest)"
        if drive.twin.datum is None:
            raise InputError(drive.name, f"{never}: {NO_DATUM.text}")
        raise InputError(
            drive.name,
            f"{never}: is it the road of this drive, and is the twin file's datum the origin of its x and y?",
        )


def _distance(drive: Observation) -> float:
    """Least distance in m of the drive from the road's reference line."""
    x, y = drive.trajectory.x, drive.trajectory.y
    u, _ = drive.road.xy_to_uv(x, y)
    u = np.clip(u, drive.road.u_first, drive.road.u_last)
    line_x, line_y = drive.road.uv_to_xy(u, np.zeros_like(u))
    return float(np.min(np.hypot(x - line_x, y - line_y)))


def check_parts(drive: Observation, samples: int, settings: TrimSettings) -> None:
    """Refuse a drive that the road hardly shakes, or that is on the road for too short a time."""
    seconds = samples / drive.rate
    if seconds >= LEAST_EXCITED:
        return
    check_on_road(drive, settings)
    moving = drive.mask & (np.abs(drive.speed) > settings.slowest)
    vertical = drive.measured["vertical_acceleration"][moving]
    rms = float(np.std(vertical))
    floor = drive.noise_rms["vertical_acceleration"]
    raise InputError(
        drive.name,
        f"the road does not excite the car: {rms:.3f} m/s² rms at a noise of {floor:.3f}, {seconds:.1f} s above "
        f"{settings.threshold:g} times that: drive over a bump or a rough road",
    )


def check_on_road(drive: Observation, settings: TrimSettings) -> None:
    """Refuse a drive that is on the road for too short a time."""
    on_road = float(np.count_nonzero(drive.mask & (np.abs(drive.speed) > settings.slowest))) / drive.rate
    if on_road < 2 * LEAST_EXCITED:
        raise InputError(
            drive.name,
            f"only {on_road:.1f} s are driven on the road with a pose and a whole signal: at least "
            f"{2 * LEAST_EXCITED:.0f} s are needed",
        )


def check_agreement(names: Sequence[str], correlations: Sequence[float], road: str) -> None:
    """Refuse the result where measured and simulated acceleration hardly correlate."""
    for name, correlation in zip(names, correlations, strict=True):
        if not correlation >= SAME_ROAD:
            raise WorkError(
                f"{name}: measured and simulated vertical acceleration have little in common even at the best fit "
                f"(correlation {correlation:.2f}): was it another road than {road}, is the map or a clock off by "
                "more than a second, or does the IMU sit elsewhere than the twin file says?"
            )
