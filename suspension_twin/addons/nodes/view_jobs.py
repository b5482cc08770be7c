# SPDX-License-Identifier: Apache-2.0
"""Calibrations and diagnoses asked for on the page, and their results, which are loaded into the twin."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.action.client import ActionClient
from rclpy.parameter import Parameter

from suspension_twin.addons.nodes.view_recorder import ViewRecorder, unused
from suspension_twin.addons.view.live import LiveView
from suspension_twin.errors import InputError, WorkError
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.topics import OK, WARN
from suspension_twin_interfaces.action import Calibrate, Diagnose
from suspension_twin_interfaces.srv import LoadTwin

__all__ = ["ViewJob", "ViewJobs"]

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
        view.tell("job", None)

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

    def _on_accepted(self, job: ViewJob, future: Any) -> None:
        handle = future.result()
        if handle is None or not handle.accepted:
            self._end(job, False, "the node calibrator refused, another goal is running")
            return
        job.handle, job.running = handle, True
        handle.get_result_async().add_done_callback(partial(self._on_result, job))

    def _on_result(self, job: ViewJob, future: Any) -> None:
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
            self._view.tell("job", shown | {"result": found and not job.running})

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

    def _on_loaded(self, path: Path, future: Any) -> None:
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
