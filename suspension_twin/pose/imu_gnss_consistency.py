# SPDX-License-Identifier: Apache-2.0
"""IMU/GNSS consistency: clock offset, yaw of the mounting, mirrored axes, sign and unit of the gyro.

Planar acceleration a of the GNSS path and specific force f of the IMU, both as complex numbers (forward + 1j left),
have the correlation

    c(k) = sum f(n + k) conj(a(n)) / (|f| |a|),

whose magnitude does not depend on the yaw of the sensor. The lag of the largest |c| is the clock offset, and the
angle of c there the yaw of the mounting. For left-handed sensor axes the conjugate of f correlates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.pose.satellites import RATE, satellite_motion
from suspension_twin.signals.checks import Finding
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Datum, Place

__all__ = ["Consistency", "clock_offset_beyond", "consistency", "findings", "yaw_beyond"]

Complexes = NDArray[np.complex128]

_LARGEST_LAG = 40.0  # s
#: Least correlation of a result, and by how much that of a long lag has to exceed that of the short ones.
_LEAST_CORRELATION, _LEAST_MARGIN = 0.75, 0.15
_LEAST = 0.2  # m/s² rms of the path's acceleration
#: Limits in s and rad from which on a finding is reported, and clock offset in s from which on it is an error.
_CLOCK_OFFSET, _TURNED, _CLOCK_OFFSET_ERROR = 0.3, 0.35, 2.0
#: Least rms yaw rate in rad/s for a check of the sign of the gyro.
_LEAST_YAW_RATE = 0.02
#: Largest plausible 99th percentile of the rate in rad/s; in °/s any drive exceeds it.
_LARGEST_RATE = 4.0
_LEAP_SECONDS = "GPS time is 18 s ahead of UTC"


@dataclass(frozen=True)
class Consistency:
    """``clock_offset`` s of the IMU stamps against those of the receiver (positive: later); ``yaw`` rad of the sensor
    against the mounting of the twin file, 0 where its axes are ``mirrored``; ``reversed``: the yaw rate has the wrong
    sign."""

    clock_offset: float
    yaw: float
    mirrored: bool = False
    reversed: bool = False


def consistency(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> Consistency | None:
    """Compare IMU and GNSS; None where the drive has too little planar acceleration."""
    try:
        slow, path = satellite_motion(drive, signals, gps, datum)
    except InputError:
        return None
    used = path.valid
    if np.count_nonzero(used) < 5 * RATE:
        return None
    # the mean is removed instead of gravity, whose direction a gyro in wrong units would spoil
    force = slow.force @ np.array([1.0, 1.0j, 0.0])
    reference = np.where(used, path.acceleration[:, 0] + 1.0j * path.speed * path.yaw_rate, 0.0)
    reference[used] -= reference[used].mean()
    if math.sqrt(float(np.mean(np.abs(reference[used]) ** 2))) < _LEAST:
        return None
    plain, mirrored = (_best_delay(p, reference, used) for p in (force, force.conj()))
    # mirrored axes may also correlate by chance at a long lag
    better = abs(mirrored[1]) - abs(plain[1])
    handed = better > _LEAST_MARGIN or (
        better > 0.0 and abs(mirrored[0]) <= _CLOCK_OFFSET_ERROR < abs(plain[0])
    )
    clock_offset, value = mirrored if handed else plain
    if abs(value) < _LEAST_CORRELATION:
        return None
    yaw = 0.0 if handed else float(-np.angle(value))
    return Consistency(
        clock_offset, yaw, handed, _reversed(slow.rate[:, 2], path.yaw_rate, used, round(clock_offset * RATE))
    )


def _best_delay(force: Complexes, reference: Complexes, used: NDArray[np.bool_]) -> tuple[float, complex]:
    """Lag in s of the force against the path with the largest correlation, and the correlation there."""
    most = min(round(_LARGEST_LAG * RATE), reference.size - 1)
    values = np.array([_correlation(force, reference, used, k) for k in range(-most, most + 1)])
    size = np.abs(values)
    best = int(np.argmax(size))
    reach = min(round(_CLOCK_OFFSET_ERROR * RATE), most)
    near = most - reach + int(np.argmax(size[most - reach : most + reach + 1]))
    if size[best] - size[near] < _LEAST_MARGIN:
        best = near
    between = 0.0
    if 0 < best < size.size - 1:
        left, middle, right = size[best - 1 : best + 2]
        between = float(np.clip(0.5 * (right - left) / max(2.0 * middle - left - right, 1e-9), -0.5, 0.5))
    return (best - most + between) / RATE, complex(values[best])


def _reversed(rate: Floats, reference: Floats, used: NDArray[np.bool_], k: int) -> bool:
    """Whether the yaw rates (n,) rad/s, ``k`` samples later, surely have the opposite sign of the path."""
    if math.sqrt(float(np.mean(reference[used] ** 2))) < _LEAST_YAW_RATE:
        return False
    return _correlation(rate.astype(complex), reference.astype(complex), used, k).real < -_LEAST_CORRELATION


def _correlation(force: Complexes, reference: Complexes, used: NDArray[np.bool_], k: int) -> complex:
    """Correlation of the ``force``, ``k`` samples later, with the path; 0 where they overlap by less than half of its
    energy."""
    first, last = max(-k, 0), min(reference.size - k, reference.size)
    own = np.flatnonzero(used[first:last]) + first
    a, p = reference[own], force[own + k]
    if own.size < 5 * RATE or np.linalg.norm(a) ** 2 < 0.5 * np.linalg.norm(reference) ** 2:
        return 0.0j
    a, p = a - a.mean(), p - p.mean()
    return complex(np.sum(p * a.conj()) / max(float(np.linalg.norm(a) * np.linalg.norm(p)), 1e-12))


def yaw_beyond(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> float:
    """Yaw in rad of the sensor against its mounting, where beyond ``_TURNED``; else 0."""
    known = consistency(drive, signals, gps, datum)
    return known.yaw if known is not None and abs(known.yaw) > _TURNED else 0.0


def clock_offset_beyond(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> float:
    """Clock offset in s of the IMU against the receiver, where beyond ``_CLOCK_OFFSET``; else 0."""
    known = consistency(drive, signals, gps, datum)
    return known.clock_offset if known is not None and abs(known.clock_offset) > _CLOCK_OFFSET else 0.0


def findings(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> list[Finding]:
    """Findings for the user, one line each."""
    rates, found = drive.imu.angular_rate, []
    largest = float(np.percentile(np.linalg.norm(rates[np.isfinite(rates).all(axis=1)], axis=1), 99))
    if largest > _LARGEST_RATE:
        text = f"the gyro reads more than {largest:.0f} rad/s for a hundredth of the drive: are its rates in °/s?"
        found.append(Finding("error", "degrees", text))
    known = consistency(drive, signals, gps, datum)
    if known is None:
        return found
    if known.mirrored:
        text = "the lateral acceleration of the IMU is opposite to that of the path: its axes are mirrored, invert one"
        found.append(Finding("error", "mirrored", text))
    elif known.reversed:
        text = "the gyro turns the other way about the vertical than the path: turn the sign of its rates"
        found.append(Finding("error", "reversed", text))
    if abs(known.clock_offset) > _CLOCK_OFFSET:
        after = "after" if known.clock_offset > 0 else "before"
        far = abs(known.clock_offset) > _CLOCK_OFFSET_ERROR
        seconds = f"{abs(known.clock_offset):.1f} s"
        text = f"the IMU's stamps are about {seconds} {after} the receiver's: give both one clock"
        found.append(
            Finding("error" if far else "warn", "clocks", text + (f" ({_LEAP_SECONDS})" if far else ""))
        )
    if abs(known.yaw) > _TURNED:
        text = f"by braking and turning the sensor is turned by {math.degrees(known.yaw):.0f}° about the vertical "
        found.append(Finding("warn", "facing", text + "against imu.rpy of the twin file"))
    return found
