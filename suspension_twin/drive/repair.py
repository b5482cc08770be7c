# SPDX-License-Identifier: Apache-2.0
"""Repair of recorded data: stamps that are missing or absurd, samples that are not finite.

Nothing is repaired silently: each function returns a line for every repair.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData

__all__ = ["clean_drive", "measured", "nanoseconds", "repair_stamps", "seconds"]

Bools = NDArray[np.bool_]
Stamps = NDArray[np.int64]
Kind = TypeVar("Kind", ImuData, FixData, VelocityData, HeadingData)

#: A stamp this far from its neighbours' offset to the record time is a fault, not jitter.
_OUTLIER_NS = 10_000_000_000
_NEIGHBOURS = 9

#: Beyond this, in SI units, no sensor on a vehicle measures: the bytes are damaged.
_BEYOND = 1e6


def seconds(stamps: Stamps) -> Floats:
    """Stamps in ns as s, each the nearest double."""
    return np.asarray(stamps // 1_000_000_000 + (stamps % 1_000_000_000) / 1e9, dtype=np.float64)


def nanoseconds(t: Floats) -> Stamps:
    """Times in s as ns: ``seconds(nanoseconds(t))`` is ``t`` to within half a nanosecond."""
    whole = np.floor(t)
    return np.asarray(whole.astype(np.int64) * 1_000_000_000 + np.rint((t - whole) * 1e9).astype(np.int64))


def _count(number: int, of: int, kind: str) -> str:
    return f"{number} of {of} {kind}"


def repair_stamps(header: Stamps, recorded: Stamps) -> tuple[Floats, Bools, list[str]]:
    """Times (n,) in s, which samples to keep (n,), and a line for every repair.

    ``header`` and ``recorded`` are ns, in the order of recording. All header stamps zero (or
    before 1970): the record stamps are the times. Some: they get the record stamp, shifted by the median
    difference of the two. A stamp more than 10 s off its neighbours is left out. A clock
    that goes back for good (a looped recording) is kept as it is, with a warning.
    """
    warnings: list[str] = []
    n = header.size
    keep = np.ones(n, dtype=np.bool_)
    missing = header <= 0
    stamps = header.copy()
    if missing.all() and n:
        warnings.append("no header stamps: the times of recording are taken")
        stamps = recorded.copy()
        if (stamps <= 0).all() and n > 1:
            return seconds(stamps), ~keep, ["neither header stamps nor times of recording: left out"]
    elif missing.any():
        stamps[missing] = recorded[missing] + np.int64(np.median((header - recorded)[~missing]))
        warnings.append(
            f"{_count(int(missing.sum()), n, 'header stamps')} are missing: taken from the recording"
        )
    if n >= 3:
        offset = (stamps - recorded).astype(np.float64)
        local = median_filter(offset, size=min(_NEIGHBOURS, n), mode="nearest")
        absurd = np.abs(offset - local) > _OUTLIER_NS
        if absurd.any():
            keep &= ~absurd
            warnings.append(f"{_count(int(absurd.sum()), n, 'stamps')} are absurd: left out")
    kept = stamps[keep]
    back = np.diff(kept) < -1_000_000_000
    if back.any():
        warnings.append(f"time jumps back {int(back.sum())} times by more than 1 s (a looped recording?)")
    return seconds(stamps), keep, warnings


def measured(values: Floats) -> Bools:
    """Rows of (n, k) that are finite and of a size that can be measured; NaN and infinity are neither."""
    return np.asarray((np.abs(values) < _BEYOND).all(axis=1))


def clean_drive(drive: Drive) -> Drive:
    """The drive without samples that are not numbers or no place on Earth; warnings added."""
    warnings = list(drive.warnings)

    def kept(samples: Kind, good: Bools, kind: str, fault: str) -> Kind:
        if good.all():
            return samples
        warnings.append(f"{_count(int((~good).sum()), len(samples), kind)} {fault}: left out")
        return samples.select(good)

    imu, fix, velocity, heading = drive.imu, drive.fix, drive.velocity, drive.heading
    good = np.isfinite(imu.t) & measured(imu.specific_force) & measured(imu.angular_rate)
    imu = kept(imu, good, "IMU samples", "are no numbers")
    with np.errstate(invalid="ignore"):
        good = (np.abs(fix.latitude) <= 90) & (np.abs(fix.longitude) <= 180) & np.isfinite(fix.t)
    # receivers and phones report 0, 0 before their first fix
    good &= ~((fix.latitude == 0) & (fix.longitude == 0))
    fix = _with_altitude(kept(fix, good, "fixes", "have no valid position"), warnings)
    good = measured(velocity.enu) & np.isfinite(velocity.t)
    velocity = kept(velocity, good, "velocities", "are no numbers")
    if heading is not None:
        heading = kept(
            heading, np.isfinite(heading.yaw) & np.isfinite(heading.t), "headings", "are not valid"
        )
    return replace(drive, imu=imu, fix=fix, velocity=velocity, heading=heading, warnings=tuple(warnings))


def _with_altitude(fix: FixData, warnings: list[str]) -> FixData:
    """Fixes with the altitudes that are missing taken from their neighbours, or as 0 m."""
    known = np.abs(fix.altitude) < 1e5  # m; NaN and infinity are not
    if known.all():
        return fix
    altitude, done = np.zeros(len(fix)), "taken as 0 m"
    if known.any():
        altitude, done = np.interp(fix.t, fix.t[known], fix.altitude[known]), "taken from their neighbours"
    warnings.append(f"{_count(int((~known).sum()), len(fix), 'fixes')} have no altitude: {done}")
    return replace(fix, altitude=altitude)
