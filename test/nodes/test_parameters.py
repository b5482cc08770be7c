# SPDX-License-Identifier: Apache-2.0
"""Parameters: declared with what they mean, refused with the reason."""

from __future__ import annotations

from pathlib import Path

import pytest
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.parameter import Parameter

from suspension_twin.errors import InputError
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.suspension_model import SuspensionModelNode

KINDS = (ImuIngestNode, PoseInjectorNode, SuspensionModelNode, CalibratorNode)


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_says_what_it_is_and_within_which_bounds(bench, kind):
    node = bench.make(kind)
    own = [n for n in node.list_parameters([], 0).names if n in node.values]
    assert "twin" in own and "silence_timeout" in own
    for name in own:
        described: ParameterDescriptor = node.describe_parameter(name)
        assert len(described.description) > 10, name
        value = node.get_parameter(name).value
        if isinstance(value, float):
            (bounds,) = described.floating_point_range
            assert bounds.from_value <= value <= bounds.to_value, name
        elif isinstance(value, int) and not isinstance(value, bool):
            (whole,) = described.integer_range
            assert whole.from_value <= value <= whole.to_value, name


REFUSED = [
    (ImuIngestNode, "filter.cutoff", 0.01, "range"),
    (ImuIngestNode, "filter.cutoff", float("nan"), "nan"),
    (ImuIngestNode, "filter.order", 9, "range"),
    (ImuIngestNode, "filter.order", 2.5, "type"),
    (ImuIngestNode, "level", "sometimes", "never, gross, always"),
    (ImuIngestNode, "base_frame", "other", "read-only"),
    (PoseInjectorNode, "gate", -1.0, "range"),
    (PoseInjectorNode, "datum.latitude", 91.0, "range"),
    (PoseInjectorNode, "datum.source", "guess", "first_fix"),
    (PoseInjectorNode, "twin", "/nowhere/twin.yaml", "/nowhere/twin.yaml"),
    (SuspensionModelNode, "gap.bands", [3.0, 1.0], "rise"),
    (SuspensionModelNode, "gap.bands", [1.0, float("inf")], "finite"),
    (SuspensionModelNode, "visual_rate", 0.0, "range"),
    (CalibratorNode, "threads", -1, "range"),
]


@pytest.mark.parametrize(("kind", "name", "value", "word"), REFUSED)
def test_a_wrong_value_is_refused_with_the_reason_and_changes_nothing(bench, kind, name, value, word):
    node = bench.make(kind)
    before = node.values[name]
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert word in result.reason
    assert node.values[name] == before == node.get_parameter(name).value


@pytest.mark.parametrize(
    ("kind", "name", "value", "words"),
    [
        (ImuIngestNode, "filter.cutoff", 20, "a number with a decimal point"),
        (ImuIngestNode, "filter.cutoff", 2000.0, "800"),
        (ImuIngestNode, "level", "up", "never, gross, always"),
        (SuspensionModelNode, "gap.bands", ["a"], "in a list"),
        (SuspensionModelNode, "twin", "no.yaml", "no.yaml"),
        (PoseInjectorNode, "fix_sigma", "big", "fix_sigma"),
    ],
)
def test_a_node_does_not_start_with_a_wrong_value_and_names_it(bench, kind, name, value, words):
    with pytest.raises(InputError) as caught:
        bench.make(kind, **{name.replace(".", "__"): value})
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_parameter_cannot_be_unset(bench):
    node = bench.make(ImuIngestNode)
    (result,) = node.set_parameters([Parameter("max_bias", Parameter.Type.NOT_SET, None)])
    assert not result.successful
    assert node.values["max_bias"] == 0.3


def test_values_that_only_fit_together_are_taken_together(bench, twin_path: Path):
    node = bench.make(PoseInjectorNode, twin=str(twin_path))
    assert node._lock.datum.latitude == 47.4025
    new = {"datum.source": "parameters", "datum.latitude": 10.0, "datum.longitude": 20.0}
    result = node.set_parameters_atomically([Parameter(k, value=v) for k, v in new.items()])
    assert result.successful, result.reason
    assert (node._lock.datum.latitude, node._lock.datum.longitude) == (10.0, 20.0)


def test_quality_of_service_can_be_overridden(bench):
    given = "qos_overrides./imu/data_raw.subscription.reliability"
    node = bench.make(ImuIngestNode, **{given.replace(".", "__"): "reliable"})
    (subscription,) = [s for s in node.subscriptions if s.topic_name == "/imu/data_raw"]
    assert subscription.qos_profile.reliability.name == "RELIABLE"


@pytest.mark.parametrize(
    ("topic", "end", "given"),
    [("fix", "subscription", "reliable"), ("twin/odom", "publisher", "best_effort")],
)
def test_an_override_is_for_its_topic_and_node_alone(bench, topic: str, end: str, given: str):
    def ends(namespace: str, **overrides: str) -> dict[str, str]:
        node = bench.make(PoseInjectorNode, namespace=namespace, **overrides)
        found = [*node.subscriptions, *(o.publisher for o in node.outputs.values())]
        return {e.topic_name.removeprefix(f"/{namespace}"): e.qos_profile.reliability.name for e in found}

    usual = ends("first")
    override = f"qos_overrides./second/{topic}.{end}.reliability".replace(".", "__")
    assert ends("second", **{override: given}) == {**usual, f"/{topic}": given.upper()} != usual
    assert ends("third") == usual
