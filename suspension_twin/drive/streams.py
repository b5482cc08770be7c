# SPDX-License-Identifier: Apache-2.0
"""Sensor streams of an imported recording and their assembly into one drive.

An importer hands on each stream with its own stamps and in its own unit; here they are put in
order, into SI units and onto common stamps, with a line for each decision.

Sources of the conventions of phones: Android's ``Location.getAccuracy``, Apple's ``CLLocation``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal, TypeVar

import numpy as np
import pymap3d
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.checks import clean_drive, measured
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.drive.units import imu_in_si
from suspension_twin.errors import InputError

__all__ = [
    "Series",
    "Streams",
    "assemble",
    "merge",
    "phone_fix",
    "velocities_from_course",
    "velocities_from_fixes",
]

Received = TypeVar("Received", FixData, VelocityData)

#: No drive is that long: a stamp further from the others is damage.
_LONGEST: Final = 30 * 86_400.0  # s
#: Below this speed a receiver's bearing means nothing.
_STANDING: Final = 0.3  # m/s


@dataclass(frozen=True, eq=False)
class Series:
    """Values (n, k) of a sensor at stamps ``t`` (n,) s, in the axes of ``frame``.

    ``unit`` of a specific force; None lets the values decide.
    """

    t: Floats
    values: Floats
    unit: Literal["m/s²", "g"] | None = None
    frame: str = "imu_link"


@dataclass
class Streams:
    """The streams of one recording; ``origin`` is the title of its format.

    ``force`` is specific force (gravity included) and ``rate`` angular rate in rad/s, in sensor axes. ``notes`` has a
    line for every decision, ``warnings`` one for everything lost or doubtful.
    """

    origin: str
    force: Series | None = None
    rate: Series | None = None
    fix: FixData | None = None
    velocity: VelocityData | None = None
    heading: HeadingData | None = None
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def merge(parts: Sequence[Streams]) -> Streams:
    """One out of several recordings; of a stream that more than one has, the last one's counts."""
    whole = Streams(origin=" + ".join(part.origin for part in parts))
    for part in parts:
        for name in ("force", "rate", "fix", "velocity", "heading"):
            value = getattr(part, name)
            if value is None:
                continue
            if getattr(whole, name) is not None:
                whole.notes.append(f"{name} from {part.origin}, not from the source before it")
            setattr(whole, name, value)
        if part.fix is not None and part.velocity is None:
            # another receiver's velocities would not belong to these fixes
            whole.velocity = None
        whole.notes += part.notes
        whole.warnings += part.warnings
    return whole


def assemble(streams: Streams, name: str, source: str) -> tuple[Drive, list[str]]:
    """The drive, and a line for each decision on the way.

    Raises InputError naming ``source`` where there is no accelerometer, no gyroscope, or the two do
    not overlap in time.
    """
    notes, warnings = list(streams.notes), list(streams.warnings)
    if streams.force is None:
        raise InputError(source, "no accelerometer data")
    if streams.rate is None:
        raise InputError(source, "no gyroscope data: record it together with the accelerometer")
    force = _in_order(streams.force, "accelerometer", source, warnings)
    rate = _in_order(streams.rate, "gyroscope", source, warnings)
    if not np.array_equal(force.t, rate.t):
        force, rate = _on_common_stamps(force, rate, source, notes, warnings)
    velocity = streams.velocity
    if velocity is None and streams.fix is not None and len(streams.fix):
        velocity = velocities_from_fixes(streams.fix)
        if len(velocity):
            notes.append("velocity: none recorded, derived from the positions")
    imu = ImuData(force.t, force.values, rate.values, None, force.frame)
    imu, doubts = imu_in_si(imu, velocity, force.unit, notes)
    warnings += doubts
    drive = Drive(
        name=name,
        imu=imu,
        fix=_in_time_order(streams.fix or FixData.empty(), "fixes", warnings),
        velocity=_in_time_order(velocity or VelocityData.empty(), "velocities", warnings),
        heading=streams.heading,
        warnings=tuple(warnings),
    )
    drive = clean_drive(drive)
    if not len(drive.fix):
        notes.append("no GPS positions: the pose cannot be locked to this drive")
    else:
        apart = max(drive.fix.t[0] - drive.imu.t[-1], drive.imu.t[0] - drive.fix.t[-1])
        if apart >= 0:
            text = f"IMU and GPS do not overlap in time: {apart:.1f} s lie between them, check the time base"
            drive = replace(drive, warnings=(*drive.warnings, text))
    return drive, notes


def _in_order(series: Series, sensor: str, source: str, warnings: list[str]) -> Series:
    """Finite samples in rising order of time, each stamp once; InputError for fewer than two."""
    samples = f"{sensor} samples"
    timed = _timed(series.t, samples, warnings)
    good = timed & measured(series.values)

    def lost(count: int, fault: str) -> None:
        if count:
            warnings.append(f"{count} of {good.size} {samples} {fault}")

    lost(int(timed.sum() - good.sum()), "are no numbers: left out")
    t, values = series.t[good], series.values[good]
    if t.size and (np.diff(t) <= 0).any():
        order = np.argsort(t, kind="stable")
        lost(int((np.diff(t) < 0).sum()), "came out of order: sorted")
        t, values = t[order], values[order]
        first = np.concatenate([[True], np.diff(t) > 0])
        lost(int(t.size - first.sum()), "repeat a stamp: left out")
        t, values = t[first], values[first]
    if t.size < 2:
        raise InputError(source, f"no usable {sensor} data")
    return replace(series, t=t, values=values)


def _timed(t: Floats, samples: str, warnings: list[str]) -> NDArray[np.bool_]:
    """Which stamps are finite and near the others."""
    good = np.isfinite(t)
    if good.any():
        good &= np.abs(np.where(good, t, 0.0) - np.median(t[good])) < _LONGEST
    if not good.all():
        warnings.append(f"{int((~good).sum())} of {t.size} {samples} have no usable stamp: left out")
    return good


def _on_common_stamps(
    force: Series, rate: Series, source: str, notes: list[str], warnings: list[str]
) -> tuple[Series, Series]:
    """Both at the accelerometer's stamps, the gyroscope interpolated where it has no gap."""
    step = float(np.median(np.diff(rate.t)))
    after = np.clip(np.searchsorted(rate.t, force.t), 1, rate.t.size - 1)
    nearest = np.minimum(np.abs(force.t - rate.t[after - 1]), np.abs(rate.t[after] - force.t))
    inside = nearest <= max(0.05, 2.5 * step)
    if inside.sum() < 2:
        raise InputError(source, "accelerometer and gyroscope do not overlap in time")
    if lost := int((~inside).sum()):
        warnings.append(
            f"{lost} of {force.t.size} accelerometer samples have no gyroscope beside them: left out"
        )
    t = force.t[inside]
    rates = np.stack([np.interp(t, rate.t, rate.values[:, i]) for i in range(3)], axis=1)
    notes.append(f"gyroscope: {1 / step:.1f} Hz, taken at the accelerometer's stamps")
    return replace(force, t=t, values=force.values[inside]), Series(t, rates)


def _in_time_order(samples: Received, kind: str, warnings: list[str]) -> Received:
    """The samples with a usable stamp in rising order, each stamp once."""
    t = samples.t
    order = np.argsort(t, kind="stable")
    order = order[_timed(t, kind, warnings)[order]]
    fresh = np.concatenate([[True], np.diff(t[order]) > 0]) if order.size else np.empty(0, dtype=np.bool_)
    if not fresh.all():
        warnings.append(f"{int((~fresh).sum())} of {t.size} {kind} repeat a stamp: left out")
    return samples.select(order[fresh])


# Positions and velocities as receivers and phones give them


def phone_fix(
    t: Floats, latitude: Floats, longitude: Floats, altitude: Floats, horizontal: Floats, vertical: Floats
) -> FixData:
    """Fixes (n,) of a phone from its accuracies in m.

    The horizontal accuracy is the radius of a 1 sigma circle, so √2 sigma of each axis. A negative one marks
    an invalid fix, zero or NaN one that is not known.
    """
    with np.errstate(invalid="ignore"):
        sigma = np.stack([horizontal / np.sqrt(2), horizontal / np.sqrt(2), vertical], axis=1)
        sigma = np.where(sigma > 0, sigma, np.nan)
        status = np.where(horizontal < 0, -1, 0).astype(np.int8)
    return FixData(t, latitude, longitude, altitude, status, sigma)


def velocities_from_course(t: Floats, speed: Floats, bearing: Floats) -> VelocityData:
    """From speed in m/s and bearing in degrees clockwise from north; the vertical part is taken as 0.

    Receivers mark an unknown value by a negative number or leave it out: those samples are
    dropped, but for a bearing missing at standstill.
    """
    with np.errstate(invalid="ignore"):
        standing = (speed >= 0) & (speed < _STANDING)
        known = np.isfinite(t) & (standing | ((speed >= 0) & (bearing >= 0) & (bearing <= 360)))
    speed, angle = speed[known], np.radians(np.where(np.isfinite(bearing[known]), bearing[known], 0.0))
    enu = np.stack([speed * np.sin(angle), speed * np.cos(angle), np.zeros_like(speed)], axis=1)
    return VelocityData(t[known], enu)


def velocities_from_fixes(fix: FixData) -> VelocityData:
    """Slopes of parabolas through five neighbouring positions each (three where there are no more).

    A central difference of the same noise would need the same five fixes and lag at the ends. Fixes
    beyond a gap of five periods belong to another segment; segments under three fixes give none.
    """
    good = (fix.status >= 0) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & np.isfinite(fix.t)
    t, fresh = np.unique(fix.t[good], return_index=True)
    if t.size < 3:
        return VelocityData.empty()
    latitude, longitude = fix.latitude[good][fresh], fix.longitude[good][fresh]
    altitude = np.nan_to_num(fix.altitude[good][fresh])
    origin = (latitude[0], longitude[0], altitude[0])
    place = np.stack(pymap3d.geodetic2enu(latitude, longitude, altitude, *origin), axis=1)
    breaks = np.flatnonzero(np.diff(t) > 5 * np.median(np.diff(t))) + 1
    segments = [slice(*ends) for ends in zip([0, *breaks], [*breaks, t.size], strict=True)]
    segments = [s for s in segments if s.stop - s.start >= 3]
    if not segments:
        return VelocityData.empty()
    slopes = [_slopes(t[s], place[s]) for s in segments]
    return VelocityData(np.concatenate([t[s] for s in segments]), np.concatenate(slopes))


def _slopes(t: Floats, place: Floats) -> Floats:
    """(n, 3) derivative at each stamp of the parabola fitted to its window."""
    n, size = t.size, min(5, t.size)
    start = np.clip(np.arange(n) - size // 2, 0, n - size)
    window = start[:, None] + np.arange(size)
    x = t[window] - t[:, None]
    # least squares a + b x + c x², of which b is the derivative at the stamp itself
    design = np.stack([np.ones_like(x), x, x * x], axis=2)
    return np.asarray((np.linalg.pinv(design) @ place[window])[:, 1, :])
