# SPDX-License-Identifier: Apache-2.0
"""The topics that the suspension model publishes, filled from what the live twin gives."""

from __future__ import annotations

import math
from array import array

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import AccelStamped, Point, PoseStamped, TransformStamped
from sensor_msgs.msg import Imu, JointState, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, String
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker

from suspension_twin.live.follow import Followed, Follower, VirtualImu
from suspension_twin.live.gap import TILE_EDGE, RunningGap
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.messages import put_stamp
from suspension_twin.nodes.topics import LATCHED_QOS, NS
from suspension_twin.pose.lock import PlanarState
from suspension_twin.road.road import Road
from suspension_twin.signals.attitude import quaternion
from suspension_twin.vehicle.corners import Joint
from suspension_twin.vehicle.twin import Twin
from suspension_twin.vehicle.urdf import urdf, wheel_frame
from suspension_twin_interfaces.msg import Gap

__all__ = ["TwinOutputs"]

#: Samples over which the rate is averaged, and the share of the period from which on samples come "at that rate": a
#: clock runs a little fast, and a lost sample more must not begin a thinning.
_RATE_SAMPLES, _TOLERATED = 50, 0.9
#: The piece of road that is published: m to each side of the vehicle, m between its points, m driven until the next.
_REACH, _STEP, _EVERY = 8.0, 0.1, 2.0
#: A gap this many times the floor is red.
_RED = 4.0


class TwinOutputs:
    """One set of messages with one common stamp, filled anew for every sample."""

    def __init__(self, node: TwinNode, map_frame: str, base_frame: str) -> None:
        self.map_frame = map_frame
        self._node = node
        self._base_frame = base_frame = node.frame(base_frame)
        self._stamp = Time()
        self._vertical, self._imu = AccelStamped(), Imu()
        self._pose, self._joints, self._gap = PoseStamped(), JointState(), Gap()
        self._transform = TransformStamped(child_frame_id=base_frame)
        self._tf = TFMessage(transforms=[self._transform])
        for message, frame in (
            (self._vertical, base_frame),
            (self._imu, ""),
            (self._pose, map_frame),
            (self._joints, ""),
            (self._gap, base_frame),
            (self._transform, map_frame),
        ):
            message.header.frame_id = frame
            message.header.stamp = self._stamp
        self._vertical_out = node.offer(AccelStamped, "twin/vertical_acceleration")
        self._imu_out = node.offer(Imu, "twin/imu")
        self._pose_out = node.offer(PoseStamped, "twin/pose")
        self._joints_out = node.offer(JointState, "joint_states")
        self._tf_out = node.offer(TFMessage, "/tf")
        self._gap_out = node.offer(Gap, "twin/gap")
        self._marker = GapMarker(node, map_frame)
        self._road = RoadCloud(node, map_frame)
        self._description = TwinDescription(node, base_frame)
        self._wheels: list[tuple[Joint, TransformStamped]] = []

    def configure(self, follower: Follower | None, visual_rate: float, gap_rate: float) -> None:
        """Take joint names and frames from another twin, and new rates in Hz."""
        self._visual = Thinning(visual_rate)
        self._gap_period = int(NS / gap_rate)
        if follower is not None:
            twin = follower.twin
            self._joints.name = list(twin.joint_names)
            self._imu.header.frame_id = self._node.frame(twin.imu.frame)
            self._road.road = None if twin.road is None else follower.road
            self._hang(twin.joints)
            self._description.send(twin)
        self.reset()

    def reset(self) -> None:
        """The next sample is the first."""
        self._gap_due = 0
        self._visual.reset()
        self._marker.reset()
        self._road.reset()

    def _hang(self, joints: tuple[Joint, ...]) -> None:
        """Transforms of the wheels, behind that of the body."""
        self._wheels = []
        for joint in joints:
            transform = TransformStamped(child_frame_id=self._node.frame(wheel_frame(joint)))
            transform.header.frame_id = self._base_frame
            transform.header.stamp = self._stamp
            place = transform.transform.translation
            place.x, place.y, place.z = joint.origin
            self._wheels.append((joint, transform))
        self._tf.transforms = [self._transform, *(transform for _, transform in self._wheels)]

    def send(self, at: Followed, follower: Follower, ns: int) -> None:
        """Publish the filtered vertical acceleration at once, all other topics of the same sample at their rates and if
        there is a subscriber."""
        self._stamp.sec, self._stamp.nanosec = divmod(ns, NS)
        self._vertical.accel.linear.z = at.vertical_acceleration
        self._vertical_out.send(self._vertical, urgent=True)
        if self._imu_out.wanted:
            self._send_imu(follower.virtual_imu(at))
        if self._visual.takes(ns):
            self._send_visual(at)
            if at.pose.aligned:
                self._road.send(at.pose, ns)
        if ns >= self._gap_due:
            self._gap_due = ns + self._gap_period
            if self._gap_out.wanted:
                self._send_gap(follower.gap)
            self._marker.send(follower, ns)

    def _send_imu(self, sensed: VirtualImu) -> None:
        imu = self._imu
        for vector, values in ((imu.linear_acceleration, sensed.force), (imu.angular_velocity, sensed.rate)):
            vector.x, vector.y, vector.z = values
        q = imu.orientation
        q.x, q.y, q.z, q.w = sensed.orientation
        self._imu_out.send(imu)

    def _send_visual(self, at: Followed) -> None:
        state = at.state
        if self._joints_out.wanted:
            self._joints.position = state.deflection.tolist()
            self._joints.velocity = state.deflection_rate.tolist()
            self._joints_out.send(self._joints)
        if not (self._pose_out.wanted or self._tf_out.wanted):
            return
        turn = at.orientation
        pose, transform = self._pose.pose, self._transform.transform
        for place, rotation in (
            (pose.position, pose.orientation),
            (transform.translation, transform.rotation),
        ):
            place.x, place.y, place.z = at.pose.x, at.pose.y, state.z
            rotation.x, rotation.y, rotation.z, rotation.w = turn
        self._pose_out.send(self._pose)
        if not self._tf_out.wanted:
            return
        for (joint, wheel), position in zip(self._wheels, state.deflection.tolist(), strict=True):
            if joint.kind == "prismatic":
                wheel.transform.translation.z = joint.origin[2] + position
            else:  # an arm about y
                wheel.transform.rotation.y, wheel.transform.rotation.w = (
                    math.sin(position / 2),
                    math.cos(position / 2),
                )
        self._tf_out.send(self._tf)

    def _send_gap(self, gap: RunningGap) -> None:
        now, message = gap.now(), self._gap
        if now is None:
            return
        message.window = gap.window
        message.rms, message.measured_rms = now.rms, now.measured_rms
        message.noise_rms, message.normalised = now.noise_rms, now.normalised
        message.band_low_hz, message.band_high_hz = list(gap.edges[:-1]), list(gap.edges[1:])
        message.band_rms = list(now.bands)
        message.samples = now.samples
        self._gap_out.send(message)


class Thinning:
    """Which samples are published at a largest rate in Hz: all of them if they do not come faster, however their
    stamps jitter; otherwise evenly spread ones."""

    def __init__(self, rate: float) -> None:
        self._period = NS / rate
        self.reset()

    def reset(self) -> None:
        """The next sample is the first."""
        self._interval = self._period
        self._last = self._due = 0.0

    def takes(self, ns: int) -> bool:
        """Whether the sample with this stamp in ns is published."""
        interval, self._last = ns - self._last, ns
        if 0.0 < interval < NS:
            self._interval += (interval - self._interval) / _RATE_SAMPLES
        if self._interval >= _TOLERATED * self._period:
            self._due = ns + self._period
            return True
        if ns < self._due:
            return False
        self._due = max(self._due + self._period, ns)
        return True


class TwinDescription:
    """``/tf_static`` and ``robot_description``, published whenever another twin is loaded."""

    def __init__(self, node: TwinNode, base_frame: str) -> None:
        self._node = node
        self._base = base_frame
        self._static_out = node.offer(TFMessage, "/tf_static", LATCHED_QOS)
        self._description_out = node.offer(String, "robot_description", LATCHED_QOS)

    def send(self, twin: Twin) -> None:
        """Publish for a twin, latched: also for subscriptions to come."""
        node = self._node
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

    def send(self, pose: PlanarState, ns: int) -> None:
        """Publish the piece around a pose, if there is a road, a subscriber, and enough way since the last one."""
        if self.road is None or math.hypot(pose.x - self._at[0], pose.y - self._at[1]) < _EVERY:
            return
        if not self._out.wanted:
            return
        self._at = pose.x, pose.y
        # on a grid that stays where it is, or the points would swim
        points = np.round(np.array([pose.x, pose.y]) / _STEP) * _STEP + self._around
        samples = self.road.sample(points[:, 0], points[:, 1])
        cloud = np.column_stack([points, samples.z])[samples.inside].astype("<f4")
        message = self._cloud
        put_stamp(message.header, ns)
        message.width, message.row_step = len(cloud), 12 * len(cloud)
        message.data = array("B", cloud.tobytes())
        self._out.send(message)


class GapMarker:
    """``twin/gap_marker``, once a second: one tile for every metre driven, green where the gap is at its floor,
    over yellow to red at four times that. Without a calibration the floor is the median of the tiles."""

    def __init__(self, node: TwinNode, map_frame: str) -> None:
        self.reset()
        self._marker = Marker(ns="gap", type=Marker.CUBE_LIST, action=Marker.ADD)
        self._marker.header.frame_id = map_frame
        self._marker.pose.orientation.w = 1.0
        self._marker.scale.x = self._marker.scale.y = TILE_EDGE
        self._marker.scale.z = 0.02
        self._out = node.offer(Marker, "twin/gap_marker")

    def reset(self) -> None:
        """The next sample is the first."""
        self._due = 0

    def send(self, follower: Follower, ns: int) -> None:
        """Publish the tiles at stamp ``ns``, if they are due and there is a subscriber."""
        if ns < self._due:
            return
        self._due = ns + NS
        if not (self._out.wanted and follower.tiles.tiles):
            return
        marker, tiles = self._marker, list(follower.tiles.tiles.values())
        put_stamp(marker.header, ns)
        marker.points = [Point(x=t.x, y=t.y, z=t.z) for t in tiles]
        floor = follower.gap.floor or sorted(t.rms for t in tiles)[len(tiles) // 2]
        marker.colors = [colour(t.rms / floor if floor > 0 else 1.0) for t in tiles]
        self._out.send(marker)


def colour(ratio: float) -> ColorRGBA:
    """Green for a gap of at most the floor, yellow half way, red for a ``ratio`` of four or more."""
    share = min(max((ratio - 1.0) / (_RED - 1.0), 0.0), 1.0)
    return ColorRGBA(r=min(2.0 * share, 1.0), g=min(2.0 - 2.0 * share, 1.0) * 0.85, b=0.1, a=0.8)
