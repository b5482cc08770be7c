# SPDX-License-Identifier: Apache-2.0
"""What the twin publishes: messages filled from its state."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from builtin_interfaces.msg import Time
from geometry_msgs.msg import AccelStamped, PoseStamped, TransformStamped
from sensor_msgs.msg import Imu, JointState
from tf2_msgs.msg import TFMessage

from suspension_twin.gap.sliding_window import RunningGap
from suspension_twin.models.live import LiveState
from suspension_twin.nodes._follow import Follower
from suspension_twin.nodes._gap_marker import GapMarker
from suspension_twin.nodes._pairing import PlanarRow
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.vehicle.corners import CORNERS
from suspension_twin_interfaces.msg import Gap

if TYPE_CHECKING:
    from suspension_twin.nodes._base import TwinNode

__all__ = ["TwinOut"]

_NS = 1_000_000_000
Quaternion = tuple[float, float, float, float]


class TwinOut:
    """The outputs of the suspension model. One set of messages, filled anew for every sample; all
    share one stamp."""

    def __init__(self, node: TwinNode, map_frame: str, base_frame: str) -> None:
        self.map_frame = map_frame
        self._stamp = Time()
        self._vertical, self._imu = AccelStamped(), Imu()
        self._pose, self._joints, self._gap = PoseStamped(), JointState(), Gap()
        self._transform = TransformStamped(child_frame_id=base_frame)
        self._tf = TFMessage(transforms=[self._transform])
        self._joints.name = [f"{corner}_suspension" for corner in CORNERS]
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
        self.configure(None, 100.0, 5.0)

    def configure(self, follower: Follower | None, visual_rate: float, gap_rate: float) -> None:
        """Take the imu's place of another twin, and other rates in Hz."""
        # A tenth of a period of slack: samples at just the rate shall not be halved by their jitter.
        self._visual_pause = int(0.9 * _NS / visual_rate)
        self._gap_pause = int(_NS / gap_rate)
        if follower is not None:
            place = follower.twin.imu
            self._joints.name = list(follower.twin.joint_names)
            self._imu.header.frame_id = place.frame
            self._to_sensor = [[float(v) for v in row] for row in rpy_matrix(place.rpy).T]
            self._mounting = _quaternion(*place.rpy)
            self._sensor = place.position[0], place.position[1]
        self.reset()

    def reset(self) -> None:
        """The next sample is the first."""
        self._visual_due = self._gap_due = 0
        self.marker.reset()

    def send_acceleration(self, ns: int, filtered: float) -> None:
        """What is waited for most: published at once."""
        self._stamp.sec, self._stamp.nanosec = divmod(ns, _NS)
        self._vertical.accel.linear.z = filtered
        self._vertical_out.send(self._vertical, urgent=True)

    def send_rest(self, row: PlanarRow, state: LiveState, gap: RunningGap) -> None:
        """Everything else about the same sample, as often as it is due and if anybody listens."""
        if self._imu_out.wanted:
            self._send_imu(row, state)
        if row.ns >= self._visual_due:
            self._visual_due = row.ns + self._visual_pause
            self._send_visual(row, state)
        if row.ns >= self._gap_due:
            self._gap_due = row.ns + self._gap_pause
            if self._gap_out.wanted:
                self._send_gap(gap)
            self.marker.send(row.ns)

    def locate(self, row: PlanarRow, z: float, difference: float) -> None:
        """A gap of ``difference`` m/s² was felt where the sensor is now."""
        ahead, left = self._sensor
        c, s = math.cos(row.yaw), math.sin(row.yaw)
        self.marker.tiles.push(row.x + c * ahead - s * left, row.y + s * ahead + c * left, z, difference)

    def _send_imu(self, row: PlanarRow, state: LiveState) -> None:
        imu, turn = self._imu, self._to_sensor
        a, w = imu.linear_acceleration, imu.angular_velocity
        for vector, (x, y, z) in ((a, state.force.tolist()), (w, state.rate.tolist())):
            vector.x, vector.y, vector.z = (r[0] * x + r[1] * y + r[2] * z for r in turn)
        body = _quaternion(state.roll, state.pitch, row.yaw)
        q = imu.orientation
        q.x, q.y, q.z, q.w = _product(body, self._mounting)
        self._imu_out.send(imu)

    def _send_visual(self, row: PlanarRow, state: LiveState) -> None:
        if self._joints_out.wanted:
            self._joints.position = state.deflection.tolist()
            self._joints.velocity = state.deflection_rate.tolist()
            self._joints_out.send(self._joints)
        if not (self._pose_out.wanted or self._tf_out.wanted):
            return
        turn = _quaternion(state.roll, state.pitch, row.yaw)
        pose, transform = self._pose.pose, self._transform.transform
        for place, rotation in (
            (pose.position, pose.orientation),
            (transform.translation, transform.rotation),
        ):
            place.x, place.y, place.z = row.x, row.y, state.z
            rotation.x, rotation.y, rotation.z, rotation.w = turn
        self._pose_out.send(self._pose)
        self._tf_out.send(self._tf)

    def _send_gap(self, gap: RunningGap) -> None:
        now = gap.now()
        if now is None:
            return
        message = self._gap
        message.window = gap.window
        message.rms, message.measured_rms = now.rms, now.measured_rms
        message.noise_rms, message.normalised = now.noise_rms, now.normalised
        message.band_low_hz, message.band_high_hz = list(gap.edges[:-1]), list(gap.edges[1:])
        message.band_rms = list(now.bands)
        message.samples = now.samples
        self._gap_out.send(message)


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """x, y, z, w of fixed-axis roll, pitch, yaw in rad."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )
