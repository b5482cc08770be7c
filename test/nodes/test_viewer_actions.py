# SPDX-License-Identifier: Apache-2.0
"""What the buttons of the page make of the other nodes, asked for as a browser does, without one."""

from __future__ import annotations

import asyncio
import threading
import urllib.request
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from aiohttp import ClientSession
from geometry_msgs.msg import AccelStamped, PoseStamped, TwistStamped
from nodes_bench import put_stamp
from rclpy.action import ActionServer
from rclpy.action.server import GoalResponse
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Imu, NavSatFix
from stand_ins import lighter, reported, search_until_stopped

from suspension_twin.addons.nodes.viewer import ViewerNode
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.types import Drive
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.messages import fill_fix, fill_imu, fill_velocity
from suspension_twin.nodes.player import BagPlayer
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.topics import Embedding
from suspension_twin.vehicle.twin import load_twin
from suspension_twin_interfaces.action import Calibrate


@pytest.fixture
def viewer(bench, twin_path, recorded, tmp_path) -> Any:
    """The node of the page, in an empty folder, beside a replay of a recording."""
    options = {"twin": str(twin_path), "port": 0, "folder": str(tmp_path), "bag": str(recorded)}
    return bench.make(ViewerNode, **options)


def press(bench, viewer, name: str, value: float | None = None) -> tuple[str, bool]:
    """What the page says after a button; whether it is an error."""
    answers: list[dict[str, Any]] = []

    async def ask() -> None:
        async with ClientSession() as session, session.ws_connect(viewer.server.address("ws")) as socket:
            await socket.send_json({"do": name} if value is None else {"do": name, "value": value})
            while "said" not in (frame := await socket.receive_json(timeout=10.0)):
                pass
            answers.append(frame)

    thread = threading.Thread(target=asyncio.run, args=(ask(),))
    thread.start()
    bench.until(lambda: not thread.is_alive(), f"an answer to {name}")
    return answers[0]["said"], answers[0]["wrong"]


def job(viewer) -> dict[str, Any]:
    return viewer.view.snapshot()["job"] or {"running": True, "text": "", "result": False}


def test_a_calibration_is_loaded_by_all_nodes(bench, viewer, twin_path, tmp_path):
    model = bench.make(SuspensionModelNode, twin=str(twin_path))
    ingest = bench.make(ImuIngestNode, twin=str(twin_path))
    bench.make(CalibratorNode, {"calibrate": lighter})
    said, wrong = press(bench, viewer, "load")
    assert wrong and "no result yet" in said
    bench.until(viewer.jobs.actions["calibrate"].server_is_ready, "the action")
    assert press(bench, viewer, "calibrate") == ("Calibrating on bumpy", False)
    assert press(bench, viewer, "diagnose")[1], "one at a time"
    bench.until(lambda: not job(viewer)["running"], "the calibration", 90.0)
    result = tmp_path / "bumpy_calibrated.yaml"
    assert load_twin(result).vehicle.mass == 1700.0
    assert job(viewer)["text"] == "calibrate: the mass" and job(viewer)["result"]
    bench.until(viewer.jobs.loader.service_is_ready, "the service")
    press(bench, viewer, "load")
    for node in (model, ingest, viewer):
        bench.until(lambda n=node: n.values["twin"] == str(result), f"{node.get_name()} to load it")
    assert viewer.view.snapshot()["scene"]["name"] == "Ford Mondeo Mk IV estate"


def test_a_diagnosis_has_a_report_to_open(bench, viewer, tmp_path):
    bench.make(CalibratorNode, {"diagnose": reported})
    bench.until(viewer.jobs.actions["diagnose"].server_is_ready, "the action")
    assert press(bench, viewer, "diagnose") == ("Diagnosing bumpy", False)
    bench.until(lambda: not job(viewer)["running"], "the diagnosis", 90.0)
    assert job(viewer)["report"] and (tmp_path / "bumpy_diagnosis" / "twin.yaml").is_file()
    with urllib.request.urlopen(viewer.server.address("report")) as answer:
        assert answer.read() == b"<p>friction</p>"


def test_a_goal_whose_node_ends_is_given_up(bench, viewer):
    calibrator = bench.make(CalibratorNode, {"calibrate": search_until_stopped})
    bench.until(viewer.jobs.actions["calibrate"].server_is_ready, "the action")
    assert press(bench, viewer, "calibrate") == ("Calibrating on bumpy", False)
    bench.until(lambda: "search" in job(viewer)["text"], "the calibration to begin", 60.0)
    bench.remove(calibrator)
    bench.until(lambda: not job(viewer)["running"], "the goal to be given up")
    assert job(viewer)["text"] == "calibrate: the node calibrator ended before the result was there"
    assert press(bench, viewer, "calibrate") == ("calibrate: the node calibrator is not there", True)


@pytest.mark.long
def test_a_calibration_is_cancelled_and_its_best_so_far_is_there(bench, viewer, tmp_path):
    bench.make(CalibratorNode, {"calibrate": search_until_stopped})
    bench.until(viewer.jobs.actions["calibrate"].server_is_ready, "the action")
    assert press(bench, viewer, "cancel") == ("cancel: nothing is running that could be cancelled", True)
    press(bench, viewer, "calibrate")
    bench.until(lambda: "search" in job(viewer)["text"], "the calibration to begin", 60.0)
    assert press(bench, viewer, "cancel") == ("Cancelling: calibrate", False)
    bench.until(lambda: not job(viewer)["running"], "its end")
    assert "stopped in generation" in job(viewer)["text"] and job(viewer)["result"]
    assert (tmp_path / "bumpy_calibrated.yaml").read_text() == "best so far"
    assert press(bench, viewer, "cancel")[1]


@pytest.mark.long
def test_a_goal_that_is_not_answered_is_given_up_and_goes_on_if_it_is(bench, viewer):
    answered = Future(executor=bench.executor)

    async def late(_goal: Any) -> GoalResponse:
        return await answered

    def fail(goal: Any) -> Any:
        goal.abort()
        return Calibrate.Result(message="nothing moved")

    server = ActionServer(bench.side, Calibrate, "calibrate", fail, goal_callback=late)
    try:
        bench.until(viewer.jobs.actions["calibrate"].server_is_ready, "the action")
        press(bench, viewer, "calibrate")
        bench.until(lambda: not job(viewer)["running"], "the goal to be given up")
        assert job(viewer)["text"] == "calibrate: the node calibrator did not answer"
        answered.set_result(GoalResponse.ACCEPT)
        bench.until(lambda: job(viewer)["text"] == "calibrate: nothing moved", "the late answer")
    finally:
        server.destroy()


def test_buttons_that_cannot_say_why(bench, viewer, tmp_path):
    assert press(bench, viewer, "calibrate") == ("calibrate: the node calibrator is not there", True)
    assert press(bench, viewer, "stop") == ("stop: nothing is being recorded", True)
    assert press(bench, viewer, "pause") == ("player: no recording is being replayed", True)
    assert not press(bench, viewer, "record")[1]
    assert press(bench, viewer, "record") == ("record: is running already", True)
    said, wrong = press(bench, viewer, "stop")
    assert wrong and "no message came on imu/data_raw" in said
    assert list(tmp_path.iterdir()) == [], "nothing half is left"


def test_a_best_effort_sensor_is_recorded_too(bench, viewer, tmp_path):
    offer = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = bench.side.create_publisher(Imu, "imu/data_raw", offer)
    assert not press(bench, viewer, "record")[1]
    message, sent = Imu(), 0

    def recorded() -> bool:
        nonlocal sent
        publisher.publish(put_stamp(message, 1_700_000_000.0 + 0.01 * sent))
        sent += 1
        return viewer.recorder.bag.counts["imu/data_raw"] >= 20

    def wanted() -> str:
        ends = (
            publisher.get_subscription_count(),
            viewer.recorder.subscriptions["imu/data_raw"].get_publisher_count(),
        )
        return f"20 of {sent} samples of a best-effort publisher, {viewer.recorder.bag.counts} came, {ends} matched"

    bench.until(recorded, wanted)
    said, wrong = press(bench, viewer, "stop")
    assert not wrong and "on imu/data_raw" in said


def test_the_player_is_led(bench, viewer, drive):
    player = bench.add(BagPlayer(drive, 1.0, False, Embedding(bench.context), stay=True))
    bench.until(lambda: viewer.player.state and viewer.player.client.service_is_ready(), "the player's state")
    press(bench, viewer, "pause")
    bench.until(lambda: player.paused, "the pause")
    assert press(bench, viewer, "speed", 500.0)[1]
    press(bench, viewer, "speed", 4.0)
    bench.until(lambda: player.rate == 4.0, "the pace")
    press(bench, viewer, "seek", 7.0)
    bench.until(lambda: not player.paused, "it to go on")
    assert player.position == pytest.approx(7.0, abs=0.02)


def test_another_twins_health_is_not_shown(bench, twin_path, tmp_path):
    own = bench.make(ViewerNode, namespace="car_1", twin=str(twin_path), port=0, folder=str(tmp_path))
    bench.make(ImuIngestNode, namespace="car_1")
    bench.make(ImuIngestNode, namespace="car_2")
    heard = lambda: {s["name"] for s in own.view.snapshot()["health"]}  # noqa: E731
    bench.until(lambda: "imu_ingest" in heard(), "diagnostics")
    bench.spin(1.2)
    assert not any("car_" in name for name in heard())


def test_signals_and_pose_get_on_the_page(bench, viewer):
    send = {kind: bench.speak(kind, topic) for kind, topic in ((PoseStamped, "twin/pose"),)}
    measured, simulated = (
        bench.speak(AccelStamped, "imu/vertical_acceleration"),
        bench.speak(AccelStamped, "twin/vertical_acceleration"),
    )
    for k in range(20):
        pose = put_stamp(PoseStamped(), 1000.0 + 0.01 * k)
        pose.pose.position.x, pose.pose.orientation.w = 0.1 * k, 1.0
        send[PoseStamped](pose)
        for publish, value in ((measured, 1.0), (simulated, 0.5)):
            message = put_stamp(AccelStamped(), 1000.0 + 0.01 * k)
            message.accel.linear.z = value
            publish(message)
    whole = bench.until(
        lambda: (s := viewer.view.snapshot()) and len(s["simulated"]) == 20 and s, "the samples"
    )
    assert {row[1] for row in whole["measured"]} == {1.0} and {row[1] for row in whole["simulated"]} == {0.5}
    assert whole["pose"][-1][1] == pytest.approx(1.9)


def steps(viewer) -> list[tuple[str, str]]:
    return [(step["state"], step["text"]) for step in viewer.view.snapshot()["guide"] or []]


def drive_along(bench, drive: Drive, *parts: tuple[float, float]) -> None:
    """What a phone of 25 Hz and a receiver of 5 Hz send in parts of a drive, s from its first sample."""
    sent = []
    for samples, every, kind, topic, fill in (
        (drive.imu, 4, Imu, "imu/data_raw", fill_imu),
        (drive.fix, 2, NavSatFix, "fix", fill_fix),
        (drive.velocity, 2, TwistStamped, "vel", fill_velocity),
    ):
        publish = bench.speak(kind, topic)
        at = samples.t - drive.imu.t[0]
        wanted = np.any([(at >= first) & (at < last) for first, last in parts], axis=0)
        for i in np.flatnonzero(wanted)[::every].tolist():
            message = put_stamp(kind(), float(samples.t[i]))
            fill(samples, message, i)
            sent.append((float(samples.t[i]), len(sent), publish, message))
    for number, (_, _, publish, message) in enumerate(sorted(sent)):
        publish(message)
        if number % 20 == 0:
            bench.spin(0.004)


@pytest.mark.long
def test_a_first_drive_leads_to_a_calibrated_twin(bench, repository, tmp_path):
    bump = repository / "bags" / "bump_15kmh"
    viewer = bench.make(ViewerNode, twin=str(bump / "twin.yaml"), port=0, folder=str(tmp_path))
    model = bench.make(SuspensionModelNode, twin=str(bump / "twin.yaml"))
    assert press(bench, viewer, "guide") == ("first drive: the node calibrator is not there", True)
    bench.make(CalibratorNode, {"calibrate": lighter})
    bench.until(viewer.jobs.actions["calibrate"].server_is_ready, "the action")
    bench.until(viewer.jobs.loader.service_is_ready, "the service")
    said, wrong = press(bench, viewer, "guide")
    assert not wrong and said.startswith("Stand still")
    assert [state for state, _ in steps(viewer)] == ["now", "later", "later", "later"]
    drive_along(bench, read_drive(bump), (0.0, 12.5), (34.0, 39.0), (60.0, 67.0))
    bench.until(lambda: steps(viewer)[-1][0] == "done", "the calibration", 90.0)
    stand, off, passes, end = (text for _, text in steps(viewer))
    assert stand.startswith("gyroscope bias 0.3") and off == "the vehicle has moved"
    assert passes.count("km/h") == 3 and end == "the mass"
    recorded = next(path for path in tmp_path.iterdir() if path.is_dir())
    assert len(read_drive(recorded).imu) > 400
    bench.until(
        lambda: model.values["twin"] == str(tmp_path / f"{recorded.name}_calibrated.yaml"), "the twin"
    )
    press(bench, viewer, "guide")
    assert steps(viewer) == []


def test_a_first_drive_ends_where_it_is_told(bench, repository, tmp_path):
    bump = repository / "bags" / "bump_15kmh"
    viewer = bench.make(ViewerNode, twin=str(bump / "twin.yaml"), port=0, folder=str(tmp_path))
    bench.make(CalibratorNode, {"calibrate": lighter})
    bench.until(viewer.jobs.actions["calibrate"].server_is_ready, "the action")
    assert not press(bench, viewer, "guide")[1]
    drive_along(bench, read_drive(bump), (0.0, 2.0))
    said, _ = press(bench, viewer, "guide")
    assert said.startswith("Recorded ") and steps(viewer) == []
    drive = read_drive(bump)
    lying = replace(drive.imu, specific_force=drive.imu.specific_force[:, [0, 2, 1]])
    assert not press(bench, viewer, "guide")[1]
    drive_along(bench, replace(drive, imu=lying), (0.0, 4.0))
    bench.until(lambda: [state for state, _ in steps(viewer)] == ["failed"], "the mounting to be seen")
    assert "imu.rpy" in steps(viewer)[0][1] and viewer.recorder.bag is None
