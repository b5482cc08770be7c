# SPDX-License-Identifier: Apache-2.0
"""``config/nodes.yaml`` holds every parameter with its default, and is taken in any namespace."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from nodes_bench import Bench

from suspension_twin.nodes.composed import KINDS
from suspension_twin.nodes.parameters import read_param_file
from suspension_twin.nodes.process import ros_context
from suspension_twin.nodes.topics import Embedding

NOT_IN_THE_FILE = {"twin", "use_sim_time", "start_type_description_service"}


@pytest.fixture
def path(repository: Path) -> Path:
    return repository / "config" / "nodes.yaml"


@pytest.mark.parametrize("name", KINDS)
def test_the_file_holds_every_parameter_with_its_default(path, name):
    with ros_context([]) as context:
        bench = Bench(context)
        node = bench.add(KINDS[name](Embedding(context)))
        own = [n for n in node.list_parameters([], 0).names if not n.startswith("qos_overrides.")]
        values = dict(node.values)
        bench.close()
    sections = read_param_file(path)
    given = sections["/**"] | sections[f"/**/{name}"]
    assert set(sections[f"/**/{name}"]).isdisjoint(sections["/**"])
    for parameter in set(own) - NOT_IN_THE_FILE:
        assert parameter in given, f"{parameter} is missing"
        assert given[parameter] == values[parameter], parameter
        assert type(given[parameter]) is type(values[parameter]), parameter
    assert set(sections[f"/**/{name}"]) <= set(own)


@pytest.mark.parametrize("name", KINDS)
def test_the_file_says_of_each_what_the_node_says(path, name):
    """The meaning of a parameter, as ``ros2 param describe`` shows it, is the comment above it."""
    comments = re.sub(r"\s+#?\s*", " ", path.read_text(encoding="utf-8"))
    kind = KINDS[name]
    for parameter in (*kind.common, *kind.parameters):
        if parameter.name not in ("twin", "map_frame", "base_frame"):
            assert parameter.text in comments, parameter.name


@pytest.mark.parametrize("namespace", ["", "car"])
def test_a_changed_file_reaches_the_nodes_wherever_they_are(path, tmp_path, namespace):
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data["/**"]["ros__parameters"]["filter"]["cutoff"] = 12.5
    data["/**/suspension_model"]["ros__parameters"]["gap"]["bands"] = [1.0, 2.0]
    (tmp_path / "nodes.yaml").write_text(yaml.safe_dump(data))
    with ros_context(["--ros-args", "--params-file", str(tmp_path / "nodes.yaml")]) as context:
        bench = Bench(context)
        try:
            for name in ("imu_ingest", "suspension_model"):
                node = bench.add(KINDS[name](Embedding(context, namespace)))
                assert node.values["filter.cutoff"] == 12.5
            assert node.values["gap.bands"] == [1.0, 2.0]
        finally:
            bench.close()
