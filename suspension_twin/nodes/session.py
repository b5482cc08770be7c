# SPDX-License-Identifier: Apache-2.0
"""The four nodes for programs that want arrays and have no business with ROS: replays and calibrations."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.action.client import ActionClient
from rclpy.context import Context
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.logging import set_logger_level

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import Progress
from suspension_twin.drive.types import Drive
from suspension_twin.errors import WorkError
from suspension_twin.live.twin import Update
from suspension_twin.nodes.composed import Composed, Playback
from suspension_twin.nodes.process import ros_context
from suspension_twin.nodes.topics import NS
from suspension_twin_interfaces.action import Calibrate
from suspension_twin_interfaces.msg import Gap

__all__ = ["CalibrateAnswer", "Replay", "Session", "session"]

#: Time in s that the middleware is given to connect client and server of one process.
_PATIENCE = 20.0
_DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"


@dataclass(frozen=True, eq=False)
class Replay:
    """Messages that the nodes published while a drive was played.

    ``t`` (n,) s stamps that both signals have; ``measured`` and ``simulated`` (n,) m/s² from
    ``imu/vertical_acceleration`` and ``twin/vertical_acceleration``. ``path`` (m, 6) from ``twin/odom``:
    stamp, x and y (m), yaw (rad), speed (m/s), and the standard deviation of the yaw (rad), infinite
    while it is not known. ``gap`` (k, 2) from ``twin/gap``: stamp, rms (m/s²). ``wall`` is the time in s
    that it took.
    """

    t: Floats
    measured: Floats
    simulated: Floats
    path: Floats
    gap: Floats
    wall: float


@dataclass(frozen=True)
class CalibrateAnswer:
    """The result of the action ``calibrate``; ``values`` and ``excited`` by dotted key."""

    message: str
    output: Path
    cost: float
    initial_cost: float
    evaluations: int
    values: dict[str, float]
    excited: dict[str, bool]
    wall: float


class Session:
    """Replays and calibrations, one after the other; from :func:`session`."""

    def __init__(self, context: Context, namespace: str) -> None:
        self._context = context
        self._namespace = namespace

    def replay(
        self,
        drive: Drive,
        twin_file: Path | str,
        on_progress: Callable[[float], None] = lambda _: None,
        rate: float = math.inf,
    ) -> Replay:
        """Play ``drive`` through the four nodes; ``on_progress`` gets shares from 0 to 1.

        Raises InputError for a wrong twin file, WorkError where nothing was simulated.
        """
        began = time.monotonic()
        signals: list[tuple[float, ...]] = []
        path: list[tuple[float, ...]] = []
        gap: list[tuple[float, float]] = []

        def take(update: Update, ns: int) -> None:
            t, pose, at = ns / NS, update.pose, update.followed
            if pose is not None:
                sigma = math.sqrt(max(pose.covariance[5], 0.0)) if pose.aligned else math.inf
                path.append((t, pose.x, pose.y, pose.yaw, pose.motion.speed, sigma))
            if at is not None and not math.isnan(at.vertical_acceleration):
                signals.append((t, at.measured, at.vertical_acceleration))

        def keep(message: Gap) -> None:
            stamp = message.header.stamp
            gap.append((stamp.sec + 1e-9 * stamp.nanosec, message.rms))

        with self._composed(twin_file, Playback(drive, rate)) as composed:
            composed.outlets.append(take)
            composed.model.outputs["twin/gap"].links.append(keep)
            player = composed.player
            assert player is not None
            while not composed.finished:
                composed.step()
                on_progress(min(player.position / max(player.duration, 1e-9), 1.0))
        if not signals:
            raise WorkError(f"{drive.name}: none of {len(drive.imu)} IMU samples was simulated")
        t, measured, simulated = np.array(signals).T
        gaps = np.array(gap).reshape(-1, 2)
        return Replay(t, measured, simulated, np.array(path), gaps, time.monotonic() - began)

    def calibrate(
        self,
        twin_file: Path | str,
        bags: list[Path],
        output: Path,
        *,
        preset: str = "fast",
        seed: int = 0,
        on_progress: Callable[[Progress], None] = lambda _: None,
    ) -> CalibrateAnswer:
        """Call the action ``calibrate`` and wait; interrupted, the goal is cancelled.

        Raises WorkError with the action's message where it does not succeed.
        """
        began = time.monotonic()
        steps = ("stage", "generation", "evaluations", "best_cost", "mean_cost", "seconds_left")

        def on_feedback(message: Any) -> None:
            on_progress(Progress(*(getattr(message.feedback, name) for name in steps)))

        goal = Calibrate.Goal(
            twin=str(twin_file), bags=[str(b) for b in bags], output=str(output), preset=preset, seed=seed
        )
        with self._composed(twin_file, None) as composed:
            client: Any = rclpy.create_node(
                "session", context=self._context, namespace=self._namespace, use_global_arguments=False
            )
            composed.executor.add_node(client)
            action: Any = ActionClient(client, Calibrate, "calibrate")
            try:
                until = time.monotonic() + _PATIENCE
                while not action.server_is_ready():
                    if time.monotonic() > until:
                        raise WorkError(f"the action calibrate was not found within {_PATIENCE:g} s")
                    composed.step()
                handle = _wait(composed, action.send_goal_async(goal, feedback_callback=on_feedback))
                if not handle.accepted:
                    raise WorkError("calibrate: the goal was rejected, another goal is running")
                try:
                    answer = _wait(composed, handle.get_result_async()).result
                except KeyboardInterrupt:
                    _wait(composed, handle.cancel_goal_async())
                    raise
            finally:
                action.destroy()
                composed.executor.remove_node(client)
                client.destroy_node()
        if not answer.success:
            raise WorkError(f"calibrate: {answer.message}")
        return CalibrateAnswer(
            answer.message,
            Path(answer.output),
            answer.cost,
            answer.initial_cost,
            answer.evaluations,
            values=dict(zip(answer.names, answer.values, strict=True)),
            excited=dict(zip(answer.names, answer.excited, strict=True)),
            wall=time.monotonic() - began,
        )

    @contextmanager
    def _composed(self, twin_file: Path | str, playback: Playback | None) -> Iterator[Composed]:
        everywhere = [Path(Path.cwd().anchor)]  # nobody else reaches these nodes
        composed = Composed(self._context, twin_file, self._namespace, playback, folders=everywhere)
        try:
            yield composed
        finally:
            composed.close()


def _wait(composed: Composed, future: Any) -> Any:
    while not future.done():
        composed.step()
    return future.result()


@contextmanager
def session(namespace: str = "session") -> Iterator[Session]:
    """A ROS context for replays and calibrations, isolated from the network: a replay publishes ``/clock``, and a
    live vehicle may be on the same network. The nodes' log is not shown."""
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
