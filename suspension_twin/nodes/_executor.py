# SPDX-License-Identifier: Apache-2.0
"""A single-threaded executor that serves messages and timers without rebuilding the world for each.

rclpy's own executor builds its wait set anew for every callback, entity by entity in Python, and
wakes itself once more after each: with four nodes (a hundred services, events and subscriptions)
that costs several times what the twin computes. Here the list of entities is kept until something
changes; plain subscriptions and timers, which are nearly all there is to do, are served straight
from the wait set; services, actions, QoS events and coroutines are left to rclpy's own machinery,
which only starts when one of them is ready.
"""

from __future__ import annotations

import time

from rclpy.context import Context
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
    TimeoutObject,
)
from rclpy.node import Node
from rclpy.task import Future

from suspension_twin.nodes._wait_list import WaitList

__all__ = ["TwinExecutor"]

#: Messages of one topic served in a row before the others get their turn.
_BURST = 50
#: While messages pour in, events and unfinished coroutines are still looked after this often, in s.
_PATIENCE = 0.02
#: Callbacks that rclpy's machinery serves before messages get their turn again.
_REST = 20


class TwinExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """In place of rclpy's SingleThreadedExecutor. ``spin_once`` serves all that is ready, not one
    callback, so that messages of one wait cost one wait."""

    def __init__(self, *, context: Context | None = None) -> None:
        self._list: WaitList | None = None
        self._stale = True
        self._looked = self._rested = time.monotonic()
        super().__init__(context=context)

    def add_node(self, node: Node) -> bool:
        """See the base class."""
        self._stale = True
        return bool(super().add_node(node))

    def remove_node(self, node: Node) -> None:
        """See the base class."""
        self._stale = True
        super().remove_node(node)

    def wake(self) -> None:
        """Entities were made or destroyed: the list is built anew before the next wait."""
        self._stale = True
        super().wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """See the base class."""
        if self._list is not None:
            self._list.release()
            self._list = None
        return bool(super().shutdown(timeout_sec))

    def spin_once(self, timeout_sec: float | TimeoutObject | None = None) -> None:
        """Wait for anything and serve everything that is ready. None or below 0 waits for ever."""
        if self._is_shutdown:
            return
        if not self._context.ok():
            raise ExternalShutdownException
        limit = timeout_sec.timeout if isinstance(timeout_sec, TimeoutObject) else timeout_sec
        if self._tasks and (limit is None or limit < 0 or limit > _PATIENCE):
            limit = _PATIENCE
        if self._list is None or self._stale:
            self._rebuild()
        assert self._list is not None
        self._list.wait(-1 if limit is None or limit < 0 else int(limit * 1e9))
        if self._is_shutdown:
            return
        if not self._context.ok():
            raise ExternalShutdownException
        if self._serve(self._list):
            self._serve_rest()

    def spin_once_until_future_complete(
        self, future: Future, timeout_sec: float | TimeoutObject | None = None
    ) -> None:
        """See the base class."""
        future.add_done_callback(lambda _: self.wake())
        self.spin_once(timeout_sec)

    def _rebuild(self) -> None:
        self._stale = False
        if self._list is not None:
            self._list.release()
        self._list = WaitList(self.get_nodes(), [self._guard, self._sigint_gc], self._context)

    def _serve(self, ready: WaitList) -> bool:
        """Serve messages and timers; whether anything else is left to rclpy's machinery."""
        rest = False
        wait_set = ready.wait_set
        messages = wait_set.get_ready_entities("subscription")
        for pointer in messages:
            subscription = ready.subscriptions.get(pointer)
            if subscription is None:
                rest = True
                continue
            take, kind, raw = subscription.handle.take_message, subscription.msg_type, subscription.raw
            for _ in range(_BURST):
                taken = take(kind, raw)
                if taken is None:
                    break
                subscription.callback(taken[0])
                if self._stale:
                    break
        for pointer in wait_set.get_ready_entities("timer"):
            timer = ready.timers.get(pointer)
            if timer is None:
                rest = True
            elif timer.handle.is_timer_ready():
                timer.handle.call_timer()
                timer.callback()
        for pointer in wait_set.get_ready_entities("guard_condition"):
            guard = ready.guards.get(pointer)
            if guard is None or guard.callback is not None:
                rest = True
            if guard is not None:
                guard._executor_triggered = guard.callback is not None
            rest = rest or bool(self._tasks)
        if rest or wait_set.get_ready_entities("service") or wait_set.get_ready_entities("client"):
            return True
        now = time.monotonic()
        if self._tasks and now - self._rested > _PATIENCE:
            return True
        if messages and now - self._looked <= _PATIENCE:
            return False
        self._looked = now
        return ready.any_event()

    def _serve_rest(self) -> None:
        """Let rclpy serve whatever is ready now."""
        self._rested = time.monotonic()
        for _ in range(_REST):
            try:
                handler, _, _ = self.wait_for_ready_callbacks(0.0)
            except (TimeoutException, ShutdownException):
                break
            handler()
            if handler.exception() is not None:
                raise handler.exception()
        self._cb_iter = None  # what it had found ready may no longer be
