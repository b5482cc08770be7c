# SPDX-License-Identifier: Apache-2.0
"""Requests that take long: files are read on a thread, and the node goes on with its work meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Thread
from typing import TypeVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future

from suspension_twin.errors import InputError

__all__ = ["TICK", "Aside"]

Done = TypeVar("Done")

#: Period in s at which it is looked whether something has ended.
TICK = 0.02
#: s that a request for files may take (tolerance: a twin on a road of 100 MB takes 4 s).
_LONGEST = 20.0


class Aside:
    """Work of a node beside its topics. Callbacks that wait for it are coroutines in ``group``, which holds up nothing
    else of the node."""

    def __init__(self, node: Node) -> None:
        self.group = ReentrantCallbackGroup()
        self._node = node
        self._thread: Thread | None = None

    async def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Whether ``condition`` comes to hold within so many seconds."""
        if condition():
            return True
        end, ready = time.monotonic() + seconds, Future(executor=self._node.executor)

        def look() -> None:
            if not ready.done() and (condition() or time.monotonic() >= end):
                ready.set_result(None)

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self._node.create_timer(TICK, look, self.group, steady)
        try:
            await ready
        finally:
            self._node.destroy_timer(timer)
        return condition()

    async def do(self, work: Callable[[], Done]) -> Done:
        """Run ``work`` on a thread, one piece after the other; its result, or what it raises.

        Raises InputError where it takes too long. The thread comes to its end alone then, and until it has what else is
        asked for is refused.
        """
        before = self._thread
        if before is not None and not await self.until(lambda: not before.is_alive(), _LONGEST):
            raise InputError("busy", "the files that were asked for before are still being read")
        found: list[Done] = []
        wrong: list[Exception] = []

        def run() -> None:
            try:
                found.append(work())
            except Exception as error:
                wrong.append(error)

        thread = self._thread = Thread(target=run, daemon=True)
        thread.start()
        if not await self.until(lambda: not thread.is_alive(), _LONGEST):
            raise InputError("files", f"could not be read within {_LONGEST:g} s")
        if wrong:
            raise wrong[0]
        return found[0]
