# SPDX-License-Identifier: Apache-2.0
"""Checks of recorded data: repair of stamps and samples, and the summary of a drive.

Nothing is repaired silently: each function returns a line for every repair. The summary has rates, gaps, the axis of
gravity, path and speed, in figures and in words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import TypeVar

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from suspension_twin.arrays import Floats
from suspension_twin.drive.motion import on_one_clock
from suspension_twin.drive.received import (
    held_places,
    held_velocities,
    interpolated_places,
    one_per_epoch,
    with_vertical,
)
from suspension_twin.drive.stamps import (
    began_again,
    evened,
    jumps_back,
    of_one_recording,
    own_stamps,
    unwrapped,
)
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, VelocityData

__all__ = [
    "UNTIMED",
    "Gravity",
    "Rhythm",
    "Summary",
    "clean_drive",
    "gravity_of",
    "measured",
    "nanoseconds",
    "path_length",
    "repair_stamps",
    "rhythm_of",
    "seconds",
    "summarise",
]

Bools = NDArray[np.bool_]
Stamps = NDArray[np.int64]
Kind = TypeVar("Kind", ImuData, FixData, VelocityData, HeadingData)

#: A stamp this far from its neighbours' offset to the record time is a fault, not jitter.
_OUTLIER_NS = 10_000_000_000
_NEIGHBOURS = 9

#: Of a recording whose stamps scatter about a clock that does not show.
UNTIMED = (
    "stamps of the IMU scatter, and no even clock shows behind them: nothing says when a sample was taken"
)

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
    difference of the two; one that has neither is left out. A stamp more than 10 s off its neighbours is left out,
    and so are a few out of all proportion to the pause between them and the others. A counter that begins again goes
    on. A clock that goes back for good (a looped recording) is kept as it is, with a warning.
    """
    warnings: list[str] = []
    n = header.size
    keep = np.ones(n, dtype=np.bool_)
    missing = header <= 0
    stamps = header.copy()
    unknown = missing & (recorded <= 0)
    if unknown.any() and n > 1:
        text = f"{_count(int(unknown.sum()), n, 'messages')} have neither header stamp nor time of recording"
        warnings.append(f"{text} (recorded before the first /clock?): left out")
        keep, missing = ~unknown, missing & ~unknown
    known = header[keep & ~missing] - recorded[keep & ~missing]
    if missing.any() and not known.size:
        warnings.append("no header stamps: the times of recording are taken")
        stamps[missing] = recorded[missing]
    elif missing.any():
        stamps[missing] = recorded[missing] + np.int64(np.median(known))
        warnings.append(
            f"{_count(int(missing.sum()), n, 'header stamps')} are missing: taken from the recording"
        )

    def lost(bad: Bools, fault: str) -> None:
        if bad.any():
            keep[np.flatnonzero(keep)[bad]] = False
            warnings.append(f"{_count(int(bad.sum()), n, 'stamps')} {fault}: left out")

    if keep.sum() >= 3:
        offset = (stamps - recorded)[keep].astype(np.float64)
        local = median_filter(offset, size=min(_NEIGHBOURS, offset.size), mode="nearest")
        lost(np.abs(offset - local) > _OUTLIER_NS, "are absurd")
    t = seconds(stamps)
    t[keep], span = unwrapped(t[keep])
    if span:
        warnings.append(began_again(span))
    lost(~of_one_recording(t[keep]), "lie far from the others")
    back = jumps_back(t[keep])
    if back.size:
        first = t[keep][back[0] - 1 : back[0] + 1]
        times = f"{back.size} times, first by {first[0] - first[1]:.2f} s after {first[0]:.2f}"
        warnings.append(f"time jumps back {times} (a looped recording?)")
    return t, keep, warnings


def measured(values: Floats) -> Bools:
    """Rows of (n, k) that are finite and of a size that can be measured; NaN and infinity are neither."""
    return np.asarray((np.abs(values) < _BEYOND).all(axis=1))


def clean_drive(drive: Drive) -> Drive:
    """The drive without samples that are not numbers, no place on Earth, or there twice; warnings added."""
    warnings = list(drive.warnings)

    def kept(samples: Kind, good: Bools, kind: str, fault: str) -> Kind:
        if good.all():
            return samples
        warnings.append(f"{_count(int((~good).sum()), len(samples), kind)} {fault}: left out")
        return samples.select(good)

    imu, fix, velocity, heading = drive.imu, drive.fix, drive.velocity, drive.heading
    good = np.isfinite(imu.t) & measured(imu.specific_force) & measured(imu.angular_rate)
    imu = kept(imu, good, "IMU samples", "are no numbers")
    t, good, lines = own_stamps(imu.t, np.hstack([imu.specific_force, imu.angular_rate]), "IMU samples")
    imu = replace(imu, t=t).select(good)
    warnings += lines
    t, known = evened(imu.t, np.hstack([imu.specific_force, imu.angular_rate]))
    if not np.array_equal(t, imu.t):
        scattered = f"stamps of the IMU scatter by {1e3 * np.std(imu.t - t):.2g} ms about an even clock"
        warnings.append(f"{scattered}: its times are taken")
        imu = replace(imu, t=t)
    if not known:
        warnings.append(UNTIMED)
    with np.errstate(invalid="ignore"):
        good = (np.abs(fix.latitude) <= 90) & (np.abs(fix.longitude) <= 180) & np.isfinite(fix.t)
    # receivers and phones report 0, 0 before their first fix
    good &= ~((fix.latitude == 0) & (fix.longitude == 0))
    fix = kept(fix, good, "fixes", "have no valid position")
    fix = kept(fix, one_per_epoch(fix), "fixes", "have the stamp of another, more complete or before them")
    velocity, unknown = with_vertical(velocity)
    if unknown:
        text = _count(unknown, len(velocity), "velocities")
        warnings.append(f"{text} have no vertical part: taken as 0 m/s")
    good = measured(velocity.enu) & np.isfinite(velocity.t)
    velocity = kept(velocity, good, "velocities", "are no numbers")
    velocity = kept(velocity, np.diff(velocity.t, prepend=-np.inf) != 0, "velocities", "repeat a stamp")
    for judge, fault in (
        (held_places, "repeat the position before (held until the receiver computes another)"),
        (interpolated_places, "are interpolated between those that the receiver computed"),
    ):
        own = ~judge(fix)
        repeated = held_velocities(velocity, fix.t[~own])
        velocity = kept(velocity, ~repeated, "velocities", "repeat the one before")
        fix = kept(fix, own, "fixes", fault)
    if heading is not None:
        heading = kept(
            heading, np.isfinite(heading.yaw) & np.isfinite(heading.t), "headings", "are not valid"
        )
    drive = replace(drive, imu=imu, fix=fix, velocity=velocity, heading=heading)
    drive, lines = on_one_clock(drive)
    warnings += lines
    fix, velocity = drive.fix, drive.velocity
    if len(imu):
        apart = "lie apart, outside the IMU's time"
        fix = kept(fix, _beside(imu, fix.t), "fixes", apart)
        velocity = kept(velocity, _beside(imu, velocity.t), "velocities", apart)
    fix = _with_altitude(fix, warnings)
    return replace(drive, fix=fix, velocity=velocity, warnings=tuple(warnings))


def _beside(imu: ImuData, t: Floats) -> Bools:
    """Which of the stamps (n,) s go on, without a gap, from those within the IMU's time; all where none is."""
    inside = (t >= imu.t.min()) & (t <= imu.t.max())
    part = np.cumsum(np.concatenate([[False], ~_bridged(t)]))[: t.size]
    return np.asarray(np.isin(part, part[inside]) | ~inside.any())


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


# Summary

#: An interval longer than so many usual ones is a gap.
_GAP = 3.0
#: s that the pose goes on without a fix (``outage`` of :class:`~suspension_twin.pose.types.PoseSettings`).
_WITHOUT_FIX = 2.5


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
        speed = f", up to {self.top_speed:.1f} m/s" if np.isfinite(self.top_speed) else ""
        return lines if np.isnan(self.path) else [*lines, f"path: {self.path / 1000:.2f} km{speed}"]


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
    altitude = np.nan_to_num(fix.altitude[good])
    east, north, _ = pymap3d.geodetic2enu(
        latitude, longitude, altitude, latitude[0], longitude[0], altitude[0]
    )
    return float(np.hypot(np.diff(east), np.diff(north))[_bridged(fix.t[good])].sum())


def _bridged(t: Floats) -> Bools:
    """Which intervals (n - 1,) between stamps (n,) s a path goes on over: it stops at gaps."""
    step = np.diff(t)
    usual = float(np.median(step)) if step.size else 0.0
    return np.asarray((step > 0) & (step <= max(_GAP * usual, _WITHOUT_FIX)))


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
        velocities, the length of the polygon through the fixes; it leaves gaps out.

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
        step = np.where(_bridged(velocity.t), np.diff(velocity.t), 0.0)
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
