# SPDX-License-Identifier: Apache-2.0
"""The node that serves the action ``calibrate``: recorded drives in, a calibrated twin file out."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from rclpy.action.server import ActionServer, CancelResponse, GoalResponse, ServerGoalHandle
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.task import Future

from suspension_twin.calibration.request import Progress
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.nodes._base import Embedding, TwinNode
from suspension_twin.nodes._calibration import Outcome, calibrate_job, job_of
from suspension_twin.nodes._files import TWIN, twin_of
from suspension_twin.nodes._health import OK, WARN
from suspension_twin.nodes._main import run_alone
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.nodes._worker import Work, Worker
from suspension_twin_interfaces.action import Calibrate

__all__ = ["CalibratorNode", "main"]

#: How often the worker is listened to, in s.
_TICK = 0.02


@dataclass
class _Running:
    """One goal on its way. What the worker says in one breath is told tick by tick, and the outcome after
    it: a client that gets several at once loses those that the result overtakes."""

    goal: ServerGoalHandle
    worker: Worker
    finished: Future
    untold: deque[Progress] = field(default_factory=deque)
    outcome: Outcome | None = None
    give_up_at: float = math.inf


class CalibratorNode(TwinNode):
    """One calibration at a time, in a process of its own."""

    parameters = (
        TWIN,
        Param("threads", 0, "Threads that a calibration may use; 0: all of the machine's.", 0, 1024),
        Param(
            "cancel_patience",
            10.0,
            "Seconds that a cancelled calibration is given to hand over its best so far; then it is ended.",
            0.0,
            600.0,
        ),
    )

    def __init__(self, embedding: Embedding | None = None, work: Work = calibrate_job) -> None:
        super().__init__("calibrator", embedding)
        self._work = work
        self._running: _Running | None = None
        self._timer: Any = None
        self._server = ActionServer(
            self,
            Calibrate,
            "calibrate",
            self._execute,
            goal_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )
        self.health.values["state"] = "idle"

    def check(self, values: Values) -> None:
        """See the base class."""
        twin_of(values)

    def destroy_node(self) -> None:
        """See the base class; a calibration on its way is given up."""
        if self._running is not None:
            self._running.worker.kill()
            self._running = None
        self._server.destroy()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def _on_goal(self, _goal: Calibrate.Goal) -> GoalResponse:
        if self._running is not None:
            self.note("refused goal", WARN, "calibrate: refused a second goal, one calibration is running: cancel it "
                      "or wait for its result")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, _goal: ServerGoalHandle) -> CancelResponse:
        if self._running is not None:
            self._running.worker.stop()
            self._running.give_up_at = time.monotonic() + self.values["cancel_patience"]
        return CancelResponse.ACCEPT

    async def _execute(self, goal: ServerGoalHandle) -> Calibrate.Result:
        if self._running is not None:  # two goals in one breath, both accepted before either began
            goal.abort()
            return Calibrate.Result(message="one calibration is running: cancel it or wait for its result")
        try:
            job = job_of(goal.request, self.values["twin"], self.values["threads"])
        except SuspensionTwinError as error:
            self.note("refused goal", WARN, f"calibrate: {error}")
            goal.abort()
            return Calibrate.Result(message=str(error))
        self._running = _Running(goal, Worker(self._work, job), Future(executor=self.executor))
        self._timer = self.create_timer(_TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._feed_back(goal, Progress("reading", note="starting a worker process"))
        outcome: Outcome = await self._running.finished
        return self._conclude(goal, outcome)

    def _conclude(self, goal: ServerGoalHandle, outcome: Outcome) -> Calibrate.Result:
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome.success:
            goal.succeed()
        else:
            goal.abort()
        self.note("calibration", OK if outcome.success else WARN, f"calibrate: {outcome.message}")
        self.health.values["state"] = "idle"
        return Calibrate.Result(
            success=outcome.success,
            message=outcome.message,
            output=outcome.output,
            cost=outcome.cost,
            initial_cost=outcome.initial_cost,
            evaluations=outcome.evaluations,
            generations=outcome.generations,
            names=list(outcome.names),
            values=list(outcome.values),
            excited=list(outcome.excited),
        )

    def _tick(self) -> None:
        running = self._running
        if running is None:
            return
        try:
            self._listen(running)
            told = bool(running.untold)
            for _ in range(min(len(running.untold), 1 + len(running.untold) // 10)):
                self._feed_back(running.goal, running.untold.popleft())
        except Exception as error:  # whatever happens, the client gets its answer
            running.outcome, told = Outcome(success=False, message=f"{type(error).__name__}: {error}"), False
        if running.outcome is not None and not told:
            self._finish(running, running.outcome)

    def _listen(self, running: _Running) -> None:
        if running.outcome is not None:
            return
        for news in running.worker.news():
            if news.kind == "progress":
                running.untold.append(news.content)
                continue
            done = news.kind == "done"
            running.outcome = news.content if done else Outcome(success=False, message=news.content)
            return
        if time.monotonic() >= running.give_up_at:
            running.outcome = Outcome(success=False, message="cancelled; nothing was handed over in time")

    def _feed_back(self, goal: ServerGoalHandle, step: Progress) -> None:
        note = f" ({step.note})" if step.note else ""
        self.health.values["state"] = (
            f"{step.stage}{note}, generation {step.generation}, best cost {step.best_cost:.4g}"
        )
        feedback = Calibrate.Feedback(
            stage=step.stage,
            generation=step.generation,
            evaluations=step.evaluations,
            best_cost=step.best_cost,
            mean_cost=step.mean_cost,
            seconds_left=step.seconds_left,
        )
        feedback.header.stamp = self.stamp_now()
        goal.publish_feedback(feedback)

    def _finish(self, running: _Running, outcome: Outcome) -> None:
        self._running = None
        self.destroy_timer(self._timer)
        running.worker.kill()
        running.finished.set_result(outcome)
        if self.executor is not None:
            self.executor.wake()


def main(args: list[str] | None = None) -> Any:
    """Run the node in a process of its own."""
    return run_alone(CalibratorNode, args)


if __name__ == "__main__":
    sys.exit(main())
