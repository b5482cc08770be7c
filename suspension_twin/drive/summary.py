# SPDX-License-Identifier: Apache-2.0
"""Summary of a drive in figures and in words: rates, gaps, the axis of gravity, path, speed."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
import pymap3d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive, FixData

__all__ = ["Gravity", "Rhythm", "Summary", "gravity_of", "path_length", "rhythm_of", "summarise"]

#: An interval longer than so many usual ones is a gap.
_GAP = 3.0


@dataclass(frozen=True)
class Rhythm:
    """How stamps follow one another. ``rate`` Hz is that of the usual (median) interval; ``gaps`` are
    (time s, length s) of intervals of more than three times it, in order."""

    count: int
    start: float
    duration: float
    rate: float
    gaps: tuple[tuple[float, float], ...]

    @property
    def longest_gap(self) -> float:
        """s, 0 without gaps."""
        return max((length for _, length in self.gaps), default=0.0)

    @property
    def gaps_in_words(self) -> str:
        """Number of gaps and the longest one."""
        if not self.gaps:
            return "no gaps"
        return (
            f"{len(self.gaps)} gap{'s' if len(self.gaps) > 1 else ''}, the longest {self.longest_gap:.2f} s"
        )


@dataclass(frozen=True)
class Gravity:
    """Where gravity acts: ``axis`` of the sensor that points most upwards (``+z``), ``tilt`` rad of
    that axis against the vertical, ``size`` m/s² of the mean specific force."""

    axis: str
    tilt: float
    size: float


@dataclass(frozen=True)
class Summary:
    """Figures of one drive; ``path`` m and ``top_speed`` m/s are NaN without GPS."""

    name: str
    imu: Rhythm
    gravity: Gravity
    fix: Rhythm
    velocity: Rhythm
    path: float
    top_speed: float
    no_fix: int

    def lines(self) -> list[str]:
        """The figures in words, a line each."""
        begin = ""
        if self.imu.start > 1e8:  # else the clock was never set
            moment = datetime.fromtimestamp(self.imu.start, tz=timezone.utc)
            begin = f", from {moment:%Y-%m-%d %H:%M:%S} UTC"
        upside_down = " (upside down, or axes forward, right, down)"
        posture = {"+z": "", "-z": upside_down}.get(self.gravity.axis, " (not lying flat)")
        lines = [
            f"IMU: {self.imu.count} samples at {self.imu.rate:.2f} Hz over {self.imu.duration:.1f} s{begin}; "
            f"{self.imu.gaps_in_words}",
            f"gravity: on {self.gravity.axis}, tilted {np.degrees(self.gravity.tilt):.1f} degrees, "
            f"{self.gravity.size:.2f} m/s²{posture}",
        ]
        if not self.fix.count:
            return [*lines, "GPS: no positions"]
        lost = f", {self.no_fix} without a fix" if self.no_fix else ""
        lines.append(
            f"GPS: {self.fix.count} positions at {self.fix.rate:.2f} Hz over {self.fix.duration:.1f} s{lost}; "
            f"{self.fix.gaps_in_words}"
        )
        if self.velocity.count:
            lines.append(f"path: {self.path / 1000:.2f} km, up to {self.top_speed:.1f} m/s")
        return lines


def rhythm_of(t: Floats) -> Rhythm:
    """Rate and gaps of stamps (n,) s; zeros where there are fewer than two."""
    if t.size < 2:
        return Rhythm(int(t.size), float(t[0]) if t.size else 0.0, 0.0, 0.0, ())
    step = np.diff(t)
    forward = step[step > 0]
    usual = float(np.median(forward)) if forward.size else 0.0
    at = np.flatnonzero(step > _GAP * usual) if usual else np.empty(0, dtype=np.intp)
    gaps = tuple((float(t[i]), float(step[i])) for i in at)
    return Rhythm(int(t.size), float(t[0]), float(t[-1] - t[0]), 1 / usual if usual else 0.0, gaps)


def gravity_of(specific_force: Floats) -> Gravity:
    """From specific force (n, 3) m/s² of a whole drive, whose mean is gravity but for braking left over."""
    mean = specific_force.mean(axis=0)
    size = float(np.linalg.norm(mean))
    i = int(np.argmax(np.abs(mean)))
    share = abs(float(mean[i])) / size if size else 1.0
    return Gravity(f"{'+' if mean[i] >= 0 else '-'}{'xyz'[i]}", float(np.arccos(min(share, 1.0))), size)


def path_length(fix: FixData) -> float:
    """Horizontal length in m of the polygon through the valid fixes."""
    good = fix.status >= 0
    if good.sum() < 2:
        return 0.0
    latitude, longitude = fix.latitude[good], fix.longitude[good]
    altitude = fix.altitude[good]
    east, north, _ = pymap3d.geodetic2enu(
        latitude, longitude, altitude, latitude[0], longitude[0], altitude[0]
    )
    return float(np.hypot(np.diff(east), np.diff(north)).sum())


def summarise(drive: Drive) -> Summary:
    """Summarise a drive: rates, gaps, the axis of gravity, path and top speed.

    Parameters
    ----------
    drive : Drive
        The recording.

    Returns
    -------
    Summary
        ``lines()`` gives the figures in words. The path is the integral of the speed in m, or, without
        velocities, the length of the polygon through the fixes.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> round(float(summarise(read_drive("bags/crg_road")).top_speed), 1)
    7.1
    """
    velocity = drive.velocity
    path = top = float("nan")
    if len(velocity) > 1:
        speed = np.hypot(velocity.enu[:, 0], velocity.enu[:, 1])
        step = np.clip(np.diff(velocity.t), 0.0, None)
        path, top = float((step * (speed[1:] + speed[:-1]) / 2).sum()), float(speed.max())
    elif len(drive.fix) > 1:
        path = path_length(drive.fix)
    return Summary(
        name=drive.name,
        imu=rhythm_of(drive.imu.t),
        gravity=gravity_of(drive.imu.specific_force),
        fix=rhythm_of(drive.fix.t),
        velocity=rhythm_of(velocity.t),
        path=path,
        top_speed=top,
        no_fix=int((drive.fix.status < 0).sum()),
    )
