# SPDX-License-Identifier: Apache-2.0
"""The node of live sources, alone and in ``run --source``: a phone's drive moves the twin."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path

import aiohttp
import numpy as np
import pytest

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1] / "addons/sources")
)  # for the emulators of the apps

from nodes_bench import stamp_of
from sensor_logger_app import SensorLoggerApp
from sensor_msgs.msg import Imu, NavSatFix
from test_run_command import end, run_command, start, wait_for

from suspension_twin.addons.nodes.source import SourceNode
from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.nodes.composed import Composed
from suspension_twin.testing import running_twin


def play(app: SensorLoggerApp, url: str, speed: float) -> threading.Thread:
    """The app at work beside the test."""

    def push() -> None:
        with contextlib.suppress(aiohttp.ClientError):  # the receiver ends before the drive does
            asyncio.run(app.push(url, speed))

    thread = threading.Thread(target=push, daemon=True)
    thread.start()
    return thread


def url_of(node: SourceNode) -> str:
    return node.notes[0].rpartition(" ")[2]


@pytest.mark.long
def test_samples_become_messages_of_the_sensors_topics(bench, drive, twin_path):
    node = bench.make(SourceNode, sources="sensorlogger://127.0.0.1:0", twin=str(twin_path))
    imu, fix = bench.hear(Imu, "imu/data_raw"), bench.hear(NavSatFix, "fix")
    play(SensorLoggerApp(drive), url_of(node), 20.0)
    bench.until(lambda: len(imu) >= len(drive.imu) and len(fix) >= len(drive.fix), "the drive")
    np.testing.assert_allclose([stamp_of(m) / 1e9 for m in imu], drive.imu.t, rtol=0, atol=1e-6)
    force = [[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for m in imu]
    np.testing.assert_allclose(force, drive.imu.specific_force, atol=1e-6)
    assert imu[0].header.frame_id == "imu_link" and imu[0].orientation_covariance[0] == -1.0
    assert fix[0].position_covariance[0] == pytest.approx(drive.fix.sigma[0, 0] ** 2)
    node.report()
    assert node.health.values["imu from"] == "phone 5f0c1a7e"
    assert "phone 5f0c1a7e: clock: host ahead (s)" in node.health.values
    bench.until(lambda: any("silent" in text for _, text in node.health.complaints()), "the silence")


def follow(composed: Composed, done) -> dict[str, list]:
    kept: dict[str, list] = {"odom": [], "gap": []}
    composed.nodes["pose_injector"].outputs["twin/odom"].links.append(
        lambda m: kept["odom"].append((stamp_of(m) / 1e9, m.pose.pose.position.x, m.pose.pose.position.y))
    )
    composed.nodes["suspension_model"].outputs["twin/gap"].links.append(
        lambda m: kept["gap"].append((stamp_of(m) / 1e9, m.rms))
    )
    until = time.monotonic() + 60.0
    while not done():
        assert time.monotonic() < until
        composed.step(0.02)
    return kept


def test_the_twin_follows_as_it_follows_the_recording(bench, drive, twin_path):
    """Path and gap within 1 cm and 1 % of those of the recording, replayed."""
    with running_twin(twin_path) as nodes:
        played = nodes.replay(drive, ["twin/odom", "twin/gap"])
    live = Composed(bench.context, twin_path, "live", sources=["sensorlogger://127.0.0.1:0"])
    source = live.nodes["source"]
    assert isinstance(source, SourceNode)
    play(SensorLoggerApp(drive, batch=0.05), url_of(source), 10.0)
    ingest = live.nodes["imu_ingest"].inputs["imu/data_raw"].state
    found = follow(live, lambda: ingest.received >= len(drive.imu))
    assert live.condition().rates.keys() == {"imu", "fix", "vel", "twin"}
    live.close()
    odom, here = played["twin/odom"], np.array(found["odom"])
    there = np.column_stack([odom.t, odom["pose.pose.position.x"], odom["pose.pose.position.y"]])
    assert len(here) > 0.98 * len(there)
    for column in (1, 2):
        np.testing.assert_allclose(
            np.interp(here[:, 0], there[:, 0], there[:, column]), here[:, column], atol=0.01
        )
    assert found["gap"][-1][1] == pytest.approx(played["twin/gap"]["rms"][-1], rel=0.01)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def is_open(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.parametrize("alone", [False, True], ids=["run", "node alone"])
@pytest.mark.long
def test_a_phone_that_sends_to_the_command_is_heard_on_the_topic(alone, bench, drive, twin_path):
    port = free_port()
    url = f"sensorlogger://127.0.0.1:{port}"
    if alone:
        process = start(
            [
                sys.executable,
                "-c",
                "from suspension_twin.addons.nodes.source import SourceNode; SourceNode.main()",
                "--ros-args",
                "-p",
                f"sources:={url}",
            ]
        )
    else:
        process = start(run_command("--twin", twin_path, "--source", url))
    wait_for(bench, "source")
    heard = bench.hear(Imu, "imu/data_raw")
    bench.until(lambda: bench.side.count_publishers("imu/data_raw"), "the publisher")
    bench.until(lambda: is_open(port), "the port")
    play(SensorLoggerApp(drive), f"http://127.0.0.1:{port}/", 20.0)
    bench.until(lambda: len(heard) > 500, "samples")
    took = end(process, signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert took < 1.5 and "Traceback" not in errors
    assert alone or f"push to http://127.0.0.1:{port}/" in errors


@pytest.mark.long
def test_what_the_twin_follows_is_recorded_beside(bench, drive, twin_path, tmp_path):
    port, bag = free_port(), tmp_path / "drive"
    url = f"sensorlogger://127.0.0.1:{port}"
    process = start(run_command("--twin", twin_path, "--source", url, "--record", bag))
    bench.until(lambda: is_open(port), "the port", 60.0)
    play(SensorLoggerApp(drive), f"http://127.0.0.1:{port}/", 20.0).join(30.0)
    bench.spin(0.5)
    end(process, signal.SIGTERM)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    assert out.startswith(f"Writes {bag}\n") and f"positions written to {bag}" in errors
    recorded = read_drive(bag)
    assert len(recorded.imu) == len(drive.imu) and len(recorded.fix) == len(drive.fix)
    assert main(["run", "--twin", str(twin_path), "--source", url, "--record", str(bag)]) == 2  # it exists
    assert (
        main(["run", "--twin", str(twin_path), "--record", str(tmp_path / "other")]) == 2
    )  # without a source


def push_until_refused(port: int, acknowledged: list[float]) -> None:
    """Push a fifth of a second at a time as fast as it is taken; ``acknowledged`` gets the stamps, in s."""
    up, still = {"x": 0.0, "y": 0.0, "z": 9.81}, {"x": 0.0, "y": 0.0, "z": 0.0}
    begin, number = time.time_ns() - 60_000_000_000, 0
    with contextlib.suppress(OSError, http.client.HTTPException):
        connection = http.client.HTTPConnection("127.0.0.1", port)
        while True:
            stamps = [begin + 10_000_000 * (20 * number + k) for k in range(20)]
            readings = [
                {"name": name, "time": ns, "values": values}
                for ns in stamps
                for name, values in (("totalacceleration", up), ("gyroscope", still))
            ]
            body = {"messageId": number, "sessionId": "s", "deviceId": "d", "payload": readings}
            connection.request("POST", "/", json.dumps(body), {"Content-Type": "application/json"})
            if connection.getresponse().read() != b"ok":
                return
            acknowledged += [ns / 1e9 for ns in stamps]
            number += 1


@pytest.mark.long
def test_whatever_was_acknowledged_is_recorded_when_it_is_killed(bench, twin_path, tmp_path):
    port, bag, acknowledged = free_port(), tmp_path / "drive", []
    url = f"sensorlogger://127.0.0.1:{port}"
    process = start(run_command("--twin", twin_path, "--source", url, "--record", bag))
    bench.until(lambda: is_open(port), "the port", 60.0)
    sender = threading.Thread(target=push_until_refused, args=(port, acknowledged))
    sender.start()
    bench.until(lambda: len(acknowledged) > 800, "pushes")
    end(process, signal.SIGTERM)
    _, errors = process.communicate()
    sender.join(10.0)
    assert process.returncode == 0 and "InvalidHandle" not in errors and "Traceback" not in errors, errors
    assert len(read_drive(bag).imu) >= len(acknowledged)


def test_wrong_sources_end_in_one_line(bench, twin_path, capfd):
    with pytest.raises(InputError, match="none is given"):
        bench.make(SourceNode)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for source, words in (
            ("sensorlogger://127.0.0.1:1?axes=no", "axes: must be one of"),
            (f"sensorlogger://127.0.0.1:{port}", "the port is in use"),
        ):
            assert main(["run", "--twin", str(twin_path), "--source", source]) == 2
            out, errors = capfd.readouterr()
            assert words in errors and errors.count("\n") == 1 and out == "", errors
    assert main(["run", "--twin", str(twin_path), "--source", "sensorlogger://:1", "--bag", os.devnull]) == 2
