# SPDX-License-Identifier: Apache-2.0
"""The node that takes the IMU in: ``imu/data_raw`` to ``imu/data`` and ``imu/vertical_acceleration``.

All that it knows about signals is :class:`~suspension_twin.signals.ingest.ImuIngest`.
"""

from __future__ import annotations

import sys
from collections.abc import Set as AbstractSet
from typing import Any

from geometry_msgs.msg import AccelStamped
from sensor_msgs.msg import Imu

from suspension_twin.errors import InputError
from suspension_twin.gap.mounting import turn_of
from suspension_twin.nodes._base import Embedding, TwinNode
from suspension_twin.nodes._files import FILTER, TWIN, filter_of, twin_of
from suspension_twin.nodes._health import WARN
from suspension_twin.nodes._main import run_alone
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.nodes._warm_up import warm_up_ingest
from suspension_twin.signals.ingest import ImuIngest, ImuSettings
from suspension_twin.signals.standstill import StillLimits
from suspension_twin.vehicle.twin import Place

__all__ = ["ImuIngestNode", "main"]

_DEFAULT = ImuSettings()
_STILL = StillLimits()


class ImuIngestNode(TwinNode):
    """``imu/data_raw`` in; bias-free, filtered signals in ``base_link`` axes out."""

    parameters = (
        TWIN,
        *FILTER,
        Param("base_frame", "base_link", "Frame of what is published.", read_only=True),
        Param(
            "convert_units",
            _DEFAULT.convert_units,
            "Take a sensor that sends g instead of m/s² times 9.80665.",
        ),
        Param(
            "restore_gravity", _DEFAULT.restore_gravity, "Put gravity back where the phone has removed it."
        ),
        Param(
            "level",
            _DEFAULT.level,
            "Turn the sensor's axes upright by gravity: never (the twin file's mounting is the truth), gross (only "
            "where it is more than 45 degrees off), always (any tilt seen at standstill).",
            choices=("never", "gross", "always"),
        ),
        Param(
            "max_bias",
            _DEFAULT.max_bias,
            "Horizontal reading at rest in m/s² up to which it is taken for a bias; more is a tilt.",
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
        Param("still.window", _STILL.window, "Window in s over which a standstill is judged.", 0.1, 10.0),
        Param(
            "still.force",
            _STILL.force,
            "Standard deviation in m/s² that a standing car stays below.",
            0.001,
            5.0,
        ),
        Param(
            "still.rate",
            _STILL.rate,
            "Standard deviation in rad/s that a standing car stays below.",
            1e-5,
            1.0,
        ),
        Param(
            "still.turn",
            _STILL.turn,
            "Mean rate in rad/s of a standing car: the gyroscope's bias.",
            1e-5,
            1.0,
        ),
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("imu_ingest", embedding)
        warm_up_ingest()
        self._data = Imu()
        self._data.header.frame_id = self.values["base_frame"]
        self._data.orientation_covariance[0] = -1.0
        self._vertical = AccelStamped()
        self._vertical.header.frame_id = self.values["base_frame"]
        self._seen: dict[str, int] = {}
        self._data_out = self.offer(Imu, "imu/data")
        self._vertical_out = self.offer(AccelStamped, "imu/vertical_acceleration")
        self._start()
        self.listen(Imu, "imu/data_raw", self._on_imu)

    def check(self, values: Values) -> None:
        """See the base class."""
        _settings(values)

    def changed(self, names: AbstractSet[str]) -> None:
        """See the base class: the settings shape everything, so it starts afresh with them."""
        if names & {p.name for p in self.parameters}:
            self._start()

    def _start(self) -> None:
        twin = twin_of(self.values)
        self._frame = None if twin is None else twin.imu.frame
        # a tilt that the twin simulates is to be seen in the measured signals, and no news
        self._silent = (*_COUNTED, *(() if twin is None or turn_of(twin) is None else ("tilted",)))
        self._ingest = ImuIngest(_settings(self.values), Place() if twin is None else twin.imu)
        self.reset()

    def reset(self) -> None:
        """See the base class."""
        self._ingest.reset()
        self._seen.clear()

    def _on_imu(self, message: Imu, ns: int) -> None:
        if message.header.frame_id != self._frame and self._frame is not None:
            self.note_frame("imu/data_raw", message.header.frame_id, self._frame)
        if message.linear_acceleration_covariance[0] == -1.0:
            raise InputError(
                "imu/data_raw", "linear_acceleration is not reported (its covariance begins with -1)"
            )
        a, w = message.linear_acceleration, message.angular_velocity
        out = self._ingest.push(ns / 1e9, (a.x, a.y, a.z), (w.x, w.y, w.z))
        if out is None:
            return
        data, vertical = self._data, self._vertical
        data.header.stamp = vertical.header.stamp = message.header.stamp
        vector = data.linear_acceleration
        vector.x, vector.y, vector.z = out.force
        vector = data.angular_velocity
        vector.x, vector.y, vector.z = out.rate
        vertical.accel.linear.z = out.vertical_acceleration
        self._data_out.send(data)
        self._vertical_out.send(vertical)

    def report(self) -> None:
        """See the base class."""
        ingest, health = self._ingest, self.health
        found = [f for f in ingest.findings if f.code not in self._silent]
        self.show_findings(found)
        for code, text in _COUNTED.items():
            count = ingest.counts[code]
            new = count - self._seen.get(code, 0)
            if new > 0:
                self.note(code, WARN, f"imu/data_raw: {text}: {new}")
            self._seen[code] = count
        health.values["sample rate (Hz)"] = f"{ingest.rate:.2f}" if ingest.rate else "not known yet"
        health.values["standing"] = str(ingest.standing)
        health.values |= {f"samples {code}": str(count) for code, count in sorted(ingest.counts.items())}


#: Counters of the ingest that are told while they grow.
_COUNTED = {
    "invalid": "messages with a number that is not finite, dropped",
    "saturated": "samples at the end of the sensor's range (set a larger range)",
    "late": "samples that came late, dropped",
    "duplicate": "samples that repeat a stamp, dropped",
    "missing": "missing samples, filled in",
    "gaps": "pauses after which the filter started anew",
}


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


def main(args: list[str] | None = None) -> Any:
    """Run the node in a process of its own."""
    return run_alone(ImuIngestNode, args)


if __name__ == "__main__":
    sys.exit(main())
