# SPDX-License-Identifier: Apache-2.0
"""Plays a recorded drive into the topics it came from, with ``/clock``, at any speed."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix

from suspension_twin.arrays import Floats
from suspension_twin.drive.repair import nanoseconds
from suspension_twin.drive.types import Drive
from suspension_twin.nodes._base import STREAM_QOS, Embedding
from suspension_twin.nodes._links import Outbox, Output
from suspension_twin.nodes._recorded import Fill, fill_fix, fill_heading, fill_imu, fill_velocity

__all__ = ["BagPlayer"]

_NS = 1_000_000_000
#: Most messages a second of real time on /clock.
_CLOCK_RATE = 100.0
#: At full speed: seconds of work before the executor gets its turn, and samples before
#: subscribers outside are waited for.
_SLICE = 0.02
_UNACKNOWLEDGED = STREAM_QOS.depth // 2


class BagPlayer(Node):  # type: ignore[misc]
    """Publishes ``imu/data_raw``, ``fix``, ``vel``, ``heading`` in the order of their stamps.

    ``rate`` times real time; ``math.inf`` as fast as the linked nodes take the messages and
    subscribers outside acknowledge them, so that nothing is lost. With ``loop`` it begins again at
    the end, and time jumps back. The first message waits for ``delay`` s, in which others find it.
    """

    def __init__(
        self, drive: Drive, rate: float, loop: bool, embedding: Embedding, delay: float = 0.0
    ) -> None:
        super().__init__(
            "bag_player",
            context=embedding.context,
            namespace=embedding.namespace or None,
            use_global_arguments=embedding.use_global_arguments,
        )
        self.rate = rate
        self.loop = loop
        self.loops = 0
        self.done = False
        #: Publishers whose subscribers full speed waits for.
        self.watched: list[Publisher] = []
        self._outbox = embedding.outbox or Outbox()
        self._clock_out = self.create_publisher(Clock, "/clock", 10)
        self.outputs: dict[str, Output] = {}
        fills = (
            self._role(Imu, "imu/data_raw", fill_imu(drive)),
            self._role(NavSatFix, "fix", fill_fix(drive)),
            self._role(TwistStamped, "vel", fill_velocity(drive)),
            self._role(QuaternionStamped, "heading", fill_heading(drive)),
        )
        stamps = [drive.imu.t, drive.fix.t, drive.velocity.t]
        stamps.append(np.empty(0) if drive.heading is None else drive.heading.t)
        self._fills = fills
        self._ns, self._kind, self._index = _schedule(stamps)
        self.start = int(self._ns[0])
        self.end = int(self._ns[-1])
        self.reset(delay)

    def _role(self, kind: type, topic: str, fill: Fill) -> tuple[Output, Any, Any]:
        output = Output(self.create_publisher(kind, topic, STREAM_QOS), self._outbox)
        self.outputs[topic] = output
        return output, kind(), fill

    def reset(self, delay: float = 0.0) -> None:
        """Back to the beginning, which is ``delay`` s from now."""
        self._next = 0
        self._began = time.monotonic() + delay
        self._clock_due = 0.0
        self._unacknowledged = 0

    @property
    def position(self) -> float:
        """Seconds of the drive played so far."""
        return (int(self._ns[min(self._next, self._ns.size - 1)]) - self.start) / _NS

    @property
    def duration(self) -> float:
        """Seconds of the whole drive."""
        return (self.end - self.start) / _NS

    def play(self) -> float:
        """Send what is due; seconds until something is due again (0 at full speed, inf at the end)."""
        if self.done:
            return math.inf
        until = time.monotonic() + _SLICE
        if until < self._began:
            return self._began - until
        while self._next < self._ns.size:
            now = time.monotonic()
            if self.rate < math.inf:
                due = self._began + (int(self._ns[self._next]) - self.start) / _NS / self.rate
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
        output, message, fill = self._fills[self._kind[number]]
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(ns, _NS)
        fill(message, int(self._index[number]))
        output.send(message)
        self._unacknowledged += 1
        if self.rate == math.inf and self._unacknowledged >= _UNACKNOWLEDGED:
            self.settle(1.0)

    def settle(self, patience: float) -> None:
        """Wait until subscribers outside have acknowledged everything, at most ``patience`` s each."""
        self._unacknowledged = 0
        for publisher in (*self.watched, *(o.publisher for o in self.outputs.values())):
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked(Duration(seconds=patience))

    def _send_clock(self, now: float, force: bool = False) -> None:
        if not force and now < self._clock_due:
            return
        self._clock_due = now + 1.0 / _CLOCK_RATE
        if self.rate < math.inf:
            ns = self.start + int((now - self._began) * self.rate * _NS)
            ns = min(ns, self.end)
        else:
            ns = int(self._ns[min(self._next, self._ns.size - 1)])
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(ns, _NS)
        self._clock_out.publish(message)

    def _end(self) -> None:
        self._send_clock(time.monotonic(), force=True)
        self.settle(1.0)
        self.loops += 1
        if self.loop:
            self.reset()
        else:
            self.done = True


def _schedule(stamps: list[Floats]) -> tuple[NDArray[np.int64], NDArray[np.int8], NDArray[np.int64]]:
    """All messages in the order of their stamps; what was recorded late is sent late."""
    ns = [nanoseconds(t) for t in stamps]
    when = [np.maximum.accumulate(part) if part.size else part for part in ns]
    kind = np.concatenate([np.full(part.size, k, dtype=np.int8) for k, part in enumerate(ns)])
    index = np.concatenate([np.arange(part.size) for part in ns])
    # The slower topics first: a fix belongs before the sample of the same stamp.
    order = np.lexsort((-kind, np.concatenate(when)))
    return np.concatenate(ns)[order], kind[order], index[order]
