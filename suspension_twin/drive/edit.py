# SPDX-License-Identifier: Apache-2.0
"""Parts of drives and drives put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData
from suspension_twin.errors import InputError

__all__ = ["concatenate", "cut"]

_STREAMS = ("imu", "fix", "velocity", "heading")


def cut(drive: Drive, start: float, stop: float) -> Drive:
    """Cut a piece out of a drive.

    Parameters
    ----------
    drive : Drive
        The recording.
    start, stop : float
        Stamps in s since the epoch; samples with ``start`` <= t < ``stop`` are kept.

    Returns
    -------
    Drive
        The piece; it may be empty.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> drive = read_drive("bags/bump_15kmh")
    >>> begin = drive.imu.t[0]
    >>> piece = cut(drive, begin + 10.0, begin + 20.0)
    >>> 990 < len(piece.imu) <= 1001
    True
    """
    streams = {name: getattr(drive, name) for name in _STREAMS}
    inside = {k: s.select((s.t >= start) & (s.t < stop)) for k, s in streams.items() if s is not None}
    return replace(drive, **inside)


def concatenate(drives: Sequence[Drive], name: str | None = None) -> Drive:
    """Join drives as a recorder that was switched off between them would have recorded them.

    Parameters
    ----------
    drives : sequence of Drive
        In the order of time.
    name : str, optional
        Name of the result; that of the first by default.

    Returns
    -------
    Drive
        All samples, one drive after the other.

    Raises
    ------
    InputError
        No drive, or one that begins before the one before it ends.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> drive = read_drive("bags/bump_15kmh")
    >>> middle = drive.imu.t[0] + 30.0
    >>> whole = concatenate([cut(drive, 0.0, middle), cut(drive, middle, float("inf"))])
    >>> len(whole.imu) == len(drive.imu)
    True
    """
    if not drives:
        raise InputError("drives", "none given")
    for before, after in zip(drives, drives[1:], strict=False):
        if len(before.imu) and len(after.imu) and after.imu.t[0] <= before.imu.t[-1]:
            raise InputError(after.name, f"begins before {before.name} ends")
    headings = [d.heading for d in drives if d.heading is not None]
    return Drive(
        name=name or drives[0].name,
        imu=ImuData.joined([d.imu for d in drives]),
        fix=FixData.joined([d.fix for d in drives]),
        velocity=VelocityData.joined([d.velocity for d in drives]),
        heading=HeadingData.joined(headings) if headings else None,
        warnings=tuple(line for d in drives for line in d.warnings),
    )
