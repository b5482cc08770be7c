# SPDX-License-Identifier: Apache-2.0
"""The first drive on the page: the sensors' topics, as they come, to the steps that are shown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.calibration.first_drive import FirstDrive
from suspension_twin.drive.types import Samples
from suspension_twin.errors import InputError
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.messages import read_fix, read_imu, read_velocity
from suspension_twin.nodes.topics import SENSOR_QOS
from suspension_twin.vehicle.twin import Twin

__all__ = ["ViewGuide"]

_READ: tuple[tuple[type, str, Callable[[Any], Samples]], ...] = (
    (Imu, "imu/data_raw", read_imu),
    (NavSatFix, "fix", read_fix),
    (TwistStamped, "vel", read_velocity),
)


class ViewGuide:
    """Listens while it is open. Raises InputError for a twin without a road."""

    def __init__(self, node: TwinNode, twin: Twin) -> None:
        self.drive = FirstDrive(twin)
        #: What is said of the calibration that follows.
        self.calibration = ""
        self.calibrated = False
        self._node = node
        self._waiting: list[tuple[list[Any], Callable[[Any], Samples]]] = []
        self._subscriptions = []
        for kind, topic, read in _READ:
            messages: list[Any] = []
            self._waiting.append((messages, read))
            self._subscriptions.append(node.create_subscription(kind, topic, messages.append, SENSOR_QOS))

    def take(self) -> None:
        """Go on with what has come. Raises InputError where the sensor sits otherwise than the twin file says."""
        for messages, read in self._waiting:
            if messages:
                self.drive.add(read(messages))
                messages.clear()
        still = self.drive.standstill
        if still is not None and still.mounting is not None and still.mounting.level == "error":
            raise InputError("first drive", "imu.rpy", still.mounting.text)

    def shown(self) -> list[dict[str, str]]:
        """The steps for the page."""
        steps = [{"title": s.title, "state": s.state, "text": s.text} for s in self.drive.steps()]
        still = self.drive.standstill
        if still is not None and still.mounting is not None:
            steps[0]["text"] += f"; {still.mounting.text}"
        state = "done" if self.calibrated else "now" if self.calibration else "later"
        return [
            *steps,
            {"title": "Calibrate", "state": state, "text": self.calibration or "by itself, about a minute"},
        ]

    def close(self) -> None:
        """Listen no longer."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
