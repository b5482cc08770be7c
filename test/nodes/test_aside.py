# SPDX-License-Identifier: Apache-2.0
"""What others ask a node to read holds it up at no time, and is told them by its place alone."""

from __future__ import annotations

import threading

import pytest
from nodes_bench import Client
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from stand_ins import stumbles_on_a_file

from suspension_twin import files
from suspension_twin.live import follow
from suspension_twin.nodes import aside, base
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.pose_injector import PoseInjectorNode
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin_interfaces.action import Calibrate
from suspension_twin_interfaces.srv import LoadTwin


@pytest.mark.parametrize("kind", [SuspensionModelNode, ImuIngestNode, PoseInjectorNode, CalibratorNode])
@pytest.mark.long
def test_a_node_answers_while_a_slow_file_is_read(bench, twin_path, monkeypatch, kind):
    node = bench.make(kind, twin=str(twin_path))
    released = threading.Event()
    monkeypatch.setattr(aside, "_LONGEST", 0.3)
    monkeypatch.setattr(base, "read_named", lambda _path: released.wait(20.0))
    name = f"/{node.get_name()}/set_parameters"
    named = Parameter("twin", value=str(twin_path)).to_parameter_msg()
    client = bench.side.create_client(SetParameters, name)
    bench.until(client.service_is_ready)
    waiting = client.call_async(SetParameters.Request(parameters=[named]))
    other = Parameter("silence_timeout", value=3.0).to_parameter_msg()
    assert bench.call(SetParameters, name, SetParameters.Request(parameters=[other])).results[0].successful
    assert not waiting.done()
    bench.until(waiting.done)
    assert "could not be read within 0.3 s" in waiting.result().results[0].reason
    refused = bench.call(SetParameters, name, SetParameters.Request(parameters=[named])).results[0]
    assert not refused.successful and "still being read" in refused.reason
    released.set()
    monkeypatch.undo()
    monkeypatch.setattr(aside, "_LONGEST", 300.0)  # however slow the machine
    assert bench.call(SetParameters, name, SetParameters.Request(parameters=[named])).results[0].successful


def test_a_twin_that_a_service_names_is_read_by_no_callback(bench, twin_path, monkeypatch):
    node = bench.make(SuspensionModelNode)
    here, threads = threading.get_ident(), set()
    opened = files.open_file
    monkeypatch.setattr(
        files, "open_file", lambda path: (threads.add(threading.get_ident()), opened(path))[1]
    )
    monkeypatch.setattr(follow, "road_of", lambda _twin: pytest.fail("the road is read in the callback"))
    request = LoadTwin.Request(path=str(twin_path))
    assert bench.call(LoadTwin, "/suspension_model/load_twin", request).success
    assert node._follower.road.length > 0.0 and threads and here not in threads


def test_what_stands_in_a_file_is_heard_by_nobody_else(bench, twin_path, tmp_path):
    heard = bench.hear(Log, "/rosout")
    bench.make(SuspensionModelNode, twin=str(twin_path))
    (tmp_path / "secret.yaml").write_text("mass: 3\nroot_password_hunter2: x\n")
    request = LoadTwin.Request(path=str(tmp_path / "secret.yaml"))
    response = bench.call(LoadTwin, "/suspension_model/load_twin", request)
    bench.spin(0.3)
    assert not response.success and "secret.yaml: cannot be used" in response.message
    assert "hunter2" not in " ".join([response.message, *(m.msg for m in heard)])


def test_a_worker_that_stumbles_on_a_file_tells_its_place(bench, twin_path, recorded, capfd):
    bench.make(CalibratorNode, {"calibrate": stumbles_on_a_file}, twin=str(twin_path))
    client = Client(bench, Calibrate, "calibrate")
    _, result = client.result(client.send(Calibrate.Goal(bags=[str(recorded)])))
    assert not result.success
    assert "other.yaml: cannot be used (vehicle" in result.message
    assert "hunter2" not in result.message
    assert "hunter2" in capfd.readouterr().err
