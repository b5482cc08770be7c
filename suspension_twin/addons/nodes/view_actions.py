# SPDX-License-Identifier: Apache-2.0
"""Actions behind the buttons of the page: jobs of the calibrator, a first drive, the player of a recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TwistStamped
from rcl_interfaces.srv import SetParameters
from rclpy.action.client import ActionClient
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.addons.nodes.view_recorder import ViewRecorder
from suspension_twin.addons.sources.common.first_drive import FirstDrive
from suspension_twin.addons.view.live import LiveView
from suspension_twin.calibration.output import details_path
from suspension_twin.drive.types import Samples
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.files import Json, read_yaml, unused
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.messages import read_fix, read_imu, read_velocity
from suspension_twin.nodes.topics import OK, SENSOR_QOS, WARN
from suspension_twin.vehicle.twin import Twin
from suspension_twin_interfaces.action import Calibrate, Diagnose
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["ViewGuide", "ViewJob", "ViewJobs", "ViewPlayer"]

#: s for an answer to a goal.
_PATIENCE = 5.0


@dataclass
class ViewJob:
    """A goal of the action ``name`` and its result at ``output``."""

    name: str
    output: Path
    running: bool = True
    handle: Any = None
    report: bool = False
    progress: float | None = None
    began: float = field(default_factory=time.monotonic)


class ViewJobs:
    """One job at a time. ``on_end`` gets a job that has ended, whether it succeeded, and its message."""

    def __init__(
        self,
        node: TwinNode,
        view: LiveView,
        recorder: ViewRecorder,
        on_end: Callable[[ViewJob, bool, str], None],
    ) -> None:
        self._node, self._view, self._recorder, self._on_end = node, view, recorder, on_end
        self._job: ViewJob | None = None
        self._result: Path | None = None
        self.actions = {
            "calibrate": ActionClient(node, Calibrate, "calibrate"),
            "diagnose": ActionClient(node, Diagnose, "diagnose"),
        }
        self.loader = node.create_client(LoadTwin, "suspension_model/load_twin")
        self._others = [
            node.create_client(SetParameters, f"{name}/set_parameters")
            for name in ("imu_ingest", "pose_injector", "calibrator")
        ]
        view.update("job", None)

    def close(self) -> None:
        """Give the clients of the actions up."""
        for client in self.actions.values():
            client.destroy()

    @property
    def running(self) -> bool:
        """Whether there is a job that has not ended."""
        return self._job is not None and self._job.running

    def calibrate(self) -> str:
        """Calibrate on the last recording."""
        bag, output = self._paths("_calibrated.yaml")
        goal = Calibrate.Goal(twin=str(self._own_twin()), bags=[bag], output=str(output), preset="fast")
        self._begin("calibrate", goal, output)
        return f"Calibrating on {Path(bag).name}"

    def diagnose(self) -> str:
        """Diagnose the last recording."""
        bag, output = self._paths("_diagnosis")
        goal = Diagnose.Goal(twin=str(self._own_twin()), bags=[bag], output=str(output))
        self._begin("diagnose", goal, output)
        return f"Diagnosing {Path(bag).name}"

    def _paths(self, ending: str) -> tuple[str, Path]:
        bag = self._recorder.finished()
        return bag, unused(Path(self._node.values["folder"]) / f"{Path(bag).name}{ending}").resolve()

    def _own_twin(self) -> Path:
        if not self._node.values["twin"]:
            raise InputError("twin", "is not known to the page: start it with the parameter twin")
        return Path(self._node.values["twin"]).resolve()

    def _begin(self, name: str, goal: Any, output: Path) -> None:
        if self.running:
            raise InputError(name, "a calibration or diagnosis is running already")
        client = self.actions[name]
        if not client.server_is_ready():
            raise WorkError(f"{name}: the node calibrator is not there")
        self._job = job = ViewJob(name, output)
        self._show(f"{name}: starting")
        sent = client.send_goal_async(goal, feedback_callback=partial(self._on_feedback, job))
        sent.add_done_callback(partial(self._on_accepted, job))

    def _on_feedback(self, job: ViewJob, message: Any) -> None:
        feedback = message.feedback
        left = feedback.seconds_left
        rest = f", about {left:.0f} s left" if math.isfinite(left) else ""
        elapsed = time.monotonic() - job.began
        job.progress = elapsed / (elapsed + left) if math.isfinite(left) and elapsed + left > 0 else None
        cost = getattr(feedback, "best_cost", math.nan)
        so_far = f", best cost {cost:.4g}" if math.isfinite(cost) and cost > 0 else ""
        self._show(f"{job.name}: {feedback.stage}{so_far}{rest}")

    def cancel(self) -> str:
        """A cancelled calibration hands over its best so far, a diagnosis nothing."""
        job = self._job
        if job is None or not job.running or job.handle is None:
            raise InputError("cancel", "nothing is running that could be cancelled")
        job.handle.cancel_goal_async()
        return f"Cancelling: {job.name}"

    def watch(self, now: float) -> None:
        """Give up a goal whose node is gone, or that is not answered: the middleware loses an answer to a client it has
        not found yet. A late answer is taken up."""
        job = self._job
        if job is None or not job.running:
            return
        if not self.actions[job.name].server_is_ready():
            self._end(job, False, "the node calibrator ended before the result was there")
        elif job.handle is None and now - job.began > _PATIENCE:
            self._end(job, False, "the node calibrator did not answer")

    def _on_accepted(self, job: ViewJob, future: Future) -> None:
        handle = future.result()
        if handle is None or not handle.accepted:
            self._end(job, False, "the node calibrator refused, another goal is running")
            return
        job.handle, job.running = handle, True
        handle.get_result_async().add_done_callback(partial(self._on_result, job))

    def _on_result(self, job: ViewJob, future: Future) -> None:
        answer = future.result()
        done = bool(answer.result.success)  # also of a cancelled calibration, with its best so far
        if done:
            job.report = job.name == "diagnose"
            self._result = job.output / "twin.yaml" if job.report else job.output
        self._end(job, done, answer.result.message)

    def _end(self, job: ViewJob, done: bool, message: str) -> None:
        """Show on the page and in the health what became of a goal."""
        job.running = False
        self._node.note(f"goals of {job.name}", OK if done else WARN, f"{job.name}: {message}")
        self._show(f"{job.name}: {message}")
        self._on_end(job, done, message)

    def _show(self, text: str) -> None:
        job = self._job
        if job is not None:
            found = self._result is not None and self._result.exists()
            shown = {"text": text, "running": job.running, "progress": job.progress, "report": job.report}
            self._view.update("job", shown | {"result": found and not job.running})

    def load(self) -> str:
        """Load the last result into the twin."""
        path = self._result
        if path is None or not path.exists():
            raise InputError("load", "there is no result yet: calibrate or diagnose first")
        if not self.loader.service_is_ready():
            raise WorkError("load: the node suspension_model is not there")
        future = self.loader.call_async(LoadTwin.Request(path=str(path)))
        future.add_done_callback(partial(self._on_loaded, path))
        return f"Loading {path.name}"

    def _on_loaded(self, path: Path, future: Future) -> None:
        answer = future.result()
        if not answer.success:
            self._show(f"load: {answer.message}")
            return
        # the sensor's place and clock offset are the other nodes' concern, too
        twin = Parameter("twin", value=str(path))
        there = [client for client in self._others if client.service_is_ready()]
        for client in there:
            client.call_async(SetParameters.Request(parameters=[twin.to_parameter_msg()]))
        self._node.set_parameters([twin])
        whole = len(there) == len(self._others)
        self._show(answer.message.partition(";")[0] if whole else answer.message)


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
        view.update("guide", None)

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
            self._view.update("guide", None)

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
            self._view.update("guide", [{"title": "First drive", "state": "failed", "text": str(error)}])

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
        self._view.update("guide", [*steps, {"title": "Calibrate", "state": state, "text": text}])


def _gap_of(twin: Path) -> str:
    """The gap of the first drive before and after a calibration, from the file beside its result; empty without."""
    try:
        drive = read_yaml(details_path(twin))["drives"][0]
        before, after = (float(drive[name]["rms"]) for name in ("gap_before", "gap_after"))
    except (InputError, ValueError, LookupError, TypeError):
        return ""
    return f"gap {before:.3f} m/s² before, {after:.3f} after; the twin is {twin}"


class ViewPlayer:
    """Known while it says how it is: ``state`` has length and position in s, times real time (None: full speed),
    whether it is paused, has ended, waits to begin; None without one."""

    def __init__(self, node: TwinNode, view: LiveView) -> None:
        self.state: Json | None = None
        self.client = node.create_client(SetParameters, "bag_player/set_parameters")
        self._view, self._seen = view, 0.0

    def show(self, values: Mapping[str, str]) -> None:
        """Values of its diagnostics."""
        self._seen = time.monotonic()
        rate = float(values["rate"])
        self._view.count_from(int(values["start (ns)"]))
        self.state = {
            "duration": float(values["duration"]),
            "position": round(float(values["position"]), 1),
            "rate": rate if math.isfinite(rate) else None,
            "paused": values["paused"] == "True",
            "ended": values["ended"] == "True",
            "waiting": values["waiting"] == "True",
        }
        self._view.update("player", self.state)

    def begin(self) -> None:
        """Begin now, if the replay waits for somebody to look on."""
        if self.state is not None and self.state["waiting"] and self.client.service_is_ready():
            self.state["waiting"] = False  # asked once for each report
            self.set(paused=False)

    def forget(self, before: float) -> None:
        """It is gone where it was last heard of before that time."""
        if self.state is not None and self._seen < before:
            self.state = None
            self._view.update("player", None)

    def seek(self, number: float | None) -> str:
        """Go on from so many s of the recording, or its end."""
        most = math.inf if self.state is None else self.state["duration"]
        said = self.set(seek=min(max(number or 0.0, 0.0), most), paused=False)
        self._view.clear()
        return said

    def speed(self, number: float | None) -> str:
        """Times real time; InputError beyond 0.01 to 100."""
        if self.state is not None and not 0.01 <= (number or 0.0) <= 100.0:
            raise InputError("speed", "must be from 0.01 to 100 times real time")
        return self.set(rate=number)

    def set(self, **values: object) -> str:
        """Give the player other parameters. Raises InputError where there is none."""
        if self.state is None or not self.client.service_is_ready():
            raise InputError("player", "no recording is being replayed")
        wanted = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        self.client.call_async(SetParameters.Request(parameters=wanted))
        return ""
