# SPDX-License-Identifier: Apache-2.0
"""Samples as messages of the sensors' topics."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.drive.types import FixData, HeadingData, ImuData, VelocityData

__all__ = ["fill_fix", "fill_heading", "fill_imu", "fill_velocity"]


def fill_imu(imu: ImuData, message: Imu, i: int) -> None:
    """Put sample ``i`` into a message, all but its stamp."""
    message.header.frame_id = imu.frame
    a, w, q = message.linear_acceleration, message.angular_velocity, message.orientation
    a.x, a.y, a.z = imu.specific_force[i].tolist()
    w.x, w.y, w.z = imu.angular_rate[i].tolist()
    if imu.orientation is None:
        message.orientation_covariance[0] = -1.0
    else:
        q.x, q.y, q.z, q.w = imu.orientation[i].tolist()


def fill_fix(fix: FixData, message: NavSatFix, i: int) -> None:
    """As :func:`fill_imu`."""
    message.header.frame_id = fix.frame
    message.latitude, message.longitude = float(fix.latitude[i]), float(fix.longitude[i])
    message.altitude = float(fix.altitude[i])
    message.status.status = int(fix.status[i])
    variance = np.square(fix.sigma[i])
    known = bool(np.isfinite(variance[:2]).all())
    kind = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN if known else NavSatFix.COVARIANCE_TYPE_UNKNOWN
    message.position_covariance_type = kind
    message.position_covariance[::4] = np.where(np.isfinite(variance), variance, 0.0) if known else 0.0


def fill_velocity(velocity: VelocityData, message: TwistStamped, i: int) -> None:
    """As :func:`fill_imu`."""
    message.header.frame_id = "enu"
    v = message.twist.linear
    v.x, v.y, v.z = velocity.enu[i].tolist()


def fill_heading(heading: HeadingData, message: QuaternionStamped, i: int) -> None:
    """As :func:`fill_imu`."""
    message.header.frame_id = "map"
    yaw = float(heading.yaw[i])
    message.quaternion.z, message.quaternion.w = math.sin(yaw / 2), math.cos(yaw / 2)
