# SPDX-License-Identifier: Apache-2.0
"""Recording from the page: the sensors' topics as they come, and the events marked, into one bag.

The node listens to these topics from its start on: a subscription that is made for a recording misses what is sent
until the publishers have found it.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from std_msgs.msg import String

from suspension_twin.addons.view.live import LiveView
from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import InputError, WorkError
from suspension_twin.files import unused
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.messages import SENSORS
from suspension_twin.nodes.topics import NS, SENSOR_QOS, STREAM_QOS, WARN, type_name

__all__ = ["SensorBag", "ViewRecorder"]

_EVENTS = "events"
#: s between two times that a recording is written out.
_FLUSHED = 1.0


class SensorBag:
    """One open recording; what was flushed stays, whatever happens.

    Raises InputError or WorkError where ``path`` cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts = {topic: 0 for _, topic, _ in SENSORS.values()}
        self._began = time.monotonic()
        self._stack = ExitStack()
        self._bag = self._stack.enter_context(BagWriter(path, live=True))
        self._rows: dict[str, tuple[list[int], list[bytes]]] = {t: ([], []) for t in self.counts}
        self._newest = 0

    @property
    def seconds(self) -> float:
        """Length so far."""
        return time.monotonic() - self._began

    def add(self, topic: str, data: bytes) -> None:
        """A serialised message of one of the topics."""
        # all of these begin with a header, behind four bytes that say the byte order
        sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
        ns = sec * NS + nanosec
        if ns <= 0:
            return
        stamps, messages = self._rows[topic]
        stamps.append(ns)
        messages.append(data)
        self.counts[topic] += 1
        self._newest = max(self._newest, ns)

    def flush(self) -> None:
        """Write out what has come so far."""
        for kind, topic, _ in SENSORS.values():
            stamps, messages = self._rows[topic]
            if stamps:
                self._bag.write_raw(topic, type_name(kind), np.array(stamps, dtype=np.int64), messages)
                self._rows[topic] = [], []
        self._bag.flush()

    def mark(self, text: str) -> None:
        """An event at the newest stamp."""
        data = serialize_message(String(data=text))
        self._bag.write_raw(_EVENTS, "std_msgs/msg/String", np.array([self._newest], dtype=np.int64), [data])

    def close(self) -> None:
        """Finish the recording. Raises WorkError, and leaves nothing, where no IMU sample came."""
        with self._stack:
            if not self.counts["imu/data_raw"]:
                self._bag.discard()
                raise WorkError("nothing was recorded: no message came on imu/data_raw")
            self.flush()


class ViewRecorder:
    """Records the sensors into one bag after another; ``recorded`` is the last one, at first that which is replayed."""

    def __init__(self, node: TwinNode, view: LiveView) -> None:
        self.bag: SensorBag | None = None
        self.recorded = Path(node.values["bag"]) if node.values["bag"] else None
        self.subscriptions: dict[str, Subscription] = {}
        self._node, self._view, self._flush_due = node, view, 0.0
        self._events = node.create_publisher(String, _EVENTS, 10)
        for kind, topic, _ in SENSORS.values():
            self._listen(kind, topic, STREAM_QOS)
        self._show()

    def _listen(self, kind: type, topic: str, qos: QoSProfile) -> None:
        """Subscribe reliably, for nothing may be missing from a recording, until a best-effort publisher is met, which
        a reliable subscription does not match."""
        handler: Callable[[bytes], None] = partial(self._on_sensor, topic)
        self.subscriptions[topic] = self._node.create_subscription(kind, topic, handler, qos, raw=True)

    def match(self) -> None:
        """Go on at best effort where a publisher offers no more."""
        for kind, topic, _ in SENSORS.values():
            if self.subscriptions[topic].qos_profile.reliability != ReliabilityPolicy.RELIABLE:
                continue
            offered = self._node.get_publishers_info_by_topic(topic)
            if any(p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for p in offered):
                self._node.destroy_subscription(self.subscriptions[topic])
                self._listen(kind, topic, SENSOR_QOS)

    def _on_sensor(self, topic: str, data: bytes) -> None:
        if self.bag is not None:
            self.bag.add(topic, data)

    def start(self) -> str:
        """Begin a recording."""
        if self.bag is not None:
            raise InputError("record", "is running already")
        self.bag = SensorBag(unused(Path(self._node.values["folder"]) / time.strftime("drive_%Y%m%d_%H%M%S")))
        self._show()
        return f"Recording into {self.bag.path}"

    def stop(self) -> str:
        """Finish it. Raises InputError where there is none, WorkError where it holds nothing."""
        bag, self.bag = self.bag, None
        if bag is None:
            raise InputError("stop", "nothing is being recorded")
        try:
            bag.close()
        finally:
            self._show()
        self.recorded = bag.path
        counts = ", ".join(f"{count} on {topic}" for topic, count in bag.counts.items() if count)
        return f"Recorded {bag.seconds:.0f} s into {bag.path}: {counts}"

    def mark(self) -> str:
        """An event, on the page and in the recording."""
        text = time.strftime("mark %H:%M:%S")
        self._view.mark(text)
        self._events.publish(String(data=text))
        if self.bag is None:
            return "Marked"
        self.bag.mark(text)
        return "Marked and recorded"

    def flush(self, now: float) -> None:
        """Write out what has come, about once a second."""
        if self.bag is None or now < self._flush_due:
            return
        self._flush_due = now + _FLUSHED
        try:
            self.bag.flush()
        except Exception as error:
            self._node.note("recording failed", WARN, f"recording: {error}")
        self._show()

    def finished(self) -> str:
        """Path of the last recording. Raises InputError while one is running and where there is none."""
        if self.bag is not None:
            raise InputError("record", "is still running: stop it first")
        if self.recorded is None:
            raise InputError("calibrate", "nothing was recorded yet: record a drive first")
        return str(self.recorded.resolve())

    def _show(self) -> None:
        on, seconds, path = False, 0.0, ""
        if self.bag is not None:
            on, seconds, path = True, round(self.bag.seconds, 1), str(self.bag.path)
        self._view.update("record", {"on": on, "seconds": seconds, "path": path})
