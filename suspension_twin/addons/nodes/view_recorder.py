# SPDX-License-Identifier: Apache-2.0
"""Recording from the page: the sensors' topics as they come, and the events marked, into one bag.

The node listens to these topics from its start on: a subscription that is made for a recording misses what is sent
until the publishers have found it.
"""

from __future__ import annotations

import struct
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from geometry_msgs.msg import QuaternionStamped, TwistStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import String

from suspension_twin.drive.write import BagWriter
from suspension_twin.errors import WorkError
from suspension_twin.nodes.topics import NS

__all__ = ["RECORDED", "ViewRecorder"]

#: What a recorded drive holds.
RECORDED = (
    (Imu, "imu/data_raw", "sensor_msgs/msg/Imu"),
    (NavSatFix, "fix", "sensor_msgs/msg/NavSatFix"),
    (TwistStamped, "vel", "geometry_msgs/msg/TwistStamped"),
    (QuaternionStamped, "heading", "geometry_msgs/msg/QuaternionStamped"),
)
EVENTS = "events"


class ViewRecorder:
    """Records what it is given while it is open; what was flushed stays, whatever happens.

    Raises InputError or WorkError where ``path`` cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.began = time.monotonic()
        self.counts = {topic: 0 for _, topic, _ in RECORDED}
        self._stack = ExitStack()
        self._bag = self._stack.enter_context(BagWriter(path, live=True))
        self._rows: dict[str, tuple[list[int], list[bytes]]] = {t: ([], []) for t in self.counts}
        self._newest = 0

    @property
    def seconds(self) -> float:
        """Length so far."""
        return time.monotonic() - self.began

    def add(self, topic: str, data: bytes) -> None:
        """A serialised message of one of the topics of ``RECORDED``."""
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
        """Write out what has come so far; to be called about once a second."""
        for _, topic, kind in RECORDED:
            stamps, messages = self._rows[topic]
            if stamps:
                self._bag.write_raw(topic, kind, np.array(stamps, dtype=np.int64), messages)
                self._rows[topic] = [], []
        self._bag.flush()

    def mark(self, text: str) -> None:
        """An event at the newest stamp."""
        data = serialize_message(String(data=text))
        self._bag.write_raw(EVENTS, "std_msgs/msg/String", np.array([self._newest], dtype=np.int64), [data])

    def close(self) -> None:
        """Finish the recording. Raises WorkError, and leaves nothing, where no IMU sample came."""
        with self._stack:
            if not self.counts["imu/data_raw"]:
                self._bag.discard()
                raise WorkError("nothing was recorded: no message came on imu/data_raw")
            self.flush()
