# SPDX-License-Identifier: Apache-2.0
"""The layouts for RViz and PlotJuggler: what they name is published, with the type and durability that they ask for."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from importlib import import_module
from typing import Any

import pytest
import yaml
from rclpy.qos import DurabilityPolicy

from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.vehicle.twin import load_twin

DISPLAYS = {
    "RobotModel": "std_msgs/msg/String",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "Marker": "visualization_msgs/msg/Marker",
    "Odometry": "nav_msgs/msg/Odometry",
}
DURABILITY = {"Transient Local": DurabilityPolicy.TRANSIENT_LOCAL, "Volatile": DurabilityPolicy.VOLATILE}


@pytest.fixture
def publisher(bench, twin_path) -> Any:
    """What the graph knows of the only publisher of a topic of a running twin."""
    for kind in (ImuIngestNode, PoseInjectorNode, SuspensionModelNode):
        bench.make(kind, twin=str(twin_path))

    def ask(topic: str) -> Any:
        (found,) = bench.until(
            lambda: bench.side.get_publishers_info_by_topic(topic), f"a publisher of {topic}", 5.0
        )
        return found

    return ask


def test_rviz_shows_what_is_published(repository, publisher):
    layout = yaml.safe_load((repository / "config" / "suspension_twin.rviz").read_text())
    manager = layout["Visualization Manager"]
    shown = {}
    for display in manager["Displays"]:
        kind = display["Class"].removeprefix("rviz_default_plugins/")
        topic = display.get("Description Topic", display.get("Topic"))
        assert display["Enabled"] and (topic is not None) == (kind in DISPLAYS)
        if topic is None:
            continue
        found = publisher(topic["Value"])
        assert found.topic_type == DISPLAYS[kind]
        latched = DURABILITY[topic["Durability Policy"]] == DurabilityPolicy.TRANSIENT_LOCAL
        assert latched == (found.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)
        shown[kind] = topic["Value"]
    assert set(shown) == set(DISPLAYS)
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert manager["Views"]["Current"]["Target Frame"] == "base_link"


def test_plotjuggler_plots_what_is_published(repository, publisher, twin_path):
    layout = ElementTree.parse(repository / "config" / "plotjuggler_layout.xml")
    joints = [joint.name for joint in load_twin(twin_path).joints]
    names = [curve.attrib["name"] for curve in layout.iter("curve")]
    assert len(names) == len(set(names)) > 15
    for splitter in layout.iter("DockSplitter"):
        assert int(splitter.attrib["count"]) == len(splitter) == len(splitter.attrib["sizes"].split(";"))
    seen = set()
    for name in names:
        parts = name.strip("/").split("/")
        if parts[0] == "joint_states":  # by the names of the joints, as PlotJuggler shows them
            assert parts[1] in joints and parts[2] in ("position", "velocity")
            topic, fields = "/joint_states", []
        else:
            topic, fields = "/" + "/".join(parts[:2]), parts[2:]
        package, _, kind = publisher(topic).topic_type.split("/")
        value = getattr(import_module(f"{package}.msg"), kind)()
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float) or topic == "/joint_states"
        seen.add(topic)
    assert {"/imu/vertical_acceleration", "/twin/vertical_acceleration", "/twin/gap", "/joint_states"} <= seen
    # PlotJuggler drops the curves that have no data yet, unless the layout has it start to stream
    streamer = layout.find("previouslyLoaded_Streamer").attrib["name"]
    chosen = layout.find(f"Plugins/plugin[@ID='{streamer}']/selected_topics").attrib["value"]
    assert sorted(chosen.split(";")) == sorted(seen)
