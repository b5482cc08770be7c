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

__all__ = [
    "DEGREES",
    "ImuWindows",
    "Units",
    "imu_in_si",
    "rates_in_degrees",
    "recognise_units",
    "turning_fault",
    "windowed",
]

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
#: Times from which on it is the unit: other scales and axes that are exchanged reach some (a car's bends; by hand).
_CERTAIN = 6.0
#: Share of the turning by the gyroscope, in deg/s, that the accelerometer has to show.
_LEAST = 0.7
#: Speed in m/s from which a course is one, rad of turning that are needed, and the correlation that makes a ratio sure.
_COURSE, _BENDS, _SURE = 3.0, 0.5, 0.75
#: Ratio of rates from which on the unit is another; share of the trace that keeps out axes in which nothing turns;
#: length of the mean vertical of a sensor that sits still; cosine between verticals that are one, or opposed (by hand).
_SCALE, _RIDGE, _STEADY, _ALONG = 1.7, 0.01, 0.9, 0.6
#: Gravity that is off 9.81 m/s² by more than this share shows a wrong unit or column: the scale of an accelerometer is
#: good to a few per cent (tolerance, by hand).
_OFF = 0.15
#: Of seconds: the fewest that show anything.
_FEWEST = 10


def recognise_units(force: Floats) -> Units:
    """Units of ``force`` (n, 3) by the length of its mean, which over seconds of driving is gravity."""
    if not len(force):
        return "unknown"
    length = _gravity(force)
    if 6.0 < length < 14.0:
        return "m/s2"
    spread = float(np.median(np.abs(np.linalg.norm(force, axis=1) - length)))
    if 0.85 < length < 1.15 and spread < 0.35:
        return "g"
    return "gravity removed" if length < 3.0 else "unknown"


def _gravity(force: Floats) -> float:
    """Length of the mean of ``force`` (n, 3), of a long one that of its quarters: a sensor may be turned over."""
    parts = np.array_split(force, 4 if len(force) >= _LONG else 1)
    return float(np.median(np.linalg.norm([part.mean(axis=0) for part in parts], axis=1)))


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
    turns = None if velocity is None else _turning(windows, velocity)
    if turns is not None:  # the course says what the unit is
        ratio = 1.0 / float(np.linalg.norm(turns))
        return f"the course turns {ratio:.0f} times less" if 0.5 < ratio * DEGREES < 2.0 else ""
    seen, said = _turning_of_gravity(windows)
    # gravity has to turn as the rates say once they are converted
    converts = DEGREES * said < max(_TURNS, _TIMES * seen)
    if float(np.mean(windows.largest > _FASTEST)) > _OFTEN and converts:
        most = float(windows.largest.max())
        return f"they reach {most:.0f}, and no gyroscope of a phone measures {_FASTEST:.0f} rad/s"
    if said > max(_TURNS, _CERTAIN * seen) and seen > _LEAST * DEGREES * said:
        return _otherwise(seen, said)
    return ""


def _otherwise(seen: float, said: float) -> str:
    return f"gravity turns by {seen / DEGREES:.1f}° a second and not by {said / DEGREES:.0f}°"


def _turning_of_gravity(windows: ImuWindows) -> tuple[float, float]:
    """rad by which gravity turns in the axes of the sensor from second to second, as the accelerometer sees and as the
    gyroscope says; zero where gravity was removed, which does not turn."""
    length, up = _upright(windows)
    rate = windows.rate - np.median(windows.rate, axis=0)
    follows = np.diff(windows.t) < 1.5
    if not np.median(length) > 0.5:
        return 0.0, 0.0
    said = _rms(np.cross(0.5 * (up[1:] + up[:-1]), 0.5 * (rate[1:] + rate[:-1]))[follows])
    return _rms(np.diff(up, axis=0)[follows]), said


def turning_fault(windows: ImuWindows, velocity: VelocityData, mounted: Floats | None = None) -> str:
    """Fault of the gyroscope, or of the accelerometer beside it, by the course of the ``velocity`` or the turning of
    gravity, in words; empty where they agree, and for rates in deg/s: see :func:`rates_in_degrees`.

    ``mounted`` (3,) is up in the axes of the sensor as it is mounted. Where the accelerometer agrees with it, a
    gyroscope of the other sign may be one of mirrored axes: the comparison with the path tells these apart."""
    if windows.t.size < _FEWEST or rates_in_degrees(windows, velocity):
        return ""
    turns = _turning(windows, velocity)
    if turns is None:
        seen, said = _turning_of_gravity(windows)
        wrong = said > max(_TURNS, _CERTAIN * seen)
        return f"{_otherwise(seen, said)}, as the rates say: check their unit and axes" if wrong else ""
    size = float(np.linalg.norm(turns))
    if not 1.0 / _SCALE < size < _SCALE:
        return f"angular rates are {1.0 / size:.2g} times what the course turns: check their unit"
    length, up = _upright(windows)
    vertical = up.mean(axis=0)
    steady = float(np.linalg.norm(vertical))
    if np.median(length) < 0.5 or steady < _STEADY:
        return ""
    cosine = float(turns @ vertical) / size / steady
    if cosine < -_ALONG:
        if mounted is not None and vertical @ mounted > 0.0:
            return ""
        return (
            "the gyroscope turns the other way about the accelerometer's vertical than the course: one of the two is "
            "negated (as iOS has its accelerometer)"
        )
    if cosine < 1.0 - _ALONG:
        off = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return f"the gyroscope sees bends about an axis {off:.0f}° off the accelerometer's vertical: their axes differ"
    return ""


def _upright(windows: ImuWindows) -> tuple[Floats, Floats]:
    """Length of the force of each second (k,), and its direction (k, 3)."""
    length = np.linalg.norm(windows.force, axis=1)
    return length, windows.force / np.maximum(length, 1e-9)[:, None]


def _turning(windows: ImuWindows, velocity: VelocityData) -> Floats | None:
    """The vector (3,) whose product with the angular rate is that of the course, by least squares: along the vertical
    of the gyroscope, of length one for rates in rad/s. None where too little turns, or it does not follow."""
    if len(velocity) < 2:
        return None
    course, used = _course_turns(windows.t, velocity)
    rate = windows.rate[used]
    # errors of single velocities turn the course to and fro, a bend one way
    if len(course) < _FEWEST or float(np.ptp(np.cumsum(course))) < _BENDS:
        return None
    square = rate.T @ rate
    turns = np.linalg.solve(square + _RIDGE * max(np.trace(square), 1e-12) * np.eye(3), rate.T @ course)
    said = rate @ turns
    size = float(np.linalg.norm(said) * np.linalg.norm(course))
    return np.asarray(turns) if size > 0.0 and float(said @ course) > _SURE * size else None


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
    left, gravity = recognise_units(force), _gravity(force)
    if left == "gravity removed":
        warnings.append(
            f"accelerometer: median {scale * size:.2f} m/s²: gravity seems to be removed; record the accelerometer "
            "with gravity"
        )
    elif left == "g":
        warnings.append(f"accelerometer: gravity is {gravity:.2f} m/s², so it is in g: give g as its unit")
    elif abs(gravity / STANDARD_GRAVITY - 1.0) > _OFF:
        warnings.append(
            f"accelerometer: gravity is {gravity:.2f} m/s², not 9.81: check the unit and the columns (are they the "
            "gyroscope's?)"
        )
    windows = windowed(imu.t, force, imu.angular_rate)
    evidence = rates_in_degrees(windows, velocity)
    fault = "" if velocity is None else turning_fault(windows, velocity)
    rate = imu.angular_rate * (DEGREES if evidence else 1.0)
    if evidence:
        notes.append(f"gyroscope: rates in deg/s, taken times π/180: {evidence}")
    elif fault:
        warnings.append(fault)
    elif (fastest := float(np.abs(rate).max())) > _FASTEST:
        warnings.append(f"angular rates up to {fastest:.0f} rad/s: are they in deg/s?")
    return replace(imu, specific_force=force, angular_rate=rate), warnings


def _rms(vectors: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else 0.0


def _course_turns(t: Floats, velocity: VelocityData) -> tuple[Floats, NDArray[np.bool_]]:
    """rad by which the course of the ``velocity`` turns in each of the seconds from ``t`` (k,) on in which the vehicle
    is fast enough, and which those are (k,)."""
    east, north = (np.interp(np.append(t, t[-1] + 1.0), velocity.t, velocity.enu[:, i]) for i in (0, 1))
    fast: NDArray[np.bool_] = np.hypot(east, north) > _COURSE
    turns = np.diff(np.arctan2(north, east))
    used = fast[1:] & fast[:-1] & (np.diff(np.append(t, t[-1] + 1.0)) < 1.5)
    used &= (t >= velocity.t[0]) & (t <= velocity.t[-1])
    return (np.remainder(turns + np.pi, 2.0 * np.pi) - np.pi)[used], used
