# SPDX-License-Identifier: Apache-2.0
"""Parts of drives and drives put together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.errors import InputError

__all__ = ["concatenate", "cut"]


def cut(drive: Drive, start: float, stop: float) -> Drive:
    """What was stamped at ``start`` <= t < ``stop`` (s since the epoch); it may be empty."""

    def within(t: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (t >= start) & (t < stop)
        return inside

    i, f, v = within(drive.imu.t), within(drive.fix.t), within(drive.velocity.t)
    imu, fix, heading = drive.imu, drive.fix, drive.heading
    if heading is not None:
        h = within(heading.t)
        heading = HeadingData(heading.t[h], heading.yaw[h])
    return Drive(
        name=drive.name,
        imu=ImuData(
            imu.t[i],
            imu.specific_force[i],
            imu.angular_rate[i],
            None if imu.orientation is None else imu.orientation[i],
            imu.frame,
        ),
        fix=FixData(
            fix.t[f],
            fix.latitude[f],
            fix.longitude[f],
            fix.altitude[f],
            fix.status[f],
            fix.sigma[f],
            fix.frame,
        ),
        velocity=VelocityData(drive.velocity.t[v], drive.velocity.enu[v]),
        heading=heading,
        warnings=drive.warnings,
    )


def concatenate(drives: Sequence[Drive], name: str | None = None) -> Drive:
    """One drive after the other, as a recorder that was switched off between them would have it.

    Raises InputError where one begins before the one before it ends, or there is none.
    """
    if not drives:
        raise InputError("drives", "none given")
    for before, after in zip(drives, drives[1:], strict=False):
        if len(before.imu) and len(after.imu) and after.imu.t[0] <= before.imu.t[-1]:
            raise InputError(after.name, f"begins before {before.name} ends")
    imus, fixes = [d.imu for d in drives], [d.fix for d in drives]
    orientations = [imu.orientation for imu in imus if imu.orientation is not None]
    headings = [d.heading for d in drives if d.heading is not None]
    return Drive(
        name=name or drives[0].name,
        imu=ImuData(
            np.concatenate([imu.t for imu in imus]),
            np.concatenate([imu.specific_force for imu in imus]),
            np.concatenate([imu.angular_rate for imu in imus]),
            np.concatenate(orientations) if len(orientations) == len(drives) else None,
            imus[0].frame,
        ),
        fix=FixData(
            np.concatenate([fix.t for fix in fixes]),
            np.concatenate([fix.latitude for fix in fixes]),
            np.concatenate([fix.longitude for fix in fixes]),
            np.concatenate([fix.altitude for fix in fixes]),
            np.concatenate([fix.status for fix in fixes]),
            np.concatenate([fix.sigma for fix in fixes]),
            fixes[0].frame,
        ),
        velocity=VelocityData(
            np.concatenate([d.velocity.t for d in drives]), np.concatenate([d.velocity.enu for d in drives])
        ),
        heading=HeadingData(
            np.concatenate([h.t for h in headings]), np.concatenate([h.yaw for h in headings])
        )
        if headings
        else None,
        warnings=tuple(line for d in drives for line in d.warnings),
    )
