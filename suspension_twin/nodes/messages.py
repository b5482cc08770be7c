# SPDX-License-Identifier: Apache-2.0
"""Samples as messages of the sensors' topics, and messages as samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import FixData, HeadingData, ImuData, VelocityData

__all__ = ["fill_fix", "fill_heading", "fill_imu", "fill_velocity", "read_fix", "read_imu", "read_velocity"]


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


def read_imu(messages: Sequence[Imu]) -> ImuData:
    """The samples of some messages, in their order."""
    force = [(m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z) for m in messages]
    rate = [(m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z) for m in messages]
    return ImuData(_stamps(messages), np.array(force).reshape(-1, 3), np.array(rate).reshape(-1, 3))


def read_fix(messages: Sequence[NavSatFix]) -> FixData:
    """As :func:`read_imu`."""
    variance = np.array([m.position_covariance[[0, 4, 8]] for m in messages]).reshape(-1, 3)
    known = np.array([m.position_covariance_type != 0 for m in messages], dtype=np.bool_)[:, None] & (
        variance >= 0
    )
    latitude, longitude, altitude, status = (
        np.array([(m.latitude, m.longitude, m.altitude, m.status.status) for m in messages], dtype=np.float64)
        .reshape(-1, 4)
        .T
    )
    sigma = np.sqrt(np.where(known, variance, np.nan))
    return FixData(_stamps(messages), latitude, longitude, altitude, status.astype(np.int8), sigma)


def read_velocity(messages: Sequence[TwistStamped]) -> VelocityData:
    """As :func:`read_imu`."""
    enu = [(m.twist.linear.x, m.twist.linear.y, m.twist.linear.z) for m in messages]
    return VelocityData(_stamps(messages), np.array(enu).reshape(-1, 3))


def _stamps(messages: Sequence[Any]) -> Floats:
    return np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages], dtype=np.float64)
