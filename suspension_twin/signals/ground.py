# SPDX-License-Identifier: Apache-2.0
"""Approximate speed, course and planar acceleration from GNSS, before the pose is estimated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive

__all__ = ["NO_FIX", "Ground", "ground_motion"]

NO_FIX = -1  # sensor_msgs/NavSatStatus
FAST = 3.0  # m/s from which a course is one
NEAR = 1.5  # s beyond which a stamp says nothing of another


@dataclass(frozen=True, eq=False)
class Ground:
    """``t`` (m,) s rising, ``east`` and ``north`` (m,) m/s over ground, ``noise`` m/s their uncertainty."""

    t: Floats
    east: Floats
    north: Floats
    noise: float

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
        """What the gyro turns more than the course does, in rad/s, over ten seconds of driving at least."""
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


def ground_motion(drive: Drive) -> Ground:
    """From the velocities, or else from the way between fixes as far apart as their noise demands."""
    velocity, fix = drive.velocity, drive.fix
    good = np.isfinite(velocity.t) & np.isfinite(velocity.enu[:, :2]).all(axis=1)
    if np.count_nonzero(good) >= 4:
        stamps, first = np.unique(velocity.t[good], return_index=True)
        return Ground(stamps, velocity.enu[good, 0][first], velocity.enu[good, 1][first], 0.0)
    good = (
        np.isfinite(fix.t) & np.isfinite(fix.latitude) & np.isfinite(fix.longitude) & (fix.status != NO_FIX)
    )
    stamps, first = np.unique(fix.t[good], return_index=True)
    if stamps.size < 4:
        return Ground(np.empty(0), np.empty(0), np.empty(0), 0.0)
    latitude, longitude = fix.latitude[good][first], fix.longitude[good][first]
    # A sphere will do: a thousandth of a speed does not matter here.
    north = 111_200.0 * (latitude - latitude[0])
    east = 111_200.0 * math.cos(math.radians(latitude[0])) * (longitude - longitude[0])
    reported = fix.sigma[good, :2]
    sigma = float(np.median(reported[np.isfinite(reported)])) if np.isfinite(reported).any() else 2.5
    apart = float(np.clip(14.0 * sigma, 0.1, 1.0))  # s that make 0.1 m/s of the noise
    later = np.minimum(np.searchsorted(stamps, stamps + 0.99 * apart), stamps.size - 1)
    ok = later > np.arange(stamps.size)
    step = (stamps[later] - stamps)[ok]
    return Ground(
        0.5 * (stamps[later] + stamps)[ok],
        (east[later] - east)[ok] / step,
        (north[later] - north)[ok] / step,
        4.0 * sigma / float(np.median(step)),
    )
