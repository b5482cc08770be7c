# SPDX-License-Identifier: Apache-2.0
"""The lifecycle of the nodes, driven by a client as ``ros2 lifecycle`` and nav2's lifecycle manager do it."""

from __future__ import annotations

from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from nodes_bench import worst
from rclpy.parameter import Parameter
from test_pose_injector import T0, straight, tap

from suspension_twin.errors import InputError
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin_interfaces.srv import SetDatum

KINDS = (ImuIngestNode, PoseInjectorNode, SuspensionModelNode, CalibratorNode)


def state(bench: Any, node: Any) -> str:
    return str(bench.call(GetState, f"{node.get_name()}/get_state", GetState.Request()).current_state.label)


def change(bench: Any, node: Any, name: str) -> bool:
    request = ChangeState.Request(transition=Transition(label=name))
    return bool(bench.call(ChangeState, f"{node.get_name()}/change_state", request).success)


@pytest.mark.parametrize("kind", KINDS)
def test_a_client_leads_a_node_through_every_transition_twice(bench, kind, twin_path):
    node = bench.make(kind, twin=str(twin_path), autostart=False)
    for _ in range(2):
        for name, after in (
            ("configure", "inactive"),
            ("activate", "active"),
            ("deactivate", "inactive"),
            ("activate", "active"),
            ("deactivate", "inactive"),
            ("cleanup", "unconfigured"),
        ):
            assert change(bench, node, name), name
            assert state(bench, node) == after and node.active == (after == "active")
    offered = GetAvailableTransitions.Request()
    known = bench.call(
        GetAvailableTransitions, f"{node.get_name()}/get_available_transitions", offered
    ).available_transitions
    assert {t.transition.label for t in known} >= {"configure", "shutdown"}
    assert change(bench, node, "shutdown") and state(bench, node) == "finalized"


@pytest.mark.parametrize("kind", KINDS)
def test_a_node_starts_by_itself_unless_told_otherwise(bench, kind, twin_path):
    assert state(bench, bench.make(kind, twin=str(twin_path))) == "active"


def test_it_works_while_it_is_active_and_begins_anew(bench):
    node = bench.make(PoseInjectorNode, autostart=False)
    rows = tap(node)
    straight(node, 1.0)
    assert not rows and node.inputs["fix"].state.received == 0
    datum = SetDatum.Request(latitude=47.0, longitude=19.0)
    answer = bench.call(SetDatum, "pose_injector/set_datum", datum)
    assert not answer.success and "not active" in answer.message
    for again in range(2):
        assert (change(bench, node, "configure") if not again else True) and change(bench, node, "activate")
        straight(node, 3.0, start=T0 + 100.0 * again)
        count = len(rows)
        assert count > 250 and rows[-1][5] < 0.1
        assert change(bench, node, "deactivate") and node.twin.lock is None
        straight(node, 1.0, start=T0 + 100.0 * again + 3.0)
        assert len(rows) == count
        rows.clear()


@pytest.mark.parametrize("wrong", ["", "/nowhere/twin.yaml"])
def test_a_model_without_its_twin_is_unconfigured_and_says_why(bench, wrong, twin_path):
    node = bench.make(SuspensionModelNode, twin=wrong, autostart=False)
    for _ in range(2):
        assert not change(bench, node, "configure") and state(bench, node) == "unconfigured"
    level, text = worst(node)
    assert level == 2 and text.startswith("unconfigured: ") and (wrong or "no twin loaded") in text
    assert node.set_parameters([Parameter("twin", value=str(twin_path))])[0].successful
    assert change(bench, node, "configure") and change(bench, node, "activate")
    assert "unconfigured" not in worst(node)[1]


def test_one_that_starts_by_itself_waits_for_its_twin(bench, twin_path):
    node = bench.make(SuspensionModelNode)
    assert state(bench, node) == "unconfigured" and "no twin loaded" in worst(node)[1]
    node.set_parameters([Parameter("twin", value=str(twin_path))])
    assert state(bench, node) == "active"
    with pytest.raises(InputError, match="nowhere"):
        bench.make(SuspensionModelNode, namespace="b", twin="/nowhere/twin.yaml")
