# SPDX-License-Identifier: Apache-2.0
"""The four nodes used as a client would use them: topics listened to, the action called.

For programs that want the nodes' answers as arrays and have no business with ROS themselves.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.action.client import ActionClient
from rclpy.context import Context
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.logging import set_logger_level
from rclpy.task import Future

from suspension_twin.drive.types import Drive
from suspension_twin.errors import WorkError
from suspension_twin.nodes._listener import DEPTH, Listener
from suspension_twin.nodes._main import ros_context
from suspension_twin.nodes.answers import CalibrateAnswer, Feedback, Replay
from suspension_twin.nodes.composed import Composed, Playback
from suspension_twin_interfaces.action import Calibrate

__all__ = ["Session", "session"]

#: Seconds that the middleware is given to bring nodes or messages of one process together.
_PATIENCE = 20.0
_DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"


class Session:
    """Replays and calibrations, one after the other; from :func:`session`."""

    def __init__(self, context: Context, namespace: str) -> None:
        self._context = context
        self._namespace = namespace

    def replay(
        self,
        drive: Drive,
        twin_file: Path | str,
        on_progress: Callable[[float], None] | None = None,
        rate: float = math.inf,
    ) -> Replay:
        """Play ``drive`` through the four nodes and listen; ``on_progress`` gets shares from 0 to 1.

        Raises InputError for a wrong twin file, WorkError where the nodes said nothing comparable.
        """
        began = time.monotonic()
        with self._composed(twin_file, Playback(drive, rate)) as (composed, client):
            player = composed.player
            assert player is not None
            outputs = {
                t: o for n in composed.nodes.values() for t, o in n.outputs.items() if t in client.rows
            }
            met = [o.publisher.get_subscription_count for o in outputs.values()]
            self._serve(
                composed, lambda: all(count() for count in met), "the middleware brought nobody together"
            )

            def behind() -> int:
                return max(o.sent - len(client.rows[t]) for t, o in outputs.items())

            lost = "messages of the nodes got lost"
            player.reset()
            while not composed.finished:
                composed.step()
                # Full speed waits for messages to arrive, not for this client to take them.
                self._serve(composed, lambda: behind() < DEPTH // 2, lost)
                if on_progress is not None:
                    on_progress(min(player.position / max(player.duration, 1e-9), 1.0))
            self._serve(composed, lambda: behind() <= 0, lost)
            measured = client.table("imu/vertical_acceleration", 2)
            simulated = client.table("twin/vertical_acceleration", 2)
            path = client.table("twin/odom", 6)
            gap = client.table("twin/gap", 2)
        t, at, also = np.intersect1d(measured[:, 0], simulated[:, 0], return_indices=True)
        if not t.size:
            raise WorkError(f"{drive.name}: the twin answered to none of {len(drive.imu)} samples")
        return Replay(t, measured[at, 1], simulated[also, 1], path, gap, time.monotonic() - began)

    def calibrate(
        self,
        twin_file: Path | str,
        bags: list[Path],
        output: Path,
        *,
        preset: str = "fast",
        seed: int = 0,
        on_feedback: Callable[[Feedback], None] | None = None,
    ) -> CalibrateAnswer:
        """Call the action ``calibrate`` and wait; interrupted, the goal is cancelled.

        Raises WorkError with the action's own words where it does not succeed.
        """
        began = time.monotonic()

        def heard(message: Any) -> None:
            said = message.feedback
            if on_feedback is not None:
                on_feedback(
                    Feedback(
                        said.stage,
                        said.generation,
                        said.evaluations,
                        said.best_cost,
                        said.mean_cost,
                        said.seconds_left,
                    )
                )

        with self._composed(twin_file, None) as (composed, client):
            action: Any = ActionClient(client, Calibrate, "calibrate")
            try:
                self._serve(composed, action.server_is_ready, "the action calibrate was not found")
                goal = Calibrate.Goal(
                    twin=str(twin_file),
                    bags=[str(b) for b in bags],
                    output=str(output),
                    preset=preset,
                    seed=seed,
                )
                handle = self._wait(composed, action.send_goal_async(goal, feedback_callback=heard))
                if not handle.accepted:
                    raise WorkError("calibrate: the goal was refused, another calibration is running")
                try:
                    answer = self._wait(composed, handle.get_result_async()).result
                except KeyboardInterrupt:
                    self._wait(composed, handle.cancel_goal_async())
                    raise
            finally:
                action.destroy()
        if not answer.success:
            raise WorkError(f"calibrate: {answer.message}")
        names = list(answer.names)
        return CalibrateAnswer(
            message=answer.message,
            output=Path(answer.output),
            cost=answer.cost,
            initial_cost=answer.initial_cost,
            evaluations=answer.evaluations,
            generations=answer.generations,
            values=dict(zip(names, answer.values, strict=True)),
            excited=dict(zip(names, answer.excited, strict=True)),
            wall=time.monotonic() - began,
        )

    @contextmanager
    def _composed(
        self, twin_file: Path | str, playback: Playback | None
    ) -> Iterator[tuple[Composed, Listener]]:
        composed = Composed(self._context, twin_file, self._namespace, playback)
        client: Any = Listener(self._context, self._namespace)
        composed.executor.add_node(client)
        try:
            yield composed, client
        finally:
            composed.executor.remove_node(client)
            client.destroy_node()
            composed.close()

    def _serve(self, composed: Composed, ready: Callable[[], bool], otherwise: str) -> None:
        """Serve the nodes until ``ready``; WorkError where that takes too long."""
        until = time.monotonic() + _PATIENCE
        while not ready():
            if time.monotonic() > until:
                raise WorkError(f"{otherwise} within {_PATIENCE:g} s")
            composed.executor.spin_once(timeout_sec=0.02)

    def _wait(self, composed: Composed, future: Future) -> Any:
        while not future.done():
            composed.step()
        return future.result()


@contextmanager
def session(namespace: str = "session") -> Iterator[Session]:
    """A ROS context of its own for replays and calibrations, which nobody else hears or is heard by:
    a replay publishes ``/clock``, and a real car may be on the same network. The nodes' log is not shown."""
    before = os.environ.get(_DISCOVERY)
    os.environ[_DISCOVERY] = "OFF"
    set_logger_level(namespace, LoggingSeverity.FATAL)
    try:
        with ros_context([]) as context:
            yield Session(context, namespace)
    finally:
        set_logger_level(namespace, LoggingSeverity.UNSET)
        if before is None:
            del os.environ[_DISCOVERY]
        else:
            os.environ[_DISCOVERY] = before
