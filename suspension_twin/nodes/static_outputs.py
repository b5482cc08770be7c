# SPDX-License-Identifier: Apache-2.0
"""What describes the twin to a viewer: the sensors' frames, the robot description, and the road near the vehicle."""

from __future__ import annotations

import math
from array import array

import numpy as np
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.follower import Follower, PlanarRow
from suspension_twin.nodes.topics import LATCHED_QOS, NS
from suspension_twin.road.road import Road
from suspension_twin.signals.attitude import quaternion
from suspension_twin.vehicle.urdf import urdf

__all__ = ["RoadCloud", "TwinDescription"]

#: The piece of road that is published: m to each side of the vehicle, m between its points, m driven until the next.
_REACH, _STEP, _EVERY = 8.0, 0.1, 2.0


class TwinDescription:
    """``/tf_static`` and ``robot_description``, published whenever another twin is loaded."""

    def __init__(self, node: TwinNode, base_frame: str) -> None:
        self._node = node
        self._base = base_frame
        self._static_out = node.offer(TFMessage, "/tf_static", LATCHED_QOS)
        self._description_out = node.offer(String, "robot_description", LATCHED_QOS)

    def send(self, follower: Follower) -> None:
        """Publish for the follower's twin, latched: also for subscriptions to come."""
        twin, node = follower.twin, self._node
        transforms = []
        for place in (twin.imu, twin.gps):
            transform = TransformStamped(child_frame_id=node.frame(place.frame))
            transform.header.frame_id = self._base
            transform.header.stamp = node.stamp_now()
            position, turn = transform.transform.translation, transform.transform.rotation
            position.x, position.y, position.z = place.position
            turn.x, turn.y, turn.z, turn.w = quaternion(*place.rpy)
            transforms.append(transform)
        self._static_out.publisher.publish(TFMessage(transforms=transforms))
        prefix = self._base.rpartition("/")[0]
        text = urdf(twin, self._base, f"{prefix}/" if prefix else "")
        self._description_out.publisher.publish(String(data=text))


class RoadCloud:
    """``twin/road``: the surface around the vehicle as points in ``map``, anew after every two metres."""

    def __init__(self, node: TwinNode, map_frame: str) -> None:
        self.road: Road | None = None
        self._out = node.offer(PointCloud2, "twin/road", LATCHED_QOS)
        fields = [
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate("xyz")
        ]
        self._cloud = PointCloud2(fields=fields, height=1, point_step=12, is_dense=True)
        self._cloud.header.frame_id = map_frame
        steps = np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
        x, y = np.meshgrid(steps, steps)
        near = np.hypot(x, y) <= _REACH
        self._around = np.column_stack([x[near], y[near]])
        self.reset()

    def reset(self) -> None:
        """The next pose is the first."""
        self._at = (math.inf, math.inf)

    def send(self, row: PlanarRow) -> None:
        """Publish the piece around a pose, if there is a road, a subscriber, and enough way since the last one."""
        if self.road is None or math.hypot(row.x - self._at[0], row.y - self._at[1]) < _EVERY:
            return
        if not self._out.wanted:
            return
        self._at = row.x, row.y
        # on a grid that stays where it is, or the points would swim
        points = np.round(np.array([row.x, row.y]) / _STEP) * _STEP + self._around
        samples = self.road.sample(points[:, 0], points[:, 1])
        cloud = np.column_stack([points, samples.z])[samples.inside].astype("<f4")
        message = self._cloud
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(row.ns, NS)
        message.width, message.row_step = len(cloud), 12 * len(cloud)
        message.data = array("B", cloud.tobytes())
        self._out.send(message)
