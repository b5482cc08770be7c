# SPDX-License-Identifier: Apache-2.0
"""What the buttons of the page make of the other nodes, asked for as a browser does, without one."""

from __future__ import annotations

import asyncio
import threading
import urllib.request
from typing import Any

import pytest
from aiohttp import ClientSession
from geometry_msgs.msg import AccelStamped, PoseStamped
from nodes_bench import put_stamp
from stand_ins import lighter, reported

from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.imu_ingest import ImuIngestNode
from suspension_twin.nodes.player import BagPlayer
from suspension_twin.nodes.suspension_model import SuspensionModelNode
from suspension_twin.nodes.topics import Embedding
from suspension_twin.nodes.viewer import ViewerNode
from suspension_twin.vehicle.twin import load_twin


@pytest.fixture
def viewer(bench, twin_path, recorded, tmp_path) -> Any:
    """The node of the page, in an empty folder, beside a replay of a recording."""
    options = {"twin": str(twin_path), "port": 0, "folder": str(tmp_path), "bag": str(recorded)}
    return bench.make(ViewerNode, **options)


def press(bench, viewer, name: str, value: float | None = None) -> tuple[str, bool]:
    """What the page says after a button; whether it is an error."""
    answers: list[dict[str, Any]] = []

    async def ask() -> None:
        async with ClientSession() as session, session.ws_connect(f"{viewer.server.url}ws") as socket:
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
    bench.until(viewer._actions["calibrate"].server_is_ready, "the action")
    assert press(bench, viewer, "calibrate") == ("Calibrating on bumpy", False)
    assert press(bench, viewer, "diagnose")[1], "one at a time"
    bench.until(lambda: not job(viewer)["running"], "the calibration")
    result = tmp_path / "bumpy_calibrated.yaml"
    assert load_twin(result).vehicle.mass == 1700.0
    assert job(viewer)["text"] == "calibrate: the mass" and job(viewer)["result"]
    bench.until(viewer._loader.service_is_ready, "the service")
    press(bench, viewer, "load")
    for node in (model, ingest, viewer):
        bench.until(lambda n=node: n.values["twin"] == str(result), f"{node.get_name()} to load it")
    assert viewer.view.snapshot()["scene"]["name"] == "Ford Mondeo Mk IV estate"


def test_a_diagnosis_has_a_report_to_open(bench, viewer, tmp_path):
    bench.make(CalibratorNode, {"diagnose": reported})
    bench.until(viewer._actions["diagnose"].server_is_ready, "the action")
    assert press(bench, viewer, "diagnose") == ("Diagnosing bumpy", False)
    bench.until(lambda: not job(viewer)["running"], "the diagnosis")
    assert job(viewer)["report"] and (tmp_path / "bumpy_diagnosis" / "twin.yaml").is_file()
    with urllib.request.urlopen(f"{viewer.server.url}report") as answer:
        assert answer.read() == b"<p>friction</p>"


def test_buttons_that_cannot_say_why(bench, viewer, tmp_path):
    assert press(bench, viewer, "calibrate") == ("calibrate: the node calibrator is not there", True)
    assert press(bench, viewer, "stop") == ("stop: nothing is being recorded", True)
    assert press(bench, viewer, "pause") == ("player: no recording is being replayed", True)
    assert not press(bench, viewer, "record")[1]
    assert press(bench, viewer, "record") == ("record: is running already", True)
    said, wrong = press(bench, viewer, "stop")
    assert wrong and "no message came on imu/data_raw" in said
    assert list(tmp_path.iterdir()) == [], "nothing half is left"


def test_the_player_is_led(bench, viewer, drive):
    player = bench.add(BagPlayer(drive, 1.0, False, Embedding(bench.context), stay=True))
    bench.until(lambda: viewer._player and viewer._set_player.service_is_ready(), "the player's state")
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
