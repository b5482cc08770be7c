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
from numpy.typing import NDArray

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.drive.checks import clean_drive, measured
from suspension_twin.drive.received import velocities_from_fixes, velocity_fault
from suspension_twin.drive.stamps import (
    began_again,
    jumps_back,
    moment,
    of_one_recording,
    own_stamps,
    strays,
    unwrapped,
)
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
    "with_velocities",
]

Received = TypeVar("Received", FixData, VelocityData, HeadingData)

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

    def add_course(self, t: Floats, speed: Floats, bearing: Floats, words: str = "speed and bearing") -> None:
        """Velocities as :func:`velocities_from_course` has them; those that are lost are said."""
        self.velocity = velocities_from_course(t, speed, bearing)
        self.notes.append(f"velocity: from {words}")
        given = int((np.isfinite(t) & np.isfinite(speed)).sum())
        if lost := given - len(self.velocity):
            self.warnings.append(f"{lost} of {given} velocities have no speed or no course: left out")


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


def assemble(streams: Streams, name: str, source: str, unread: Sequence[str] = ()) -> tuple[Drive, list[str]]:
    """The drive, and a line for each decision on the way.

    Raises InputError naming ``source`` and all that was lost where there is no accelerometer (and the files ``unread``,
    which nobody recognised), no gyroscope, or the two do not overlap in time.
    """
    notes, warnings = list(streams.notes), list(streams.warnings)
    try:
        return _assembled(streams, name, source, notes, warnings, unread), notes
    except InputError as error:
        raise InputError("; ".join([str(error), *warnings])) from None


def _assembled(
    streams: Streams, name: str, source: str, notes: list[str], warnings: list[str], unread: Sequence[str]
) -> Drive:
    if streams.force is None:
        among = (
            f", or its columns in a --mapping if it is one of those not recognised: {', '.join(unread[:8])}"
        )
        raise InputError(source, f"no accelerometer data: give the IMU's file too{among if unread else ''}")
    if streams.rate is None:
        raise InputError(source, "no gyroscope data: record it together with the accelerometer")
    force, span = _in_order(streams.force, "accelerometer", source, warnings)
    rate, _ = _in_order(streams.rate, "gyroscope", source, warnings)
    if not np.array_equal(force.t, rate.t):
        force, rate = _on_common_stamps(force, rate, source, notes, warnings)

    def received(samples: Received, kind: str) -> Received:
        t, order, _ = _rising(samples.t, kind, source, warnings)
        # the first of them may have come after the counter began again
        late = order.size and t[order[-1]] < force.t[0] <= t[order[-1]] + span
        return replace(samples, t=t + span if late else t).select(order)

    drive = Drive(
        name=name,
        imu=ImuData(force.t, force.values, rate.values, None, force.frame),
        fix=received(streams.fix or FixData.empty(), "fixes"),
        velocity=received(streams.velocity or VelocityData.empty(), "velocities"),
        heading=None if streams.heading is None else received(streams.heading, "headings"),
        warnings=tuple(warnings),
    )
    drive = checked(clean_drive(drive), force.unit, notes)
    if not len(drive.fix):
        notes.append("no GPS positions: the pose cannot be locked to this drive")
    return drive


def checked(drive: Drive, unit: Literal["m/s²", "g"] | None, notes: list[str]) -> Drive:
    """The drive with velocities and in SI units, with warnings of what its parts say against each other; ``unit`` and
    ``notes`` as of :func:`~suspension_twin.drive.units.imu_in_si`."""
    fault = velocity_fault(drive.fix, drive.velocity)
    drive, derived = with_velocities(drive)
    notes += derived
    imu, doubts = imu_in_si(drive.imu, None if fault else drive.velocity, unit, notes)
    doubts += [fault] if fault else []
    if len(drive.fix) and len(imu):
        apart = max(drive.fix.t[0] - imu.t[-1], imu.t[0] - drive.fix.t[-1])
        if apart >= 0:
            doubts.append(
                f"IMU and GPS do not overlap in time: {apart:.1f} s lie between them, check the time base"
            )
    return replace(drive, imu=imu, warnings=(*drive.warnings, *doubts))


def with_velocities(drive: Drive) -> tuple[Drive, list[str]]:
    """The drive, with velocities derived from the positions where it has none, and a line that says so."""
    if len(drive.velocity) or not len(drive.fix):
        return drive, []
    velocity = velocities_from_fixes(drive.fix)
    lines = ["velocity: none recorded, derived from the positions"] if len(velocity) else []
    return replace(drive, velocity=velocity), lines


def _in_order(series: Series, sensor: str, source: str, warnings: list[str]) -> tuple[Series, float]:
    """Finite samples in rising order of time, each at a stamp of its own, and the span in s after which their counter
    began again, or 0; InputError for fewer than two samples."""
    samples = f"{sensor} samples"
    timed, order, span = _rising(series.t, samples, source, warnings)
    t, values = timed[order], series.values[order]
    good = measured(values)

    def lost(count: int, fault: str) -> None:
        if count:
            warnings.append(f"{count} of {series.t.size} {samples} {fault}")

    lost(int(good.size - good.sum()), "are no numbers: left out")
    t, values = t[good], values[good]
    t, first, lines = own_stamps(t, values, samples)
    warnings += lines
    t, values = t[first], values[first]
    fresh = np.diff(t, prepend=-np.inf) > 0
    lost(int(t.size - fresh.sum()), "repeat a stamp: left out")
    if fresh.sum() < 2:
        raise InputError(source, f"no usable {sensor} data")
    return replace(series, t=t[fresh], values=values[fresh]), span


def _rising(
    t: Floats, samples: str, source: str, warnings: list[str]
) -> tuple[Floats, NDArray[np.intp], float]:
    """Stamps (n,) s, those of a counter that begins again made to go on, the indices of the usable ones in rising
    order, and the counter's span in s, or 0. Raises InputError where the clock was set back."""
    t, index = t.copy(), np.flatnonzero(np.isfinite(t))
    index = index[~strays(t[index])]
    t[index], span = unwrapped(t[index])
    if span:
        warnings.append(f"{samples}: {began_again(span)}")
    index = index[of_one_recording(t[index])]
    if index.size < t.size:
        warnings.append(f"{t.size - index.size} of {t.size} {samples} have no usable stamp: left out")
    if (back := jumps_back(t[index])).size:
        before, after = t[index][back[0] - 1 : back[0] + 1]
        fault = f"the clock of the {samples} goes back by {before - after:.3f} s after {moment(before)}"
        raise InputError(
            source, f"{fault}, sample {index[back[0]]}: import the parts before and after it apart"
        )
    if late := int((np.diff(t[index]) < 0).sum()):
        warnings.append(f"{late} of {t.size} {samples} came out of order: sorted")
    return t, index[np.argsort(t[index], kind="stable")], span


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
    rates = interpolated(t, rate.t, rate.values)
    notes.append(f"gyroscope: {1 / step:.1f} Hz, taken at the accelerometer's stamps")
    return replace(force, t=t, values=force.values[inside]), Series(t, rates)


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
    dropped, but for a bearing missing at standstill. Standstill alone, where no bearing is known, is no velocity.
    """
    with np.errstate(invalid="ignore"):
        standing, moving = (speed >= 0) & (speed < _STANDING), speed >= _STANDING
        directed = moving & (bearing >= 0) & (bearing <= 360)
    known = np.isfinite(t) & (directed | standing & (directed.any() or not moving.any()))
    speed, angle = speed[known], np.radians(np.where(np.isfinite(bearing[known]), bearing[known], 0.0))
    enu = np.stack([speed * np.sin(angle), speed * np.cos(angle), np.zeros_like(speed)], axis=1)
    return VelocityData(t[known], enu)
