# SPDX-License-Identifier: Apache-2.0
"""The node of the IMU: ``imu/data_raw`` to ``imu/data`` and ``imu/vertical_acceleration``.

It is the first stage of :class:`~suspension_twin.live.twin.DigitalTwin`. Where all stages are in one process, a sample
goes through them here.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from geometry_msgs.msg import AccelStamped
from sensor_msgs.msg import Imu

from suspension_twin.errors import InputError
from suspension_twin.inference.sensor_correction import SensorCorrection
from suspension_twin.live.twin import Update, compile_stages, ingest_stage
from suspension_twin.nodes.lifecycle import ManagedNode
from suspension_twin.nodes.messages import is_rotation, put_stamp
from suspension_twin.nodes.parameters import (
    FILTER,
    FOLDERS,
    LOW_PASS,
    TWIN,
    Param,
    Values,
    filter_of,
    low_pass_text,
    twin_of,
)
from suspension_twin.nodes.topics import OK, STALE, WARN, Embedding
from suspension_twin.signals.attitude import quaternion, quaternion_product
from suspension_twin.signals.imu import ImuSettings, StillLimits

__all__ = ["ImuIngestNode"]

#: Hz, the nominal rates of an IMU.
_LEAST, _MOST = 50.0, 1600.0
#: Mean deviation of the stamps, as a share of their interval, from which single samples change places.
_JITTER = 0.5
_DEFAULT = ImuSettings()
_STILL = StillLimits()
#: Counters of the ingest that are reported while they grow.
_COUNTED = {
    "invalid": "IMU messages with a value that is not finite, dropped",
    "saturated": "IMU samples at the end of the sensor's range (set a larger range)",
    "late": "late IMU samples, dropped",
    "duplicate": "IMU samples with a repeated stamp, dropped",
    "missing": "missing IMU samples, interpolated",
    "gaps": "gaps in the IMU samples, the filter restarted",
}


class ImuIngestNode(ManagedNode):
    """``imu/data_raw`` in; bias-free, filtered signals in ``base_link`` axes out."""

    parameters = (
        TWIN,
        FOLDERS,
        *FILTER,
        Param("base_frame", "base_link", "Frame of the published messages.", read_only=True),
        Param(
            "convert_units",
            _DEFAULT.convert_units,
            "Convert the data of a sensor that sends g instead of m/s² (factor 9.80665), or °/s instead of rad/s.",
        ),
        Param(
            "restore_gravity",
            _DEFAULT.restore_gravity,
            "Add gravity to the data of a phone that has removed it.",
        ),
        Param(
            "level",
            _DEFAULT.level,
            "Rotate the sensor's axes upright by gravity: never (the twin file's mounting is right), gross (only if "
            "more than 45 degrees off), always (any tilt seen at standstill).",
            choices=("never", "gross", "always"),
        ),
        Param(
            "max_bias",
            _DEFAULT.max_bias,
            "Horizontal reading at rest in m/s² up to which it is treated as a bias; above, as a tilt.",
            0.001,
            5.0,
        ),
        Param("full_scale", 0.0, "Range of the accelerometer in m/s²; 0: not known.", 0.0, 2000.0),
        Param("full_scale_rate", 0.0, "Range of the gyroscope in rad/s; 0: not known.", 0.0, 200.0),
        Param(
            "attitude_time",
            _DEFAULT.attitude_time,
            "Time constant in s with which the accelerometer corrects the gyroscope's attitude.",
            0.1,
            1000.0,
        ),
        Param("still.window", _STILL.window, "Window in s over which standstill is detected.", 0.1, 10.0),
        Param(
            "still.force",
            _STILL.force,
            "Standstill: largest standard deviation of the specific force in m/s².",
            0.001,
            5.0,
        ),
        Param(
            "still.rate",
            _STILL.rate,
            "Standstill: largest standard deviation of the angular rate in rad/s.",
            1e-5,
            1.0,
        ),
        Param(
            "still.turn",
            _STILL.turn,
            "Standstill: largest mean angular rate in rad/s, the gyroscope's bias.",
            1e-5,
            1.0,
        ),
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("imu_ingest", embedding)
        compile_stages()
        self._data, self._vertical = Imu(), AccelStamped()
        self._data.orientation_covariance[0] = -1.0
        for message in (self._data, self._vertical):
            message.header.frame_id = self.frame(self.values["base_frame"])
        self._data_out = self.offer(Imu, "imu/data")
        self._vertical_out = self.offer(AccelStamped, "imu/vertical_acceleration")
        #: Called with what every sample gives and its stamp in ns, the most urgent first.
        self.outlets: list[Callable[[Update, int], None]] = [self.publish]
        #: Called with every sample that has an orientation, and the stamp in s.
        self.oriented: list[Callable[[Imu, float], None]] = []
        self._frame: str | None = None
        self._silent: tuple[str, ...] = ()
        self._unmount = 0.0, 0.0, 0.0, 1.0
        self._ingest = ingest_stage(None, ImuSettings())
        if self.active:
            self.start()
        self.listen(Imu, "imu/data_raw", self._on_imu)

    def check(self, values: Values) -> None:
        """See the base class."""
        _settings(values)

    def start(self) -> None:
        """See the base class."""
        twin = twin_of(self.values)
        self._frame = None if twin is None else twin.imu.frame
        x, y, z, w = (0.0, 0.0, 0.0, 1.0) if twin is None else quaternion(*twin.imu.rpy)
        self._unmount = -x, -y, -z, w
        # a tilt that the twin simulates is expected in the measured signals
        turned = twin is not None and SensorCorrection.of_twin(twin).turn is not None
        self._silent = (*_COUNTED, *(("tilted",) if turned else ()))
        self._ingest = self.twin.ingest = ingest_stage(twin, _settings(self.values))
        self._counted.clear()

    def stop(self) -> None:
        """See the base class."""
        self.twin.ingest = None

    def reset(self) -> None:
        """See the base class."""
        self._ingest.reset()
        self._counted.clear()

    def _on_imu(self, message: Imu, ns: int) -> None:
        if self._frame is not None and not self.is_frame(message.header.frame_id, self._frame):
            self.note_frame("imu/data_raw", message.header.frame_id, self._frame)
        if message.linear_acceleration_covariance[0] == -1.0:
            raise InputError(
                "imu/data_raw",
                "message dropped: no linear_acceleration (linear_acceleration_covariance[0] is -1)",
            )
        self._orient(message, ns)
        a, w = message.linear_acceleration, message.angular_velocity
        update = self.twin.push_imu(ns / 1e9, (a.x, a.y, a.z), (w.x, w.y, w.z))
        if update is not None:
            for take in self.outlets:
                take(update, ns)
            self.outbox.later(self.twin.rest)

    def _orient(self, message: Imu, ns: int) -> None:
        """Give ``imu/data`` the sensor's orientation, as that of ``base_link``, where its covariance says that it has
        one: REP-145 has zeros for an unknown covariance, -1 for no orientation."""
        out, covariance = self._data, message.orientation_covariance
        if not (covariance[0] >= 0.0 and covariance[8] > 0.0 and is_rotation(message.orientation)):
            out.orientation_covariance[0] = -1.0
            return
        q, turned = message.orientation, out.orientation
        turned.x, turned.y, turned.z, turned.w = quaternion_product((q.x, q.y, q.z, q.w), self._unmount)
        out.orientation_covariance[:] = covariance
        for take in self.oriented:
            take(out, ns / 1e9)

    def publish(self, update: Update, ns: int) -> None:
        """Publish the filtered sample."""
        sample = update.sample
        if sample is None:
            return
        if self._data_out.wanted:
            put_stamp(self._data.header, ns)
            force, rate = self._data.linear_acceleration, self._data.angular_velocity
            force.x, force.y, force.z = sample.force
            rate.x, rate.y, rate.z = sample.rate
            self._data_out.send(self._data)
        if self._vertical_out.wanted:
            put_stamp(self._vertical.header, ns)
            linear, angular = self._vertical.accel.linear, self._vertical.accel.angular
            linear.x, linear.y, linear.z = sample.acceleration
            angular.x, angular.y, angular.z = sample.angular_acceleration
            self._vertical_out.send(self._vertical)

    def report(self) -> None:
        """See the base class."""
        super().report()
        ingest, values = self._ingest, self.health.values
        values[LOW_PASS] = low_pass_text(self.values)
        self.show_findings(f for f in ingest.findings if f.code not in self._silent)
        self.note_counts(ingest.counts, _COUNTED)
        raw, rate = self.inputs["imu/data_raw"].state, ingest.rate or math.nan
        usual, steady = _LEAST <= rate <= _MOST, raw.jitter <= _JITTER * raw.interval
        level = STALE if math.isnan(rate) else OK if usual else WARN
        text = (
            "not known yet"
            if math.isnan(rate)
            else f"{rate:.1f} Hz" + ("" if usual else ", 50 to 1600 are usual")
        )
        self.health.thing("rate", level, text, raw.frame, rate_Hz=rate)
        text = f"stamps lie {1e3 * raw.jitter:.2g} ms from even ones"
        self.health.thing("stamp jitter", OK if steady else WARN, text, raw.frame, jitter_ms=1e3 * raw.jitter)
        values["sample rate (Hz)"] = f"{ingest.rate:.2f}" if ingest.rate else "not known yet"
        values["vehicle standing"] = str(ingest.standing)
        values["IMU samples"] = str(ingest.counts["samples"])


def _settings(values: Values) -> ImuSettings:
    twin = twin_of(values)
    datum = None if twin is None else twin.datum
    return ImuSettings(
        filter=filter_of(values),
        convert_units=values["convert_units"],
        restore_gravity=values["restore_gravity"],
        level=values["level"],
        max_bias=values["max_bias"],
        latitude=None if datum is None else datum.latitude,
        full_scale=values["full_scale"] or None,
        full_scale_rate=values["full_scale_rate"] or None,
        attitude_time=values["attitude_time"],
        still=StillLimits(**{k: values[f"still.{k}"] for k in ("window", "force", "rate", "turn")}),
    )
