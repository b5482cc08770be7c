# SPDX-License-Identifier: Apache-2.0
"""Units of an IMU by what it measures: the same for files, recordings and live samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import ImuData, VelocityData
from suspension_twin.units import STANDARD_GRAVITY

__all__ = ["DEGREES", "ImuWindows", "Units", "imu_in_si", "rates_in_degrees", "recognise_units", "windowed"]

Units = Literal["m/s2", "g", "gravity removed", "unknown"]

#: rad in a degree.
DEGREES = float(np.radians(1.0))
#: Samples of which each quarter has a mean that is gravity: four seconds at 100 Hz.
_LONG = 400
#: Angular rates beyond the range of any phone's gyroscope, 2300 degrees a second; the share of seconds that hold one.
_FASTEST, _OFTEN = 40.0, 0.1  # rad/s
#: Turning of gravity by the gyroscope from second to second: rad that no road asks for (9°), and how many times that of
#: the accelerometer, which accelerations make larger, not smaller.
_TURNS, _TIMES = 0.15, 3.0
#: Share of the turning by the gyroscope, in deg/s, that the accelerometer has to show.
_LEAST = 0.7
#: Speed in m/s from which a course is one, rad of turning that are needed, and the correlation that makes a ratio sure.
_COURSE, _BENDS, _SURE = 3.0, 0.5, 0.75
#: Of seconds: the fewest that show anything.
_FEWEST = 10


def recognise_units(force: Floats) -> Units:
    """Units of ``force`` (n, 3) by the length of its mean, which over seconds of driving is gravity."""
    if not len(force):
        return "unknown"
    length = float(np.linalg.norm(force.mean(axis=0)))
    if length < 6.0 and len(force) >= _LONG:  # a sensor that was turned over has a mean, too
        quarters = np.linalg.norm([part.mean(axis=0) for part in np.array_split(force, 4)], axis=1)
        length = length if np.median(quarters) < 6.0 else float(np.median(quarters))
    if 6.0 < length < 14.0:
        return "m/s2"
    spread = float(np.median(np.abs(np.linalg.norm(force, axis=1) - length)))
    if 0.85 < length < 1.15 and spread < 0.35:
        return "g"
    return "gravity removed" if length < 3.0 else "unknown"


@dataclass(frozen=True, eq=False)
class ImuWindows:
    """Seconds of samples, one after the other: ``t`` (k,) s of their begin, mean ``force`` and ``rate`` (k, 3) and the
    ``largest`` (k,) rate of a sample."""

    t: Floats
    force: Floats
    rate: Floats
    largest: Floats


def windowed(t: Floats, force: Floats, rate: Floats) -> ImuWindows:
    """The seconds of samples (n, 3) at ``t`` (n,) s, rising."""
    _, start, count = np.unique(np.floor(t - t[0]), return_index=True, return_counts=True)
    mean = np.add.reduceat(np.column_stack([force, rate]), start, axis=0) / count[:, None]
    size = np.linalg.norm(rate, axis=1)
    return ImuWindows(t[start], mean[:, :3], mean[:, 3:], np.maximum.reduceat(size, start))


def rates_in_degrees(windows: ImuWindows, velocity: VelocityData | None = None) -> str:
    """The evidence that angular rates come in deg/s instead of rad/s, in words; empty where there is none.

    By the range of gyroscopes, by gravity, which turns in the axes of the sensor as the gyroscope says, and by the
    course of the ``velocity``.
    """
    if windows.t.size < _FEWEST:
        return ""
    if float(np.mean(windows.largest > _FASTEST)) > _OFTEN:
        most = float(windows.largest.max())
        return f"they reach {most:.0f}, and no gyroscope of a phone measures {_FASTEST:.0f} rad/s"
    length = np.linalg.norm(windows.force, axis=1)
    up = windows.force / np.maximum(length, 1e-9)[:, None]
    rate = windows.rate - np.median(windows.rate, axis=0)
    follows = np.diff(windows.t) < 1.5
    seen = _rms(np.diff(up, axis=0)[follows])
    said = _rms(np.cross(0.5 * (up[1:] + up[:-1]), 0.5 * (rate[1:] + rate[:-1]))[follows])
    # gravity that was removed does not turn; and it has to turn as the rates say once they are converted
    if np.median(length) > 0.5 and said > max(_TURNS, _TIMES * seen) and seen > _LEAST * DEGREES * said:
        return f"gravity turns by {seen / DEGREES:.1f}° a second and not by {said / DEGREES:.0f}°"
    if velocity is not None and len(velocity) > 1:
        course, turned = _course_turns(windows.t, np.sum(windows.rate * up, axis=1), velocity)
        most = float(np.sum(np.abs(course)))
        if most > _BENDS and np.corrcoef(course, turned)[0, 1] ** 2 > _SURE**2:
            ratio = abs(float(turned @ course / (course @ course)))
            if 0.5 < ratio * DEGREES < 2.0:
                return f"the course turns {ratio:.0f} times less"
    return ""


def imu_in_si(
    imu: ImuData, velocity: VelocityData | None, unit: Literal["m/s²", "g"] | None, notes: list[str]
) -> tuple[ImuData, list[str]]:
    """Recorded samples in m/s² and rad/s, and warnings; ``notes`` gets a line for each decision. ``unit`` is that of
    the specific force by its source; None lets the values decide."""
    size = float(np.median(np.linalg.norm(imu.specific_force, axis=1)))
    seen = recognise_units(imu.specific_force)
    if unit is None:
        unit = "g" if seen == "g" else "m/s²"
        if seen in ("g", "m/s2"):
            notes.append(f"accelerometer: median {size:.2f}, so in {unit}")
    warnings, scale = [], STANDARD_GRAVITY if unit == "g" else 1.0
    force = scale * imu.specific_force
    left = recognise_units(force)
    if left == "unknown":
        warnings.append(f"accelerometer: median {scale * size:.1f} m/s², not gravity's 9.8: check the unit")
    elif left != "m/s2":
        warnings.append(
            f"accelerometer: median {scale * size:.2f} m/s²: gravity seems to be removed; record the accelerometer "
            "with gravity"
        )
    evidence = rates_in_degrees(windowed(imu.t, force, imu.angular_rate), velocity)
    rate = imu.angular_rate * (DEGREES if evidence else 1.0)
    if evidence:
        notes.append(f"gyroscope: rates in deg/s, taken times π/180: {evidence}")
    elif (fastest := float(np.abs(rate).max())) > _FASTEST:
        warnings.append(f"angular rates up to {fastest:.0f} rad/s: are they in deg/s?")
    return replace(imu, specific_force=force, angular_rate=rate), warnings


def _rms(vectors: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else 0.0


def _course_turns(t: Floats, yaw_rate: Floats, velocity: VelocityData) -> tuple[Floats, Floats]:
    """rad by which the course of the ``velocity`` turns from second to second (k,) where the vehicle is fast enough,
    and by which the ``yaw_rate`` (k,) of the seconds from ``t`` (k,) on does."""
    east, north = (np.interp(np.append(t, t[-1] + 1.0), velocity.t, velocity.enu[:, i]) for i in (0, 1))
    fast: NDArray[np.bool_] = np.hypot(east, north) > _COURSE
    turns = np.diff(np.arctan2(north, east))
    used = fast[1:] & fast[:-1] & (np.diff(np.append(t, t[-1] + 1.0)) < 1.5)
    used &= (t >= velocity.t[0]) & (t <= velocity.t[-1])
    return (np.remainder(turns + np.pi, 2.0 * np.pi) - np.pi)[used], yaw_rate[used]
