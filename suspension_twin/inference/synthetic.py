# SPDX-License-Identifier: Apache-2.0
"""Synthetic drives: the recording that a known twin would produce on a road.

For checks with a known truth and for planning a measurement. The motion is that of the model of the twin; noise,
jitter, lost samples and biases of a phone and the errors of a GNSS receiver are added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import PchipInterpolator

from suspension_twin.arrays import Floats, interpolated
from suspension_twin.drive.types import Drive, FixData, ImuData, VelocityData
from suspension_twin.errors import InputError
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.pose.types import Trajectory
from suspension_twin.road.road import Road
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.vehicle.twin import Twin

__all__ = ["SensorErrors", "path_along", "synthetic_drive"]


@dataclass(frozen=True)
class ImuErrors:
    """Errors of a phone's IMU: standard deviations of the noise in ``force`` m/s² and ``rate`` rad/s; biases in sensor
    axes; ``jitter`` s of the stamps; ``lost`` share of the samples; ``imu_rate`` Hz; ``clock_offset`` s of the stamps
    (positive: later)."""

    force: float = 0.05
    rate: float = 0.003
    force_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    jitter: float = 3e-4
    lost: float = 0.0
    imu_rate: float = 100.0
    clock_offset: float = 0.0


@dataclass(frozen=True)
class ReceiverErrors:
    """Errors of an RTK receiver: standard deviations of ``position`` m and ``velocity`` m/s; ``gps_rate`` Hz."""

    position: float = 0.01
    velocity: float = 0.02
    gps_rate: float = 10.0


@dataclass(frozen=True)
class SensorErrors(ReceiverErrors, ImuErrors):
    """Errors of a phone and of an RTK receiver in a recording that begins at ``start``, UTC in s."""

    start: float = 1_700_000_000.0


def path_along(
    road: Road, t: Floats, knots: Sequence[tuple[float, float]], u: float, v: float = 0.0
) -> Trajectory:
    """A drive along a road, as a trajectory.

    Parameters
    ----------
    road : Road
        The road.
    t : (n,) array
        Stamps in s, in the time of the knots.
    knots : sequence of tuple
        (s, m/s) of the speed, joined smoothly.
    u : float
        m on the road at which the origin of ``base_link`` starts.
    v : float
        Lateral offset in m.

    Returns
    -------
    Trajectory
        With the origin of ``base_link`` on the path.

    Raises
    ------
    InputError
        Fewer than two knots.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.road import bump_road, half_sine
    >>> road = bump_road(half_sine(0.9, 0.05), length=40.0)
    >>> path = path_along(road, np.arange(0.0, 2.0, 0.01), ((0.0, 5.0), (2.0, 5.0)), 4.0)
    >>> round(float(path.x[0]), 6)
    4.0
    """
    if len(knots) < 2:
        raise InputError("speed", "needs at least two knots of time and speed")
    times, speeds = np.array(knots, dtype=float).T
    profile = PchipInterpolator(times, speeds, extrapolate=False)
    fine = np.arange(times[0], times[-1] + 1e-3, 1e-3)
    speed = np.asarray(np.nan_to_num(profile(np.minimum(fine, times[-1]))), dtype=np.float64)
    place = u + cumulative_trapezoid(speed, fine, initial=0)
    x, y = road.uv_to_xy(place, np.full_like(place, v))
    ahead, behind = (road.uv_to_xy(place + d, np.full_like(place, v)) for d in (0.25, -0.25))
    yaw = np.unwrap(np.arctan2(ahead[1] - behind[1], ahead[0] - behind[0]))
    yaw_rate = np.gradient(yaw, fine)
    columns = {
        "x": x,
        "y": y,
        "yaw": yaw,
        "velocity": np.column_stack([speed, np.zeros_like(speed)]),
        "yaw_rate": yaw_rate,
        "acceleration": np.column_stack([np.gradient(speed, fine), speed * yaw_rate]),
    }
    at = np.clip(t, fine[0], fine[-1])
    return Trajectory(
        t=t, valid=np.ones(t.size, dtype=bool), **{k: interpolated(at, fine, c) for k, c in columns.items()}
    )


def synthetic_drive(
    truth: Twin,
    road: Road,
    knots: Sequence[tuple[float, float]],
    seed: int,
    errors: SensorErrors | None = None,
    *,
    u: float = 5.0,
    v: float = 0.0,
    name: str = "synthetic",
) -> Drive:
    """Drive as the sensors of a known twin would record it, to test a method on.

    Parameters
    ----------
    truth : Twin
        The twin that drives; it needs a datum.
    road : Road
        The road.
    knots : sequence of tuple
        (s, m/s) of the speed.
    seed : int
        Seed of the noise.
    errors : SensorErrors, optional
        Noise, biases, rates and clock offset of phone and receiver.
    u, v : float
        Start on the road in m.
    name : str
        Name of the drive.

    Returns
    -------
    Drive
        As a recorder would have written it.

    Raises
    ------
    InputError
        The twin has no datum.

    Examples
    --------
    >>> from suspension_twin.road import bump_road, half_sine
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin, road = load_twin("bags/bump_15kmh/twin.yaml"), bump_road(half_sine(0.9, 0.05))
    >>> drive = synthetic_drive(twin, road, ((0.0, 0.0), (2.0, 0.0), (4.0, 5.0), (8.0, 5.0)), seed=1)
    >>> len(drive.imu)
    800
    """
    e = errors or SensorErrors()
    if truth.datum is None:
        raise InputError("twin", "datum", "is missing: positions need an origin")
    rng = np.random.default_rng(seed)
    end = knots[-1][0]
    even = np.arange(knots[0][0], end, 1.0 / e.imu_rate)
    t = even + e.jitter * np.clip(rng.standard_normal(even.size), -3.0, 3.0)
    t = t[rng.random(t.size) >= e.lost]
    trajectory = path_along(road, t, knots, u, v)
    response = simulate_twin(truth, excitation(trajectory, truth.vehicle, road))
    turn = rpy_matrix(truth.imu.rpy)
    force = response.force @ turn + np.array(e.force_bias) + e.force * rng.standard_normal((t.size, 3))
    rate = response.rate @ turn + np.array(e.rate_bias) + e.rate * rng.standard_normal((t.size, 3))
    imu = ImuData(t=e.start + t + e.clock_offset, specific_force=force, angular_rate=rate)

    fixes = np.arange(knots[0][0], end, 1.0 / e.gps_rate)
    at = path_along(road, fixes, knots, u, v)
    cos, sin = np.cos(at.yaw), np.sin(at.yaw)
    arm = truth.gps.position
    height, roll, pitch = (np.interp(fixes, t, c) for c in (response.z, response.roll, response.pitch))
    # roll and pitch displace the antenna
    ahead, left = arm[0] + arm[2] * pitch, arm[1] - arm[2] * roll
    antenna = np.column_stack(
        [at.x + cos * ahead - sin * left, at.y + sin * ahead + cos * left, height + arm[2]]
    )
    antenna = antenna + e.position * rng.standard_normal(antenna.shape) * np.array([1.0, 1.0, 1.5])
    latitude, longitude, altitude = LocalMap(truth.datum).to_geodetic(antenna).T
    along = at.speed - at.yaw_rate * arm[1]
    across = at.yaw_rate * arm[0]
    enu = np.column_stack([cos * along - sin * across, sin * along + cos * across, np.zeros(fixes.size)])
    enu = enu + e.velocity * rng.standard_normal(enu.shape)
    sigma = np.tile(np.array([1.0, 1.0, 1.5]) * e.position, (fixes.size, 1))
    fix = FixData(
        t=e.start + fixes,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        status=np.zeros(fixes.size, dtype=np.int8),
        sigma=sigma,
    )
    return Drive(name=name, imu=imu, fix=fix, velocity=VelocityData(t=e.start + fixes, enu=enu))
