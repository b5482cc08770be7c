# SPDX-License-Identifier: Apache-2.0
"""Foxglove's WebSocket, seen by a client written from the protocol's description alone."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import pytest

pytest.importorskip("foxglove")

from aiohttp import ClientSession, WSMsgType
from geometry_msgs.msg import PoseStamped
from nodes_bench import put_stamp
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from std_msgs.msg import String

from suspension_twin.addons.nodes.foxglove_bridge import FoxgloveBridgeNode, definition
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.topics import LATCHED_QOS
from suspension_twin_interfaces.msg import Gap


class Viewer:
    """Subscribes ``topics`` as soon as they are advertised; ``channels`` by topic, ``messages`` (topic, ns, bytes)."""

    def __init__(self, port: int, topics: set[str]) -> None:
        self.port, self.topics = port, topics
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: list[tuple[str, int, bytes]] = []
        self.done = threading.Event()
        self.thread = threading.Thread(target=asyncio.run, args=(self._watch(),))
        self.thread.start()

    async def _watch(self) -> None:
        protocols = ("foxglove.sdk.v1", "foxglove.websocket.v1")
        url = f"http://127.0.0.1:{self.port}/"
        async with ClientSession() as session, session.ws_connect(url, protocols=protocols) as socket:
            while not self.done.is_set():
                try:
                    message = await socket.receive(timeout=0.1)
                except TimeoutError:
                    continue
                except asyncio.TimeoutError:
                    continue
                if message.type is WSMsgType.TEXT:
                    await self._on_text(socket, json.loads(message.data))
                elif message.type is WSMsgType.BINARY and message.data[0] == 1:
                    number, ns = struct.unpack_from("<IQ", message.data, 1)
                    topic = next(t for t, c in self.channels.items() if c["id"] == number)
                    self.messages.append((topic, ns, message.data[13:]))

    async def _on_text(self, socket: Any, said: dict[str, Any]) -> None:
        if said["op"] == "serverInfo":
            self.info = said
        for channel in said.get("channels", []) if said["op"] == "advertise" else []:
            self.channels[channel["topic"]] = channel
            if channel["topic"] in self.topics:
                wanted = {
                    "id": channel["id"],
                    "channelId": channel["id"],
                }  # its own id again for the subscription
                await asyncio.sleep(0.1)  # the server knows a channel some time after it has advertised it
                await socket.send_json({"op": "subscribe", "subscriptions": [wanted]})

    def read(self, topic: str, data: bytes) -> Any:
        """The message, by the definition that the server sent."""
        channel = self.channels[topic]
        assert channel["encoding"] == "cdr" and channel["schemaEncoding"] == "ros2msg"
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
        return store.deserialize_cdr(data, channel["schemaName"])

    def close(self) -> None:
        self.done.set()
        self.thread.join(5.0)


@pytest.fixture
def bridge(bench) -> FoxgloveBridgeNode:
    return bench.make(FoxgloveBridgeNode, port=0)


@pytest.fixture
def viewer(bridge) -> Iterator[Any]:
    made: list[Viewer] = []

    def watch(*topics: str) -> Viewer:
        made.append(Viewer(bridge.server.port, set(topics)))
        return made[-1]

    yield watch
    for one in made:
        one.close()


def test_messages_come_through_byte_for_byte_with_their_definition(bench, bridge, viewer):
    publisher = bench.side.create_publisher(PoseStamped, "twin/pose", 10)
    seen = viewer("/twin/pose")
    bench.until(lambda: publisher.get_subscription_count(), "the bridge to listen")
    for k in range(20):
        pose = put_stamp(PoseStamped(), 1000.0 + k)
        pose.header.frame_id, pose.pose.position.x, pose.pose.orientation.w = "map", 0.5 * k, 1.0
        publisher.publish(pose)
        bench.spin(0.01)
    bench.until(lambda: len(seen.messages) == 20, "all of them")
    last = seen.read(*(seen.messages[-1][i] for i in (0, 2)))
    assert last.header.frame_id == "map" and last.pose.position.x == 9.5 and last.header.stamp.sec == 1019
    assert seen.info["name"] == "suspension_twin"


def test_all_topics_of_the_model_are_there_and_what_was_latched_comes(bench, bridge, viewer, twin_path):
    bench.make(SuspensionModelNode, twin=str(twin_path))
    seen = viewer("/robot_description", "/tf_static")
    wanted = {
        "/twin/gap",
        "/twin/pose",
        "/joint_states",
        "/tf",
        "/twin/road",
        "/twin/gap_marker",
        "/diagnostics",
    }
    bench.until(lambda: wanted <= seen.channels.keys(), "the topics")
    bench.until(lambda: {t for t, _, _ in seen.messages} == seen.topics, "what was published before")
    text = next(seen.read(t, data).data for t, _, data in seen.messages if t == "/robot_description")
    assert text.startswith("<robot")
    assert "float64[] band_rms" in seen.channels["/twin/gap"]["schema"]


@pytest.mark.parametrize(
    ("host", "who"), [("127.0.0.1", "(no token: any program"), ("0.0.0.0", "everybody in")]
)
def test_the_first_line_says_who_may_read(bench, host, who, capfd):
    bench.make(FoxgloveBridgeNode, port=0, host=host)
    (line,) = [text for text in capfd.readouterr().err.splitlines() if "Foxglove" in text]
    assert f"ws://{host}:" in line and who in line


@pytest.mark.long
def test_only_what_is_watched_is_listened_to(bench, bridge, viewer):
    publisher = bench.side.create_publisher(String, "words", LATCHED_QOS)
    seen = viewer("/words")
    bench.until(lambda: publisher.get_subscription_count(), "the bridge to listen")
    seen.close()
    bench.until(lambda: not publisher.get_subscription_count(), "the bridge to leave")


@pytest.mark.parametrize(
    "name", ["sensor_msgs.msg.Imu", "tf2_msgs.msg.TFMessage", "visualization_msgs.msg.Marker"]
)
def test_definitions_have_the_fields_of_the_classes(name):
    package, _, kind = name.rpartition(".")
    message = getattr(import_module(package), kind)
    text = definition(message).partition("===")[0]
    for field in message.get_fields_and_field_types():
        assert f" {field}" in text


def test_the_twins_own_type_is_read_as_it_was_written():
    from rclpy.serialization import serialize_message

    gap = Gap(rms=0.25, band_low_hz=[0.5, 3.0], band_rms=[0.1, 0.2], samples=7)
    gap.header.frame_id = "base_link"
    name = "suspension_twin_interfaces/msg/Gap"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition(Gap), name))
    data = serialize_message(gap)
    read = store.types[name].__dataclass_fields__
    assert list(read)[: len(Gap.get_fields_and_field_types())] == list(Gap.get_fields_and_field_types())
    # the middleware pads the end, with up to three bytes of anything, which this reader takes for a fault
    again = store.deserialize_cdr(data[: data.rindex(b"\x07\0\0\0") + 4], name)
    assert (again.rms, again.samples, again.header.frame_id) == (0.25, 7, "base_link")
    assert list(again.band_rms) == [0.1, 0.2]


def test_the_layout_shows_topics_and_fields_that_there_are(repository):
    """Every path of the plots leads to a number of a message that the nodes publish."""
    from geometry_msgs.msg import AccelStamped
    from sensor_msgs.msg import JointState

    kinds = {
        "/imu/vertical_acceleration": AccelStamped,
        "/twin/vertical_acceleration": AccelStamped,
        "/joint_states": JointState,
        "/twin/gap": Gap,
    }
    layout = json.loads((repository / "config" / "foxglove_layout.json").read_text())
    panels = layout["configById"]
    paths = [
        path["value"] for name, panel in panels.items() if name.startswith("Plot!") for path in panel["paths"]
    ]
    assert len(paths) > 5
    for path in paths:
        topic, *fields = path.split(".")
        value = kinds[topic](position=[0.0] * 4) if topic == "/joint_states" else kinds[topic]()
        for field in fields:
            value = getattr(value, field.partition("[")[0])
        assert isinstance(value, float) or "[" in path

    def placed(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else placed(node["first"]) | placed(node["second"])

    assert placed(layout["layout"]) == set(panels)
