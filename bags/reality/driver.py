# SPDX-License-Identifier: Apache-2.0
"""A driver: a path of straights and arcs, a speed along it, two hands and two feet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

Floats = NDArray[Any]
GRID = 0.05  # m, between the points of a path


@dataclass(frozen=True, eq=False)
class Path:
    """x, y, heading and curvature (n,) every ``GRID`` m."""

    x: Floats
    y: Floats
    heading: Floats
    curvature: Floats

    @classmethod
    def from_pieces(
        cls, start: tuple[float, float, float], pieces: list[tuple[float, float]], ease: float = 1.5
    ) -> Path:
        """From (x, y, heading) on; each piece is (length m, curvature 1/m), blended over ``ease`` m."""
        curvature = np.concatenate([np.full(max(round(length / GRID), 1), k) for length, k in pieces])
        curvature = uniform_filter1d(curvature, round(ease / GRID), mode="nearest")
        heading = start[2] + np.concatenate([[0.0], np.cumsum(curvature[:-1])]) * GRID
        x = start[0] + np.concatenate([[0.0], np.cumsum(np.cos(heading[:-1]))]) * GRID
        y = start[1] + np.concatenate([[0.0], np.cumsum(np.sin(heading[:-1]))]) * GRID
        return cls(x, y, heading, curvature)

    @classmethod
    def from_points(cls, points: Floats) -> Path:
        """Through densely given points (k, 2)."""
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        at = np.arange(0.0, s[-1], GRID)
        x, y = np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])
        heading = uniform_filter1d(np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))), 41, mode="nearest")
        return cls(x, y, heading, np.gradient(heading, GRID))

    @property
    def length(self) -> float:
        return (self.x.size - 1) * GRID


def speed_over_path(
    length: float, limits: list[tuple[float, float]], accelerate: float, brake: float
) -> Floats:
    """Speed (n,) every ``GRID`` m: under step-wise ``limits`` (from m, m/s), from rest to rest."""
    n = round(length / GRID) + 1
    s = np.arange(n) * GRID
    top = np.empty(n)
    for begin, value in limits:
        top[s >= begin - 1e-9] = value
    v: Floats = top.copy()
    v[0], v[-1] = 0.0, 0.0
    for i in range(1, n):
        v[i] = min(v[i], math.sqrt(v[i - 1] ** 2 + 2 * accelerate * GRID))
    for i in range(n - 2, -1, -1):
        v[i] = min(v[i], math.sqrt(v[i + 1] ** 2 + 2 * brake * GRID))
    return v


class Driver:
    """Follows a path and its speed: stands, drives, stops and stands again."""

    def __init__(self, path: Path, speed: Floats, mass: float, wheelbase: float, stand: float) -> None:
        self.path, self.mass, self.wheelbase, self.stand = path, mass, wheelbase, stand
        # Speed over time, with the corners of its acceleration rounded as a foot would.
        v = np.maximum(0.5 * (speed[1:] + speed[:-1]), 0.05)
        t = np.concatenate([[0.0], np.cumsum(GRID / v)])
        self.dt = 0.01
        grid = np.arange(-1.0, t[-1] + 2.0, self.dt)
        self.plan = uniform_filter1d(np.interp(grid, t, speed, left=0.0, right=0.0), 81, mode="nearest")
        self.push = np.gradient(self.plan, self.dt)
        self.time = stand + t[-1] + 2.0
        self.at = 0
        self.steer = 0.0
        self.sum = 0.0
        self.stopped = False

    def __call__(
        self, t: float, x: float, y: float, heading: float, speed: float, dt: float
    ) -> tuple[float, float, float]:
        """Steering angle rad, drive N and brake N."""
        clock = t - self.stand
        if clock < 0:
            return 0.0, 0.0, 4000.0
        path = self.path
        while self.at < path.x.size - 2 and self._ahead(self.at + 1, x, y) > 0:
            self.at += 1
        k = min(int(clock / self.dt), self.plan.size - 1)
        wanted, push = float(self.plan[k]), float(self.push[k])
        preview = min(self.at + round((0.15 * abs(speed) + 0.6) / GRID), path.x.size - 1)
        i = self.at
        off = -(x - path.x[i]) * math.sin(path.heading[i]) + (y - path.y[i]) * math.cos(path.heading[i])
        turn = math.remainder(heading - path.heading[i], 2 * math.pi)
        aim = math.atan(self.wheelbase * path.curvature[preview]) - 1.1 * turn - 0.35 * off
        aim = min(max(aim, -0.62), 0.62)
        most = 0.6 * dt  # hands do not turn the wheels faster than this
        self.steer += min(max(aim - self.steer, -most), most)
        done = i >= path.x.size - 3 or (wanted < 0.02 and clock > 3.0)
        self.stopped = self.stopped or done
        if self.stopped:
            return self.steer, 0.0, 5000.0
        error = wanted - speed
        self.sum += error * dt
        effort = self.mass * (push + 1.5 * error + 0.4 * self.sum)
        return self.steer, max(effort, 0.0), max(-effort, 0.0)

    def _ahead(self, i: int, x: float, y: float) -> float:
        h = self.path.heading[i]
        return float((x - self.path.x[i]) * math.cos(h) + (y - self.path.y[i]) * math.sin(h))
