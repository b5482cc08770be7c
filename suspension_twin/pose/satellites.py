# SPDX-License-Identifier: Apache-2.0
"""The planar motion that the receiver alone has seen, and the IMU as slowly beside it.

The locked pose is fused from receiver and IMU: a comparison with that IMU would find it right whatever
its clock and its mounting are. Where no road separates the two, the path comes from the fixes alone,
and both sides are brought down to what fixes at a few hertz can hold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.errors import InputError
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.types import Trajectory
from suspension_twin.signals.filters import FilterSpec, zero_phase
from suspension_twin.signals.offline import ImuSignals
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.twin import Datum, Place

__all__ = ["LEVEL", "RATE", "satellite_motion"]

#: Of what is compared, Hz.
RATE = 5.0
#: Eight fixes to the shortest period: a spline through fewer is off by more than a per cent once differentiated twice.
_SHARE, _MOST = 0.125, 0.8  # of it, Hz
_SLOWEST = 3.0  # m/s: below it a course does not give the heading
_GAP = 1.5  # s
#: m: standard deviation of the height up to which its slope is a hill and not the receiver's error.
LEVEL = 0.1


def satellite_motion(
    drive: Drive,
    signals: ImuSignals,
    gps_place: Place,
    datum: Datum,
    ahead: Sequence[float] = (1.0, 0.0, 0.0),
) -> tuple[ImuSignals, Trajectory]:
    """The IMU (n,) at RATE Hz and the motion of ``base_link`` at its stamps, by the fixes alone. ``ahead`` is the
    vehicle's own axis as the signals have it: along it hills are taken off what the IMU feels.

    Raises InputError where there are too few fixes to differentiate.
    """
    fix = drive.fix
    whole = np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & np.isfinite(fix.t)
    good = np.flatnonzero((fix.status >= 0) & whole)
    good = good[np.argsort(fix.t[good], kind="stable")]
    good = good[np.concatenate([[True], np.diff(fix.t[good]) > 1e-3])] if good.size else good
    if good.size < 20:
        raise InputError(
            drive.name, "fix", f"has {good.size} usable positions: too few to derive accelerations from"
        )
    at = fix.t[good]
    places = LocalMap(datum).to_map(
        fix.latitude[good], fix.longitude[good], np.full(good.size, datum.altitude)
    )
    spec = FilterSpec(2, min(_MOST, _SHARE / float(np.median(np.diff(at)))))
    rate = signals.rate_hz
    # an even grid: on jittered stamps the speed itself would turn into acceleration
    t = np.arange(signals.t[0], signals.t[-1], 1.0 / rate)
    nearest = np.clip(np.searchsorted(signals.t, t), 0, len(signals) - 1)

    def slow(values: Floats) -> Floats:
        return np.asarray(zero_phase(spec, rate, values))

    inside = np.clip(t, at[0], at[-1])
    path = slow(_spline(at, places[:, :2], inside))
    arm = np.asarray(gps_place.position[:2])
    own = path
    # the filter spreads an error of the course this far
    margin = round(rate / spec.cutoff)
    # the antenna's course is not the vehicle's where it sits ahead of the rear axle: once more from there
    for _ in range(2):
        velocity = np.gradient(own, t, axis=0)
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        fast = minimum_filter1d(speed, 2 * margin + 1) > _SLOWEST
        if not fast.any():
            raise InputError(
                drive.name, "fix", f"never moves faster than {_SLOWEST:g} m/s: the course is undefined"
            )
        yaw = np.unwrap(np.arctan2(velocity[fast, 1], velocity[fast, 0]))
        yaw = slow(np.interp(t, t[fast], yaw))
        c, s = np.cos(yaw), np.sin(yaw)
        own = path - np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], axis=1)
    turn, acceleration = np.gradient(yaw, t), np.gradient(speed, t)
    wide = np.flatnonzero(np.diff(at) > _GAP)
    near = (t >= at[0]) & (t <= at[-1])
    for i in wide:
        near &= (t < at[i]) | (t > at[i + 1])
    step = max(1, round(rate / RATE))
    cut = slice(None, None, step)
    trajectory = Trajectory(
        t=t[cut],
        x=own[cut, 0],
        y=own[cut, 1],
        yaw=yaw[cut],
        velocity=np.column_stack([speed, np.zeros_like(speed)])[cut],
        yaw_rate=turn[cut],
        acceleration=np.column_stack([acceleration, speed * turn])[cut],
        valid=minimum_filter1d(fast & near, 2 * margin + 1)[cut],
    )
    kept = nearest[cut]

    def slowed(values: Floats) -> Floats:
        even = np.stack([np.interp(t, signals.t, column) for column in np.atleast_2d(values.T)], axis=1)
        return slow(even)[cut].reshape(-1, *values.shape[1:])

    force = slowed(signals.force)
    hills, known = _hills(fix, good, t, speed, fast, slow)
    beyond = (force @ np.asarray(ahead) - trajectory.acceleration[:, 0])[trajectory.valid]
    # heights that the receiver does not vouch for are right if the IMU feels their slopes
    if not known and not signals.standing.any():
        hills -= hills[fast].mean()  # a bias that came from the drive's mean has it already
    if known or (beyond.size and np.var(beyond - hills[cut][trajectory.valid]) < np.var(beyond)):
        force -= np.outer(hills[cut], ahead)
    slower = replace(
        signals,
        t=t[cut],
        force=force,
        rate=slowed(signals.rate),
        vertical_acceleration=slowed(signals.vertical_acceleration),
        up=signals.up[kept],
        rate_hz=rate / step,
        standing=signals.standing[kept],
        saturated=signals.saturated[kept],
    )
    return slower, trajectory


def _spline(at: Floats, values: Floats, t: Floats) -> Floats:
    """The cubic spline through ``values`` (n, ...) at ``at`` (n,), at ``t`` (m,)."""
    from scipy.interpolate import CubicSpline  # a fifth of a second, which live nodes do not wait for

    return np.asarray(CubicSpline(at, values)(t))


def _hills(
    fix: FixData,
    good: NDArray[np.intp],
    t: Floats,
    speed: Floats,
    fast: NDArray[np.bool_],
    slow: Callable[[Floats], Floats],
) -> tuple[Floats, bool]:
    """(n,) m/s² what gravity adds to the longitudinal specific force where the road climbs, which no flat road shows,
    and whether the receiver vouches for its heights."""
    good = good[np.isfinite(fix.altitude[good])]
    sigma = fix.sigma[good, 2]
    if good.size < 2:
        return np.zeros(t.size), False
    known = bool(np.isfinite(sigma).any()) and float(np.nanmedian(sigma)) <= LEVEL
    at = fix.t[good]
    climb = np.gradient(slow(_spline(at, fix.altitude[good], np.clip(t, at[0], at[-1]))), t)
    return np.where(fast, G * np.sin(np.arctan2(climb, np.maximum(speed, _SLOWEST))), 0.0), known
