# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a node: subscriptions, publishers, and direct links within one process.

In the composed process the four nodes pass each other the message objects that they publish. A hop
through the middleware costs more than all that the twin computes, so there is none between a
measurement and the simulated value of the same stamp. Rules that make this safe:

* A linked receiver copies what it needs and keeps no reference: the sender fills the same message
  object again for the next sample.
* Links are called first, publishing follows: the computation comes before the serialisation.
* A publisher without matched subscriptions is skipped. Nothing is lost by that, since a volatile
  publisher keeps no history for later subscriptions.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header

from suspension_twin.errors import InputError
from suspension_twin.live.twin import DigitalTwin

if TYPE_CHECKING:
    from suspension_twin.nodes.base import TwinNode

__all__ = [
    "ERROR",
    "LATCHED_QOS",
    "NS",
    "OK",
    "SENSOR_QOS",
    "STALE",
    "STREAM_QOS",
    "WARN",
    "Embedding",
    "Input",
    "InputState",
    "Message",
    "Outbox",
    "Output",
    "type_name",
]

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)
#: Messages over which the interval of the stamps and its deviation are averaged.
_INTERVALS = 50
#: Nanoseconds in a second.
NS = 1_000_000_000
#: As qos_profile_sensor_data, with a queue that covers a pause of the process of 0.6 s at 1.6 kHz.
SENSOR_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT
)
#: Messages of one topic taken in one callback, so that waiting ones do not cost a wait of the executor each.
_BURST = 50
#: ns: once messages are skipped, all that have waited longer.
_FRESH = 100_000_000
#: Reliable: game engines and dashboards do not connect to best-effort publishers. What a reliable subscriber did not
#: take from its socket, for it had to wait for a processor, is sent again: 10 s at 100 Hz, 0.6 s at 1.6 kHz.
STREAM_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.RELIABLE)
#: For what seldom changes: a subscription that comes later gets the newest one.
LATCHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def type_name(kind: type) -> str:
    """Name of a message's type as ROS writes it: ``sensor_msgs/msg/Imu``."""
    package, group, *_ = kind.__module__.split(".")
    return f"{package}/{group}/{kind.__name__}"


class Message(Protocol):
    """A message of any type; most have a header."""

    @property
    def header(self) -> Header: ...


class Outbox:
    """Messages to be published at the end of the callback that filled them. One for each thread of nodes."""

    def __init__(self) -> None:
        self._depth = 0
        self._waiting: list[tuple[Publisher, object]] = []
        self._later: dict[Callable[[], None], None] = {}

    def enter(self) -> None:
        """A callback begins."""
        self._depth += 1

    def leave(self) -> None:
        """A callback has ended; at the end of the outermost one all waiting messages are published."""
        self._depth -= 1
        if self._waiting and not self._depth:
            self.flush()
        if self._later and not self._depth:
            self._rest()

    def add(self, publisher: Publisher, message: object) -> None:
        """Publish ``message`` when the outermost callback ends; at once outside of any callback."""
        self._waiting.append((publisher, message))
        if not self._depth:
            self.flush()

    def later(self, work: Callable[[], None]) -> None:
        """Do ``work`` once behind the messages, when the outermost callback has ended; at once outside of any."""
        self._later[work] = None
        if not self._depth:
            self._rest()

    def _rest(self) -> None:
        waiting, self._later = self._later, {}
        for work in waiting:
            work()

    def flush(self) -> None:
        """Publish all waiting messages in the order in which they were added."""
        waiting, self._waiting = self._waiting, []
        for publisher, message in waiting:
            publisher.publish(message)


class Output:
    """One topic that a node publishes, and the handlers linked to it."""

    def __init__(self, publisher: Publisher, outbox: Outbox) -> None:
        self.publisher = publisher
        # Called for every message: the handle itself, without the publisher's lock around it.
        self._listeners: Callable[[], int] = publisher.handle.get_subscription_count
        self.links: list[Callable[[Message], None]] = []
        self.sent = 0
        self._outbox = outbox

    def send(self, message: Message, urgent: bool = False) -> None:
        """Call the links with ``message``, then publish it at the end of the outermost callback, until
        which it must not change; an ``urgent`` message is published at once, before the links."""
        self.sent += 1
        if urgent and self._listeners():
            self.publisher.publish(message)
        for link in self.links:
            link(message)
        if not urgent and self._listeners():
            self._outbox.add(self.publisher, message)

    @property
    def wanted(self) -> bool:
        """Whether there is any link or matched subscription."""
        return bool(self.links) or self._listeners() > 0


@dataclass(frozen=True)
class Embedding:
    """How a node is put into a process; the defaults are for a process of its own.

    ``linked`` names the inputs that another node of the process delivers directly, so that no
    subscription is made for them; ``twin`` and ``outbox`` are shared by all nodes of the process. ``clock_jumps``:
    reset the node when the ROS clock jumps back. Not wanted where the stamps are passed on directly
    and the clock follows behind them. ``bare``: the executor hands on messages without what the
    middleware knows about them (rclpy 7.1's events executor fails where a callback asks for it).
    """

    context: Context | None = None
    namespace: str = ""
    parameters: tuple[Parameter, ...] = ()
    linked: frozenset[str] = frozenset()
    outbox: Outbox | None = None
    clock_jumps: bool = True
    bare: bool = False
    twin: DigitalTwin | None = None


@dataclass
class InputState:
    """Statistics of one subscribed topic: ``rate`` Hz, ``silent_for`` s since the last message. A warning is
    given for a silent topic if it is ``expected``; ``why`` is the reason, if known. ``frame`` is that of the newest
    message; ``interval`` s between stamps and ``jitter`` s, their mean deviation from it, 0 while not known."""

    topic: str
    expected: bool
    received: int = 0
    rate: float = math.nan
    silent_for: float = 0.0
    warned: bool = False
    why: str = ""

    def __post_init__(self) -> None:
        self._counted, self._last = 0, math.nan
        self.frame, self.interval, self.jitter = "", 0.0, 0.0

    def stamped(self, seconds: float) -> None:
        """A stamp so many seconds after the newest one before it."""
        if not 0.0 < seconds < 1.0:
            return
        if not self.interval:
            self.interval = seconds
        self.interval += (seconds - self.interval) / _INTERVALS
        self.jitter += (abs(seconds - self.interval) - self.jitter) / _INTERVALS

    def measure(self, now: float, interval: float) -> None:
        """Update ``silent_for`` at ``now`` s and ``rate`` over the last ``interval`` s."""
        new = self.received - self._counted
        self._counted = self.received
        self.rate = new / interval if interval > 0 else math.nan
        if new or math.isnan(self._last) or now < self._last:
            self._last = now
        self.silent_for = now - self._last


def _waited(about: Mapping[str, int]) -> int:
    """ns that a message has waited in the queue, 0 where the middleware does not know."""
    received = about.get("received_timestamp") or 0
    return time.time_ns() - received if received > 0 else 0


class Input:
    """One subscribed topic. ``deliver`` takes a message from a subscription or from a linked output."""

    def __init__(self, node: TwinNode, state: InputState, handler: Callable[[Message, int], None]) -> None:
        self.state = state
        self.newest = 0
        #: None where a linked output delivers.
        self.subscription: Any = None
        self._node = node
        self._outbox = node.outbox
        self._handler = handler

    def receive(self, message: Message, about: Mapping[str, int]) -> None:
        """Deliver ``message`` and those that wait behind it in the queue of the subscription.

        A node that gets too little of the processor would answer ever later, until its queue is full: messages that
        have waited too long are skipped, up to the newest.
        """
        for _ in range(_BURST):
            if _waited(about) > self._node.max_backlog_ns and not self._node.simulated_time:
                message = self._newest(message)
            self.deliver(message)
            taken = self._take()
            if taken is None:
                return
            message, about = taken
        self.deliver(message)

    def receive_bare(self, message: Message) -> None:
        """:meth:`receive` where it is not known how long ``message`` has waited; of those behind it, it is."""
        self.receive(message, {})

    def _take(self) -> tuple[Message, Mapping[str, int]] | None:
        """The next message of the queue and what the middleware knows about it."""
        taken: tuple[Message, Mapping[str, int]] | None
        taken = self.subscription.handle.take_message(self.subscription.msg_type, False)
        return taken

    def _newest(self, message: Message) -> Message:
        """The first message of the queue that has not waited, else the last."""
        skipped = 0
        while (taken := self._take()) is not None:
            skipped, message = skipped + 1, taken[0]
            if _waited(taken[1]) < _FRESH:
                break
        if skipped:
            topic = self.state.topic
            text = f"this computer is too slow: messages on {topic} waited too long and were skipped"
            self._node.note(f"messages skipped on {topic}", WARN, text, skipped)
        return message

    def arrived(self, ns: int) -> None:
        """Count what the nodes of one process hand on without a message, stamped ``ns``."""
        self.state.received += 1
        self.newest = max(self.newest, ns)

    def deliver(self, message: Message) -> None:
        """Call the handler with ``message`` and its stamp in ns; never raises because of a message."""
        node, topic = self._node, self.state.topic
        if not node.active:
            return
        self.state.received += 1
        self._outbox.enter()
        try:
            stamp = message.header.stamp
            ns = stamp.sec * NS + stamp.nanosec
            if ns <= 0:
                raise InputError(topic, "message dropped: header.stamp is zero")
            if ns < self.newest - node.jump_back_ns:
                node.reset_to(f"the stamps of {topic} jumped back by {(self.newest - ns) / NS:.1f} s", ns)
            self.state.frame = message.header.frame_id
            if ns > self.newest:
                self.state.stamped((ns - self.newest) / NS)
                self.newest = ns
            self._handler(message, ns)
        except InputError as error:
            node.note(f"messages dropped on {topic}", WARN, str(error))
        except Exception as error:  # whatever a message causes, the next one is handled
            node.note(f"errors on {topic}", ERROR, f"{topic}: {type(error).__name__}: {error}")
        finally:
            self._outbox.leave()
