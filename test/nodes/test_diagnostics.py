# SPDX-License-Identifier: Apache-2.0
"""The messages on /diagnostics: a status for each thing, its level and the sensor that it is about."""

from __future__ import annotations

import time
from typing import Any

import yaml
from geometry_msgs.msg import AccelStamped
from nav_msgs.msg import Odometry
from nodes_bench import put_stamp
from test_pose_injector import T0, imu, straight

from suspension_twin.nodes.base import HARDWARE
from suspension_twin.nodes.composed import KINDS
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.vehicle.twin import load_twin, save_twin

OK, WARN, STALE = b"\x00", b"\x01", b"\x03"


def shown(node: Any) -> dict[str, Any]:
    """Every status of a node by its thing, the node's own by the empty name."""
    node.report()
    prefix = node.get_name()
    return {s.name.removeprefix(prefix).removeprefix(": "): s for s in node.health.statuses()}


def values(status: Any) -> dict[str, float]:
    return {pair.key: float(pair.value) for pair in status.values}


def test_the_imu_has_a_rate_and_a_jitter_of_its_own(bench):
    node = bench.make(ImuIngestNode)
    before = shown(node)
    assert before["rate"].level == STALE and before["stamp jitter"].level == OK
    for k in range(400):
        message = imu(T0 + k / 100)
        message.header.frame_id = "imu_link"
        node.inputs["imu/data_raw"].deliver(message)
    found = shown(node)
    assert found["rate"].level == OK and abs(values(found["rate"])["rate Hz"] - 100.0) < 0.5
    assert found["stamp jitter"].level == OK and values(found["stamp jitter"])["jitter ms"] < 0.1
    for thing in ("rate", "stamp jitter", "imu/data_raw"):
        assert found[thing].hardware_id == f"{HARDWARE}: imu_link"
    assert found[""].hardware_id == HARDWARE
    for k in range(400):  # in bursts of four
        message = imu(T0 + 4.0 + 0.04 * (k // 4) + 0.0005 * (k % 4))
        node.inputs["imu/data_raw"].deliver(message)
    assert shown(node)["stamp jitter"].level == WARN


def test_pose_and_gap_have_theirs(bench, twin_path):
    pose = bench.make(PoseInjectorNode)
    assert {shown(pose)[thing].level for thing in ("latency", "datum")} == {STALE}
    straight(pose, 3.0)
    found = shown(pose)
    assert found["latency"].level == found["datum"].level == OK and "47.4" in found["datum"].message
    model = bench.make(SuspensionModelNode, twin=str(twin_path))
    assert {shown(model)[thing].level for thing in ("gap", "excitation")} == {STALE}


def test_it_says_by_how_much_the_twin_is_behind_the_car_and_why(bench, twin_path, twin, tmp_path):
    late = load_twin(twin_path).with_changes({"imu.latency": 0.02})
    save_twin(late, tmp_path / "twin.yaml")
    model = bench.make(SuspensionModelNode, twin=str(tmp_path / "twin.yaml"))
    assert "latency" not in shown(model)
    for _ in range(300):
        t = time.time() - 0.030
        odom, felt = put_stamp(Odometry(), t), put_stamp(AccelStamped(), t)
        odom.header.frame_id, odom.pose.pose.orientation.w = "map", 1.0
        model.inputs["twin/odom"].deliver(odom)
        model.inputs["imu/vertical_acceleration"].deliver(felt)
    found = values(shown(model)["latency"])
    assert found["sensor ms"] == 20.0 and abs(found["low pass ms"] - 11.3) < 0.3
    assert 29.0 < found["age ms"] < 60.0


def test_a_topic_that_is_silent_is_stale(bench):
    node = bench.make(ImuIngestNode, silence_timeout=0.1)
    node._measure_inputs()
    bench.until(lambda: (node._measure_inputs(), shown(node)["imu/data_raw"].level == STALE)[1], "silence")
    assert shown(node)[""].level == WARN


def test_each_status_has_one_place_in_the_tree(bench, repository, twin_path):
    file = repository / "config" / "diagnostics_analyzers.yaml"
    tree = yaml.safe_load(file.read_text(encoding="utf-8"))["analyzers"]["ros__parameters"]
    kinds = {name: part["contains"] for name, part in tree.items() if isinstance(part, dict)}
    for kind in KINDS.values():
        node = bench.make(kind, namespace="car_1", twin=str(twin_path))
        node.report()
        for status in node.health.statuses():
            places = [n for n, words in kinds.items() if any(word in status.name for word in words)]
            assert len(places) == 1, status.name
