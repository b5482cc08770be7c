# SPDX-License-Identifier: Apache-2.0
"""The pose of a recorded drive: measurements and IMU at the nodes of the filter, its first state, the smoothed path."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.pose import ekf
from suspension_twin.pose.ekf import planar_inputs, smooth
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.types import (
    POOR_FIX,
    RECEIVER_TIME,
    REVERSE_SPEED,
    REVERSE_TIME,
    SLOPE_TIME,
    SWAY_SIGMA,
    VELOCITY_SHARE,
    PoseSettings,
    Trajectory,
    fix_sigma,
)
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.vehicle.twin import Datum, Place

__all__ = [
    "MAX_MEAN_SLOPE",
    "Measurements",
    "Nodes",
    "first_state",
    "gather",
    "locked_trajectory",
    "make_nodes",
    "mean_tilt",
    "planar_rows",
]

#: Hz to which yaw rate and forward pull are smoothed before they meet the filter's nodes.
PLANAR = FilterSpec(2, 12.0)
STEP = 0.01  # s between nodes at most
MAX_MEAN_SLOPE = 3.0  # degrees on average of a drive; a larger mean tilt is the sensor's mounting


@dataclass(frozen=True, eq=False)
class Measurements:
    """Fixes, velocities and headings in the order of time: ``t`` (m,), ``kind`` (m,), ``z`` (m, 3) two
    numbers and a standard deviation."""

    t: Floats
    kind: Floats
    z: Floats


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes that the filter runs over: ``t`` (k,) s, ``kind`` (k,) of the measurement there, below 0 for none, ``z``
    (k, 3), ``inputs`` (k, 8) over the interval before each node, ``sway`` (k, 4) what the antenna's
    quick swinging adds to the last four of them. ``inputs`` and ``z`` are the caller's to change."""

    t: Floats
    kind: Floats
    z: Floats
    inputs: Floats
    sway: Floats


def gather(drive: Drive, datum: Datum, settings: PoseSettings) -> Measurements:
    """Every usable measurement of ``drive``. Raises InputError where there is no fix."""
    fix, velocity = drive.fix, drive.velocity
    sigma = np.array(
        [
            fix_sigma(settings, int(status), float(east), float(north))
            for status, (east, north) in zip(fix.status, fix.sigma[:, :2], strict=True)
        ],
        dtype=np.float64,
    )
    usable = np.isfinite(fix.t) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & np.isfinite(sigma)
    if not usable.any():
        raise InputError(drive.name, "fix", "has no usable GPS fix: the pose cannot be found")
    height = np.where(np.isfinite(fix.altitude), fix.altitude, datum.altitude)
    enu = LocalMap(datum).to_map(fix.latitude[usable], fix.longitude[usable], height[usable])
    parts = [(fix.t[usable], ekf.FIX, np.column_stack([enu[:, :2], sigma[usable]]))]
    good = np.isfinite(velocity.t) & np.isfinite(velocity.enu[:, :2]).all(axis=1)
    spread = max(settings.velocity_sigma, VELOCITY_SHARE * float(np.median(sigma[usable])))
    parts.append((velocity.t[good], ekf.VELOCITY, _beside(velocity.enu[good, :2], spread)))
    if drive.heading is not None:
        good = np.isfinite(drive.heading.t) & np.isfinite(drive.heading.yaw)
        yaw = drive.heading.yaw[good]
        pair = np.column_stack([yaw, np.zeros_like(yaw)])
        parts.append((drive.heading.t[good], ekf.HEADING, _beside(pair, settings.heading_sigma)))
    t = np.concatenate([part[0] for part in parts])
    kind = np.concatenate([np.full(len(part[0]), float(part[1])) for part in parts])
    z = np.vstack([part[2] for part in parts])
    order = np.lexsort((kind, t))
    t, kind, z = t[order], kind[order], z[order]
    fresh = np.ones(t.size, dtype=np.bool_)
    fresh[1:] = (np.diff(t) > 0) | (np.diff(kind) != 0)
    return Measurements(t[fresh], kind[fresh], z[fresh])


def _beside(pair: Floats, sigma: float) -> Floats:
    return np.column_stack([pair, np.full(len(pair), sigma)])


def planar_rows(signals: ImuSignals, gps_place: Place, upright: bool = False) -> tuple[Floats, Floats]:
    """(n, 8) planar inputs at the IMU's stamps without the antenna's sway, and (n, 4) what it adds; ``upright``: on
    average the tilt is that of the sensor's mounting, not of the vehicle with its antenna."""
    spec = FilterSpec(PLANAR.order, min(PLANAR.cutoff, 0.4 * signals.rate_hz))
    force = zero_phase(spec, signals.rate_hz, signals.force)
    rate = zero_phase(spec, signals.rate_hz, signals.rate)
    slow = gaussian_filter1d(signals.up, SLOPE_TIME * signals.rate_hz, axis=0, mode="nearest")
    slow /= np.linalg.norm(slow, axis=1, keepdims=True)
    faster = np.gradient(rate, signals.t, axis=0)
    imu, antenna = np.array(signals.place.position), np.array(gps_place.position)
    still, swaying = (
        planar_inputs(force, rate, faster, signals.up, slow, share, signals.gravity, imu, antenna)
        for share in (0.0, 1.0)
    )
    # the antenna tilts with the vehicle, not with the sensor's mounting
    if upright or mean_tilt(signals.up) > MAX_MEAN_SLOPE:
        up, slow = _upright(signals.up), _upright(slow)
        for share, out in ((0.0, still), (1.0, swaying)):
            right = planar_inputs(force, rate, faster, up, slow, share, signals.gravity, imu, antenna)
            out[:, 4:] = right[:, 4:]
    still[:, 2] = signals.standing
    return still, swaying[:, 4:] - still[:, 4:]


def mean_tilt(up: Floats) -> float:
    """Degrees by which the mean of verticals (n, 3) is off the z axis."""
    mean = up.mean(axis=0)
    return math.degrees(math.atan2(math.hypot(mean[0], mean[1]), mean[2]))


def _upright(up: Floats) -> Floats:
    """Verticals (n, 3) turned so that their mean is the z axis."""
    mean = up.mean(axis=0)
    mean /= np.linalg.norm(mean)
    # the smallest turn that takes the mean to the z axis (Rodrigues)
    axis = np.array([mean[1], -mean[0], 0.0])
    cross = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turn = np.eye(3) + cross + cross @ cross / (1.0 + mean[2])
    return np.asarray(np.einsum("ij,nj->ni", turn, up, optimize=False))


def make_nodes(signals: ImuSignals, rows: Floats, sway: Floats, measured: Measurements) -> Nodes:
    """An even grid of nodes and one more for each measurement, at its very stamp."""
    inside = (measured.t >= signals.t[0]) & (measured.t <= signals.t[-1])
    if np.count_nonzero(inside & (measured.kind == ekf.FIX)) < 2:
        raise InputError("fix", "fewer than two fixes within the time of the IMU: do the clocks agree?")
    step = max(STEP, 1.0 / signals.rate_hz)
    count = max(2, math.ceil((signals.t[-1] - signals.t[0]) / step) + 1)
    even = np.linspace(signals.t[0], signals.t[-1], count)
    t = np.concatenate([even, measured.t[inside]])
    kind = np.concatenate([np.full(count, -1.0), measured.kind[inside]])
    z = np.vstack([np.zeros((count, 3)), measured.z[inside]])
    order = np.lexsort((kind, t))
    t, kind, z = t[order], kind[order], z[order]
    at_nodes = [np.interp(t, signals.t, column) for column in (*rows.T, *sway.T)]
    inputs = np.ascontiguousarray(np.stack(at_nodes[:8], axis=1))
    # The mean over an interval from the running integral loses nothing to jitter or to coarse nodes.
    interval = np.diff(t)
    wide = interval > 1e-6
    for column in (0, 1):
        integral = _integral(t, signals.t, rows[:, column])
        inputs[1:, column][wide] = np.diff(integral)[wide] / interval[wide]
    inputs[:, 2] = inputs[:, 2] > 0.5
    inputs[:, 3] = 1.0
    for begin, end in signals.gaps:
        inputs[(t > begin) & (t <= end), 3] = 1000.0
    return Nodes(t, kind, z, inputs, np.stack(at_nodes[8:], axis=1))


def _integral(t: Floats, stamps: Floats, values: Floats) -> Floats:
    """The integral from the first stamp of the line through ``values`` at ``stamps``, at ``t`` within them."""
    steps = np.diff(stamps)
    whole = np.concatenate([[0.0], np.cumsum(steps * 0.5 * (values[1:] + values[:-1]))])
    k = np.clip(np.searchsorted(stamps, t, side="right") - 1, 0, stamps.size - 2)
    ahead = t - stamps[k]
    slope = (values[k + 1] - values[k]) / steps[k]
    return np.asarray(whole[k] + ahead * (values[k] + 0.5 * slope * ahead), dtype=np.float64)


def first_state(measured: Measurements, stamps: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """State (8,) and covariance (8, 8) at the first of ``stamps`` (n,), whose planar inputs are ``rows`` (n, 8).

    The yaw is a heading's, or the course where the vehicle is fast, carried back to the start by the
    gyro: a drive may begin at rest or in reverse. Raises InputError where no course is defined.
    """
    at, course, speed, sigma = _courses(measured)
    turned = np.concatenate([[0.0], np.cumsum(np.diff(stamps) * 0.5 * (rows[1:, 0] + rows[:-1, 0]))])
    headings = np.flatnonzero((measured.kind == ekf.HEADING) & (measured.t >= stamps[0]))
    if headings.size:
        when, yaw, yaw_sigma = float(measured.t[headings[0]]), float(measured.z[headings[0], 0]), 0.05
    else:
        within = (at >= stamps[0]) & (at <= stamps[-1])
        fast = np.flatnonzero(within & (speed > np.maximum(0.5, 8.0 * sigma)))
        if not fast.size:
            slow = "the vehicle never moves fast enough for its course to give the yaw"
            if np.any(measured.kind == ekf.VELOCITY):
                raise InputError("vel", slow)
            raise InputError("fix", f"by its positions {slow}: record the receiver's velocities too")
        quick = speed[fast] > min(5.0, 0.8 * float(speed[fast].max()))
        chosen = int(fast[np.flatnonzero(quick)[0]])
        when, yaw = float(at[chosen]), float(course[chosen])
        yaw_sigma = float(sigma[chosen] / speed[chosen]) + 0.02
        if _drives_backwards(at, speed, stamps, rows):
            yaw += math.pi
    yaw -= float(np.interp(when, stamps, turned))
    yaw_sigma += 0.003 * max(0.0, when - stamps[0])
    c, s = math.cos(yaw), math.sin(yaw)
    x = np.zeros(ekf.STATES)
    x[ekf.YAW] = yaw
    velocity_age = 10.0
    if at.size:
        nearest = int(np.argmin(np.abs(at - stamps[0])))
        velocity_age = abs(float(at[nearest] - stamps[0]))
        if velocity_age < 1.0:
            x[ekf.SPEED] = speed[nearest] * math.cos(course[nearest] - yaw)
    first = int(np.flatnonzero((measured.kind == ekf.FIX) & (measured.t >= stamps[0]))[0])
    wait = float(measured.t[first] - stamps[0])
    ahead, left = rows[0, 4], rows[0, 5]
    x[ekf.X] = measured.z[first, 0] - (ahead * c - left * s) - x[ekf.SPEED] * wait * c
    x[ekf.Y] = measured.z[first, 1] - (ahead * s + left * c) - x[ekf.SPEED] * wait * s
    away = 3.0 * measured.z[first, 2] + 0.1 + 3.0 * wait
    spread = np.array(
        [away, away, min(yaw_sigma, 1.0), 0.5 + min(3.0 * velocity_age, 10.0), 1.0, 0.1, 0.01, 0.2]
    )
    return x, np.diag(spread**2)


def _courses(measured: Measurements) -> tuple[Floats, Floats, Floats, Floats]:
    """Stamps, course rad, speed m/s and its standard deviation, from velocities or else from the
    displacement between fixes about a second apart."""
    moving = measured.kind == ekf.VELOCITY
    if np.count_nonzero(moving) >= 2:
        east, north = measured.z[moving, 0], measured.z[moving, 1]
        return measured.t[moving], np.arctan2(north, east), np.hypot(east, north), measured.z[moving, 2]
    fixes = np.flatnonzero(measured.kind == ekf.FIX)
    t, p = measured.t[fixes], measured.z[fixes]
    later = np.minimum(np.searchsorted(t, t + 0.99), t.size - 1)
    apart = t[later] - t
    ok = (apart > 0.5) & (apart < 4.0)
    d = (p[later[ok], :2] - p[ok, :2]) / apart[ok, None]
    sigma = np.hypot(p[later[ok], 2], p[ok, 2]) / apart[ok]
    return 0.5 * (t[later[ok]] + t[ok]), np.arctan2(d[:, 1], d[:, 0]), np.hypot(d[:, 0], d[:, 1]), sigma


def _drives_backwards(at: Floats, speed: Floats, stamps: Floats, rows: Floats) -> bool:
    """Whether the vehicle reverses: over a whole drive its forward acceleration by the accelerometer and the
    change of its speed are anticorrelated. A vehicle too fast to reverse has its sensor mounted so."""
    grid = np.arange(max(at[0], stamps[0]), min(at[-1], stamps[-1]), 0.5)
    if grid.size < 6 or np.count_nonzero(np.interp(grid, at, speed) > REVERSE_SPEED) * 0.5 > REVERSE_TIME:
        return False
    change = np.gradient(np.interp(grid, at, speed), 0.5)
    if np.ptp(change) < 0.2:
        return False
    rate_hz = 1.0 / float(np.median(np.diff(stamps)))
    pull = np.interp(grid, stamps, zero_phase(FilterSpec(2, 0.5), rate_hz, rows[:, 1]))
    return float(np.corrcoef(change, pull)[0, 1]) < -0.5


PASSES = 4
FAR = 50.0  # factor on a measurement's standard deviation beyond which it no longer supports a pose


def locked_trajectory(
    drive: Drive,
    signals: ImuSignals,
    gps_place: Place,
    datum: Datum,
    t: Floats,
    *,
    settings: PoseSettings | None = None,
    upright: bool = False,
) -> Trajectory:
    """Estimate the path of ``base_link`` over a whole drive, forward and backward (RTS smoother).

    Parameters
    ----------
    drive : Drive
        The recording, with fixes.
    signals : ImuSignals
        Its IMU, cleaned by :func:`~suspension_twin.signals.offline.ingest_drive`.
    gps_place : Place
        Position of the antenna in ``base_link``.
    datum : Datum
        Origin of ``map``.
    t : (n,) array
        Stamps in s, strictly rising, at which the path is wanted.
    settings : PoseSettings, optional
        Noise and gates of the filter.
    upright : bool
        Take a mean tilt for the sensor's mounting and not for the vehicle's.

    Returns
    -------
    Trajectory
        x, y, yaw, speeds, yaw rate and planar accelerations at ``t``.

    Raises
    ------
    InputError
        No fix, or no motion from which the yaw follows.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.signals.offline import ingest_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> drive, twin = read_drive("bags/crg_road"), load_twin("bags/crg_road/twin.yaml")
    >>> signals = ingest_drive(drive, twin.imu)
    >>> path = locked_trajectory(drive, signals, twin.gps, twin.datum, signals.t)
    >>> round(float(path.speed.max()), 1)
    7.0
    """
    settings = settings or PoseSettings()
    measured = gather(drive, datum, settings)
    rows, sway = planar_rows(signals, gps_place, upright)
    nodes = make_nodes(signals, rows, sway, measured)
    start, spread = first_state(measured, signals.t, rows)
    noise = settings.noise(hard=False)
    states = np.empty((nodes.t.size, ekf.STATES))
    covariances = np.empty((nodes.t.size, ekf.STATES, ekf.STATES))
    weights = np.zeros(nodes.t.size)
    slow = _slow_factor(measured)
    factor = np.where(nodes.kind == ekf.FIX, max(slow, 1.0), 1.0)
    share = 1.0
    for _ in range(PASSES):
        now = _with(nodes, share, factor)
        ekf.forward(now.t, now.inputs, now.kind, now.z, start, spread, noise, states, covariances, weights)
        smooth(now.t, now.inputs, noise, states, covariances)
        share = _sway_share(now, states, share)
        factor = _noise_factors(_with(nodes, share, np.ones(nodes.t.size)), states, slow)
    if not np.isfinite(states).all():
        raise InputError(drive.name, "no pose agrees with its IMU and receiver: are the units right?")
    t = np.asarray(t, dtype=np.float64)
    return _evaluate(t, nodes, states, signals, rows, _valid(t, nodes, factor / max(slow, 1.0), settings))


def _with(nodes: Nodes, share: float, factor: Floats) -> Nodes:
    """The nodes with the antenna swaying by ``share`` and standard deviations times ``factor``."""
    inputs, z = nodes.inputs.copy(), nodes.z.copy()
    inputs[:, 4:] += share * nodes.sway
    z[:, 2] *= factor
    return replace(nodes, inputs=inputs, z=z)


def _residuals(nodes: Nodes, states: Floats, which: int) -> Floats:
    """(j, 2) measured less expected, ahead and to the left, of the measurements of one kind."""
    at = nodes.kind == which
    x, u, z = states[at], nodes.inputs[at], nodes.z[at]
    c, s = np.cos(x[:, ekf.YAW]), np.sin(x[:, ekf.YAW])
    east, north = z[:, 0], z[:, 1]
    if which == ekf.FIX:
        east, north = east - x[:, ekf.X], north - x[:, ekf.Y]
        ahead, left = u[:, 4], u[:, 5]
    else:
        ahead, left = x[:, ekf.SPEED] + u[:, 6], x[:, ekf.LATERAL_SPEED] + u[:, 7]
    return np.column_stack([east * c + north * s - ahead, north * c - east * s - left])


def _sway_share(nodes: Nodes, states: Floats, share: float) -> float:
    """Share of the antenna's sway in the residuals, by least squares with its prior."""
    weight = 1.0 / SWAY_SIGMA**2
    total = weight
    for which, columns in ((ekf.FIX, slice(0, 2)), (ekf.VELOCITY, slice(2, 4))):
        at = nodes.kind == which
        if not at.any():
            continue
        sway, sigma = nodes.sway[at, columns], nodes.z[at, 2:3]
        full = _residuals(nodes, states, which) + share * sway
        total += float(np.sum(sway * full / sigma**2))
        weight += float(np.sum((sway / sigma) ** 2))
    return float(np.clip(total / weight, 0.0, 1.2))


def _slow_factor(measured: Measurements) -> float:
    """Factor on the standard deviation of fixes whose error is slow, 0 where it is not.

    The error of a fix by code has the variance s² and the correlation time T. Below the frequency 1 / T its spectral
    density is that of white noise with the variance s² 2 T / dt, a fix every dt; above, velocities know the motion
    better, without which the fixes alone have to give it.
    """
    fixes = measured.kind == ekf.FIX
    t, sigma = measured.t[fixes], measured.z[fixes, 2]
    if not (measured.kind == ekf.VELOCITY).any() or t.size < 2 or not np.median(sigma) > POOR_FIX:
        return 0.0
    return math.sqrt(max(2.0 * RECEIVER_TIME / float(np.median(np.diff(t))), 1.0))


def _noise_factors(nodes: Nodes, states: Floats, slow: float) -> Floats:
    """(k,) factors on the standard deviations: the noise that the residuals show for each kind of
    measurement, and more for each that lies further off than its kind does; ``slow`` that of fixes whose error is slow,
    which their residuals do not show."""
    factor = np.ones(nodes.kind.size)
    for which in (ekf.FIX, ekf.VELOCITY):
        at = nodes.kind == which
        if not at.any():
            continue
        off = np.linalg.norm(_residuals(nodes, states, which), axis=1) / nodes.z[at, 2]
        # The median of a Rayleigh distribution lies at 1.1774 standard deviations.
        common = float(np.clip(np.median(off) / 1.1774, 0.3, 10.0)) if off.size >= 20 else 1.0
        far = off / (3.5 * common)
        own = slow if slow and which == ekf.FIX else common
        factor[at] = own * np.where(far > 1.0, np.minimum(far**2, 1.0e4), 1.0)
    return factor


def _evaluate(
    t: Floats,
    nodes: Nodes,
    states: Floats,
    signals: ImuSignals,
    rows: Floats,
    valid: NDArray[np.bool_],
) -> Trajectory:
    """Between the nodes: cubics through position and velocity, so both stay in step."""
    from scipy.interpolate import CubicHermiteSpline  # a fifth of a second, which live nodes do not wait for

    last = np.append(np.diff(nodes.t) > 1e-7, True)  # of nodes that share a stamp the last has it all
    at, x = nodes.t[last], states[last]
    turn = np.interp(at, signals.t, rows[:, 0]) - x[:, ekf.GYRO_BIAS]
    turn = np.where(np.interp(at, signals.t, signals.standing) > 0.5, 0.0, turn)
    c, s = np.cos(x[:, ekf.YAW]), np.sin(x[:, ekf.YAW])
    v, side, acceleration = x[:, ekf.SPEED], x[:, ekf.LATERAL_SPEED], x[:, ekf.ACCELERATION]
    inside = np.clip(t, at[0], at[-1])
    speed = CubicHermiteSpline(at, v, acceleration + turn * side)(inside)
    yaw_rate = np.interp(inside, at, turn)
    return Trajectory(
        t=t,
        x=CubicHermiteSpline(at, x[:, ekf.X], v * c - side * s)(inside),
        y=CubicHermiteSpline(at, x[:, ekf.Y], v * s + side * c)(inside),
        yaw=CubicHermiteSpline(at, x[:, ekf.YAW], turn)(inside),
        velocity=np.column_stack([speed, np.interp(inside, at, side)]),
        yaw_rate=yaw_rate,
        acceleration=np.column_stack([np.interp(inside, at, acceleration), speed * yaw_rate]),
        valid=valid & (t >= at[0]) & (t <= at[-1]),
    )


def _valid(t: Floats, nodes: Nodes, factor: Floats, settings: PoseSettings) -> NDArray[np.bool_]:
    """(n,) True within ``outage`` s of a fix on either side that was not thrown out, half of that before the
    first and after the last."""
    used = nodes.t[(nodes.kind == ekf.FIX) & (factor < FAR)]
    if not used.size:
        return np.zeros(t.size, dtype=np.bool_)
    after = np.searchsorted(used, t)
    since = np.where(after > 0, t - used[np.maximum(after - 1, 0)], np.inf)
    until = np.where(after < used.size, used[np.minimum(after, used.size - 1)] - t, np.inf)
    between = np.maximum(since, until) <= settings.outage
    ends = np.minimum(since, until) <= 0.5 * settings.outage
    return np.asarray(np.where(np.isfinite(since) & np.isfinite(until), between, ends), dtype=np.bool_)
