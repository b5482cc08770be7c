# SPDX-License-Identifier: Apache-2.0
"""The URDF of a twin: a tree from ``base_link``, with each wheel where the joints put it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import pytest

from suspension_twin.vehicle.twin import load_twin
from suspension_twin.vehicle.urdf import urdf, wheel_frame

FILES = ["bags/bump_15kmh/twin.yaml", "config/tracked/pt91.yaml", "config/twins/quarter_car.yaml"]


def numbers(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split()))


@pytest.mark.parametrize("file", FILES)
def test_it_is_one_tree(file, repository):
    robot = ElementTree.fromstring(urdf(load_twin(repository / file), "car/base_link", "car/"))
    links = [link.get("name") for link in robot.iter("link")]
    children = [j.find("child").get("link") for j in robot.iter("joint")]
    assert len(set(links)) == len(links) and sorted(children) == sorted(set(links) - {"car/base_link"})
    assert {j.find("parent").get("link") for j in robot.iter("joint")} == {"car/base_link"}


@pytest.mark.parametrize("file", FILES[:2])
def test_joints_are_those_of_the_twin(file, repository):
    twin = load_twin(repository / file)
    robot = ElementTree.fromstring(urdf(twin))
    found = {j.get("name"): j for j in robot.iter("joint")}
    shapes = {link.get("name"): link.find("visual/origin") for link in robot.iter("link")}
    for joint in twin.joints:
        element = found[joint.name]
        assert element.get("type") == joint.kind
        assert numbers(element.find("origin").get("xyz")) == pytest.approx(joint.origin)
        assert numbers(element.find("axis").get("xyz")) == joint.axis
        assert numbers(shapes[wheel_frame(joint)].get("xyz")) == pytest.approx(joint.wheel)
        limit = element.find("limit")
        assert float(limit.get("lower")) < joint.standing < float(limit.get("upper"))
