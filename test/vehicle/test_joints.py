# SPDX-License-Identifier: Apache-2.0
"""Joints of the wheels: a standing vehicle stands on the ground, and compression moves a wheel up."""

import pytest

from suspension_twin.vehicle.twin import load_twin


@pytest.mark.parametrize("file", ["bags/bump_15kmh/twin.yaml", "config/tracked/pt91.yaml"])
def test_wheels_stand_on_the_ground_and_move_up(file, repository):
    twin = load_twin(repository / file)
    joints = twin.joints
    assert [j.name for j in joints] == list(twin.joint_names)
    thickness = twin.vehicle.track.thickness if joints[0].kind == "revolute" else 0.0
    for joint in joints:
        _, _, z = joint.centre(joint.standing)
        assert z == pytest.approx(joint.radius + thickness)
        assert joint.centre(joint.standing + 0.05)[2] > z


def test_the_outer_wheels_are_where_the_vehicle_says(repository):
    for file in ("bags/bump_15kmh/twin.yaml", "config/tracked/pt91.yaml"):
        twin = load_twin(repository / file)
        places = {tuple(round(v, 6) for v in j.centre(j.standing)[:2]) for j in twin.joints}
        assert {tuple(p) for p in twin.vehicle.wheel_positions.round(6).tolist()} <= places


def test_an_arm_keeps_its_length(repository):
    twin = load_twin(repository / "config/tracked/pt91.yaml")
    joint = twin.joints[0]
    for position in (-0.3, 0.0, 0.4):
        x, _, z = joint.centre(position)
        length = ((x - joint.origin[0]) ** 2 + (z - joint.origin[2]) ** 2) ** 0.5
        assert length == pytest.approx(twin.vehicle.arm.length)
