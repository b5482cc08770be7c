# SPDX-License-Identifier: Apache-2.0
"""The node that locks the twin to the vehicle: GPS and ``imu/data`` to ``twin/odom``.

All that it knows about poses is :class:`~suspension_twin.pose.lock.PoseLock`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Set as AbstractSet
from typing import Any

from geometry_msgs.msg import QuaternionStamped, TwistStamped
from nav_msgs.msg import Odometry
from pydantic import ValidationError
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.mounting import gain_of, turn_of
from suspension_twin.nodes._base import Embedding, TwinNode
from suspension_twin.nodes._files import FILTER, TWIN, twin_of
from suspension_twin.nodes._health import WARN
from suspension_twin.nodes._main import run_alone
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.nodes._pose_parameters import POSE, datum_of, settings_of
from suspension_twin.nodes._warm_up import warm_up_pose
from suspension_twin.pose.lock import PlanarState, PoseLock
from suspension_twin.vehicle.twin import Datum
from suspension_twin_interfaces.srv import SetDatum

__all__ = ["PoseInjectorNode", "main"]

_COUNTED = {
    "unusable": "unusable fixes and velocities (no fix, not finite, too uncertain), dropped",
    "refused": "outliers among fixes and velocities, refused",
    "too_late": "fixes that came too late to be used",
    "from_the_future": "fixes stamped ahead of the IMU, dropped (do the clocks agree?)",
    "relocated": "times that the pose was moved to where the fixes are",
}


class PoseInjectorNode(TwinNode):
    """``fix``, ``vel``, ``heading`` and ``imu/data`` in; the locked planar pose out."""

    parameters = (
        TWIN,
        *FILTER,
        Param("map_frame", "map", "Frame of the pose.", read_only=True),
        Param("base_frame", "base_link", "Frame whose pose it is.", read_only=True),
        *POSE,
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("pose_injector", embedding)
        warm_up_pose()
        self._odom = Odometry(child_frame_id=self.values["base_frame"])
        self._odom.header.frame_id = self.values["map_frame"]
        for free in (14, 21, 28):  # z, roll and pitch are not known here
            self._odom.pose.covariance[free] = 1.0e6
        self._seen: dict[str, int] = {}
        self._out = self.offer(Odometry, "twin/odom")
        self._start()
        self.listen(Imu, "imu/data", self._on_imu)
        self.listen(NavSatFix, "fix", self._on_fix)
        self.listen(TwistStamped, "vel", self._on_velocity)
        self.listen(QuaternionStamped, "heading", self._on_heading, expected=False)
        self.create_service(SetDatum, "~/set_datum", self._set_datum)

    def check(self, values: Values) -> None:
        """See the base class."""
        twin_of(values)
        settings_of(values)

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class: the settings shape everything, so it starts afresh with them."""
        if names & {p.name for p in self.parameters}:
            self._start()

    def _start(self) -> None:
        twin = twin_of(self.values)
        self._frame = None if twin is None else twin.gps.frame
        gps, imu, turn = (None, None, None) if twin is None else (twin.gps, twin.imu, turn_of(twin))
        gain = 1.0 if twin is None else gain_of(twin)
        self._lock = PoseLock(settings_of(self.values), gps, datum_of(self.values), imu, turn, gain)
        self._seen.clear()

    def reset(self) -> None:
        """See the base class. A datum that was set stays."""
        self._lock.reset()
        self._seen.clear()

    def _on_imu(self, message: Imu, ns: int) -> None:
        a, w = message.linear_acceleration, message.angular_velocity
        if not math.isfinite(a.x + a.y + a.z + w.x + w.y + w.z):
            raise InputError("imu/data", "holds a number that is not finite: dropped")
        state = self._lock.on_imu(ns / 1e9, (a.x, a.y, a.z), (w.x, w.y, w.z))
        if state is None:
            return
        if not math.isfinite(state.x + state.y + state.yaw + state.speed + state.yaw_rate):
            self._lock.reset()
            raise WorkError("the pose was lost to numbers that are not finite: starting afresh")
        self._odom.header.stamp = message.header.stamp
        _fill(self._odom, state)
        self._out.send(self._odom)

    def _on_fix(self, message: NavSatFix, ns: int) -> None:
        if message.header.frame_id != self._frame and self._frame is not None:
            self.note_frame("fix", message.header.frame_id, self._frame)
        # Not set (-2 in Jazzy) is not the same as no fix (-1): the position is there.
        status = 0 if message.status.status < -1 else message.status.status
        sigma = (math.nan, math.nan)
        variance = message.position_covariance
        if (
            message.position_covariance_type != NavSatFix.COVARIANCE_TYPE_UNKNOWN
            and min(variance[0], variance[4]) >= 0
        ):
            sigma = math.sqrt(variance[0]), math.sqrt(variance[4])
        self._lock.on_fix(ns / 1e9, message.latitude, message.longitude, message.altitude, status, *sigma)

    def _on_velocity(self, message: TwistStamped, ns: int) -> None:
        self._lock.on_velocity(ns / 1e9, message.twist.linear.x, message.twist.linear.y)

    def _on_heading(self, message: QuaternionStamped, ns: int) -> None:
        q = message.quaternion
        norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
        if not abs(norm - 1.0) < 0.02:
            raise InputError("heading", "quaternion is not of length 1: dropped")
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
        self._lock.on_heading(ns / 1e9, yaw)

    def _set_datum(self, request: SetDatum.Request, response: SetDatum.Response) -> SetDatum.Response:
        try:
            datum = Datum(latitude=request.latitude, longitude=request.longitude, altitude=request.altitude)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key, text = first["loc"][0], str(first["msg"]).removeprefix("Value error, ")
            response.success, response.message = False, f"{key}: {text}"
            return response
        self._lock.set_datum(datum)
        response.success = True
        response.message = (
            f"map begins at {datum.latitude:.7f}, {datum.longitude:.7f}, {datum.altitude:.2f} m"
        )
        self.log.info(response.message)
        return response

    def report(self) -> None:
        """See the base class."""
        lock, values = self._lock, self.health.values
        self.show_findings(f for f in lock.findings if f.code not in (*_COUNTED, "no_imu"))
        for code, text in _COUNTED.items():
            new = lock.counts[code] - self._seen.get(code, 0)
            if new > 0:
                self.note(code, WARN, f"{text}: {new}")
            self._seen[code] = lock.counts[code]
        values["latency of fixes (s)"] = f"{lock.latency:.3f}"
        values["age of the fix (s)"] = f"{lock.fix_age:.2f}"
        values["yaw known"] = str(lock.aligned)
        values["standing"] = str(lock.standing)
        datum = lock.datum
        values["datum"] = (
            f"{datum.latitude:.8f} {datum.longitude:.8f} {datum.altitude:.3f}" if datum else "not known"
        )


def _fill(odom: Odometry, state: PlanarState) -> None:
    pose, twist, covariance = odom.pose.pose, odom.twist.twist, odom.pose.covariance
    pose.position.x, pose.position.y = state.x, state.y
    pose.orientation.z, pose.orientation.w = math.sin(state.yaw / 2), math.cos(state.yaw / 2)
    twist.linear.x, twist.linear.y, twist.angular.z = state.speed, state.lateral_speed, state.yaw_rate
    xx, xy, xyaw, yy, yyaw, yawyaw = state.covariance
    covariance[0], covariance[7], covariance[35] = xx, yy, yawyaw
    covariance[1] = covariance[6] = xy
    covariance[5] = covariance[30] = xyaw
    covariance[11] = covariance[31] = yyaw


def main(args: list[str] | None = None) -> Any:
    """Run the node in a process of its own."""
    return run_alone(PoseInjectorNode, args)


if __name__ == "__main__":
    sys.exit(main())
