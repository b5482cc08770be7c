# SPDX-License-Identifier: Apache-2.0
"""Samples as messages of the sensors' topics, and messages as samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import Quaternion, QuaternionStamped, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import FixData, HeadingData, ImuData, VelocityData, deviations
from suspension_twin.errors import InputError
from suspension_twin.nodes.topics import NS, Message
from suspension_twin.pose.lock import PlanarMotion, PlanarState

__all__ = [
    "SENSORS",
    "fill_fix",
    "fill_heading",
    "fill_imu",
    "fill_odometry",
    "fill_velocity",
    "is_rotation",
    "put_stamp",
    "read_fix",
    "read_imu",
    "read_odometry",
    "read_velocity",
    "sigmas_of",
    "yaw_of",
]

#: rad²: variance of a yaw from which it counts as not known.
YAW_UNKNOWN = 1.0
#: Limits of a plausible odometry: distance from the datum (m), speeds (m/s, rad/s).
_FARTHEST, _FASTEST = 1e8, 1e3


def put_stamp(header: Header, ns: int) -> None:
    """The stamp of a header, in ns."""
    header.stamp.sec, header.stamp.nanosec = divmod(ns, NS)


def yaw_of(q: Quaternion) -> float:
    """Yaw in rad of a quaternion."""
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def is_rotation(q: Quaternion) -> bool:
    """Whether a quaternion is normalised."""
    return bool(abs(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w - 1.0) < 0.02)


def sigmas_of(fix: NavSatFix) -> tuple[float, float]:
    """Standard deviations east and north in m of a fix, NaN where the receiver gives none."""
    east, north = fix.position_covariance[0], fix.position_covariance[4]
    if fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN or min(east, north) < 0:
        return math.nan, math.nan
    return math.sqrt(east), math.sqrt(north)


def fill_odometry(state: PlanarState, odom: Odometry) -> None:
    """Put a locked pose into a message, all but its stamp."""
    pose, twist, covariance = odom.pose.pose, odom.twist.twist, odom.pose.covariance
    pose.position.x, pose.position.y = state.x, state.y
    pose.orientation.z, pose.orientation.w = math.sin(state.yaw / 2), math.cos(state.yaw / 2)
    motion = state.motion
    twist.linear.x, twist.linear.y, twist.angular.z = motion.speed, motion.lateral_speed, motion.yaw_rate
    xx, xy, xyaw, yy, yyaw, yawyaw = state.covariance
    covariance[0], covariance[7], covariance[35] = xx, yy, yawyaw
    covariance[1] = covariance[6] = xy
    covariance[5] = covariance[30] = xyaw
    covariance[11] = covariance[31] = yyaw


def read_odometry(odom: Odometry, t: float) -> PlanarState:
    """The pose of a message at ``t`` s; its accelerations are not known. Raises InputError for a value out of range."""
    p, twist, covariance = odom.pose.pose.position, odom.twist.twist, odom.pose.covariance
    yaw, v, turn = yaw_of(odom.pose.pose.orientation), twist.linear, twist.angular.z
    near = abs(p.x) < _FARTHEST and abs(p.y) < _FARTHEST and math.isfinite(yaw)
    if not (near and abs(v.x) < _FASTEST and abs(v.y) < _FASTEST and abs(turn) < _FASTEST):
        raise InputError("twin/odom", "message dropped: a value is not finite or out of range")
    known = bool(covariance[35] < YAW_UNKNOWN)
    xx, xy, xyaw, yy, yyaw, yawyaw = (float(covariance[k]) for k in (0, 1, 5, 7, 11, 35))
    motion = PlanarMotion(v.x, v.y, turn, math.nan, math.nan)
    return PlanarState(t, p.x, p.y, yaw, motion, known, known, (xx, xy, xyaw, yy, yyaw, yawyaw))


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


#: Topics of the sensors by stream: type, name, and the function that puts a sample into a message.
SENSORS: Final[Mapping[str, tuple[type, str, Callable[[Any, Any, int], None]]]] = {
    "imu": (Imu, "imu/data_raw", fill_imu),
    "fix": (NavSatFix, "fix", fill_fix),
    "vel": (TwistStamped, "vel", fill_velocity),
    "heading": (QuaternionStamped, "heading", fill_heading),
}


def read_imu(messages: Sequence[Imu]) -> ImuData:
    """The samples of some messages, in their order."""
    force = [(m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z) for m in messages]
    rate = [(m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z) for m in messages]
    return ImuData(_stamps(messages), np.array(force).reshape(-1, 3), np.array(rate).reshape(-1, 3))


def read_fix(messages: Sequence[NavSatFix]) -> FixData:
    """As :func:`read_imu`."""
    variance = np.array([m.position_covariance[[0, 4, 8]] for m in messages]).reshape(-1, 3)
    known = np.array([m.position_covariance_type != 0 for m in messages], dtype=np.bool_)
    latitude, longitude, altitude, status = (
        np.array([(m.latitude, m.longitude, m.altitude, m.status.status) for m in messages], dtype=np.float64)
        .reshape(-1, 4)
        .T
    )
    sigma = deviations(variance, known)
    return FixData(_stamps(messages), latitude, longitude, altitude, status.astype(np.int8), sigma)


def read_velocity(messages: Sequence[TwistStamped]) -> VelocityData:
    """As :func:`read_imu`."""
    enu = [(m.twist.linear.x, m.twist.linear.y, m.twist.linear.z) for m in messages]
    return VelocityData(_stamps(messages), np.array(enu).reshape(-1, 3))


def _stamps(messages: Sequence[Message]) -> Floats:
    return np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages], dtype=np.float64)
