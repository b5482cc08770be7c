# SPDX-License-Identifier: Apache-2.0
"""The live twins of many vehicles, a namespace each, in one process or a few.

All twins of a process share one thread and one executor. rclpy's usual executors look at every entity of every node
whenever a message comes, so that a message costs the more the more twins there are; its events executor takes what has
come from a queue, at the same cost for any number.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any

from rclpy.context import Context

from suspension_twin.errors import SuspensionTwinError, WorkError
from suspension_twin.nodes.composed import Composed, Condition
from suspension_twin.nodes.process import WAIT, events_executor, ros_context, stopping

__all__ = ["Helpers", "TwinFleet"]

#: s between two reports of a helper process, and between two looks at whether it is still wanted.
_REPORT, _LOOK = 1.0, 0.1
#: s that a helper process may take to import everything and to make its twins, at least and for each twin.
_STARTING, _EACH = 60.0, 2.0


class TwinFleet:
    """Twins in one process, on one thread. ``twins`` maps a namespace to a twin file."""

    def __init__(self, context: Context, twins: Mapping[str, str]) -> None:
        self.executor = events_executor(context)
        self.twins: dict[str, Composed] = {}
        try:
            for namespace, file in twins.items():
                self.twins[namespace] = Composed(context, file, namespace, executor=self.executor)
        except BaseException:
            self.close()
            raise

    def step(self, most: float = WAIT) -> None:
        """Serve one callback; returns after ``most`` s at the latest."""
        self.executor.spin_once(timeout_sec=most)

    def conditions(self) -> dict[str, Condition]:
        """The present state of every twin, by namespace."""
        return {namespace: twin.condition() for namespace, twin in self.twins.items()}

    def parameter_names(self) -> dict[str, list[str]]:
        """The names of all parameters, by node."""
        return next(iter(self.twins.values())).parameter_names()

    def settle_memory(self) -> None:
        """See :meth:`Composed.settle_memory`."""
        next(iter(self.twins.values())).settle_memory()

    def close(self) -> None:
        """Shut everything down."""
        for twin in self.twins.values():
            twin.close()
        self.twins.clear()
        self.executor.shutdown()


class Helpers:
    """Processes that hold a share of the twins each, and say every second how these are.

    ``shares`` has the twins of each process, ``arguments`` are those for ROS. Raises what a process raises while it
    starts. A context manager: at its end the processes end.
    """

    def __init__(self, shares: Sequence[Mapping[str, str]], arguments: Sequence[str]) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._known: dict[str, Condition] = {}
        self._processes: list[tuple[Any, Connection]] = []
        for share in shares:
            here, there = spawn.Pipe()
            process = spawn.Process(target=_help, args=(there, dict(share), list(arguments)), daemon=True)
            process.start()
            there.close()
            self._processes.append((process, here))
        self._until = time.monotonic() + _STARTING + _EACH * max(map(len, shares), default=0)

    def __enter__(self) -> Helpers:
        return self

    def __exit__(self, *exception: object) -> None:
        for process, connection in self._processes:
            connection.close()  # by which it knows
            process.join(1.0)
            if process.is_alive():
                process.kill()

    @property
    def pids(self) -> list[int]:
        """Ids of the processes."""
        return [process.pid for process, _ in self._processes]

    def wait(self, going_on: Callable[[], bool]) -> None:
        """Wait until every process has made its twins, while ``going_on``."""
        for process, connection in self._processes:
            while not connection.poll(WAIT):
                if not going_on():
                    return
                if time.monotonic() > self._until or not process.is_alive():
                    raise WorkError("a process of the fleet did not start")
            self._take(connection)

    def conditions(self) -> dict[str, Condition]:
        """The state of every twin as it was last said, by namespace.

        Raises WorkError where a process has ended."""
        for process, connection in self._processes:
            try:
                while connection.poll():
                    self._take(connection)
            except (EOFError, OSError):
                raise WorkError(
                    f"a process of the fleet has ended (exit status {process.exitcode})"
                ) from None
        return dict(self._known)

    def _take(self, connection: Connection) -> None:
        said = connection.recv()
        if isinstance(said, SuspensionTwinError):
            raise said
        self._known.update(said)


def _help(connection: Connection, twins: dict[str, str], arguments: list[str]) -> None:
    """One process of :class:`Helpers`: ends when the other end of the connection is closed."""
    with stopping():
        try:
            with ros_context(arguments) as context:
                fleet = TwinFleet(context, twins)
                try:
                    fleet.settle_memory()
                    report = look = 0.0
                    while context.ok():
                        now = time.monotonic()
                        if now >= report:
                            connection.send(fleet.conditions())
                            report = now + _REPORT
                        if now >= look:
                            look = now + _LOOK
                            if connection.poll():
                                break
                        fleet.step()
                finally:
                    fleet.close()
        except SuspensionTwinError as error:
            connection.send(error)
        except (EOFError, OSError):
            pass
    os._exit(0)  # the regular exit takes half a second with a compiler loaded
