# SPDX-License-Identifier: Apache-2.0
"""The first drive on the page: standstill, drive, passes and calibration, step by step."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TwistStamped
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.addons.nodes.view_jobs import ViewJob, ViewJobs
from suspension_twin.addons.nodes.view_recorder import ViewRecorder
from suspension_twin.addons.view.live import LiveView
from suspension_twin.calibration.first_drive import FirstDrive
from suspension_twin.calibration.output import details_path
from suspension_twin.drive.types import Samples
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
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
#: s between two looks at a first drive.
_LOOK = 0.25


class ViewGuide:
    """A first drive at a time: listens, records and calibrates while it is ``active``."""

    def __init__(self, node: TwinNode, view: LiveView, recorder: ViewRecorder, jobs: ViewJobs) -> None:
        self._node, self._view, self._recorder, self._jobs = node, view, recorder, jobs
        self._drive: FirstDrive | None = None
        self._calibration, self._calibrated = "", False
        self._waiting: list[tuple[list[Any], Callable[[Any], Samples]]] = []
        self._subscriptions: list[Subscription] = []
        self._due = 0.0
        view.tell("guide", None)

    @property
    def active(self) -> bool:
        """Whether a first drive is under way or calibrated."""
        return self._drive is not None

    def start(self, twin: Twin | None) -> str:
        """Begin. Raises InputError for a twin without a road, WorkError where no node calibrates."""
        if twin is None:
            raise InputError("twin", "is not known to the page: start it with the parameter twin")
        if not self._jobs.actions["calibrate"].server_is_ready():
            raise WorkError("first drive: the node calibrator is not there")
        if self._jobs.running:
            raise InputError("first drive", "a calibration or diagnosis is running")
        drive = FirstDrive(twin)
        if self._recorder.bag is None:
            self._recorder.start()
        self._drive, self._calibration, self._calibrated = drive, "", False
        for kind, topic, read in _READ:
            messages: list[Any] = []
            self._waiting.append((messages, read))
            self._subscriptions.append(
                self._node.create_subscription(kind, topic, messages.append, SENSOR_QOS)
            )
        self._show(drive)
        return "Stand still, with the engine as it is when driving"

    def _stop_listening(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions, self._waiting = [], []

    def end(self, *, driving: bool = False) -> None:
        """Give the first drive up; with ``driving`` only if it is not yet calibrated."""
        if self._drive is not None and not (driving and self._calibration):
            self._stop_listening()
            self._drive = None
            self._view.tell("guide", None)

    def lead(self, now: float) -> None:
        """Show how far the drive is, and calibrate when it is done."""
        drive = self._drive
        if drive is None or self._calibration or now < self._due:
            return
        self._due = now + _LOOK
        try:
            self._take(drive)
            if drive.done:
                self._stop_listening()
                self._recorder.stop()
                self._jobs.calibrate()
                self._calibration = "calibrating"
            self._show(drive)
        except SuspensionTwinError as error:
            self.end()
            with suppress(SuspensionTwinError):
                self._recorder.stop()
            self._view.tell("guide", [{"title": "First drive", "state": "failed", "text": str(error)}])

    def _take(self, drive: FirstDrive) -> None:
        """Go on with what has come. Raises InputError where the sensor sits otherwise than the twin file says."""
        for messages, read in self._waiting:
            if messages:
                drive.add(read(messages))
                messages.clear()
        still = drive.standstill
        if still is not None and still.mounting is not None and still.mounting.level == "error":
            raise InputError("first drive", "imu.rpy", still.mounting.text)

    def job_ended(self, job: ViewJob, done: bool, message: str) -> None:
        """The last step: the gap before and after, and the calibrated twin takes over."""
        if self._drive is None or not self._calibration or job.name != "calibrate":
            return
        self._calibration, self._calibrated = message, done
        if done:
            self._calibration = _gap_of(job.output) or message
            with suppress(SuspensionTwinError):
                self._jobs.load()
        self._show(self._drive)

    def _show(self, drive: FirstDrive) -> None:
        steps = [{"title": s.title, "state": s.state, "text": s.text} for s in drive.steps()]
        still = drive.standstill
        if still is not None and still.mounting is not None:
            steps[0]["text"] += f"; {still.mounting.text}"
        state = "done" if self._calibrated else "now" if self._calibration else "later"
        text = self._calibration or "by itself, about a minute"
        self._view.tell("guide", [*steps, {"title": "Calibrate", "state": state, "text": text}])


def _gap_of(twin: Path) -> str:
    """The gap of the first drive before and after a calibration, from the file beside its result; empty without."""
    import yaml

    try:
        drive = yaml.safe_load(details_path(twin).read_text(encoding="utf-8"))["drives"][0]
        before, after = (float(drive[name]["rms"]) for name in ("gap_before", "gap_after"))
    except (OSError, ValueError, KeyError, IndexError, TypeError, yaml.YAMLError):
        return ""
    return f"gap {before:.3f} m/s² before, {after:.3f} after; the twin is {twin}"
