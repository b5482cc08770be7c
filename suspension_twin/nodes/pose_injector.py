# SPDX-License-Identifier: Apache-2.0
"""The node that locks the twin to the vehicle: GPS and ``imu/data`` to ``twin/odom``.

It is the second stage of :class:`~suspension_twin.live.twin.DigitalTwin`.
"""

from __future__ import annotations

import math

from geometry_msgs.msg import QuaternionStamped, TwistStamped
from nav_msgs.msg import Odometry
from pydantic import ValidationError
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.errors import InputError
from suspension_twin.live.felt import FeltSettings, felt_stage
from suspension_twin.live.twin import Update, compile_stages, delay_of, lock_stage
from suspension_twin.nodes.lifecycle import ManagedNode
from suspension_twin.nodes.messages import fill_odometry, is_rotation, put_stamp, sigmas_of, yaw_of
from suspension_twin.nodes.parameters import (
    FILTER,
    FOLDERS,
    LOW_PASS,
    TWIN,
    Param,
    Values,
    filter_of,
    low_pass_text,
    named_twin,
    twin_of,
)
from suspension_twin.nodes.pose_inputs import INPUTS, PoseInputs
from suspension_twin.nodes.topics import OK, STALE, WARN, Embedding
from suspension_twin.pose.lock import LATE
from suspension_twin.pose.types import PoseSettings
from suspension_twin.vehicle.twin import Datum
from suspension_twin_interfaces.srv import SetDatum

__all__ = ["PoseInjectorNode"]

_COUNTED = {
    "unusable": "unusable fixes or velocities (no fix, not finite, too uncertain), dropped",
    "refused": "outliers among fixes and velocities, dropped",
    "too_late": "fixes that arrived too late, dropped",
    "from_the_future": "fixes stamped ahead of the IMU, dropped (check that the clocks agree)",
    "not_finite": "the estimated pose is not finite: the estimation is restarted",
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


class PoseInjectorNode(ManagedNode):
    """``fix``, ``vel``, ``heading`` (or poses of another program) and ``imu/data`` in; the locked planar pose out."""

    parameters = (
        TWIN,
        FOLDERS,
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
        Param(
            "felt_position",
            "auto",
            "Where fixes are worse than 0.3 m and the twin file has a road: move the pose along the road to where the "
            "IMU feels it to be (auto), or not (off).",
            choices=("auto", "off"),
        ),
        Param(
            "felt_rate",
            FeltSettings().rate,
            "Largest speed in m/s at which a felt place moves the pose.",
            0.01,
            50.0,
        ),
        *INPUTS,
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("pose_injector", embedding)
        compile_stages()
        self._odom = Odometry(child_frame_id=self.frame(self.values["base_frame"]))
        self._odom.header.frame_id = self.values["map_frame"]
        for free in (14, 21, 28):  # z, roll and pitch are not estimated here
            self._odom.pose.covariance[free] = 1.0e6
        self._out = self.offer(Odometry, "twin/odom")
        self.listen(Imu, "imu/data", self._on_imu)
        self.listen(NavSatFix, "fix", self._on_fix)
        self.listen(TwistStamped, "vel", self._on_velocity)
        self.listen(QuaternionStamped, "heading", self._on_heading, expected=False)
        self.others = PoseInputs(self, lambda: self._lock)
        self._frame: str | None = None
        self._lock = lock_stage(None, PoseSettings(), None)
        self.others.configure(None)
        if self.active:
            self.start()
        self.create_service(SetDatum, "~/set_datum", self._set_datum)

    def check(self, values: Values) -> None:
        """See the base class."""
        twin_of(values)
        _settings(values)
        if len(values["origin"]) != 3:
            raise InputError("origin", f"must be x and y in m and a yaw in rad, is {values['origin']}")

    def start(self) -> None:
        """See the base class."""
        twin = twin_of(self.values)
        self._frame = None if twin is None else twin.gps.frame
        self.others.configure(twin)
        self._lock = self.twin.lock = lock_stage(twin, _settings(self.values), _datum(self.values))
        named, settings = (
            named_twin(self.values),
            FeltSettings(self.values["felt_rate"], filter_of(self.values)),
        )
        felt = felt_stage(twin, settings, None if named is None else named.road)
        self.twin.felt = felt if self.values["felt_position"] == "auto" else None
        self._counted.clear()

    def stop(self) -> None:
        """See the base class."""
        self.twin.lock = self.twin.felt = None

    def reset(self) -> None:
        """See the base class. A datum that was set stays."""
        self._lock.reset()
        if self.twin.felt is not None:
            self.twin.felt.reset()
        self.others.reset()
        self._counted.clear()

    def _on_imu(self, message: Imu, ns: int) -> None:
        a, w = message.linear_acceleration, message.angular_velocity
        if not math.isfinite(a.x + a.y + a.z + w.x + w.y + w.z):
            raise InputError("imu/data", "message dropped: a value is not finite")
        self.others.on_orientation(message, ns / 1e9)
        pose = self.twin.locate(ns / 1e9, (a.x, a.y, a.z), (w.x, w.y, w.z))
        self.publish(Update(None, pose), ns)
        self.outbox.later(self.twin.rest)

    def take(self, update: Update, ns: int) -> None:
        """Publish what the twin makes of a sample that has gone through all stages in this process."""
        if self.active:
            self.inputs["imu/data"].arrived(ns)
            self.publish(update, ns)

    def publish(self, update: Update, ns: int) -> None:
        """Publish the locked pose."""
        if update.pose is not None and self._out.wanted:
            put_stamp(self._odom.header, ns)
            fill_odometry(update.pose, self._odom)
            self._out.send(self._odom)

    def _on_fix(self, message: NavSatFix, ns: int) -> None:
        if self._frame is not None and not self.is_frame(message.header.frame_id, self._frame):
            self.note_frame("fix", message.header.frame_id, self._frame)
        # Not set (-2 in Jazzy) is not the same as no fix (-1): the position is there.
        status = 0 if message.status.status < -1 else message.status.status
        place = message.latitude, message.longitude, message.altitude
        held = self.twin.is_held(ns / 1e9, *place[:2], status)
        if not held and self.others.allows("position", "fix", ns / 1e9):
            self._lock.on_fix(ns / 1e9, *place, status, *sigmas_of(message))

    def _on_velocity(self, message: TwistStamped, ns: int) -> None:
        if self.others.allows("velocity", "vel", ns / 1e9):
            self.twin.take_velocity(ns / 1e9, message.twist.linear.x, message.twist.linear.y)

    def _on_heading(self, message: QuaternionStamped, ns: int) -> None:
        if not is_rotation(message.quaternion):
            raise InputError("heading", "message dropped: the quaternion is not normalised")
        if self.others.allows("heading", "heading", ns / 1e9):
            self._lock.on_heading(ns / 1e9, yaw_of(message.quaternion))

    def _set_datum(self, request: SetDatum.Request, response: SetDatum.Response) -> SetDatum.Response:
        if not self.active:
            response.success, response.message = False, "the node is not active"
            return response
        try:
            datum = Datum(latitude=request.latitude, longitude=request.longitude, altitude=request.altitude)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key, text = first["loc"][0], str(first["msg"]).removeprefix("Value error, ")
            response.success, response.message = False, f"{key}: {text}"
            return response
        self._lock.set_datum(datum)
        self.reset()
        response.success = True
        response.message = (
            f"datum set to {datum.latitude:.7f}°, {datum.longitude:.7f}°, {datum.altitude:.2f} m"
        )
        self.log.info(response.message)
        return response

    def report(self) -> None:
        """See the base class."""
        super().report()
        lock, values = self._lock, self.health.values
        values[LOW_PASS] = low_pass_text(self.values)
        self.show_findings(f for f in lock.findings if f.code not in (*_COUNTED, "no_imu"))
        self.note_counts(lock.counts, _COUNTED)
        values["latency of fixes (s)"] = f"{lock.latency:.3f}"
        values["age of last fix (s)"] = f"{lock.fix_age:.2f}"
        self.others.report(values)
        values["yaw known"] = str(lock.aligned)
        values["vehicle standing"] = str(lock.standing)
        datum, shown = lock.datum, "not known"
        if datum is not None:
            shown = f"{datum.latitude:.8f}° {datum.longitude:.8f}° {datum.altitude:.3f} m"
        values["datum"] = shown
        level = STALE if math.isnan(lock.latency) else OK if lock.latency <= LATE else WARN
        text = (
            "no position yet" if level == STALE else f"positions come {lock.latency:.3f} s after their stamps"
        )
        frame = self.inputs["fix"].state.frame
        self.health.thing("latency", level, text, frame, latency_s=lock.latency, age_s=lock.fix_age)
        self.health.thing("datum", OK if datum is not None else STALE, shown)
        if self.twin.felt is not None:
            values["felt place"] = self.twin.felt.condition()
            self.health.thing("felt place", OK, values["felt place"])


def _settings(values: Values) -> PoseSettings:
    """Settings of the pose lock; raises InputError for values that do not fit together."""
    given = values["imu_delay"]
    delay = delay_of(filter_of(values)) if given < 0 else given
    return PoseSettings(imu_delay=delay, **{name: values[name] for name, *_ in _SETTINGS})


def _datum(values: Values) -> Datum | None:
    """The origin of the map, None for the first fix."""
    if values["datum.source"] == "parameters":
        return Datum(**{k: values[f"datum.{k}"] for k in ("latitude", "longitude", "altitude")})
    twin = twin_of(values)
    return None if twin is None or values["datum.source"] == "first_fix" else twin.datum
