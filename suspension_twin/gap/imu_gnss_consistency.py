# SPDX-License-Identifier: Apache-2.0
"""Do IMU and receiver tell of the same motion? Clocks that differ, a sensor that faces elsewhere, mirrored axes, rates
in degrees or of the other sign.

The receiver alone says how the vehicle speeds up and turns, slowly; the IMU feels the same, later if its clock is late,
and in its own axes. As complex numbers, ahead and to the left, the two correlate as well whichever way the sensor
faces: the delay at which they do best is the clocks', the angle that is left the mount's. Of a sensor whose axes are
left-handed it is the complex conjugate that correlates.
"""

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

__all__ = ["Agreement", "agreement", "facing", "findings", "lateness"]

Complexes = NDArray[np.complex128]

_FARTHEST = 40.0  # s
#: Correlation from which a delay is told, and by how much one that is far has to beat those that are near.
_SURE, _BETTER = 0.75, 0.15
_LEAST = 0.2  # m/s² rms of the path's acceleration
#: s and rad of which a user should know, and s beyond which nothing that is made of the drive means anything.
_LATE, _TURNED, _APART = 0.3, 0.35, 2.0
#: rad/s rms of turning from which the sign of a gyro shows.
_TURNS = 0.02
#: rad/s that no vehicle turns by for a hundredth of a drive; in °/s, which is 57 times as much, any does.
_QUICK = 4.0
_LEAPS = "GPS time is 18 s ahead of UTC"


@dataclass(frozen=True)
class Agreement:
    """``late`` s by which the IMU's stamps are after the receiver's, ``yaw`` rad by which the sensor is turned against
    the mounting of the twin file, 0 where its axes are ``mirrored``; ``reversed`` whether its gyro turns the other way
    about the vertical than the path does."""

    late: float
    yaw: float
    mirrored: bool = False
    reversed: bool = False


def agreement(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> Agreement | None:
    """What the two say of each other; None where the drive hardly tells."""
    try:
        slow, path = satellite_motion(drive, signals, gps, datum)
    except InputError:
        return None
    used = path.valid
    if np.count_nonzero(used) < 5 * RATE:
        return None
    # less its mean instead of gravity's part: what is vertical a gyro in other units hides
    pull = slow.force @ np.array([1.0, 1.0j, 0.0])
    told = np.where(used, path.ax + 1.0j * path.speed * path.yaw_rate, 0.0)
    told[used] -= told[used].mean()
    if math.sqrt(float(np.mean(np.abs(told[used]) ** 2))) < _LEAST:
        return None
    plain, mirrored = (_best_delay(p, told, used) for p in (pull, pull.conj()))
    # a bend to the left is one to the right some time before or after, not quite
    better = abs(mirrored[1]) - abs(plain[1])
    handed = better > _BETTER or (better > 0.0 and abs(mirrored[0]) <= _APART < abs(plain[0]))
    late, value = mirrored if handed else plain
    if abs(value) < _SURE:
        return None
    yaw = 0.0 if handed else float(-np.angle(value))
    return Agreement(late, yaw, handed, _reversed(slow.rate[:, 2], path.yaw_rate, used, round(late * RATE)))


def _best_delay(pull: Complexes, told: Complexes, used: NDArray[np.bool_]) -> tuple[float, complex]:
    """Seconds by which what is felt is after what is told, and their correlation there."""
    most = min(round(_FARTHEST * RATE), told.size - 1)
    values = np.array([_correlation(pull, told, used, k) for k in range(-most, most + 1)])
    size = np.abs(values)
    best = int(np.argmax(size))
    reach = min(round(_APART * RATE), most)
    near = most - reach + int(np.argmax(size[most - reach : most + reach + 1]))
    if size[best] - size[near] < _BETTER:
        best = near
    between = 0.0
    if 0 < best < size.size - 1:
        left, middle, right = size[best - 1 : best + 2]
        between = float(np.clip(0.5 * (right - left) / max(2.0 * middle - left - right, 1e-9), -0.5, 0.5))
    return (best - most + between) / RATE, complex(values[best])


def _reversed(rate: Floats, told: Floats, used: NDArray[np.bool_], k: int) -> bool:
    """Whether rates (n,) rad/s felt ``k`` samples later are surely those told with the other sign."""
    if math.sqrt(float(np.mean(told[used] ** 2))) < _TURNS:
        return False
    return _correlation(rate.astype(complex), told.astype(complex), used, k).real < -_SURE


def _correlation(pull: Complexes, told: Complexes, used: NDArray[np.bool_], k: int) -> complex:
    """Of what is felt ``k`` samples later with what is told; 0 where less than half of that is left to compare."""
    first, last = max(-k, 0), min(told.size - k, told.size)
    own = np.flatnonzero(used[first:last]) + first
    a, p = told[own], pull[own + k]
    if own.size < 5 * RATE or np.linalg.norm(a) ** 2 < 0.5 * np.linalg.norm(told) ** 2:
        return 0.0j
    a, p = a - a.mean(), p - p.mean()
    return complex(np.sum(p * a.conj()) / max(float(np.linalg.norm(a) * np.linalg.norm(p)), 1e-12))


def facing(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> float:
    """Yaw in rad by which the sensor is turned against its mounting, where that is far; else 0."""
    told = agreement(drive, signals, gps, datum)
    return told.yaw if told is not None and abs(told.yaw) > _TURNED else 0.0


def lateness(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> float:
    """Seconds by which the IMU's stamps are after the receiver's, where that is far; else 0."""
    told = agreement(drive, signals, gps, datum)
    return told.late if told is not None and abs(told.late) > _LATE else 0.0


def findings(drive: Drive, signals: ImuSignals, gps: Place, datum: Datum) -> list[Finding]:
    """What of it a user should know, in a line each."""
    found = []
    rates = drive.imu.angular_rate
    quick = float(np.percentile(np.linalg.norm(rates[np.isfinite(rates).all(axis=1)], axis=1), 99))
    if quick > _QUICK:
        text = (
            f"the gyro reads more than {quick:.0f} rad/s for a hundredth of the drive: are its rates in °/s?"
        )
        found.append(Finding("error", "degrees", text))
    told = agreement(drive, signals, gps, datum)
    if told is None:
        return found
    if told.mirrored:
        text = "what the IMU feels to the left is to the right of the path: its axes are mirrored, turn the sign of one"
        found.append(Finding("error", "mirrored", text))
    elif told.reversed:
        text = "the gyro turns the other way about the vertical than the path: turn the sign of its rates"
        found.append(Finding("error", "reversed", text))
    if abs(told.late) > _LATE:
        after = "after" if told.late > 0 else "before"
        text = (
            f"the IMU's stamps are about {abs(told.late):.1f} s {after} the receiver's: give both one clock"
        )
        if abs(told.late) > _APART:
            found.append(Finding("error", "clocks", f"{text} ({_LEAPS})"))
        else:
            found.append(Finding("warn", "clocks", text))
    if abs(told.yaw) > _TURNED:
        found.append(
            Finding(
                "warn",
                "facing",
                f"by what it feels of braking and turning the sensor is turned by {math.degrees(told.yaw):.0f}° "
                "about the vertical against imu.rpy of the twin file",
            )
        )
    return found
