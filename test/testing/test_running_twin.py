# SPDX-License-Identifier: Apache-2.0
"""The front door for tests: nodes in one process, a drive replayed, messages as arrays, fixtures of pytest."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive, cut
from suspension_twin.errors import InputError
from suspension_twin.testing import running_twin
from suspension_twin.vehicle.twin import load_twin

BAG = Path(__file__).resolve().parents[2] / "bags" / "crg_road"
TWIN = BAG / "twin.yaml"


@pytest.fixture(scope="module")
def drive() -> Drive:
    """The first seconds of a bundled drive."""
    whole = read_drive(BAG)
    return cut(whole, whole.imu.t[0], whole.imu.t[0] + 6.0)


def test_a_replay_gives_every_answer_and_the_same_every_time(drive: Drive) -> None:
    with running_twin(TWIN) as nodes:
        first, second = (nodes.replay(drive) for _ in range(2))
    measured, twin = first["imu/vertical_acceleration"], first["twin/vertical_acceleration"]
    assert len(drive.imu) - len(twin) < 50  # the rate of the IMU and gravity are found first
    np.testing.assert_array_equal(measured.t, twin.t)
    assert np.isin(np.round(twin.t, 6), np.round(drive.imu.t, 6)).all()
    for topic, received in first.items():
        assert len(received) and np.all(np.diff(received.t) > 0), topic
    for field in ("pose.pose.position.x", "pose.covariance"):
        np.testing.assert_array_equal(first["twin/odom"][field], second["twin/odom"][field])
    assert first["twin/odom"]["pose.covariance"].shape == (len(first["twin/odom"]), 36)
    assert str(twin) == f"twin/vertical_acceleration: {len(twin)} messages"


def test_a_namespace_a_twin_in_memory_and_parameters(drive: Drive) -> None:
    topics = ("twin/gap", "/car/twin/gap", "joint_states", "robot_description", "/tf_static")
    with running_twin(load_twin(TWIN), namespace="car", parameters={"gap.window": 2.0}) as nodes:
        out = nodes.replay(drive, topics)
    assert tuple(out) == topics
    assert len(out["twin/gap"]) == len(out["/car/twin/gap"]) > 0
    assert set(out["twin/gap"]["window"]) <= {2.0}
    assert out["joint_states"]["position"].shape[1] == 4
    assert len(out["robot_description"]) and out["/tf_static"].messages  # latched before anybody listens


def test_a_node_of_the_tests_own_hears_the_twin(drive: Drive) -> None:
    heights: list[float] = []
    with running_twin(TWIN) as nodes:
        own = nodes.add(Node("own", context=nodes.context))
        own.create_subscription(PoseStamped, "twin/pose", lambda m: heights.append(m.pose.position.z), 10_000)
        out = nodes.replay(drive, ["twin/pose"])
    assert heights == out["twin/pose"]["pose.position.z"].tolist()


def test_what_cannot_be_used_is_named(drive: Drive, tmp_path: Path) -> None:
    with running_twin(TWIN) as nodes:
        with pytest.raises(InputError, match=r"twin/gpa: no node publishes it, did you mean /twin/gap\?"):
            nodes.replay(drive, ["twin/gpa"])
        with pytest.raises(InputError, match="nowhere"):
            nodes.replay(tmp_path / "nowhere")
        assert len(nodes.replay(drive, ["twin/gap"])["twin/gap"])  # and the next replay is whole
    (tmp_path / "twin.yaml").write_text("model: truck\n")
    for twin, options, named in (
        (tmp_path / "twin.yaml", {}, r"twin\.yaml"),
        (TWIN, {"namespace": "7 cars"}, "--namespace"),
    ):
        with pytest.raises(InputError, match=named), running_twin(twin, **options):
            pass


def test_the_surroundings_are_left_as_they_were() -> None:
    before = dict(os.environ)
    with running_twin(TWIN):
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "OFF"
    assert dict(os.environ) == before


CASES = f"""
import sys

def test_loading_the_fixtures_imports_neither_ros_nor_numpy():
    assert not {{"rclpy", "numpy", "numba", "yaml"}} & set(sys.modules)

def test_the_nodes(running_twin):
    first, second = running_twin({str(TWIN)!r}), running_twin({str(TWIN)!r}, namespace="second")
    assert first.context is not second.context

def test_a_replay(replayed):
    out = replayed({str(TWIN)!r}, {str(BAG)!r}, ["twin/vertical_acceleration"])
    assert len(out["twin/vertical_acceleration"]["accel.linear.z"]) > 2000
"""


def test_the_fixtures_of_pytest(tmp_path: Path, repository: Path) -> None:
    (tmp_path / "test_mine.py").write_text(CASES)
    given = ["-q", "-p", "suspension_twin.testing.plugin", "-p", "no:cacheprovider", "test_mine.py"]
    environment = {**os.environ, "PYTHONPATH": str(repository)}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *given],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout


#: A package of somebody else's: a node that warns of a body that heaves, and the test of it beside a twin.
FOREIGN = {
    "pyproject.toml": """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"

[project]
name = "heave-watch"
version = "0.1"
""",
    "heave_watch/__init__.py": """
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from std_msgs.msg import Float64


class HeaveWatch(Node):
    def __init__(self, **options):
        super().__init__("heave_watch", **options)
        self.out = self.create_publisher(Float64, "heave", 10_000)
        self.create_subscription(PoseStamped, "twin/pose", self.take, 10_000)

    def take(self, message):
        self.out.publish(Float64(data=message.pose.position.z))
""",
    "test_heave_watch.py": f"""
import heave_watch
import numpy as np

from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import cut

def test_it_repeats_the_heave_of_the_twin(running_twin):
    assert "target" in heave_watch.__file__, "the one that was installed"
    nodes = running_twin({str(TWIN)!r}, parameters={{"visual_rate": 50.0}})
    nodes.add(heave_watch.HeaveWatch(context=nodes.context))
    drive = read_drive({str(BAG)!r})
    out = nodes.replay(cut(drive, drive.imu.t[0], drive.imu.t[0] + 6.0), ["twin/pose", "/heave"])
    heave = out["/heave"]["data"]
    assert len(heave) > 0.9 * len(out["twin/pose"]) > 200
    assert np.isin(heave, out["twin/pose"]["pose.position.z"]).all() and np.std(heave) > 1e-3
""",
}


@pytest.mark.long
def test_a_package_of_somebody_elses_tests_its_node_beside_a_twin(tmp_path: Path, repository: Path) -> None:
    """Built, installed into a folder and tested by pytest, as its owner would."""
    source, target = tmp_path / "source", tmp_path / "target"
    for name, text in FOREIGN.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(text, encoding="utf-8")
    test = (source / "test_heave_watch.py").rename(tmp_path / "test_heave_watch.py")
    offline = ["--quiet", "--no-index", "--no-build-isolation", "--no-deps", "--target", str(target)]
    plugin = ["-q", "-p", "suspension_twin.testing.plugin", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (target, repository)))}
    for command in (["pip", "install", *offline, str(source)], ["pytest", *plugin, str(test)]):
        done = subprocess.run(
            [sys.executable, "-m", *command],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout and (target / "heave_watch-0.1.dist-info").is_dir()
