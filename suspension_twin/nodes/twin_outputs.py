# SPDX-License-Identifier: Apache-2.0
"""The topics that the suspension model publishes, filled from the state of the model."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from geometry_msgs.msg import AccelStamped, PoseStamped, TransformStamped
from sensor_msgs.msg import Imu, JointState
from tf2_msgs.msg import TFMessage

from suspension_twin.inference.sliding_window import RunningGap
from suspension_twin.models.live import LiveState
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.follower import Follower, PlanarRow
from suspension_twin.nodes.live_gap import GapMarker
from suspension_twin.nodes.static_outputs import RoadCloud, TwinDescription
from suspension_twin.nodes.topics import NS
from suspension_twin.signals.attitude import Quaternion, quaternion, rpy_matrix
from suspension_twin.vehicle.corners import Joint
from suspension_twin.vehicle.urdf import wheel_frame
from suspension_twin_interfaces.msg import Gap

__all__ = ["TwinOutputs"]

#: Samples over which the rate is averaged, and the share of the period from which on samples come "at that rate": a
#: clock runs a little fast, and a lost sample more must not begin a thinning.
_RATE_SAMPLES, _TOLERATED = 50, 0.9


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
        self.marker = GapMarker(node, map_frame)
        self.road = RoadCloud(node, map_frame)
        self._description = TwinDescription(node, base_frame)
        self._wheels: list[tuple[Joint, TransformStamped]] = []

    def configure(self, follower: Follower | None, visual_rate: float, gap_rate: float) -> None:
        """Take joint names and the IMU's mounting from another twin, and new rates in Hz."""
        self._visual = Thinning(visual_rate)
        self._gap_period = int(NS / gap_rate)
        if follower is not None:
            imu = follower.twin.imu
            self._joints.name = list(follower.twin.joint_names)
            self._imu.header.frame_id = self._node.frame(imu.frame)
            self._to_sensor = [[float(v) for v in row] for row in rpy_matrix(imu.rpy).T]
            self._mounting = quaternion(*imu.rpy)
            self._sensor = imu.position[0], imu.position[1]
            self.road.road = None if follower.twin.road is None else follower.road
            self._hang(follower.twin.joints)
            self._description.send(follower)
        self.reset()

    def reset(self) -> None:
        """The next sample is the first."""
        self._gap_due = 0
        self._visual.reset()
        self.marker.reset()
        self.road.reset()

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

    def send_acceleration(self, ns: int, filtered: float) -> None:
        """The filtered vertical acceleration in m/s², published at once."""
        self._stamp.sec, self._stamp.nanosec = divmod(ns, NS)
        self._vertical.accel.linear.z = filtered
        self._vertical_out.send(self._vertical, urgent=True)

    def send_rest(self, row: PlanarRow, state: LiveState, gap: RunningGap) -> None:
        """All other topics of the same sample, at their rates and if there is a subscriber."""
        if self._imu_out.wanted:
            self._send_imu(row, state)
        if self._visual.takes(row.ns):
            self._send_visual(row, state)
            if row.known:
                self.road.send(row)
        if row.ns >= self._gap_due:
            self._gap_due = row.ns + self._gap_period
            if self._gap_out.wanted:
                self._send_gap(gap)
            self.marker.send(row.ns)

    def locate(self, row: PlanarRow, z: float, difference: float) -> None:
        """Add a gap of ``difference`` m/s² at the present position of the sensor to the marker."""
        ahead, left = self._sensor
        c, s = math.cos(row.yaw), math.sin(row.yaw)
        self.marker.tiles.push(row.x + c * ahead - s * left, row.y + s * ahead + c * left, z, difference)

    def _send_imu(self, row: PlanarRow, state: LiveState) -> None:
        imu, turn = self._imu, self._to_sensor
        for vector, (x, y, z) in (
            (imu.linear_acceleration, state.force.tolist()),
            (imu.angular_velocity, state.rate.tolist()),
        ):
            vector.x, vector.y, vector.z = (r[0] * x + r[1] * y + r[2] * z for r in turn)
        q = imu.orientation
        q.x, q.y, q.z, q.w = _product(quaternion(state.roll, state.pitch, row.yaw), self._mounting)
        self._imu_out.send(imu)

    def _send_visual(self, row: PlanarRow, state: LiveState) -> None:
        if self._joints_out.wanted:
            self._joints.position = state.deflection.tolist()
            self._joints.velocity = state.deflection_rate.tolist()
            self._joints_out.send(self._joints)
        if not (self._pose_out.wanted or self._tf_out.wanted):
            return
        turn = quaternion(state.roll, state.pitch, row.yaw)
        pose, transform = self._pose.pose, self._transform.transform
        for place, rotation in (
            (pose.position, pose.orientation),
            (transform.translation, transform.rotation),
        ):
            place.x, place.y, place.z = row.x, row.y, state.z
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


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )
