# SPDX-License-Identifier: Apache-2.0
"""The node that serves all topics on Foxglove's WebSocket, for Foxglove and Lichtblick, in a process of its own.

Messages go through as the bytes that they are (``cdr``), each topic with its definition (``ros2msg``). A topic is
subscribed while somebody watches it.
"""

from __future__ import annotations

import os
import re
import sys
import time
from functools import partial
from importlib import import_module
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from rosgraph_msgs.msg import Clock as ClockMessage

from suspension_twin.addons.sources.common.connection import is_local
from suspension_twin.errors import InputError
from suspension_twin.nodes.base import TwinNode
from suspension_twin.nodes.parameters import Param
from suspension_twin.nodes.topics import NS, Embedding, type_name
from suspension_twin_interfaces.msg import Gap

__all__ = ["FoxgloveBridgeNode", "definition"]

#: s between two looks at the graph.
_PERIOD = 1.0
#: Topics that say nothing of a twin.
_HIDDEN = ("/rosout", "/parameter_events")


class FoxgloveBridgeNode(TwinNode):
    """All topics of the graph in; Foxglove's WebSocket on ``host`` and ``port`` out."""

    parameters = (
        Param("host", "127.0.0.1", "Address to listen on; there is no password.", read_only=True),
        Param("port", 8765, "Port to listen on; 0: any free one.", 0, 65535, read_only=True),
        Param("parent", 0, "Process whose end ends this one; 0: none.", 0, 2**31 - 1, read_only=True),
    )

    def __init__(self, embedding: Embedding | None = None) -> None:
        super().__init__("foxglove_bridge", embedding)
        try:
            import foxglove
        except ImportError:
            raise InputError(
                "foxglove", 'is not installed: pip install "suspension-twin[foxglove]"'
            ) from None
        self._foxglove = foxglove
        self._sink = foxglove.Context()
        simulated = bool(self.get_parameter("use_sim_time").value)
        capabilities = [foxglove.Capability.Time] if simulated else []
        foxglove.set_log_level("CRITICAL")  # of every connection that is none it logs a line
        try:
            self.server = foxglove.start_server(
                name="suspension_twin",
                host=self.values["host"],
                port=self.values["port"],
                capabilities=capabilities,
                context=self._sink,
            )
        except RuntimeError as error:
            where = f"{self.values['host']}, port {self.values['port']}"
            raise InputError("foxglove", f"cannot listen on {where}: {error}") from None
        self._channels: dict[str, tuple[Any, Any]] = {}
        self._listened: dict[str, Subscription] = {}
        self._unknown: set[str] = set()
        if simulated:
            self.create_subscription(ClockMessage, "/clock", self._on_clock, 1)
        self.create_timer(_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._look()
        here = "any program and any website open on this machine"
        who = here if is_local(self.values["host"]) else f"everybody in the network, and {here},"
        line = f"Foxglove, Lichtblick: open a connection to ws://{self._address()}"
        print(f"{line} (no token: {who} may read every topic)", file=sys.stderr, flush=True)

    def _address(self) -> str:
        return f"{self.values['host']}:{self.server.port}"

    def destroy_node(self) -> None:
        """See the base class; viewers are disconnected."""
        self.server.stop()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def _on_clock(self, message: ClockMessage) -> None:
        self.server.broadcast_time(message.clock.sec * NS + message.clock.nanosec)

    def _look(self) -> None:
        """Offer new topics, subscribe those that are watched, and end with the parent."""
        parent = self.values["parent"]
        if parent and os.getppid() != parent:
            raise KeyboardInterrupt  # as a signal would end it
        for topic, kinds in self.get_topic_names_and_types():
            if topic not in self._channels and topic not in _HIDDEN and "/_action/" not in topic:
                self._offer(topic, kinds[0])
        for topic, (channel, kind) in self._channels.items():
            if channel.has_sinks() and topic not in self._listened:
                self._listened[topic] = self.create_subscription(
                    kind, topic, partial(self._on_message, channel), self._quality(topic), raw=True
                )
            elif not channel.has_sinks() and topic in self._listened:
                self.destroy_subscription(self._listened.pop(topic))

    def _offer(self, topic: str, name: str) -> None:
        if name in self._unknown:
            return
        package, group, kind = name.split("/")
        try:
            message = getattr(import_module(f"{package}.{group}"), kind)
            text = definition(message)
        except (ImportError, AttributeError, KeyError):
            self._unknown.add(name)
            return
        schema = self._foxglove.Schema(name=name, encoding="ros2msg", data=text.encode())
        channel = self._foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=self._sink)
        self._channels[topic] = channel, message

    def _quality(self, topic: str) -> QoSProfile:
        """As the publishers of the topic have it: what was latched comes to those who look late."""
        infos = self.get_publishers_info_by_topic(topic)
        latched = bool(infos) and all(
            i.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for i in infos
        )
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=200,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )

    def _on_message(self, channel: Any, data: bytes) -> None:
        channel.log(data, log_time=self.get_clock().now().nanoseconds or time.time_ns())

    def report(self) -> None:
        """See the base class."""
        self.health.values["address"] = f"ws://{self._address()}"
        self.health.values["topics watched"] = str(len(self._listened))


def definition(message: type) -> str:
    """The definition of a message's type with those of all types in it, as ``ros2msg`` wants it.

    Raises KeyError for a type that is neither among ROS's own nor among the twin's.
    """
    name = type_name(message)
    text, _ = _store().generate_msgdef(name, ros_version=2)
    return str(text)


#: Basic types: as a generated class names them, and as a definition does.
_BASIC = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}


def _store() -> Typestore:
    """ROS's own types and those of the twin."""
    store = get_typestore(Stores.ROS2_JAZZY)
    name = type_name(Gap)
    if name not in store.fielddefs:
        store.register(get_types_from_msg(_written(Gap), name))
    return store


def _written(message: Any) -> str:
    """The definition of a type of our own, from its class: with an installation by pip its file is not there."""
    fields: dict[str, str] = message.get_fields_and_field_types()
    return "".join(f"{_type(kind)} {field}\n" for field, kind in fields.items())


def _type(kind: str) -> str:
    if found := re.fullmatch(r"sequence<([\w/]+)>", kind):
        return f"{_type(found[1])}[]"
    if found := re.fullmatch(r"([\w/]+)\[(\d+)\]", kind):
        return f"{_type(found[1])}[{found[2]}]"
    return _BASIC.get(kind, kind)


if __name__ == "__main__":
    sys.exit(FoxgloveBridgeNode.main())
