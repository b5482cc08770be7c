# SPDX-License-Identifier: Apache-2.0
"""The node that serves the actions ``calibrate`` and ``diagnose`` over recorded drives."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from rclpy.action.server import ActionServer, CancelResponse, GoalResponse, ServerGoalHandle
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.task import Future
from rclpy.timer import Timer

from suspension_twin.calibration.request import Progress
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.files import for_peers, reading
from suspension_twin.nodes.aside import TICK
from suspension_twin.nodes.jobs import (
    DiagnosisStep,
    Job,
    Outcome,
    Step,
    Work,
    Worker,
    calibration_job,
    check_paths,
    diagnosis_job,
    run_calibration,
    run_diagnosis,
)
from suspension_twin.nodes.lifecycle import ManagedNode
from suspension_twin.nodes.parameters import FOLDERS, TWIN, Param, Values, twin_of
from suspension_twin.nodes.topics import OK, WARN, Embedding
from suspension_twin_interfaces.action import Calibrate, Diagnose

__all__ = ["CalibratorNode"]

#: s that a goal waits at most until its client's reader of answers is known (tolerance: twenty times what Fast DDS
#: waits for it by itself, 0.1 s).
_FOUND = 2.0


@dataclass(frozen=True)
class Action:
    """One action. ``job_of(goal, twin file, threads)`` takes the node's parameters that ``options`` names as well and
    raises InputError for a wrong goal; ``work`` turns the job
    into the fields of the action's result and reports one ``step`` after the other, which have the fields of its
    feedback. ``describe`` puts a step in words. ``has_partial``: a cancelled job returns its best result so far."""

    kind: type[Calibrate | Diagnose]
    name: str
    job_of: Callable[..., Job]
    work: Work
    step: type[Progress | DiagnosisStep]
    describe: Callable[..., str]
    has_partial: bool
    options: tuple[str, ...] = ()


ACTIONS = (
    Action(
        Calibrate,
        "calibrate",
        calibration_job,
        run_calibration,
        Progress,
        lambda step: f"generation {step.generation}, best cost {step.best_cost:.4g}",
        has_partial=True,
        options=("keep_sensor",),
    ),
    Action(
        Diagnose,
        "diagnose",
        diagnosis_job,
        run_diagnosis,
        DiagnosisStep,
        lambda step: f"{100 * step.progress:.0f} %",
        has_partial=False,
    ),
)


@dataclass
class _Running:
    """The goal being worked on. Steps that the worker reports at once are sent tick by tick, and the outcome after
    them: a client that gets several messages at once loses those that the result overtakes."""

    action: Action
    goal: ServerGoalHandle
    worker: Worker
    finished: Future
    steps: deque[Step] = field(default_factory=deque)
    outcome: Outcome | None = None
    give_up_at: float = math.inf

    def fail(self, message: str) -> None:
        """End without a result."""
        self.outcome = {"success": False, "message": message}


class CalibratorNode(ManagedNode):
    """One goal at a time, calibration or diagnosis, in a worker process."""

    parameters = (
        TWIN,
        FOLDERS,
        Param("threads", 0, "Threads that a calibration or diagnosis may use; 0: one per core.", 0, 1024),
        Param(
            "cancel_patience",
            10.0,
            "Time in s that a cancelled calibration is given to return its best result so far; then its process is "
            "ended. A cancelled diagnosis has no partial result and is ended at once.",
            0.0,
            600.0,
        ),
        Param(
            "waiting_goals",
            0,
            "Goals that may wait until the one that runs has ended; 0: a second goal is refused.",
            0,
            100,
        ),
        Param(
            "keep_sensor",
            False,
            "Whether a calibration leaves latency and mounting of the IMU as the file has them.",
        ),
    )

    def __init__(self, embedding: Embedding | None = None, works: Mapping[str, Work] | None = None) -> None:
        super().__init__("calibrator", embedding)
        #: Work of the worker for a goal, by the name of the action.
        self.works: dict[str, Work] = {a.name: a.work for a in ACTIONS} | dict(works or {})
        self._running: _Running | None = None
        #: The goal whose turn it is, running or about to, and those that wait, with whether each gets its turn.
        self._turn: tuple[Action, ServerGoalHandle] | None = None
        self._waiting: deque[tuple[Action, ServerGoalHandle, Future]] = deque()
        self._timer: Timer | None = None
        self._servers = [
            ActionServer(
                self,
                action.kind,
                action.name,
                partial(self._execute, action),
                goal_callback=partial(self._on_goal, action),
                cancel_callback=self._on_cancel,
                callback_group=self.aside.group,
            )
            for action in ACTIONS
        ]
        self.health.values["state"] = "idle"

    def check(self, values: Values) -> None:
        """See the base class."""
        twin_of(values)

    def destroy_node(self) -> None:
        """See the base class; a running worker is ended."""
        if self._running is not None:
            self._running.worker.kill()
            self._running = None
        for server in self._servers:
            server.destroy()
        super().destroy_node()

    def _busy(self) -> str:
        if not self.active or self._turn is None:
            return "the node is not active"
        waiting = f" and {len(self._waiting)} wait" if self._waiting else ""
        return f"a goal of {self._turn[0].name} is running{waiting}: cancel it or wait for its result"

    def _takes_another(self) -> bool:
        return self._turn is None or len(self._waiting) < self.values["waiting_goals"]

    async def _on_goal(self, action: Action, _goal: object) -> GoalResponse:
        await self._answerable(f"{self.resolve_service_name(action.name)}/_action/send_goal")
        if self.active and self._takes_another():
            return GoalResponse.ACCEPT
        self.note("rejected goals", WARN, f"{action.name}: goal rejected, {self._busy()}")
        return GoalResponse.REJECT

    async def _answerable(self, service: str) -> None:
        """Wait until as many read the answers of a service as send it requests. DDS finds the two ends of a client
        independently and loses an answer to a reader that it has not found: the goal would run unknown to its client.
        Topics are those of the ROS middlewares on DDS; where there are none of these names nothing is waited for."""

        def found() -> bool:
            asking = self.get_publishers_info_by_topic(f"rq{service}Request", no_mangle=True)
            hearing = self.get_subscriptions_info_by_topic(f"rr{service}Reply", no_mangle=True)
            return len(hearing) >= len(asking)

        await self.aside.until(found, _FOUND)

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        running = self._running
        for _, waits, turn in self._waiting:
            if waits.goal_id == goal.goal_id and not turn.done():
                turn.set_result(False)
        if running is not None and running.goal.goal_id == goal.goal_id:
            running.worker.stop()
            patience = self.values["cancel_patience"] if running.action.has_partial else 0.0
            running.give_up_at = time.monotonic() + patience
        return CancelResponse.ACCEPT

    async def _execute(self, action: Action, goal: ServerGoalHandle) -> Calibrate.Result | Diagnose.Result:
        if not self._takes_another():  # two goals accepted before either began
            goal.abort()
            return action.kind.Result(message=self._busy())
        if self._turn is not None:
            turn = Future(executor=self.executor)
            self._waiting.append((action, goal, turn))
            self._feed_back(action, goal, action.step("waiting"))
            if not await turn:
                self._waiting = deque(entry for entry in self._waiting if entry[2] is not turn)
                goal.canceled()
                return action.kind.Result(message="cancelled while it waited")
        self._turn = action, goal
        try:
            return await self._work(action, goal)
        finally:
            self._next()

    def _next(self) -> None:
        """The turn of the goal that has waited longest and was not cancelled."""
        self._turn = None
        while self._waiting:
            action, goal, turn = self._waiting.popleft()
            if not turn.done():
                self._turn = action, goal
                turn.set_result(True)
                if self.executor is not None:
                    self.executor.wake()
                break

    async def _work(self, action: Action, goal: ServerGoalHandle) -> Calibrate.Result | Diagnose.Result:
        if not self.active:
            goal.abort()
            return action.kind.Result(message=self._busy())
        try:
            with reading(action.name, "a goal"), for_peers(self.own_log.warning):
                job = await self.aside.do(lambda: self._job(action, goal.request))
        except SuspensionTwinError as error:
            self.note("rejected goals", WARN, f"{action.name}: {error}")
            goal.abort()
            return action.kind.Result(message=str(error))
        if goal.is_cancel_requested:
            goal.canceled()
            return action.kind.Result(message="cancelled: nothing was written")
        worker = Worker(self.works[action.name], job)
        self._running = _Running(action, goal, worker, Future(executor=self.executor))
        self._timer = self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._feed_back(action, goal, action.step("reading", note="starting a worker process"))
        outcome = await self._running.finished
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome["success"]:
            goal.succeed()
        else:
            goal.abort()
        level = OK if outcome["success"] else WARN
        self.note(f"goals of {action.name}", level, f"{action.name}: {outcome['message']}")
        self.health.values["state"] = "idle"
        return action.kind.Result(**outcome)

    def _job(self, action: Action, goal: Calibrate.Goal | Diagnose.Goal) -> Job:
        """The job of a goal, its paths checked and its twin read, which may take long."""
        twin_file = self.values["twin"]
        check_paths(goal, self.folders, twin_file)
        options = {name: self.values[name] for name in action.options}
        job = action.job_of(goal, twin_file, self.values["threads"], **options)
        self.folders.check(job.output)  # beside a recording that is a folder itself, it may lie out of it
        return job

    def _tick(self) -> None:
        running = self._running
        if running is None:
            return
        try:
            self._listen(running)
            pending = bool(running.steps)
            for _ in range(min(len(running.steps), 1 + len(running.steps) // 10)):
                self._feed_back(running.action, running.goal, running.steps.popleft())
        except Exception as error:  # the client gets a result in any case
            running.fail(f"unexpected error, {type(error).__name__}")
            self.own_log.error(f"{running.action.name}: {type(error).__name__}: {error}")
            pending = False
        if running.outcome is not None and not pending:
            self._finish(running)

    def _listen(self, running: _Running) -> None:
        for news in running.worker.news() if running.outcome is None else ():
            if news.kind == "progress":
                running.steps.append(news.content)
            elif news.kind == "done":
                running.outcome = news.content
            elif running.outcome is None:
                running.fail(news.content.text)
                if news.content.whole:
                    self.own_log.warning(f"{running.action.name}: {news.content.whole}")
        if running.outcome is None and time.monotonic() >= running.give_up_at:
            running.steps.clear()
            late = "no result within cancel_patience" if running.action.has_partial else "nothing was written"
            running.fail(f"cancelled: {late}")

    def _feed_back(self, action: Action, goal: ServerGoalHandle, step: Step) -> None:
        note = f" ({step.note})" if step.note else ""
        if (action, goal) == self._turn:
            self.health.values["state"] = f"{step.stage}{note}, {action.describe(step)}"
        feedback = action.kind.Feedback()
        feedback.header.stamp = self.stamp_now()
        for name in feedback.get_fields_and_field_types().keys() - {"header"}:
            setattr(feedback, name, getattr(step, name))
        goal.publish_feedback(feedback)

    def _finish(self, running: _Running) -> None:
        self._running = None
        if self._timer is not None:
            self.destroy_timer(self._timer)
        running.worker.kill()
        running.finished.set_result(running.outcome)
        if self.executor is not None:
            self.executor.wake()
