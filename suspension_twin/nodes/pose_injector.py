# SPDX-License-Identifier: Apache-2.0
"""The node that locks the twin to the vehicle: GPS and ``imu/data`` to ``twin/odom``.

The estimation of the pose is :class:`~suspension_twin.pose.lock.PoseLock`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Set as AbstractSet
from functools import cache, partial

from geometry_msgs.msg import QuaternionStamped, TwistStamped
from nav_msgs.msg import Odometry
from pydantic import ValidationError
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.mounting import gain_of, turn_of
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.parameters import (
    FILTER,
    LOW_PASS,
    TWIN,
    Param,
    Values,
    filter_of,
    low_pass_text,
    twin_of,
)
from suspension_twin.nodes.process import run_alone
from suspension_twin.nodes.topics import Embedding
from suspension_twin.pose.lock import PlanarState, PoseLock
from suspension_twin.pose.types import PoseSettings
from suspension_twin.vehicle.twin import Datum
from suspension_twin_interfaces.srv import SetDatum

__all__ = ["PoseInjectorNode", "main"]

_COUNTED = {
    "unusable": "unusable fixes or velocities (no fix, not finite, too uncertain), dropped",
    "refused": "outliers among fixes and velocities, dropped",
    "too_late": "fixes that arrived too late, dropped",
    "from_the_future": "fixes stamped ahead of the IMU, dropped (check that the clocks agree)",
    "relocated": "jumps of the pose to the position of the fixes",
}

_DEFAULT = PoseSettings()
_SETTINGS = (
    ("fix_sigma", "Standard deviation in m of a fix whose receiver gives no covariance.", 0.001, 1000.0),
    ("fix_floor", "Smallest standard deviation in m that is accepted for a fix.", 1e-4, 100.0),
    ("fix_ceiling", "Standard deviation in m above which a fix is not used.", 0.01, 1000.0),
    ("velocity_sigma", "Standard deviation in m/s of a GPS velocity.", 1e-3, 10.0),
    ("heading_sigma", "Standard deviation in rad of a heading.", 1e-4, 3.0),
    ("gate", "Standard deviations beyond which a measurement is an outlier.", 1.0, 100.0),
    ("align_speed", "Speed in m/s from which the course gives the first yaw.", 0.1, 20.0),
    ("outage", "Time in s without a fix after which the pose is no longer valid.", 0.1, 600.0),
    ("blend", "Time in s over which a correction is blended into the pose.", 0.01, 10.0),
    ("blend_speed", "Largest speed in m/s at which a correction moves the pose.", 0.01, 50.0),
    ("snap", "Distance in m from which a correction is applied at once.", 0.1, 1000.0),
    ("history", "Time in s by which a fix may be late and still be used.", 0.1, 10.0),
)
#: Hz at which the delay of the low-pass is computed: it hardly depends on the sample rate.
_FAST = 20_000.0


class PoseInjectorNode(TwinNode):
    """``fix``, ``vel``, ``heading`` and ``imu/data`` in; the locked planar pose out."""

    parameters = (
        TWIN,
        *FILTER,
        Param("map_frame", "map", "Frame in which the pose is given.", read_only=True),
        Param("base_frame", "base_link", "Frame whose pose is given.", read_only=True),
        Param(
            "imu_delay",
            -1.0,
            "Delay of imu/data in s; below 0: the delay of the low-pass above.",
            -1.0,
            0.2,
        ),
        Param(
            "datum.source",
            "twin",
            "Origin of the map: the twin file's (the first fix if it has none), the first fix, or the parameters "
            "datum.latitude, datum.longitude and datum.altitude.",
            choices=("twin", "first_fix", "parameters"),
        ),
        Param("datum.latitude", 0.0, "Latitude of the datum in degrees, WGS 84.", -90.0, 90.0),
        Param("datum.longitude", 0.0, "Longitude of the datum in degrees, WGS 84.", -180.0, 180.0),
        Param(
            "datum.altitude",
            0.0,
            "Altitude of the datum in m above the ellipsoid of WGS 84.",
            -1000.0,
            20000.0,
        ),
        *(Param(name, getattr(_DEFAULT, name), text, low, high) for name, text, low, high in _SETTINGS),
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("pose_injector", embedding)
        _compile()
        self._odom = Odometry(child_frame_id=self.frame(self.values["base_frame"]))
        self._odom.header.frame_id = self.values["map_frame"]
        for free in (14, 21, 28):  # z, roll and pitch are not estimated here
            self._odom.pose.covariance[free] = 1.0e6
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
        _settings(values)

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class: any new setting resets the node."""
        if names & {p.name for p in self.parameters}:
            self._start()

    def _start(self) -> None:
        twin = twin_of(self.values)
        self._frame = None if twin is None else twin.gps.frame
        gps, imu, turn = (None, None, None) if twin is None else (twin.gps, twin.imu, turn_of(twin))
        gain = 1.0 if twin is None else gain_of(twin)
        self._lock = PoseLock(_settings(self.values), gps, _datum(self.values), imu, turn, gain)
        self._counted.clear()

    def reset(self) -> None:
        """See the base class. A datum that was set stays."""
        self._lock.reset()
        self._counted.clear()

    def _on_imu(self, message: Imu, ns: int) -> None:
        a, w = message.linear_acceleration, message.angular_velocity
        if not math.isfinite(a.x + a.y + a.z + w.x + w.y + w.z):
            raise InputError("imu/data", "message dropped: a value is not finite")
        state = self._lock.on_imu(ns / 1e9, (a.x, a.y, a.z), (w.x, w.y, w.z))
        if state is None:
            return
        if not math.isfinite(state.x + state.y + state.yaw + state.speed + state.yaw_rate):
            self._lock.reset()
            raise WorkError("the estimated pose is not finite: the estimation is restarted")
        self._odom.header.stamp = message.header.stamp
        _fill(self._odom, state)
        self._out.send(self._odom)

    def _on_fix(self, message: NavSatFix, ns: int) -> None:
        if self._frame is not None and not self.is_frame(message.header.frame_id, self._frame):
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
            raise InputError("heading", "message dropped: the quaternion is not normalised")
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
            f"datum set to {datum.latitude:.7f}°, {datum.longitude:.7f}°, {datum.altitude:.2f} m"
        )
        self.log.info(response.message)
        return response

    def report(self) -> None:
        """See the base class."""
        lock, values = self._lock, self.health.values
        values[LOW_PASS] = low_pass_text(self.values)
        self.show_findings(f for f in lock.findings if f.code not in (*_COUNTED, "no_imu"))
        self.note_counts(lock.counts, _COUNTED)
        values["latency of fixes (s)"] = f"{lock.latency:.3f}"
        values["age of last fix (s)"] = f"{lock.fix_age:.2f}"
        values["yaw known"] = str(lock.aligned)
        values["vehicle standing"] = str(lock.standing)
        datum, shown = lock.datum, "not known"
        if datum is not None:
            shown = f"{datum.latitude:.8f}° {datum.longitude:.8f}° {datum.altitude:.3f} m"
        values["datum"] = shown


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


def _settings(values: Values) -> PoseSettings:
    """Settings of the pose lock; raises InputError for values that do not fit together."""
    given = values["imu_delay"]
    delay = filter_of(values).delay(_FAST) if given < 0 else given
    return PoseSettings(imu_delay=delay, **{name: values[name] for name, *_ in _SETTINGS})


def _datum(values: Values) -> Datum | None:
    """The origin of the map, None for the first fix."""
    if values["datum.source"] == "parameters":
        return Datum(**{k: values[f"datum.{k}"] for k in ("latitude", "longitude", "altitude")})
    twin = twin_of(values)
    return None if twin is None or values["datum.source"] == "first_fix" else twin.datum


@cache
def _compile() -> None:
    """Compile before the first message: a second of driving east, with every kind of GPS message."""
    lock = PoseLock(datum=Datum(latitude=0.0, longitude=0.0))
    for k in range(100):
        t = 1.0 + 0.01 * k
        if k % 10 == 0:
            lock.on_fix(t - 0.025, 0.0, 10.0 * t / 111_319.5, 0.0, 2)
            lock.on_velocity(t - 0.025, 10.0, 0.0)
            lock.on_heading(t - 0.025, 0.0)
        lock.on_imu(t, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


main = partial(run_alone, PoseInjectorNode)

if __name__ == "__main__":
    sys.exit(main())
