# SPDX-License-Identifier: Apache-2.0
"""A client that keeps what the nodes say about a drive, row by row."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import AccelStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile

from suspension_twin.arrays import Floats
from suspension_twin.nodes._base import STREAM_QOS
from suspension_twin_interfaces.msg import Gap

__all__ = ["DEPTH", "Listener"]

#: Messages of a topic that may wait to be taken.
DEPTH = 2000


class Listener(Node):  # type: ignore[misc]
    """Keeps what comes in on the topics, row by row."""

    def __init__(self, context: Context, namespace: str) -> None:
        super().__init__("session", context=context, namespace=namespace or None, use_global_arguments=False)
        self.rows: dict[str, list[tuple[float, ...]]] = {}
        qos = QoSProfile(history=STREAM_QOS.history, depth=DEPTH, reliability=STREAM_QOS.reliability)
        for kind, topic, columns in (
            (AccelStamped, "imu/vertical_acceleration", lambda m: (m.accel.linear.z,)),
            (AccelStamped, "twin/vertical_acceleration", lambda m: (m.accel.linear.z,)),
            (Odometry, "twin/odom", _odom),
            (Gap, "twin/gap", lambda m: (m.rms,)),
        ):
            self.rows[topic] = []
            self.create_subscription(kind, topic, self._keeper(topic, columns), qos)

    def _keeper(self, topic: str, columns: Callable[[Any], tuple[float, ...]]) -> Callable[[Any], None]:
        rows = self.rows[topic]

        def keep(message: Any) -> None:
            stamp = message.header.stamp
            rows.append((stamp.sec + 1e-9 * stamp.nanosec, *columns(message)))

        return keep

    def table(self, topic: str, width: int) -> Floats:
        """Rows (n, width) in the order of their stamps."""
        table = np.array(self.rows[topic], dtype=np.float64).reshape(-1, width)
        return np.asarray(table[np.argsort(table[:, 0], kind="stable")])


def _odom(message: Any) -> tuple[float, ...]:
    pose, v = message.pose, message.twist.twist.linear
    p, q = pose.pose.position, pose.pose.orientation
    variance = pose.covariance[35]
    return (
        p.x,
        p.y,
        2.0 * math.atan2(q.z, q.w),
        v.x,
        math.sqrt(variance) if 0.0 <= variance < 1.0 else math.inf,
    )
