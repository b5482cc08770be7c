# SPDX-License-Identifier: Apache-2.0
"""The locked path, and the settings and priors of the filter that estimates it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = [
    "POOR_FIX",
    "RECEIVER_TIME",
    "REVERSE_SPEED",
    "REVERSE_TIME",
    "SLOPE_TIME",
    "STANDING_SPEED",
    "SWAY_SIGMA",
    "VELOCITY_SHARE",
    "PoseSettings",
    "Trajectory",
    "fix_sigma",
]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Planar motion of ``base_link`` in ``map``.

    Parameters
    ----------
    t : (n,) array
        s, strictly rising.
    x, y : (n,) array
        m.
    yaw : (n,) array
        rad from east, counter-clockwise, continuous.
    velocity : (n, 2) array
        m/s along x and y of ``base_link``.
    yaw_rate : (n,) array
        rad/s.
    acceleration : (n, 2) array
        m/s² along x and y of ``base_link`` of the body above its origin, at the height of the centre of
        gravity, the centripetal part included, gravity not.
    valid : (n,) array of bool
        False where no fix supports the pose.

    Examples
    --------
    >>> import numpy as np
    >>> from suspension_twin.inference.synthetic import path_along
    >>> from suspension_twin.road import flat_road
    >>> t = np.arange(0.0, 2.0, 0.1)
    >>> path = path_along(flat_road(), t, ((0.0, 10.0), (2.0, 10.0)), 100.0)
    >>> round(float(path.x[-1] - path.x[0]), 1)
    19.0
    """

    t: Floats
    x: Floats
    y: Floats
    yaw: Floats
    velocity: Floats
    yaw_rate: Floats
    acceleration: Floats
    valid: NDArray[np.bool_]

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def speed(self) -> Floats:
        """(n,) m/s along x of ``base_link``."""
        return np.asarray(self.velocity[:, 0])


NO_FIX = -1  # sensor_msgs/NavSatStatus

#: m/s and s: nothing on the road reverses this fast for this long. What pulls backwards then is a sensor that faces so.
REVERSE_SPEED, REVERSE_TIME = 4.0, 3.0
#: Speed in m/s below which a vehicle counts as standing: what receivers at rest give, with a margin.
STANDING_SPEED = 0.1
SLOPE_TIME = 5.0  # s; what tilts the vehicle for longer is a slope, not a sway
#: Prior of the share of the antenna's sway: 1 with this standard deviation.
SWAY_SIGMA = 0.3
#: m/s of a velocity's standard deviation for each m of the fixes', at least: a receiver that is bad at one is at both
#: (prior, by hand).
VELOCITY_SHARE = 0.05
#: s after which the error of a receiver is another one: the correlation time of multipath and atmosphere of code fixes,
#: of the order of a minute (Kaplan and Hegarty, Understanding GPS, ch. 7). So long a place is remembered.
RECEIVER_TIME = 60.0
#: m: fixes with a larger standard deviation are those of code, not of carrier phase. They are worse than what is felt,
#: which knows the place to some 0.1 m (benchmarks/felt.py).
POOR_FIX = 0.3


@dataclass(frozen=True)
class PoseSettings:
    """Noise, gates and time constants of the pose filter, the same live and offline.

    ``fix_sigma`` m where the receiver gives no covariance (SBAS and RTK status shrink it);
    ``fix_floor`` m the least standard deviation believed; ``fix_ceiling`` m the largest that is of
    use; ``velocity_sigma`` m/s; ``heading_sigma`` rad; ``gate`` standard deviations beyond which a
    fix is an outlier; ``align_speed`` m/s at which the course gives the yaw;
    ``outage`` s without a fix after which the pose is no longer valid; ``blend`` s over which a
    correction is bled in; ``blend_speed`` m/s that it may drift at most; ``snap`` m beyond which it
    jumps instead; ``history`` s that a fix may come late; ``imu_delay`` s by which ``imu/data`` lags what
    happened, of use to the live lock alone: the default is that of the default low-pass.
    """

    fix_sigma: float = 2.5
    fix_floor: float = 0.01
    fix_ceiling: float = 30.0
    velocity_sigma: float = 0.05
    heading_sigma: float = 0.02
    gate: float = 6.0
    align_speed: float = 1.0
    outage: float = 2.5
    blend: float = 0.3
    blend_speed: float = 0.5
    snap: float = 5.0
    history: float = 2.0
    imu_delay: float = 0.01125
    force_density: float = 2.0e-3
    jerk_density: float = 0.5
    gyro_density: float = 2.5e-7
    gyro_scale: float = 0.01
    slip: float = 0.006
    force_bias_walk: float = 4.0e-4
    gyro_bias_walk: float = 1.0e-8

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and (value > 0 or (value == 0 and item.name == "imu_delay"))):
                raise InputError("pose", item.name, f"must be above 0, is {value}")
        if self.imu_delay > 0.2:
            raise InputError("pose", "imu_delay", f"must be below 0.2 s, is {self.imu_delay}")

    def noise(self, hard: bool = True) -> Floats:
        """(9,) densities in the order of :mod:`suspension_twin.pose.ekf`, then the distance in standard deviations from
        which a measurement weighs less and, if ``hard``, the one beyond which it is refused."""
        return np.array(
            [
                self.force_density,
                self.jerk_density,
                self.gyro_density,
                self.gyro_scale,
                self.slip,
                self.force_bias_walk,
                self.gyro_bias_walk,
                0.5 * self.gate,
                self.gate if hard else math.inf,
            ]
        )


def fix_sigma(settings: PoseSettings, status: int, east: float, north: float) -> float:
    """Standard deviation in m to use for a fix; NaN where the fix is of no use.

    ``status`` of sensor_msgs/NavSatStatus, where a receiver that does not report it (-2) counts as one with a
    plain fix; ``east`` and ``north`` m, NaN or 0 where not given.
    """
    if status == NO_FIX:
        return math.nan
    if math.isfinite(east) and math.isfinite(north) and (east > 0 or north > 0):
        sigma = math.sqrt(0.5 * (east * east + north * north))
        return math.nan if sigma > settings.fix_ceiling else max(sigma, settings.fix_floor)
    return settings.fix_sigma * {1: 0.4, 2: 0.02}.get(status, 1.0)
