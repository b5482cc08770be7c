# SPDX-License-Identifier: Apache-2.0
"""The node that serves the actions ``calibrate`` and ``diagnose`` over recorded drives."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rclpy.action.server import ActionServer, CancelResponse, GoalResponse, ServerGoalHandle
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.task import Future

from suspension_twin.errors import SuspensionTwinError
from suspension_twin.nodes._actions import CALIBRATE, DIAGNOSE, Action
from suspension_twin.nodes._base import Embedding, TwinNode
from suspension_twin.nodes._files import TWIN, twin_of
from suspension_twin.nodes._health import OK, WARN
from suspension_twin.nodes._main import run_alone
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.nodes._worker import Work, Worker

__all__ = ["CalibratorNode", "main"]

#: How often the worker is listened to, in s.
_TICK = 0.02


@dataclass
class _Running:
    """One goal on its way. What the worker says in one breath is told tick by tick, and the outcome after
    it: a client that gets several at once loses those that the result overtakes."""

    action: Action
    goal: ServerGoalHandle
    worker: Worker
    finished: Future
    untold: deque[Any] = field(default_factory=deque)
    outcome: Any = None
    give_up_at: float = math.inf


class CalibratorNode(TwinNode):
    """One goal at a time, calibration or diagnosis, in a process of its own."""

    parameters = (
        TWIN,
        Param(
            "threads", 0, "Threads that a calibration or diagnosis may use; 0: all of the machine's.", 0, 1024
        ),
        Param(
            "cancel_patience",
            10.0,
            "Seconds that a cancelled calibration is given to hand over its best so far; then it is ended. A "
            "cancelled diagnosis has nothing to hand over and is ended at once.",
            0.0,
            600.0,
        ),
    )

    def __init__(self, embedding: Embedding | None = None, works: Mapping[str, Work] | None = None) -> None:
        super().__init__("calibrator", embedding)
        #: What the worker does for a goal, by the name of the action.
        self.works: dict[str, Work] = {a.name: a.work for a in (CALIBRATE, DIAGNOSE)} | dict(works or {})
        self._running: _Running | None = None
        self._timer: Any = None
        self._servers = [self._serve(action) for action in (CALIBRATE, DIAGNOSE)]
        self.health.values["state"] = "idle"

    def _serve(self, action: Action) -> ActionServer:
        return ActionServer(
            self,
            action.kind,
            action.name,
            partial(self._execute, action),
            goal_callback=partial(self._on_goal, action),
            cancel_callback=self._on_cancel,
        )

    def check(self, values: Values) -> None:
        """See the base class."""
        twin_of(values)

    def destroy_node(self) -> None:
        """See the base class; what is on its way is given up."""
        if self._running is not None:
            self._running.worker.kill()
            self._running = None
        for server in self._servers:
            server.destroy()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def _busy(self) -> str:
        running = self._running
        return (
            ""
            if running is None
            else f"one {running.action.noun} is running: cancel it or wait for its result"
        )

    def _on_goal(self, action: Action, _goal: Any) -> GoalResponse:
        if self._running is not None:
            self.note("refused goal", WARN, f"{action.name}: refused a second goal, {self._busy()}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        running = self._running
        if running is not None and running.goal.goal_id == goal.goal_id:
            running.worker.stop()
            patience = self.values["cancel_patience"] if running.action.hands_over else 0.0
            running.give_up_at = time.monotonic() + patience
        return CancelResponse.ACCEPT

    async def _execute(self, action: Action, goal: ServerGoalHandle) -> Any:
        if self._running is not None:  # two goals in one breath, both accepted before either began
            goal.abort()
            return action.kind.Result(message=self._busy())
        try:
            job = action.job_of(goal.request, self.values["twin"], self.values["threads"])
        except SuspensionTwinError as error:
            self.note("refused goal", WARN, f"{action.name}: {error}")
            goal.abort()
            return action.kind.Result(message=str(error))
        worker = Worker(self.works[action.name], job)
        self._running = _Running(action, goal, worker, Future(executor=self.executor))
        self._timer = self.create_timer(_TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._feed_back(self._running, action.step("reading", note="starting a worker process"))
        outcome = await self._running.finished
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome.success:
            goal.succeed()
        else:
            goal.abort()
        self.note(action.noun, OK if outcome.success else WARN, f"{action.name}: {outcome.message}")
        self.health.values["state"] = "idle"
        return action.result(outcome)

    def _tick(self) -> None:
        running = self._running
        if running is None:
            return
        try:
            self._listen(running)
            told = bool(running.untold)
            for _ in range(min(len(running.untold), 1 + len(running.untold) // 10)):
                self._feed_back(running, running.untold.popleft())
        except Exception as error:  # whatever happens, the client gets its answer
            running.outcome, told = running.action.failed(f"{type(error).__name__}: {error}"), False
        if running.outcome is not None and not told:
            self._finish(running, running.outcome)

    def _listen(self, running: _Running) -> None:
        if running.outcome is not None:
            return
        for news in running.worker.news():
            if news.kind == "progress":
                running.untold.append(news.content)
                continue
            running.outcome = news.content if news.kind == "done" else running.action.failed(news.content)
            return
        if time.monotonic() >= running.give_up_at:
            running.untold.clear()
            running.outcome = running.action.failed(running.action.given_up)

    def _feed_back(self, running: _Running, step: Any) -> None:
        self.health.values["state"] = running.action.said(step)
        feedback = running.action.feedback(step)
        feedback.header.stamp = self.stamp_now()
        running.goal.publish_feedback(feedback)

    def _finish(self, running: _Running, outcome: Any) -> None:
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
