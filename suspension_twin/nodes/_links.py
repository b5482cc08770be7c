# SPDX-License-Identifier: Apache-2.0
"""What a node sends: to handlers in the same process at once, to topics in the order of urgency.

In the composed process the four nodes hand each other the very message objects that they publish.
A hop through the middleware costs more than everything the twin computes, so none lies between
a measurement and the twin's answer to it. Rules that make this safe:

* A message handed on is borrowed: the receiver takes what it needs and keeps no reference,
  because the sender fills the same object again for the next sample.
* Links come first, publishing after: what the chain has to say is out before the bookkeeping.
* Nobody listens, nothing is serialised: a publisher without matched subscriptions is skipped,
  which loses nothing, since a volatile publisher keeps no history for whom is yet to come.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.publisher import Publisher

__all__ = ["Outbox", "Output"]


class Outbox:
    """Messages that wait until the callback that made them is done. One for each thread of nodes."""

    def __init__(self) -> None:
        self._depth = 0
        self._waiting: list[tuple[Publisher, Any]] = []

    def enter(self) -> None:
        """A callback begins."""
        self._depth += 1

    def leave(self) -> None:
        """A callback has ended; after the outermost one everything that waits goes out."""
        self._depth -= 1
        if self._waiting and not self._depth:
            self.flush()

    def add(self, publisher: Publisher, message: Any) -> None:
        """Publish ``message`` when the outermost callback ends, or at once outside of any."""
        self._waiting.append((publisher, message))
        if not self._depth:
            self.flush()

    def flush(self) -> None:
        """Publish everything that waits, in the order in which it came."""
        waiting, self._waiting = self._waiting, []
        for publisher, message in waiting:
            publisher.publish(message)


class Output:
    """One topic that a node publishes, and the handlers linked to it."""

    def __init__(self, publisher: Publisher, outbox: Outbox) -> None:
        self.publisher = publisher
        # Asked for every message: the handle itself, without the publisher's guards around it.
        self._listeners: Callable[[], int] = publisher.handle.get_subscription_count
        self.links: list[Callable[[Any], None]] = []
        self.sent = 0
        self._outbox = outbox

    def send(self, message: Any, urgent: bool = False) -> None:
        """Hand ``message`` to the links, then publish it: at once if ``urgent``, else when the
        outermost callback ends. It must not change before that."""
        self.sent += 1
        if urgent and self._listeners():
            self.publisher.publish(message)
        for link in self.links:
            link(message)
        if not urgent and self._listeners():
            self._outbox.add(self.publisher, message)

    @property
    def wanted(self) -> bool:
        """Whether anybody takes what is sent."""
        return bool(self.links) or self._listeners() > 0
