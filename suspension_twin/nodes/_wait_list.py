# SPDX-License-Identifier: Apache-2.0
"""What an executor waits for, kept from one wait to the next."""

from __future__ import annotations

import inspect
from contextlib import ExitStack
from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities

__all__ = ["WaitList"]


class WaitList:
    """Every entity of some nodes, kept from destruction while it is waited for."""

    def __init__(self, nodes: list[Node], guards: list[Any], context: Context) -> None:
        self._held = ExitStack()
        subscriptions = [s for n in nodes for s in n.subscriptions if self._hold(s.handle)]
        timers = [t for n in nodes for t in n.timers if self._hold(t.handle)]
        guards = [g for g in (*guards, *(g for n in nodes for g in n.guards)) if self._hold(g.handle)]
        services = [s.handle for n in nodes for s in n.services if self._hold(s.handle)]
        clients = [c.handle for n in nodes for c in n.clients if self._hold(c.handle)]
        self._waitables = [w for n in nodes for w in n.waitables if self._hold(w)]
        self._hold(context.handle)
        count = NumberOfEntities(len(subscriptions), len(guards), len(timers), len(clients), len(services))
        for waitable in self._waitables:
            count += waitable.get_num_entities()
        self.wait_set = _rclpy.WaitSet(
            count.num_subscriptions,
            count.num_guard_conditions,
            count.num_timers,
            count.num_clients,
            count.num_services,
            count.num_events,
            context.handle,
        )
        self._events = count.num_events
        add = self.wait_set
        self._adders = (
            [(add.add_subscription, s.handle) for s in subscriptions]
            + [(add.add_timer, t.handle) for t in timers]
            + [(add.add_guard_condition, g.handle) for g in guards]
            + [(add.add_service, s) for s in services]
            + [(add.add_client, c) for c in clients]
        )
        self.subscriptions = {s.handle.pointer: s for s in subscriptions if _is_plain(s)}
        self.timers = {t.handle.pointer: t for t in timers if not inspect.iscoroutinefunction(t.callback)}
        self.guards = {g.handle.pointer: g for g in guards}

    def _hold(self, handle: Any) -> bool:
        try:
            self._held.enter_context(handle)
        except InvalidHandle:
            return False
        return True

    def release(self) -> None:
        """Let go of everything: what was to be destroyed meanwhile is destroyed now."""
        self._held.close()

    def wait(self, timeout_ns: int) -> None:
        """Until anything is ready, at most ``timeout_ns``; for ever below 0."""
        self.wait_set.clear_entities()
        for add, handle in self._adders:
            add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(self.wait_set)
        self.wait_set.wait(timeout_ns)

    def any_event(self) -> bool:
        """Whether a QoS event is ready."""
        ready = self.wait_set.is_ready
        return any(ready("event", index) for index in range(self._events))


def _is_plain(subscription: Subscription) -> bool:
    """Takes the message alone, and returns when it is done."""
    takes_message = subscription._callback_type is Subscription.CallbackType.MessageOnly
    return takes_message and not inspect.iscoroutinefunction(subscription.callback)
