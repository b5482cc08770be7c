# SPDX-License-Identifier: Apache-2.0
"""The raw messages of a recording by topic, whatever its format, and their decoding into arrays."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from suspension_twin.drive.cdr import Decoded, Encoding, decode, ros1_types, types_with
from suspension_twin.drive.unpack import ZSTD_MAGIC, Budget, inflate
from suspension_twin.errors import printable

__all__ = ["Contents", "RawTopic", "decode_topic", "topic_name", "type_name"]


def topic_name(name: str) -> str:
    """Absolute name of a topic: ``imu/data_raw`` and ``/imu/data_raw`` are one."""
    return "/" + "/".join(part for part in name.split("/") if part)


def type_name(name: str) -> str:
    """Full name of a type: ``sensor_msgs/Imu`` and ``sensor_msgs/msg/Imu`` are one."""
    parts = name.split("/")
    return "/".join((parts[0], "msg", parts[1])) if len(parts) == 2 else name


@dataclass
class RawTopic:
    """Messages of one topic in file order: record stamps in ns and their bytes."""

    msgtype: str
    stamps: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)

    def add(self, stamp: int, data: bytes) -> None:
        """One message more."""
        self.stamps.append(stamp)
        self.data.append(data)


@dataclass
class Contents:
    """Messages of the topics ``wanted`` (all if None), and the names and types of all topics.

    ``types`` maps every topic of the recording to its type, ``definitions`` a type to its text where the file embeds
    it as ROS 2 ``.msg`` text; ``warnings`` has a line for everything that was lost, ``budget`` limits the unpacking.
    """

    encoding: Encoding
    wanted: Collection[str] | None
    topics: dict[str, RawTopic] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    budget: Budget = field(default_factory=lambda: Budget("recording", 0))

    def wants(self, name: str) -> bool:
        """Whether the messages of a topic are to be read."""
        return self.wanted is None or topic_name(name) in self.wanted

    def open_topic(self, name: str, msgtype: str, encoding: str) -> RawTopic | None:
        """Announce a topic; returns where to put its messages, or None if they are not read.

        Of two types on one topic the first is read. Messages in another encoding than the recording's
        are not read; the type then names the encoding.
        """
        # the names in a damaged file may hold anything, and are shown to the user
        name, msgtype = topic_name(printable(name)), type_name(printable(msgtype))
        if encoding != self.encoding:
            msgtype = f"{printable(encoding[:40])} messages"
        if self.types.setdefault(name, msgtype) != msgtype:
            self.warnings.append(f"{name} carries a second type, {msgtype}: left out")
            return None
        if encoding != self.encoding or not self.wants(name):
            return None
        return self.topics.setdefault(name, RawTopic(msgtype))

    def finish(self) -> None:
        """Sort every topic by time of recording (files may interleave) and decompress its messages."""
        for topic in self.topics.values():
            order = sorted(range(len(topic.stamps)), key=topic.stamps.__getitem__)
            topic.stamps = [topic.stamps[i] for i in order]
            topic.data = [topic.data[i] for i in order]
            if topic.data and topic.data[0].startswith(ZSTD_MAGIC):  # rosbag2's compression mode MESSAGE
                topic.data = [inflate("zstd", data, self.budget)[0] for data in topic.data]


def decode_topic(contents: Contents, name: str) -> list[Decoded]:
    """Messages of one topic as arrays, a group for each byte layout (usually one).

    Empty where the topic has no messages; damaged ones are left out with a warning.
    """
    name = topic_name(name)
    topic = contents.topics.get(name)
    if topic is None or not topic.data:
        return []
    known = (
        {topic.msgtype: contents.definitions[topic.msgtype]} if topic.msgtype in contents.definitions else {}
    )
    store = ros1_types() if contents.encoding == "ros1" else types_with(known)
    groups = list(decode(store, topic.msgtype, topic.data, contents.encoding))
    lost = len(topic.data) - sum(group.index.size for group in groups)
    if lost:
        contents.warnings.append(f"{name}: {lost} of {len(topic.data)} messages are damaged: left out")
    return groups
