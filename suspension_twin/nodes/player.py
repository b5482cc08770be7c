# SPDX-License-Identifier: Apache-2.0
"""The node that replays a recorded drive on the topics of the sensors, with ``/clock``, at any speed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock as SystemClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from suspension_twin.drive.types import Drive, HeadingData
from suspension_twin.live.twin import schedule
from suspension_twin.nodes.messages import SENSORS
from suspension_twin.nodes.topics import NS, STREAM_QOS, Embedding, Outbox, Output

__all__ = ["BagPlayer"]

#: Largest rate of /clock in Hz of real time.
_CLOCK_RATE = 100.0
#: At full speed: time in s before the executor gets its turn, and messages before the acknowledgement of subscribers is
#: waited for (tolerance: a small part of what the streams keep).
_SLICE = 0.02
_UNACKNOWLEDGED = 50
#: A jump back of less than this in s is made one of this, for the nodes take stamps that are a little older for late
#: ones, see the parameter jump_back.
_LEAST_BACK = 1.5
#: Range of the parameter ``rate``; 0 is full speed.
_FASTEST = 1000.0
#: s between two messages on /diagnostics.
_REPORT_EVERY = 0.5


class BagPlayer(Node):  # type: ignore[misc]
    """Publishes ``imu/data_raw``, ``fix``, ``vel``, ``heading`` in the order of their stamps.

    ``rate`` times real time; ``math.inf`` as fast as the linked nodes take the messages and other
    subscribers acknowledge them, so that nothing is lost. With ``loop`` it begins again at the end,
    and time jumps back. The first message is sent after ``delay`` s, in which subscribers connect, or as soon as
    ``paused`` is set to false. With ``stay`` the player waits at the end to be sent back.

    While it plays it is led by its parameters: ``rate``, ``paused``, and ``seek``, which goes to a position in s. It
    reports its position on ``/diagnostics``.
    """

    def __init__(
        self,
        drive: Drive,
        rate: float,
        loop: bool,
        embedding: Embedding,
        delay: float = 0.0,
        stay: bool = False,
    ) -> None:
        super().__init__(
            "bag_player",
            context=embedding.context,
            namespace=embedding.namespace or None,
        )
        self.rate = rate
        self.loop = loop
        self.stay = stay
        self.paused = False
        #: Whether it waits at the end.
        self.ended = False
        #: How often it has begun anew.
        self.loops = 0
        self.done = False
        #: Further publishers whose subscribers are waited for at full speed.
        self.watched: list[Publisher] = []
        self._outbox = embedding.outbox or Outbox()
        self._clock_out = self.create_publisher(Clock, "/clock", 10)
        self.outputs: dict[str, Output] = {}
        heading = drive.heading or HeadingData(np.empty(0), np.empty(0))
        self._roles: list[tuple[Output, Any, Callable[[Any, int], None]]] = []
        streams = (drive.imu, drive.fix, drive.velocity, heading)
        for (kind, topic, fill), samples in zip(SENSORS.values(), streams, strict=True):
            output = self.outputs[topic] = Output(
                self.create_publisher(kind, topic, STREAM_QOS), self._outbox
            )
            self._roles.append((output, kind(), partial(fill, samples)))
        self._ns, self._kind, self._index = schedule(drive)
        self._when = np.maximum.accumulate(self._ns)
        self.start = int(self._ns[0])
        self.end = int(self._ns[-1])
        self.reset(delay)
        self._declare()

    def _declare(self) -> None:
        def number(name: str, value: float, text: str, high: float) -> None:
            bounds = FloatingPointRange(from_value=0.0, to_value=high)
            self.declare_parameter(
                name, value, ParameterDescriptor(description=text, floating_point_range=[bounds])
            )

        rate = min(self.rate, _FASTEST) if math.isfinite(self.rate) else 0.0
        number("rate", rate, "Times real time; 0: as fast as no message gets lost.", _FASTEST)
        number("seek", 0.0, "Setting it goes to this position in s.", self.duration)
        self.declare_parameter("paused", False, ParameterDescriptor(description="Whether the replay rests."))
        self.add_on_set_parameters_callback(self._on_set)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(_REPORT_EVERY, self._report, clock=SystemClock(clock_type=ClockType.STEADY_TIME))

    def _report(self) -> None:
        values = {
            "start (ns)": str(self.start),
            "position": f"{self.position:.3f}",
            "duration": f"{self.duration:.3f}",
            "rate": f"{self.rate:g}",
            "paused": str(self.paused),
            "ended": str(self.ended),
            "waiting": str(self.waiting),
        }
        resting = {"paused": self.paused, "at the end": self.ended, "waiting to be started": self.waiting}
        status = DiagnosticStatus(
            name=self.get_fully_qualified_name().lstrip("/"),
            hardware_id="suspension_twin",
            message=next((words for words, holds in resting.items() if holds), "playing"),
            values=[KeyValue(key=k, value=v) for k, v in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "rate":
                self.set_rate(parameter.value or math.inf)
            elif parameter.name == "paused":
                self.pause(parameter.value)
            elif parameter.name == "seek":
                self.seek(parameter.value)
        return SetParametersResult(successful=True)

    def set_rate(self, rate: float) -> None:
        """Go on from here at ``rate`` times real time, ``math.inf`` at full speed."""
        self.rate = rate
        self._go_on_from(self.position)

    def pause(self, paused: bool) -> None:
        """Rest, or go on; begin now where it waits to begin."""
        if paused and not self.paused:
            self._stopped_at = self.position
        elif not paused and (self.paused or self.waiting):
            self._go_on_from(self._stopped_at)
        self.paused = paused

    def seek(self, position: float) -> None:
        """Go to ``position`` s of the drive; backwards at least so far that the nodes see a jump."""
        if 0.0 < self.position - position < _LEAST_BACK:
            position = self.position - _LEAST_BACK
        position = min(max(position, 0.0), self.duration)
        self._next = int(np.searchsorted(self._when, self.start + int(position * NS)))
        self.ended = False
        self._stopped_at = position
        self._go_on_from(position)

    def _go_on_from(self, position: float) -> None:
        self._began = time.monotonic() - (position / self.rate if self.rate < math.inf else 0.0)
        self._clock_due = 0.0

    def reset(self, delay: float = 0.0) -> None:
        """Back to the beginning, which is ``delay`` s from now."""
        self._next = 0
        self._stopped_at = 0.0
        self._began = time.monotonic() + delay
        self._clock_due = 0.0
        self._unacknowledged = 0

    @property
    def waiting(self) -> bool:
        """Whether it has not begun yet."""
        return self._next == 0 and not self.paused and time.monotonic() < self._began

    @property
    def resting(self) -> bool:
        """Whether it stands, and ``/clock`` with it."""
        return self.paused or self.ended or self.waiting

    @property
    def position(self) -> float:
        """Seconds of the drive played so far."""
        return (int(self._ns[min(self._next, self._ns.size - 1)]) - self.start) / NS

    @property
    def duration(self) -> float:
        """Seconds of the whole drive."""
        return (self.end - self.start) / NS

    def play(self) -> float:
        """Send all messages that are due; returns the time in s until the next one (0 at full speed, inf at the
        end)."""
        if self.done or self.paused or self.ended:
            return math.inf
        until = time.monotonic() + _SLICE
        if until < self._began:
            return self._began - until
        while self._next < self._ns.size:
            now = time.monotonic()
            if self.rate < math.inf:
                due = self._began + (int(self._ns[self._next]) - self.start) / NS / self.rate
                if due > now:
                    self._send_clock(now)
                    return due - now
            if now > until:
                return 0.0
            self._send(self._next)
            self._next += 1
            self._send_clock(now)
        self._end()
        return math.inf if self.done else 0.0

    def _send(self, number: int) -> None:
        ns = int(self._ns[number])
        output, message, fill = self._roles[self._kind[number]]
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(ns, NS)
        fill(message, int(self._index[number]))
        output.send(message)
        self._unacknowledged += 1
        if self.rate == math.inf and self._unacknowledged >= _UNACKNOWLEDGED:
            self.settle(1.0)

    def settle(self, patience: float) -> None:
        """Wait until all subscribers have acknowledged all messages, at most ``patience`` s per publisher."""
        self._unacknowledged = 0
        for publisher in (*self.watched, *(o.publisher for o in self.outputs.values())):
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked(Duration(seconds=patience))

    def _send_clock(self, now: float, force: bool = False) -> None:
        if not force and now < self._clock_due:
            return
        self._clock_due = now + 1.0 / _CLOCK_RATE
        if self.rate < math.inf:
            ns = min(self.start + int((now - self._began) * self.rate * NS), self.end)
        else:
            ns = int(self._ns[min(self._next, self._ns.size - 1)])
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(ns, NS)
        self._clock_out.publish(message)

    def _end(self) -> None:
        self._send_clock(time.monotonic(), force=True)
        self.settle(1.0)
        if self.loop:
            self.loops += 1
            self.reset()
        elif self.stay:
            self.ended = True
        else:
            self.done = True
