# SPDX-License-Identifier: Apache-2.0
"""Sensor streams as an importer finds them, and the drive that is made of them.

An importer hands on each stream with its own stamps and in its own unit; here they are put in
order, into SI units and onto common stamps, and everything that was decided is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.intake.velocity import velocities_from_fixes
from suspension_twin.drive.repair import clean_drive, measured
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.units import STANDARD_GRAVITY

__all__ = ["Series", "Streams", "assemble", "merge"]

Received = TypeVar("Received", FixData, VelocityData)


#: Median of |specific force| by which its unit is recognised: a sensor at rest reads 1 g.
_IN_G = (0.5, 2.0)
_IN_SI = (5.0, 20.0)

#: No drive is that long: a stamp further from the others is damage.
_LONGEST = 30 * 86_400.0  # s


@dataclass(frozen=True, eq=False)
class Series:
    """Values (n, k) at stamps ``t`` (n,) s."""

    t: Floats
    values: Floats


@dataclass
class Streams:
    """What one source holds. ``force`` is specific force (gravity included) in sensor axes.

    ``force_unit`` None lets the values decide. ``notes`` say what was recognised, ``warnings``
    what was lost or is doubtful.
    """

    origin: str
    force: Series | None = None
    rate: Series | None = None
    force_unit: Literal["m/s²", "g"] | None = None
    fix: FixData | None = None
    velocity: VelocityData | None = None
    heading: HeadingData | None = None
    frame: str = "imu_link"
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def merge(parts: Sequence[Streams]) -> Streams:
    """One out of several sources; of a stream that more than one has, the last one's counts."""
    whole = Streams(origin=" + ".join(part.origin for part in parts))
    for part in parts:
        for name in ("force", "rate", "fix", "velocity", "heading"):
            value = getattr(part, name)
            if value is None:
                continue
            if getattr(whole, name) is not None:
                whole.notes.append(f"{name} from {part.origin}, not from the source before it")
            setattr(whole, name, value)
        if part.fix is not None and part.velocity is None and whole.velocity is not None:
            # another receiver's velocities would not belong to these fixes
            whole.velocity = None
        if part.force is not None:
            whole.force_unit, whole.frame = part.force_unit, part.frame
        whole.notes += part.notes
        whole.warnings += part.warnings
    return whole


def assemble(streams: Streams, name: str, source: str) -> tuple[Drive, list[str]]:
    """The drive and what was decided on the way, a line each.

    Raises InputError naming ``source`` where there is no accelerometer, no gyroscope, or the two do
    not overlap in time.
    """
    notes = list(streams.notes)
    warnings = list(streams.warnings)
    if streams.force is None:
        raise InputError(source, "no accelerometer data")
    if streams.rate is None:
        raise InputError(source, "no gyroscope data: record it together with the accelerometer")
    force = _in_order(streams.force, "accelerometer samples", warnings)
    rate = _in_order(streams.rate, "gyroscope samples", warnings)
    for series, what in ((force, "accelerometer"), (rate, "gyroscope")):
        if series.t.size < 2:
            raise InputError(source, f"no usable {what} data")
    values = _in_si(force.values, streams.force_unit, notes, warnings)
    fastest = float(np.abs(rate.values).max())
    if fastest > 40.0:  # 2300 degrees a second: beyond the range of any phone's gyroscope
        warnings.append(f"angular rates up to {fastest:.0f} rad/s: are they in deg/s?")
    if force.t.size == rate.t.size and np.array_equal(force.t, rate.t):
        t, rates = force.t, rate.values
    else:
        t, values, rates = _on_common_stamps(Series(force.t, values), rate, source, notes, warnings)
    velocity = streams.velocity
    if velocity is None and streams.fix is not None and len(streams.fix):
        velocity = velocities_from_fixes(streams.fix)
        if len(velocity):
            notes.append("velocity: none recorded, derived from the positions")
    drive = Drive(
        name=name,
        imu=ImuData(t, values, rates, None, streams.frame),
        fix=_in_time_order(streams.fix or FixData.empty(), "fixes", warnings),
        velocity=_in_time_order(velocity or VelocityData.empty(), "velocities", warnings),
        heading=streams.heading,
        warnings=tuple(warnings),
    )
    drive = clean_drive(drive)
    if not len(drive.fix):
        notes.append("no GPS positions: the pose cannot be locked to this drive")
    else:
        overlap = min(drive.fix.t[-1], drive.imu.t[-1]) - max(drive.fix.t[0], drive.imu.t[0])
        if overlap <= 0:
            text = f"IMU and GPS do not overlap in time: {_apart(drive)}"
            drive = replace(drive, warnings=(*drive.warnings, text))
    return drive, notes


def _apart(drive: Drive) -> str:
    gap = max(drive.fix.t[0] - drive.imu.t[-1], drive.imu.t[0] - drive.fix.t[-1])
    return f"{gap:.1f} s lie between them, check the time base"


def _in_order(series: Series, what: str, warnings: list[str]) -> Series:
    """Finite samples in rising order of time, each stamp once."""
    timed = _timed(series.t, what, warnings)
    good = timed & measured(series.values)
    lost = int(timed.sum() - good.sum())
    if lost:
        warnings.append(f"{lost} of {good.size} {what} are no numbers: left out")
    t, values = series.t[good], series.values[good]
    if t.size and (np.diff(t) <= 0).any():
        order = np.argsort(t, kind="stable")
        back = int((np.diff(t) < 0).sum())
        t, values = t[order], values[order]
        first = np.concatenate([[True], np.diff(t) > 0])
        repeated = int(t.size - first.sum())
        t, values = t[first], values[first]
        if back:
            warnings.append(f"{back} of {good.size} {what} came out of order: sorted")
        if repeated:
            warnings.append(f"{repeated} of {good.size} {what} repeat a stamp: left out")
    return Series(t, values)


def _timed(t: Floats, what: str, warnings: list[str]) -> NDArray[np.bool_]:
    """Which stamps are finite and near the others."""
    good = np.isfinite(t)
    if good.any():
        good &= np.abs(np.where(good, t, 0.0) - np.median(t[good])) < _LONGEST
    if not good.all():
        warnings.append(f"{int((~good).sum())} of {t.size} {what} have no usable stamp: left out")
    return good


def _in_si(values: Floats, unit: str | None, notes: list[str], warnings: list[str]) -> Floats:
    """Specific force in m/s²; the unit given, or the one its magnitude suggests."""
    size = float(np.median(np.linalg.norm(values, axis=1)))
    if unit is None:
        unit = "g" if _IN_G[0] <= size <= _IN_G[1] else "m/s²"
        notes.append(f"accelerometer: median {size:.2f}, so in {unit}")
    if unit == "g":
        values, size = values * STANDARD_GRAVITY, size * STANDARD_GRAVITY
    if size < _IN_SI[0] / 2:
        warnings.append(
            f"accelerometer: median {size:.2f} m/s²: gravity seems to be removed; record the accelerometer with gravity"
        )
    elif not _IN_SI[0] <= size <= _IN_SI[1]:
        warnings.append(f"accelerometer: median {size:.1f} m/s², not gravity's 9.8: check the unit")
    return values


def _on_common_stamps(
    force: Series, rate: Series, source: str, notes: list[str], warnings: list[str]
) -> tuple[Floats, Floats, Floats]:
    """Both at the accelerometer's stamps, the gyroscope interpolated where it has no gap."""
    step = float(np.median(np.diff(rate.t)))
    after = np.clip(np.searchsorted(rate.t, force.t), 1, rate.t.size - 1)
    nearest = np.minimum(np.abs(force.t - rate.t[after - 1]), np.abs(rate.t[after] - force.t))
    inside = nearest <= max(0.05, 2.5 * step)
    if inside.sum() < 2:
        raise InputError(source, "accelerometer and gyroscope do not overlap in time")
    lost = int((~inside).sum())
    if lost:
        warnings.append(
            f"{lost} of {force.t.size} accelerometer samples have no gyroscope beside them: left out"
        )
    t = force.t[inside]
    rates = np.stack([np.interp(t, rate.t, rate.values[:, i]) for i in range(3)], axis=1)
    notes.append(f"gyroscope: {1 / step:.1f} Hz, taken at the accelerometer's stamps")
    return t, force.values[inside], rates


def _in_time_order(samples: Received, what: str, warnings: list[str]) -> Received:
    """The samples with a usable stamp in rising order, each stamp once."""
    t = samples.t
    order = np.argsort(t, kind="stable")
    order = order[_timed(t, what, warnings)[order]]
    fresh = np.concatenate([[True], np.diff(t[order]) > 0]) if order.size else np.empty(0, dtype=np.bool_)
    if not fresh.all():
        warnings.append(f"{int((~fresh).sum())} of {t.size} {what} repeat a stamp: left out")
    return samples.select(order[fresh])
