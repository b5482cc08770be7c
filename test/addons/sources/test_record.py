# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin record``: what an app sends becomes a drive that the other commands take."""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2.storage_mcap import McapWriter
from sensor_logger_app import SensorLoggerApp

from suspension_twin.addons.sources.common import recorder as recorder_module
from suspension_twin.addons.sources.common.hub import Hub, Packet
from suspension_twin.addons.sources.common.recorder import LiveRecorder
from suspension_twin.addons.sources.common.runner import SourceLoop
from suspension_twin.cli.main import main
from suspension_twin.drive import write
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.recording import read_recording
from suspension_twin.drive.types import Drive, HeadingData, ImuData
from suspension_twin.errors import WorkError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.vehicle.twin import load_twin


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_port(port: int, process: subprocess.Popen[str], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while True:
        assert process.poll() is None and time.monotonic() < end, process.communicate()
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "suspension_twin", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def recorded(bump: Drive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The drive recorded by the command, and what it printed."""
    folder, port = tmp_path_factory.mktemp("record"), free_port()
    process = start("record", "--source", f"sensorlogger://127.0.0.1:{port}", "--out", folder / "live")
    wait_for_port(port, process)
    asyncio.run(
        SensorLoggerApp(bump, platform="ios", sensors=_IPHONE).push(f"http://127.0.0.1:{port}/", 20.0)
    )
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    return folder, out


_IPHONE = ("accelerometer", "gravity", "gyroscope", "location")


def test_it_says_what_it_writes_and_what_it_has(recorded: tuple[Path, str], bump: Drive) -> None:
    folder, out = recorded
    lines = out.splitlines()
    assert lines[0] == f"Writes {folder / 'live'}"
    assert lines[-1] == f"Written to {folder / 'live'}"
    assert f"IMU: {len(bump.imu)} samples" in out and "gravity: on" in out
    assert [p.name for p in folder.iterdir()] == ["live"]


def test_path_and_gap_are_those_of_the_imported_recording(
    recorded: tuple[Path, str], bump: Drive, repository: Path, tmp_path: Path
) -> None:
    twin = load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")
    export = SensorLoggerApp(bump, platform="ios", sensors=_IPHONE).export(tmp_path / "export")
    imported = simulate_drive(import_drive([export]).drive, twin)
    live = simulate_drive(read_drive(recorded[0] / "live"), twin)
    assert live.gap.rms == pytest.approx(imported.gap.rms, rel=0.01)
    there, here = imported.observation.trajectory, live.observation.trajectory
    np.testing.assert_allclose(np.interp(there.t, here.t, here.x), there.x, atol=0.01)
    np.testing.assert_allclose(np.interp(there.t, here.t, here.y), there.y, atol=0.01)


def test_the_commands_take_it_as_it_is(recorded: tuple[Path, str], repository: Path, tmp_path: Path) -> None:
    twin = str(repository / "bags" / "bump_15kmh" / "twin.yaml")
    assert main(["simulate", "--twin", twin, str(recorded[0] / "live"), "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "gap.json").read_text())["rms"] > 0


def test_nothing_received_is_a_failure_that_leaves_nothing(tmp_path: Path) -> None:
    process = start(
        "record", "--source", "sensorlogger://127.0.0.1:0", "--out", tmp_path / "live", "--seconds", "0.2"
    )
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.splitlines()[-1].endswith("live: nothing recorded, no IMU sample arrived")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--source", "sensrlogger://127.0.0.1:1"], "did you mean sensorlogger"),
        (["--source", "sensorlogger://0.0.0.0:1?token=x"], "token: must have 8 characters"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, words, tmp_path, capsys) -> None:
    assert main(["record", *arguments, "--out", str(tmp_path / "live")]) == 2
    out, errors = capsys.readouterr()
    assert out == "" and words in errors and errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_every_stream_is_written(tmp_path: Path, bump: Drive) -> None:
    heading = HeadingData(bump.fix.t, np.linspace(0.0, 1.0, len(bump.fix)))
    with LiveRecorder(tmp_path / "a.mcap") as recorder:
        for samples in (bump.imu, bump.fix, bump.velocity, heading):
            recorder.write([Packet("phone", samples, 0.0)])
    drive = read_drive(tmp_path / "a.mcap")
    assert recorder.counts == {
        "imu": 801,
        "fix": len(bump.fix),
        "vel": len(bump.velocity),
        "heading": len(bump.fix),
    }
    assert drive.heading is not None
    np.testing.assert_allclose(drive.heading.yaw, heading.yaw)
    np.testing.assert_allclose(drive.imu.t, bump.imu.t, atol=1e-9)


@pytest.mark.parametrize("name", ["a", "a.mcap"])
def test_what_a_receiver_alone_gave_is_kept_and_said(name: str, tmp_path: Path, bump: Drive) -> None:
    with (
        pytest.raises(WorkError, match="no IMU sample arrived") as caught,
        LiveRecorder(tmp_path / name) as recorder,
    ):
        for samples in (bump.fix, bump.velocity):
            recorder.write([Packet("receiver", samples, 0.0)])
    assert f"({len(bump.fix)} fix, {len(bump.velocity)} vel)" in str(caught.value)
    contents = read_recording(tmp_path / name)
    assert {topic: len(found.data) for topic, found in contents.topics.items()} == {
        "/fix": len(bump.fix),
        "/vel": len(bump.velocity),
    }


@pytest.mark.long
def test_of_a_killed_recording_all_but_the_last_seconds_is_there(
    bump: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As when the laptop's battery is empty at the end of a ride."""
    port = free_port()
    process = start("record", "--source", f"sensorlogger://127.0.0.1:{port}", "--out", tmp_path / "live")
    wait_for_port(port, process)

    app = SensorLoggerApp(bump, platform="ios", sensors=_IPHONE)
    asyncio.run(app.push_until(f"http://127.0.0.1:{port}/", 6.0, process.kill))
    process.communicate()
    drive_found = read_drive(tmp_path / "live")
    assert drive_found.imu.t[-1] - drive_found.imu.t[0] > 3.0
    assert any("cut off" in warning for warning in drive_found.warnings)
    assert (tmp_path / "live" / "metadata.yaml").is_file()
    # nobody writes over it
    assert main(["record", "--source", "sensorlogger://127.0.0.1:0", "--out", str(tmp_path / "live")]) == 2
    assert "exists already" in capsys.readouterr().err
    assert len(read_drive(tmp_path / "live").imu) == len(drive_found.imu)


@pytest.mark.parametrize("name", ["live", "live.mcap"])
def test_a_full_disk_leaves_what_was_recorded_until_then(
    name: str, bump: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "_FLUSH", 0.0)
    monkeypatch.setattr(write, "_KEEP", 0.0)
    closed, chunks = McapWriter.close_chunk, 0

    def full(self: McapWriter) -> None:
        nonlocal chunks
        chunks += 1
        if chunks > 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        closed(self)

    monkeypatch.setattr(McapWriter, "close_chunk", full)
    with pytest.raises(WorkError, match="No space left"), LiveRecorder(tmp_path / name) as recorder:
        for part in range(0, 800, 100):
            recorder.write([Packet("phone", bump.imu.select(slice(part, part + 100)), 0.0)])
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == [name]
    np.testing.assert_array_equal(read_drive(tmp_path / name).imu.t, bump.imu.t[:400])


@pytest.mark.parametrize("name", ["live", "live.mcap"])
def test_what_a_recording_replaces_stays_where_nothing_comes(name: str, bump: Drive, tmp_path: Path) -> None:
    with LiveRecorder(tmp_path / name) as recorder:
        recorder.write([Packet("phone", bump.imu, 0.0)])
    with pytest.raises(WorkError, match="nothing recorded"), LiveRecorder(tmp_path / name, overwrite=True):
        pass
    assert len(read_drive(tmp_path / name).imu) == len(bump.imu)
    with LiveRecorder(tmp_path / name, overwrite=True) as recorder:
        recorder.write([Packet("phone", bump.imu.select(slice(0, 100)), 0.0)])
    assert len(read_drive(tmp_path / name).imu) == 100
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_samples_that_nobody_takes_are_counted_and_dropped() -> None:
    hub = Hub()
    device = hub.device("imu")
    assert device is not None
    t = 1.7e9 + np.arange(30_000) / 1000.0
    for part in np.split(t, 300):
        device.imu(part, np.full((100, 3), 9.81), np.zeros((100, 3)), float(part[-1]))
    kept = ImuData.joined([p.samples for p in hub.take()])
    assert len(kept) == 20_000 and hub.dropped == 10_000
    assert kept.t[-1] == t[-1]


def test_an_interrupt_that_meets_a_task_is_no_traceback(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while a sample is being handed on; another error of a task is said."""
    # the limit of lines is the process's: a test of it, run shortly before, has used it up
    monkeypatch.setattr(logging.getLogger("asyncio"), "filters", [])
    runner = SourceLoop(["sensorlogger://127.0.0.1:0"], Hub())
    loop = runner._loop
    for error in (KeyboardInterrupt(), ValueError("lost")):
        loop.call_exception_handler({"message": "never retrieved", "exception": error})
    runner.close()
    assert "lost" in caplog.text and "Interrupt" not in caplog.text
