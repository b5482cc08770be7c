# SPDX-License-Identifier: Apache-2.0
"""Messages filled from a recorded drive, sample by sample."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import NavSatFix

from suspension_twin.drive.types import Drive

__all__ = ["Fill", "fill_fix", "fill_heading", "fill_imu", "fill_velocity"]

Fill = Callable[[Any, int], None]


def fill_imu(drive: Drive) -> Fill:
    """Fills sensor_msgs/Imu with the sample of an index."""
    imu = drive.imu

    def fill(message: Any, i: int) -> None:
        message.header.frame_id = imu.frame
        a, w = message.linear_acceleration, message.angular_velocity
        a.x, a.y, a.z = imu.specific_force[i].tolist()
        w.x, w.y, w.z = imu.angular_rate[i].tolist()
        if imu.orientation is None:
            message.orientation_covariance[0] = -1.0
        else:
            q = message.orientation
            q.x, q.y, q.z, q.w = imu.orientation[i].tolist()

    return fill


def fill_fix(drive: Drive) -> Fill:
    """Fills sensor_msgs/NavSatFix with the fix of an index."""
    fix = drive.fix

    def fill(message: Any, i: int) -> None:
        message.header.frame_id = fix.frame
        message.latitude, message.longitude = float(fix.latitude[i]), float(fix.longitude[i])
        message.altitude = float(fix.altitude[i])
        message.status.status = int(fix.status[i])
        east, north, up = fix.sigma[i].tolist()
        known = math.isfinite(east) and math.isfinite(north)
        kind = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN if known else NavSatFix.COVARIANCE_TYPE_UNKNOWN
        message.position_covariance_type = kind
        variance = (
            (east * east, north * north, up * up if math.isfinite(up) else 0.0) if known else (0.0, 0.0, 0.0)
        )
        message.position_covariance[0], message.position_covariance[4], message.position_covariance[8] = (
            variance
        )

    return fill


def fill_velocity(drive: Drive) -> Fill:
    """Fills geometry_msgs/TwistStamped with the velocity of an index."""
    velocity = drive.velocity

    def fill(message: Any, i: int) -> None:
        message.header.frame_id = "enu"
        v = message.twist.linear
        v.x, v.y, v.z = velocity.enu[i].tolist()

    return fill


def fill_heading(drive: Drive) -> Fill:
    """Fills geometry_msgs/QuaternionStamped with the heading of an index."""
    heading = drive.heading

    def fill(message: Any, i: int) -> None:
        assert heading is not None
        message.header.frame_id = "map"
        yaw = float(heading.yaw[i])
        message.quaternion.z, message.quaternion.w = math.sin(yaw / 2), math.cos(yaw / 2)

    return fill
