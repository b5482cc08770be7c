# SPDX-License-Identifier: Apache-2.0
"""A recorded drive in memory: what was measured, as it was measured, in SI units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Drive", "FixData", "HeadingData", "ImuData", "VelocityData"]

from suspension_twin.arrays import Floats


@dataclass(frozen=True, eq=False)
class ImuData:
    """IMU samples in the sensor's own axes, in the order they were recorded.

    ``t`` (n,) s since the epoch (header stamps), ``specific_force`` (n, 3) m/s²,
    ``angular_rate`` (n, 3) rad/s, ``orientation`` (n, 4) quaternion x, y, z, w of the sensor
    in ``map`` or None where the recorder gave none.
    """

    t: Floats
    specific_force: Floats
    angular_rate: Floats
    orientation: Floats | None = None
    frame: str = "imu_link"

    def __len__(self) -> int:
        return int(self.t.size)


@dataclass(frozen=True, eq=False)
class FixData:
    """GNSS fixes: ``t`` (m,) s, ``latitude`` and ``longitude`` (m,) degrees, ``altitude`` (m,) m,
    ``status`` (m,) of sensor_msgs/NavSatStatus (-1 is no fix), ``sigma`` (m, 3) standard
    deviations east, north, up in m, NaN where the receiver gave no covariance."""

    t: Floats
    latitude: Floats
    longitude: Floats
    altitude: Floats
    status: NDArray[np.int8]
    sigma: Floats
    frame: str = "gps_link"

    def __len__(self) -> int:
        return int(self.t.size)


@dataclass(frozen=True, eq=False)
class VelocityData:
    """GNSS velocities: ``t`` (k,) s, ``enu`` (k, 3) m/s east, north, up at the antenna."""

    t: Floats
    enu: Floats

    def __len__(self) -> int:
        return int(self.t.size)


@dataclass(frozen=True, eq=False)
class HeadingData:
    """Headings: ``t`` (k,) s, ``yaw`` (k,) rad from east, counter-clockwise."""

    t: Floats
    yaw: Floats

    def __len__(self) -> int:
        return int(self.t.size)


@dataclass(frozen=True, eq=False)
class Drive:
    """One recorded drive. Absent topics are empty arrays, never None, but for ``heading``.

    ``warnings`` holds one line for everything that was lost or repaired while reading.
    """

    name: str
    imu: ImuData
    fix: FixData
    velocity: VelocityData
    heading: HeadingData | None = None
    warnings: tuple[str, ...] = field(default=())
