# SPDX-License-Identifier: Apache-2.0
"""The offline IMU path: a whole recording to bias-free signals in ``base_link`` axes, unfiltered."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.drive.units import rates_in_degrees, recognise_units, turning_fault, windowed
from suspension_twin.errors import InputError
from suspension_twin.signals.attitude import (
    carried_up,
    smooth_up,
)
from suspension_twin.signals.checks import (
    Finding,
    check_axes,
    check_rate,
    saturated_samples,
)
from suspension_twin.signals.clock import Cleaned, clean_stamps, find_gaps, nominal_rate
from suspension_twin.signals.imu import MAX_TILT_DIFFERENCE, ImuReading, ImuSettings, standstill_mask
from suspension_twin.signals.mounting_change import (
    QUIET,
    WINDOW,
    MountingChange,
    mounting_change,
    windows_of,
)
from suspension_twin.vehicle.twin import Place

__all__ = [
    "NO_FIX",
    "GnssMotion",
    "ImuFacts",
    "ImuSignals",
    "gnss_motion",
    "ingest_drive",
    "turns_said",
]

NO_FIX = -1  # sensor_msgs/NavSatStatus
FAST = 3.0  # m/s from which a course is one
NEAR = 1.5  # s beyond which a stamp is too far from another
CLIMB = 2.5  # s
STEEPEST = math.radians(6.0)  # a road of 10 %: more is an error of the altitudes
MOST_CHANGES = 3  # a holder that slips more often is taken for one that slips on and on


@dataclass(frozen=True, eq=False)
class GnssMotion:
    """``t`` (m,) s rising, ``east`` and ``north`` (m,) m/s over ground, means ``over`` as many s about it, ``noise``
    m/s their uncertainty."""

    t: Floats
    east: Floats
    north: Floats
    noise: float
    over: float = 0.0

    @property
    def known(self) -> bool:
        """Whether there is anything to go by."""
        return self.t.size >= 4

    def _near(self, t: Floats) -> Floats:
        after = np.clip(np.searchsorted(self.t, t), 1, self.t.size - 1)
        return np.minimum(np.abs(t - self.t[after - 1]), np.abs(t - self.t[after]))

    def least_speed(self, t: Floats) -> Floats:
        """(n,) m/s at stamps ``t`` that the vehicle has at least, NaN far from any message."""
        speed = np.maximum(np.hypot(self.east, self.north) - self.noise, 0.0)
        return np.where(self._near(t) < NEAR, np.interp(t, self.t, speed), np.nan)

    def quiet(self, t: Floats) -> NDArray[np.bool_] | None:
        """(n,) True at stamps ``t`` where the vehicle neither brakes nor turns; None where that is not known."""
        if not self.known or self.noise > 0.5:
            return None
        grid = np.linspace(self.t[0], self.t[-1], max(3, round((self.t[-1] - self.t[0]) / 0.5) + 1))
        velocity = np.interp(grid, self.t, self.east) + 1.0j * np.interp(grid, self.t, self.north)
        return np.asarray(np.interp(t, grid, np.abs(np.gradient(velocity, grid))) < QUIET)

    def slope(self, t: Floats, fix: FixData) -> Floats | None:
        """(n,) rad of the road at ``t`` by the altitudes of the fixes over ``CLIMB`` s before and after; None where
        they or the speed are not known."""
        good = np.isfinite(fix.altitude) & (fix.status != NO_FIX)
        if not self.known or np.count_nonzero(good) < 4:
            return None
        stamps, first = np.unique(fix.t[good], return_index=True)
        grid = np.arange(max(stamps[0], self.t[0]), min(stamps[-1], self.t[-1]), 0.5)
        if grid.size < 2:
            return None
        altitude = np.interp(grid, stamps, fix.altitude[good][first])
        speed = np.interp(grid, self.t, np.hypot(self.east, self.north))
        way = np.concatenate([[0.0], np.cumsum(0.5 * speed[1:])])
        reach = round(CLIMB / 0.5)
        low = np.maximum(np.arange(grid.size) - reach, 0)
        high = np.minimum(np.arange(grid.size) + reach, grid.size - 1)
        # on a shorter way the altitudes' errors are slopes, too: three deviations of them stay below the steepest road
        sigma = np.interp(grid, stamps, np.nan_to_num(fix.sigma[good, 2][first], posinf=0.0))
        far = way[high] - way[low] > np.maximum(FAST * CLIMB, 3.0 * sigma / STEEPEST)
        if not far.any():
            return None
        slope = np.arctan2((altitude[high] - altitude[low])[far], (way[high] - way[low])[far])
        return np.asarray(np.clip(np.interp(t, grid[far], slope), -STEEPEST, STEEPEST))

    def acceleration(self, t: Floats, yaw_rate: Floats, place: tuple[float, float, float]) -> Floats:
        """(n, 3) m/s² in the plane at ``place`` in ``base_link``, ahead and to the left, by the vehicle's motion
        and the ``yaw_rate`` (n,) rad/s; zero where the motion is not known."""
        out = np.zeros((t.size, 3))
        if self.noise > 0.5:
            return out
        # On an even grid at 10 Hz, smoothed over about half a second: braking, not noise.
        span = self.t[-1] - self.t[0]
        grid = np.linspace(self.t[0], self.t[-1], max(3, round(span / 0.1) + 1))
        speed = np.interp(grid, self.t, np.hypot(self.east, self.north))
        pull = gaussian_filter1d(np.gradient(speed, grid), 3.0, mode="nearest")
        turn = np.interp(grid, t, yaw_rate)
        faster = np.interp(t, grid, gaussian_filter1d(np.gradient(turn, grid), 1.0, mode="nearest"))
        near = self._near(t) < NEAR
        ahead = np.interp(t, grid, pull) - yaw_rate**2 * place[0] - faster * place[1]
        left = np.interp(t, grid, speed) * yaw_rate + faster * place[0] - yaw_rate**2 * place[1]
        out[near, 0], out[near, 1] = ahead[near], left[near]
        return out

    def yaw_rate_bias(self, t: Floats, yaw_rate: Floats) -> float | None:
        """Rate in rad/s by which the gyro turns more than the course, over ten seconds of driving at least."""
        fast = np.hypot(self.east, self.north) > FAST + self.noise
        pair = fast[1:] & fast[:-1] & (np.diff(self.t) < NEAR)
        pair &= (self.t[:-1] >= t[0]) & (self.t[1:] <= t[-1])
        time = float(np.sum(np.diff(self.t)[pair]))
        if time < 10.0:
            return None
        course = np.arctan2(self.north, self.east)
        turned = np.concatenate([[0.0], np.cumsum(np.diff(t) * 0.5 * (yaw_rate[1:] + yaw_rate[:-1]))])
        more = np.diff(np.interp(self.t, t, turned)) - np.diff(course)
        wrapped = np.remainder(more[pair] + np.pi, 2 * np.pi) - np.pi
        return float(np.sum(wrapped)) / time


def gnss_motion(drive: Drive, apart: float | None = None) -> GnssMotion:
    """From the velocities, or else from the way between fixes ``apart`` s, or as far as their noise demands."""
    velocity, fix = drive.velocity, drive.fix
    good = np.isfinite(velocity.t) & np.isfinite(velocity.enu[:, :2]).all(axis=1)
    if np.count_nonzero(good) >= 4:
        stamps, first = np.unique(velocity.t[good], return_index=True)
        return GnssMotion(stamps, velocity.enu[good, 0][first], velocity.enu[good, 1][first], 0.0)
    good = (
        np.isfinite(fix.t) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & (fix.status != NO_FIX)
    )
    stamps, first = np.unique(fix.t[good], return_index=True)
    if stamps.size < 4:
        return GnssMotion(np.empty(0), np.empty(0), np.empty(0), 0.0)
    latitude, longitude = fix.latitude[good][first], fix.longitude[good][first]
    # A sphere will do: a thousandth of a speed does not matter here.
    north = 111_200.0 * (latitude - latitude[0])
    east = 111_200.0 * math.cos(math.radians(latitude[0])) * (longitude - longitude[0])
    reported = fix.sigma[good, :2]
    sigma = float(np.median(reported[np.isfinite(reported)])) if np.isfinite(reported).any() else 2.5
    if apart is None:
        apart = float(np.clip(14.0 * sigma, 0.1, 1.0))  # s that make 0.1 m/s of the noise
    later = np.minimum(np.searchsorted(stamps, stamps + 0.99 * apart), stamps.size - 1)
    ok = later > np.arange(stamps.size)
    step = (stamps[later] - stamps)[ok]
    return GnssMotion(
        0.5 * (stamps[later] + stamps)[ok],
        (east[later] - east)[ok] / step,
        (north[later] - north)[ok] / step,
        4.0 * sigma / float(np.median(step)),
        float(np.median(step)),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuFacts:
    """Facts of a drive's IMU: its ``place``; ``gravity`` m/s²; ``rate_hz``; ``force_bias`` m/s² and ``rate_bias`` rad/s
    (3,), what was subtracted, ``base_link`` axes; ``gaps`` (k, 2) start and end in s; ``findings``."""

    place: Place
    gravity: float
    rate_hz: float
    force_bias: Floats
    rate_bias: Floats
    gaps: Floats
    findings: list[Finding]


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuSignals(ImuFacts):
    """A drive's IMU in ``base_link`` axes at the sensor's place, at the ``n`` usable stamps, unfiltered.

    ``t`` (n,) s strictly rising; ``force`` (n, 3) m/s² specific force with gravity, ``rate`` (n, 3) rad/s, biases
    removed from both; ``vertical_acceleration`` (n,) m/s² gravity removed; ``up`` (n, 3) unit vector opposite to
    gravity; ``standing``, ``saturated`` (n,).
    """

    t: Floats
    force: Floats
    rate: Floats
    vertical_acceleration: Floats
    up: Floats
    standing: NDArray[np.bool_]
    saturated: NDArray[np.bool_]

    def __len__(self) -> int:
        return int(self.t.size)


def ingest_drive(drive: Drive, place: Place, settings: ImuSettings | None = None) -> ImuSignals:
    """Clean the IMU of a whole drive: axes, units, biases, the vertical.

    Parameters
    ----------
    drive : Drive
        The recording.
    place : Place
        Position and mounting of the sensor in ``base_link``, from the twin file.
    settings : ImuSettings, optional
        How the IMU is treated.

    Returns
    -------
    ImuSignals
        Specific force and rates in ``base_link`` axes at the sensor's place, unfiltered. ``findings`` of
        level "error" mean that the signals must not be used for calibration.

    Raises
    ------
    InputError
        No usable IMU samples.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> signals = ingest_drive(read_drive("bags/bump_15kmh"), load_twin("bags/bump_15kmh/twin.yaml").imu)
    >>> round(signals.rate_hz)
    100
    """
    settings = settings or ImuSettings()
    imu = drive.imu
    if len(imu) == 0:
        raise InputError(drive.name, "imu", "has no IMU samples: is the topic's name right?")
    finite = np.isfinite(np.hstack([imu.specific_force, imu.angular_rate])).all(axis=1)
    cleaned = clean_stamps(imu.t, np.asarray(finite))
    t = cleaned.stamps
    if t.size < 16:
        raise InputError(drive.name, "imu", f"{t.size} usable samples are too few")
    rate_hz = nominal_rate(t)
    gaps = find_gaps(t, rate_hz)
    findings = _clock_findings(cleaned, t, gaps, rate_hz)
    raw_force, raw_rate = imu.specific_force[cleaned.keep], imu.angular_rate[cleaned.keep]
    findings += check_axes(raw_force, raw_rate)

    reading = ImuReading(settings, place, _latitude(drive, settings))
    findings += _listed(reading.take_units(recognise_units(raw_force), raw_force))
    windows = windowed(t, reading.scale * raw_force, raw_rate)
    findings += _listed(reading.take_rate_units(rates_in_degrees(windows, drive.velocity)))
    if fault := turning_fault(windows, drive.velocity, reading.mounting[2]):
        findings.append(Finding("error", "senses", fault))
    raw_rate = reading.rate_scale * raw_rate
    saturated = saturated_samples(reading.scale * raw_force, settings.full_scale)
    saturated |= saturated_samples(raw_rate, settings.full_scale_rate)
    if saturated.any():
        text = f"{int(saturated.sum())} of {t.size} samples sit at the end of the range: set a larger range"
        findings.append(Finding("warn", "saturated", text))

    turn, ground = reading.mounting, gnss_motion(drive)
    changes = []
    if not reading.removed:
        pull = np.zeros_like(raw_force)
        if ground.known:
            pull = ground.acceleration(t, raw_rate @ turn[2], place.position)
            climb = ground.slope(t, drive.fix)
            pull[:, 0] += 0.0 if climb is None else reading.gravity * np.sin(climb)
            pull = pull @ turn / reading.scale
        # what pulls a vehicle along is in the force along it, if the sensor looks where the file says
        before, after = (np.nanvar(force @ turn[0]) for force in (raw_force, raw_force - pull))
        known = after < before
        changes = mounting_changes(
            t, raw_force - pull if known else raw_force, ground, drive.fix, turn[0] if known else None
        )
    for moment, change in changes:
        findings.append(change.finding(moment, t[0]))
        if not change.slow:
            raw_force, raw_rate = (turned_back(v, t >= moment, change) for v in (raw_force, raw_rate))
            saturated |= np.abs(t - moment) < WINDOW  # what is measured on the way is not compared
    force, rate = reading.scale * raw_force @ turn.T, raw_rate @ turn.T
    speed = ground.least_speed(t) if ground.known else None
    standing = standstill_mask(rate_hz, force, rate, settings.still, speed)
    blind = np.ones(t.size, dtype=np.bool_) if len(drive.velocity) < 4 or speed is None else np.isnan(speed)
    if (blind & standing).any() and not reading.removed:
        standing &= ~(blind & _accelerating(t, force, rate, rate_hz, settings.attitude_time))
    stands = int(standing.sum()) >= 0.5 * rate_hz
    rate_bias = rate[standing].mean(axis=0) if stands else _driving_bias(ground, t, rate)
    rate = rate - rate_bias
    if not stands:
        text = "the drive has no standstill: biases come from its mean, less surely"
        findings.append(Finding("warn", "no_standstill", text))
    planar = np.zeros_like(force)
    if ground.known:
        planar = ground.acceleration(t, rate[:, 2], place.position)
        planar[standing] = 0.0

    rest = force[standing].mean(axis=0) if stands else (force - planar).mean(axis=0)
    findings += _listed(reading.check_level(rest))
    level = reading.take_level(rest)
    if level is not None:
        force, rate, rate_bias, rest = force @ level.T, rate @ level.T, level @ rate_bias, level @ rest
    reading.take_rest(rest, rate_bias)
    force = force - reading.bias[:3]
    gravity = reading.gravity
    if reading.removed:
        up = np.tile([0.0, 0.0, 1.0], (t.size, 1))
        vertical = force[:, 2].copy()
        if settings.restore_gravity:
            force = force + gravity * up
            vertical = force[:, 2] - gravity
    else:
        length = np.where(standing, 0.1 * settings.attitude_time, settings.attitude_time)
        up = smooth_up(t, force - planar, rate, gravity, length)
        vertical = force[:, 2] - gravity * up[:, 2]
    unit = reading.unit  # a sensor in g that is to be left so
    return ImuSignals(
        place=place,
        gravity=gravity / unit,
        rate_hz=rate_hz,
        force_bias=reading.bias[:3] / unit,
        rate_bias=rate_bias,
        gaps=gaps,
        findings=findings,
        t=t,
        force=force / unit,
        rate=rate,
        vertical_acceleration=vertical / unit,
        up=up,
        standing=standing,
        saturated=saturated,
    )


def mounting_changes(
    t: Floats, force: Floats, ground: GnssMotion, fix: FixData, ahead: Floats | None = None
) -> list[tuple[float, MountingChange]]:
    """Turns of the sensor in its holder by ``force`` (n, 3) at ``t`` (n,), with the moment of each, in the order in
    which they are to be turned back; the last one is slow where they go on and on. Where the direction ``ahead`` (3,)
    of the vehicle is known in its axes, small ones in pitch are found, too, while it drives."""
    quiet, slope = ground.quiet(t), ground.slope(t, fix)
    found: list[tuple[float, MountingChange]] = []

    def pitched() -> MountingChange | None:
        if ahead is None or quiet is None or slope is None:
            return None
        return mounting_change(windows_of(t, force, quiet & (ground.least_speed(t) > FAST), slope), ahead)

    while (change := mounting_change(windows_of(t, force, quiet, slope)) or pitched()) is not None:
        change = replace(change, slow=change.slow or len(found) == MOST_CHANGES)
        moment = change.moment(t, force)
        found.append((moment, change))
        if change.slow:
            break
        force = turned_back(force, t >= moment, change)
    return found


def turns_said(drive: Drive) -> list[str]:
    """A line for each turn of the sensor in its holder during a drive."""
    imu = drive.imu
    cleaned = clean_stamps(imu.t, np.asarray(np.isfinite(imu.specific_force).all(axis=1)))
    force, t = imu.specific_force[cleaned.keep], cleaned.stamps
    if t.size < 16 or recognise_units(force) == "gravity removed":
        return []
    changes = mounting_changes(t, force, gnss_motion(drive), drive.fix)
    return [change.text(moment, t[0]) for moment, change in changes]


def turned_back(vectors: Floats, behind: NDArray[np.bool_], change: MountingChange) -> Floats:
    """``vectors`` (n, 3) of the sensor, those ``behind`` (n,) the change in its axes before it."""
    return np.where(behind[:, None], vectors @ change.turn.T, vectors)


def _accelerating(t: Floats, force: Floats, rate: Floats, rate_hz: float, time: float) -> NDArray[np.bool_]:
    """(n,) True where the specific force is tilted against the vertical that the gyro gives: a constant
    acceleration, which looks like standstill. Roll and pitch rates average to their bias."""
    steady = rate - rate.mean(axis=0) * np.array([1.0, 1.0, 0.0])
    gravity = float(np.median(np.linalg.norm(force, axis=1)))
    mean = gaussian_filter1d(force, 0.25 * rate_hz, axis=0, mode="nearest")
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    up, _ = carried_up(t, force, steady, gravity, np.full(t.size, time))
    return np.asarray(np.linalg.norm(mean - up, axis=1) > MAX_TILT_DIFFERENCE, dtype=np.bool_)


def _driving_bias(ground: GnssMotion, t: Floats, rate: Floats) -> Floats:
    """(3,) gyro bias of a drive that never stands: roll and pitch come back to where they were, and the yaw
    turns as the course does, if that is known."""
    about_z = ground.yaw_rate_bias(t, rate[:, 2]) if ground.known else None
    return np.array([*rate.mean(axis=0)[:2], 0.0 if about_z is None else about_z])


def _listed(finding: Finding | None) -> list[Finding]:
    return [] if finding is None else [finding]


def _clock_findings(cleaned: Cleaned, t: Floats, gaps: Floats, rate_hz: float) -> list[Finding]:
    found = _listed(check_rate(rate_hz))
    for count, code, what in (
        (cleaned.invalid, "invalid", "samples with NaN or without a stamp were dropped"),
        (cleaned.duplicates, "duplicates", "samples with a repeated stamp were dropped"),
        (cleaned.reordered, "reordered", "samples came out of order and were sorted"),
        (cleaned.other_loops, "looped", "samples of other loops were dropped: the clock was set back"),
    ):
        if count:
            found.append(Finding("warn", code, f"{count} {what}"))
    if cleaned.duplicates > 0.2 * (t.size + cleaned.duplicates):
        text = "more than a fifth of the stamps repeat: the recorder's clock is stuck or too coarse"
        found.append(Finding("error", "stamps_stuck", text))
    if len(gaps):
        lost = float(np.sum(gaps[:, 1] - gaps[:, 0]))
        text = (
            f"{len(gaps)} gaps, {lost:.2f} s in all, the longest {float(np.max(np.diff(gaps, axis=1))):.2f} s"
        )
        found.append(Finding("warn", "gaps", text))
    return found


def _latitude(drive: Drive, settings: ImuSettings) -> float | None:
    if settings.latitude is not None:
        return settings.latitude
    usable = np.isfinite(drive.fix.latitude) & (drive.fix.status != NO_FIX)
    return float(np.median(drive.fix.latitude[usable])) if usable.any() else None
