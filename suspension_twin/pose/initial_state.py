# SPDX-License-Identifier: Apache-2.0
"""The filter's first state of a recorded drive, from the measurements of the whole drive."""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.pose import ekf
from suspension_twin.pose.nodes import Measurements
from suspension_twin.signals.filters import FilterSpec, zero_phase

__all__ = ["REVERSE_SPEED", "REVERSE_TIME", "first_state"]

#: m/s and s: nothing on the road reverses this fast for this long. What pulls backwards then is a sensor that faces so.
REVERSE_SPEED, REVERSE_TIME = 4.0, 3.0


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
            raise InputError("vel", "the vehicle never moves fast enough for its course to give the yaw")
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
