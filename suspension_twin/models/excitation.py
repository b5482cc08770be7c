# SPDX-License-Identifier: Apache-2.0
"""From a locked pose and a road to what drives a model.

Between two stamps everything planar is taken as linear in time, so that a live twin, which
knows no more than the last two stamps, gets the same numbers as a recorded drive does.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError
from suspension_twin.models.types import Excitation, HeightField, Ints, PlanarPath, PoseSample
from suspension_twin.pose.types import Trajectory

__all__ = [
    "MAX_GAP",
    "MAX_STEP",
    "MOTION",
    "check_step",
    "coarser",
    "earlier_pose",
    "excitation",
    "next_yaw_acceleration",
    "substeps",
    "walk",
]

#: Largest step in s unless a caller asks otherwise.
MAX_STEP = 1e-3
#: A pause between stamps longer than this, in s, starts afresh from static equilibrium.
MAX_GAP = 0.5
#: Stamps of 1.7e9 s resolve 0.24 µs: an interval may exceed whole steps by this share of one.
_SLACK = 2e-3
#: Columns of Excitation.motion.
MOTION = ("step", "ax", "ay", "yaw_rate", "yaw_acceleration", "speed", "lateral_speed")
_CHUNK = 20_000  # stamps whose heights are looked up at once


class OnWheels(Protocol):
    """Anything with four wheels at (4, 2) m in base_link."""

    @property
    def wheel_positions(self) -> Floats: ...


def check_step(max_step: float) -> float:
    """``max_step`` in s as it is, or InputError when it is no usable step."""
    if not (math.isfinite(max_step) and 1e-6 <= max_step <= 0.05):
        raise InputError("excitation", "max_step", f"must lie between 1e-6 and 0.05 s, is {max_step}")
    return float(max_step)


def substeps(interval: float, max_step: float) -> int:
    """Number of equal steps for one interval in s; 0 where a gap asks for a fresh start."""
    if interval > MAX_GAP:
        return 0
    return max(1, math.ceil(interval / max_step - _SLACK))


def excitation(
    trajectory: Trajectory,
    vehicle: OnWheels,
    road: HeightField,
    max_step: float = MAX_STEP,
    antenna: float = 0.0,
) -> Excitation:
    """Prepare what excites a car: its planar motion, and the road under its wheels in between.

    Parameters
    ----------
    trajectory : Trajectory
        Planar motion at n stamps; stamps may jitter.
    vehicle : Vehicle
        Its wheelbase and tracks place the wheels.
    road : HeightField
        Anything with ``heights(x, y)`` in m.
    max_step : float
        Longest step of the integration in s.
    antenna : float
        Height in m of the antenna whose path this is, if the vehicle was taken for upright; 0 for the
        vehicle's own path.

    Returns
    -------
    Excitation
        For :func:`~suspension_twin.models.simulate.simulate_twin`.

    Raises
    ------
    InputError
        Stamps that do not rise, values that are not finite, a road without a height under a wheel.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.inference.synthetic import path_along
    >>> from suspension_twin.road import bump_road, half_sine
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> road = bump_road(half_sine(0.9, 0.05), at=10.0, length=40.0)
    >>> path = path_along(road, np.arange(0.0, 3.0, 0.01), ((0.0, 5.0), (3.0, 5.0)), 3.0)
    >>> len(excitation(path, load_twin("bags/bump_15kmh/twin.yaml").vehicle, road))
    300
    """
    max_step = check_step(max_step)
    t = np.asarray(trajectory.t, dtype=np.float64)
    names = ("t", "x", "y", "yaw", "velocity", "yaw_rate", "acceleration")
    columns = {name: np.ascontiguousarray(getattr(trajectory, name), dtype=np.float64) for name in names}
    if t.ndim != 1 or t.size < 1:
        raise InputError("trajectory", "t", "holds no stamps")
    for name, values in columns.items():
        if values.shape not in (t.shape, (t.size, 2)):
            raise InputError("trajectory", name, f"has shape {values.shape}, t has {t.shape}")
        if not np.isfinite(values).all():
            at = int(np.flatnonzero(~np.isfinite(values))[0])
            raise InputError("trajectory", name, f"is not finite at sample {at}")
    dt = np.diff(t)
    if (dt <= 0).any():
        at = int(np.flatnonzero(dt <= 0)[0]) + 1
        raise InputError("trajectory", "t", f"does not rise at sample {at}")

    count, first = _counted(t, max_step)
    path = PlanarPath(
        columns["x"], columns["y"], columns["yaw"], vehicle.wheel_positions, road, antenna=antenna
    )
    motion = np.zeros((t.size, len(MOTION)))
    motion[1:, 0] = _steps(dt, count)
    motion[:, 1:3], motion[:, 3], motion[:, 5:] = (
        columns[n] for n in ("acceleration", "yaw_rate", "velocity")
    )
    yaw_accelerations(columns["t"], columns["yaw_rate"], count, motion[:, MOTION.index("yaw_acceleration")])
    heights = _heights(path, t, count, first)
    return Excitation(columns["t"], count, first, heights, motion, max_step, path)


def coarser(known: Excitation, max_step: float) -> Excitation:
    """The same excitation in steps of up to ``max_step`` s, for a first look that takes less time."""
    count, first = _counted(known.t, check_step(max_step))
    motion = known.motion.copy()
    motion[1:, 0] = _steps(np.diff(known.t), count)
    heights = _heights(known.path, known.t, count, first)
    return replace(known, substeps=count, first=first, road=heights, motion=motion, max_step=max_step)


def _counted(t: Floats, max_step: float) -> tuple[Ints, Ints]:
    """(n,) steps of each interval, and (n + 1,) the rows of road that they begin at."""
    dt = np.diff(t)
    count = np.zeros(t.size, dtype=np.int64)
    count[1:] = np.maximum(1, np.ceil(dt / max_step - _SLACK))
    count[1:][dt > MAX_GAP] = 0
    first = np.zeros(t.size + 1, dtype=np.int64)
    np.cumsum(np.maximum(count, 1), out=first[1:])
    return count, first


def _steps(dt: Floats, count: Ints) -> Floats:
    """(n - 1,) s length of the steps of every interval after the first stamp; 0 where there are none."""
    return np.divide(dt, count[1:], out=np.zeros_like(dt), where=count[1:] > 0)


def _heights(path: PlanarPath, t: Floats, count: Ints, first: Ints) -> Floats:
    """(m, 4) m heights under the wheels at the end of every step; raises InputError where there is none."""
    heights = np.empty((int(first[-1]), 4))
    for begin in range(0, t.size, _CHUNK):
        end = min(begin + _CHUNK, t.size)
        rows = slice(int(first[begin]), int(first[end]))
        wheel_x, wheel_y = np.empty((2, rows.stop - rows.start, 4))
        walk(path.x, path.y, path.yaw, count, first, begin, end, path.wheels, wheel_x, wheel_y)
        heights[rows] = path.ground.heights(wheel_x, wheel_y)
    if not np.isfinite(heights).all():
        row = int(np.flatnonzero(~np.isfinite(heights).all(axis=1))[0])
        stamp = float(t[np.searchsorted(first, row, side="right") - 1])
        raise InputError("road", f"no height under a wheel at t = {stamp:.3f} s")
    return heights


#: Time constant in s of the filtered difference that gives the yaw acceleration. It delays the
#: lever-arm term a little and keeps gyro noise over a jittered interval from blowing it up.
YAW_TIME = 0.03


@compiled
def walk(
    x: Floats,
    y: Floats,
    yaw: Floats,
    count: Ints,
    first: Ints,
    begin: int,
    end: int,
    wheels: Floats,
    wheel_x: Floats,
    wheel_y: Floats,
) -> None:
    """Fill (rows, 4) ``map`` positions of the wheel centres for the stamps begin..end-1.

    ``count`` and ``first`` as in Excitation; poses run linearly between stamps. ``wheels`` (4, 2)
    in base_link.
    """
    origin = first[begin]
    for k in range(begin, end):
        n = max(1, count[k])
        for j in range(n):
            px, py, angle = x[k], y[k], yaw[k]
            if j < n - 1:
                share = (j + 1) / n
                px = x[k - 1] + share * (px - x[k - 1])
                py = y[k - 1] + share * (py - y[k - 1])
                angle = yaw[k - 1] + share * (angle - yaw[k - 1])
            c, s = math.cos(angle), math.sin(angle)
            row = first[k] + j - origin
            for i in range(4):
                wheel_x[row, i] = px + c * wheels[i, 0] - s * wheels[i, 1]
                wheel_y[row, i] = py + s * wheels[i, 0] + c * wheels[i, 1]


def next_yaw_acceleration(value: float, change: float, interval: float) -> float:
    """One step of the filtered difference: ``change`` rad/s of the yaw rate in ``interval`` s."""
    return value + (change - value * interval) / (interval + YAW_TIME)


def earlier_pose(motion: PoseSample, seconds: float) -> PoseSample:
    """The pose ``seconds`` before, at the velocity of now: where a sensor was when it took a sample that comes so much
    later."""
    x, y, yaw, speed, lateral_speed, yaw_rate, *_ = motion
    return motion._replace(
        x=x - seconds * (speed * math.cos(yaw) - lateral_speed * math.sin(yaw)),
        y=y - seconds * (speed * math.sin(yaw) + lateral_speed * math.cos(yaw)),
        yaw=yaw - seconds * yaw_rate,
    )


_next = compiled(next_yaw_acceleration)


@compiled
def yaw_accelerations(t: Floats, yaw_rate: Floats, count: Ints, out: Floats) -> None:
    """Fill (n,) rad/s² the filtered difference of the yaw rate; zero at every fresh start."""
    value = 0.0
    for k in range(t.size):
        value = _next(value, yaw_rate[k] - yaw_rate[k - 1], t[k] - t[k - 1]) if count[k] > 0 else 0.0
        out[k] = value
