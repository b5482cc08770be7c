# SPDX-License-Identifier: Apache-2.0
"""Poses and velocities of other programs in place of ``fix``, ``vel`` and ``heading``: an INS, an EKF, a simulator.

Each message is taken to the antenna's place, as the receiver's messages have it. A quantity that comes on several
topics is taken from the first of them in the order of :data:`ORDER`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    TransformStamped,
    TwistWithCovarianceStamped,
    Vector3,
)
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu, NavSatStatus

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.messages import YAW_UNKNOWN, is_rotation, yaw_of
from suspension_twin.nodes.parameters import Param
from suspension_twin.nodes.topics import OK
from suspension_twin.pose.lock import PoseLock
from suspension_twin.pose.types import fix_sigma
from suspension_twin.signals.attitude import rpy_matrix
from suspension_twin.vehicle.twin import Place, Twin

__all__ = ["INPUTS", "ORDER", "PoseInputs"]

#: Topics of each quantity, the one that is preferred first.
ORDER: Final = {
    "position": ("odom", "pose", "transform", "fix"),
    "velocity": ("odom", "fix_velocity", "vel"),
    "heading": ("odom", "pose", "transform", "heading", "imu/data"),
}
#: s of silence after which the next topic of the order is taken: more than a few messages of a receiver of 1 Hz.
_GONE = 5.0
#: s between two headings by an IMU's own orientation: errors of its magnetometer stay for longer.
_APART = 1.0
#: (m/s)²: variance from which a velocity counts as not known.
_UNKNOWN = 100.0

INPUTS = (
    Param(
        "pose_sigma",
        0.01,
        "Standard deviation in m of a position on odom, pose or transform that has no covariance.",
        1e-4,
        100.0,
    ),
    Param(
        "origin",
        [0.0, 0.0, 0.0],
        "Place of the map's origin in the frame of odom, pose and transform: x and y in m, and the yaw of the map's x "
        "axis in rad. For UTM the coordinates of the datum and the convergence of the grid.",
        -1e8,
        1e8,
    ),
)


class PoseInputs:
    """Listens to ``odom``, ``pose``, ``transform`` and ``fix_velocity`` for a ``node``; ``lock`` gives its pose lock.

    ``allows`` decides for every topic, those of the receiver too, whether it is the one that gives a quantity.
    """

    def __init__(self, node: TwinNode, lock: Callable[[], PoseLock]) -> None:
        self._node, self._lock = node, lock
        #: By quantity: the topic that gives it and the stamp in s of its newest message.
        self._used: dict[str, tuple[str, float]] = {}
        self._heading_due = -math.inf
        for kind, topic, handler in (
            (Odometry, "odom", self._on_odometry),
            (PoseStamped, "pose", self._on_pose),
            (TransformStamped, "transform", self._on_transform),
            (TwistWithCovarianceStamped, "fix_velocity", self._on_velocity),
        ):
            node.listen(kind, topic, handler, expected=False)

    def configure(self, twin: Twin | None) -> None:
        """Take the places of the sensors from a twin file."""
        values = self._node.values
        self._gps = np.array((0.0, 0.0, 0.0) if twin is None else twin.gps.position)
        places = {} if twin is None else {p.frame: p for p in (twin.imu, twin.gps)}
        self._places = {**places, values["base_frame"]: Place(frame=values["base_frame"])}
        *origin, turn = values["origin"]
        self._origin = np.array([*origin, 0.0])
        self._unturn = Rotation.from_euler("z", -turn).as_matrix()

    def reset(self) -> None:
        """Forget which topic gives what: time has jumped back."""
        self._used.clear()
        self._heading_due = -math.inf

    def allows(self, quantity: str, topic: str, t: float) -> bool:
        """Whether ``topic`` is the one that gives a ``quantity`` at ``t`` s; said when it changes."""
        order = ORDER[quantity]
        used, newest = self._used.get(quantity, ("", -math.inf))
        if used not in ("", topic) and order.index(used) < order.index(topic) and t - newest < _GONE:
            return False
        self._used[quantity] = topic, t
        if used != topic:
            self._node.note(f"{quantity} from {topic}", OK, f"{quantity} from {topic}")
            self._expect()
        return True

    def _expect(self) -> None:
        """Where something else gives position and velocity, silence of the receiver is as it should be."""
        position, velocity = (self._used.get(name, ("",))[0] for name in ("position", "velocity"))
        inputs = self._node.inputs
        inputs["fix"].state.expected = position in ("", "fix")
        inputs["vel"].state.expected = position in ("", "fix") and velocity in ("", "vel")

    def report(self, values: dict[str, str]) -> None:
        """Which topic gives what, for the diagnostics."""
        for quantity in ORDER:
            values[f"{quantity} from"] = self._used.get(quantity, ("not known yet",))[0]

    def on_orientation(self, message: Imu, t: float) -> None:
        """A sample of ``imu/data`` at ``t`` s, whose covariance says whether it has an orientation."""
        covariance = message.orientation_covariance
        known = covariance[0] >= 0.0 and 0.0 < covariance[8] < YAW_UNKNOWN
        if known and t >= self._heading_due and self.allows("heading", "imu/data", t):
            self._heading_due = t + _APART
            self._lock().on_heading(t, yaw_of(message.orientation), math.sqrt(covariance[8]))

    def _on_odometry(self, message: Odometry, ns: int) -> None:
        self._look_at("odom", message.header.frame_id)
        twist, spread, t = message.twist, message.pose.covariance, ns / 1e9
        place = self._place_of("odom", message.child_frame_id)
        known = is_rotation(message.pose.pose.orientation) and 0.0 <= spread[35] < YAW_UNKNOWN
        east, north = (math.sqrt(max(spread[k], 0.0)) for k in (0, 7))
        sigma = self._node.values["pose_sigma"]
        if east > 0.0 or north > 0.0:
            sigma = fix_sigma(self._lock().settings, NavSatStatus.STATUS_FIX, east, north)
        self._take("odom", t, place, message.pose.pose, sigma, spread[35] if known else math.inf)
        if known and twist.covariance[0] < _UNKNOWN and self.allows("velocity", "odom", t):
            turn, body = self._turned(message.pose.pose.orientation, place)
            lever = body @ (self._gps - place.position)
            velocity = turn @ _vector(twist.twist.linear) + np.cross(
                turn @ _vector(twist.twist.angular), lever
            )
            self._lock().on_velocity(t, float(velocity[0]), float(velocity[1]))

    def _on_pose(self, message: PoseStamped, ns: int) -> None:
        self._look_at("pose", message.header.frame_id)
        place = self._places[self._node.values["base_frame"]]
        self._take("pose", ns / 1e9, place, message.pose, self._node.values["pose_sigma"])

    def _on_transform(self, message: TransformStamped, ns: int) -> None:
        self._look_at("transform", message.header.frame_id)
        place = self._place_of("transform", message.child_frame_id)
        at = message.transform.translation
        pose = Pose(position=Point(x=at.x, y=at.y, z=at.z), orientation=message.transform.rotation)
        self._take("transform", ns / 1e9, place, pose, self._node.values["pose_sigma"])

    def _on_velocity(self, message: TwistWithCovarianceStamped, ns: int) -> None:
        variance, v, t = message.twist.covariance[0], message.twist.twist.linear, ns / 1e9
        if 0.0 <= variance < _UNKNOWN and self.allows("velocity", "fix_velocity", t):
            self._lock().on_velocity(t, v.x, v.y)

    def _take(
        self, topic: str, t: float, place: Place, pose: Pose, sigma: float, yaw_variance: float = 0.0
    ) -> None:
        """A position, ``sigma`` m, and a heading where its variance is that of one (0: not given)."""
        known = is_rotation(pose.orientation) and yaw_variance < YAW_UNKNOWN
        where = self._unturn @ (_vector(pose.position) - self._origin)
        if known:
            _, body = self._turned(pose.orientation, place)
            where = where + body @ (self._gps - place.position)
            if self.allows("heading", topic, t):
                self._lock().on_heading(t, _yaw(body), math.sqrt(yaw_variance))
        elif np.any(self._gps[:2] != place.position[:2]):
            raise InputError(
                topic, "message dropped: without an orientation the antenna's place is not known"
            )
        if self.allows("position", topic, t):
            self._lock().on_position(t, float(where[0]), float(where[1]), sigma)

    def _turned(self, q: Quaternion, place: Place) -> tuple[Floats, Floats]:
        """Rotations to ``map`` of the frame at ``place`` and of the body, by an orientation of that frame."""
        turn = self._unturn @ Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix()
        return turn, turn @ rpy_matrix(place.rpy).T

    def _place_of(self, topic: str, frame: str) -> Place:
        """Of a frame of the twin file; any other is taken for that of the body."""
        for name, place in self._places.items():
            if self._node.is_frame(frame, name):
                return place
        base = self._node.values["base_frame"]
        self._node.note_frame(f"{topic} (child)", frame, base)
        return self._places[base]

    def _look_at(self, topic: str, frame: str) -> None:
        wanted = self._node.values["map_frame"]
        if frame != wanted and not any(self._node.values["origin"]):
            self._node.note_frame(topic, frame, wanted)


def _vector(v: Point | Vector3) -> Floats:
    return np.array([v.x, v.y, v.z])


def _yaw(turn: Floats) -> float:
    return math.atan2(float(turn[1, 0]), float(turn[0, 0]))
