# SPDX-License-Identifier: Apache-2.0
"""README.md and docs/commands.md: every command in them is run, the table is the program's, links lead somewhere."""

from __future__ import annotations

import ast
import csv
import importlib.util
import io
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot

from suspension_twin.cli.main import main, subcommands
from suspension_twin.drive.read import read_drive
from suspension_twin.vehicle.twin import load_twin

README = Path(__file__).resolve().parents[2] / "README.md"
ROOT = README.parent
COMMANDS = ROOT / "docs" / "commands.md"


def blocks(language: str, page: Path = README) -> list[str]:
    """The examples of a page in one language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def commands(page: Path = README) -> list[str]:
    """Every command of a page."""
    return [
        line
        for block in blocks("bash", page)
        for line in block.splitlines()
        if line and not line.startswith("#")
    ]


#: In the order in which a reader meets them.
SHOWN = [*commands(), *commands(COMMANDS)]
OURS = [c for c in SHOWN if c.startswith("suspension-twin ")]
PYTHON = [c for c in SHOWN if c.startswith("python ")]
APT = commands(ROOT / "docs" / "apt.md")  # needs one; what of it can be checked without is checked
BOOTSTRAP = [c for c in SHOWN if c.startswith("python3 bootstrap.py")]


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A folder in which the commands find what the README says they find, and may write."""
    folder = tmp_path_factory.mktemp("readme")
    for name in ("bags", "config", "suspension_twin_interfaces"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "benchmarks").mkdir()
    (folder / "benchmarks" / "results").symlink_to(ROOT / "benchmarks" / "results")
    shutil.copytree(ROOT / "docs", folder / "docs")
    shutil.copy(README, folder)
    (folder / "recording.zip").write_bytes(phone_recording())
    return folder


def phone_recording() -> bytes:
    """What Sensor Logger would have exported of the first seconds of a bundled drive."""
    drive = read_drive(ROOT / "bags" / "crg_road")
    first = drive.imu.t < drive.imu.t[0] + 10
    t0 = drive.imu.t[0]
    files = {}
    for name, values in (
        ("TotalAcceleration", drive.imu.specific_force),
        ("Gyroscope", drive.imu.angular_rate),
    ):
        rows = [
            [f"{t * 1e9:.0f}", f"{t - t0:.6f}", *map(repr, v[::-1].tolist())]
            for t, v in zip(drive.imu.t[first], values[first], strict=True)
        ]
        files[f"{name}.csv"] = [["time", "seconds_elapsed", "z", "y", "x"], *rows]
    rows = []
    for i in np.flatnonzero(drive.fix.t < t0 + 10)[::10]:
        fix, v = drive.fix, drive.velocity.enu[i]
        course = np.degrees(np.arctan2(v[0], v[1])) % 360
        rows.append(
            [
                f"{fix.t[i] * 1e9:.0f}",
                f"{fix.t[i] - t0:.6f}",
                course,
                np.hypot(v[0], v[1]),
                fix.altitude[i],
                3.0,
                1.0,
                fix.longitude[i],
                fix.latitude[i],
            ]
        )
    heads = [
        "time",
        "seconds_elapsed",
        "bearing",
        "speed",
        "altitude",
        "horizontalAccuracy",
        "speedAccuracy",
        "longitude",
        "latitude",
    ]
    files["Location.csv"] = [heads, *rows]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, table in files.items():
            text = io.StringIO()
            csv.writer(text).writerows(table)
            archive.writestr(name, text.getvalue())
    return buffer.getvalue()


def environment() -> dict[str, str]:
    return {**os.environ, "COLUMNS": "100"}


def run(arguments: list[str], folder: Path, limit: float = 240) -> str:
    done = subprocess.run(
        arguments, cwd=folder, env=environment(), capture_output=True, text=True, timeout=limit, check=False
    )
    assert done.returncode == 0, f"{arguments}: {done.stderr[-2000:]}"
    assert "Traceback" not in done.stderr
    return done.stdout


def ours(command: str) -> list[str]:
    return [sys.executable, "-m", "suspension_twin", *shlex.split(command)[1:]]


def is_live(command: str) -> bool:
    return " run " in command and "--bag" not in command and not is_received(command)


def is_received(command: str) -> bool:
    """Waits for a phone."""
    return "--source" in command or " connect" in command


def is_long(command: str) -> bool:
    """Run for real by tests of its own; here only its arguments are tried."""
    return " diagnose " in command


def is_fleet(command: str) -> bool:
    """Starts processes of its own: run by the tests of fleets, and here only its arguments are tried."""
    return " fleet " in command


def test_every_command_is_of_a_kind_that_is_run():
    others = [c for c in SHOWN if c not in OURS + PYTHON + BOOTSTRAP]
    assert others == [". .venv/bin/activate"]
    assert {shlex.split(c)[1] for c in OURS} | {"demo"} == {s.name for s in subcommands()}


def test_the_commands_do_what_they_say(workspace, monkeypatch, capsys):
    """One after the other, as a reader would: later ones use what earlier ones wrote."""
    monkeypatch.chdir(workspace)
    monkeypatch.setenv("COLUMNS", "100")
    for command in OURS:
        if is_live(command) or is_received(command) or is_long(command) or is_fleet(command):
            continue
        if "--mapping" in command:
            continue
        if " run " in command:  # starts ROS and listens to signals: in a process of its own
            run(ours(command), workspace)
        else:
            assert main(shlex.split(command)[1:]) == 0, capsys.readouterr().err
    drive = read_drive(workspace / "drive")
    assert len(drive.imu) > 950
    gaps = [json.loads((workspace / "out" / name / "gap.json").read_text()) for name in ("before", "after")]
    assert gaps[1]["rms"] < 0.5 * gaps[0]["rms"]
    assert load_twin(workspace / "out" / "calibrated.yaml").vehicle.mass == 1725.0
    assert (workspace / "out" / "road.png").read_bytes()[:4] == b"\x89PNG"
    assert (workspace / "out" / "road.obj").stat().st_size > 10_000
    assert any((workspace / "out" / "report").glob("*.html"))


def test_the_example_in_python_runs(workspace, monkeypatch, capsys):
    """At most ten statements from a bag to a plot."""
    monkeypatch.chdir(workspace)
    (code,) = blocks("python")
    assert len(ast.parse(code).body) <= 10
    exec(compile(code, README.name, "exec"), {})
    pyplot.close("all")
    said = capsys.readouterr().out
    assert "Drive crg_road" in said and "Calibration of Ford Mondeo" in said and len(said.splitlines()) < 30
    assert (workspace / "drive.png").read_bytes()[:4] == b"\x89PNG"


def test_the_table_of_packages_is_that_of_the_tree():
    rows = re.findall(
        r"^\| ((?:`\w+`(?:, )?)+) \|",
        (ROOT / "CONTRIBUTING.md").read_text("utf-8").partition("| package |")[2].partition("\n## ")[0],
        re.MULTILINE,
    )
    named = [name for row in rows for name in re.findall(r"\w+", row)]
    tree = {p.parent.name for p in (ROOT / "suspension_twin").glob("*/__init__.py")}
    assert sorted(named) == sorted(tree)


def test_the_mapping_command_reads_the_real_recording(workspace, shared_data):
    (command,) = (c for c in OURS if "--mapping" in c)
    (workspace / "logger").symlink_to(shared_data / "rtklibexplorer_GNSS_IMU")
    run(ours(command), workspace)
    assert len(read_drive(workspace / "drive_0708").imu) > 50_000


@pytest.mark.parametrize("command", [c for c in OURS if is_long(c)])
def test_the_long_commands_take_their_arguments(command, tmp_path, monkeypatch, capsys):
    """In a folder without the files it gets as far as missing the twin file."""
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(command)[1:]) == 2
    assert capsys.readouterr().err == "suspension-twin: out/calibrated.yaml: No such file or directory\n"


@pytest.mark.parametrize("command", [c for c in OURS if is_fleet(c)])
def test_the_fleet_commands_take_their_arguments(command, tmp_path, monkeypatch, capsys):
    """In a folder without the files it gets as far as missing the manifest."""
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(command)[1:]) == 2
    assert capsys.readouterr().err == "suspension-twin: config/fleet.yaml: No such file or directory\n"


@pytest.mark.parametrize("command", [c for c in OURS if is_live(c)])
@pytest.mark.long
def test_the_live_commands_run_until_they_are_asked_to_end(command, workspace):
    process = subprocess.Popen(
        ours(command),
        cwd=workspace,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        time.sleep(8)
        assert process.poll() is None, process.stderr.read()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 0
    assert "Traceback" not in errors


@pytest.mark.parametrize("command", [c for c in OURS if is_received(c)])
def test_the_commands_for_a_phone_hear_it(command, workspace):
    """They print an address; what is pushed there arrives."""
    is_run, is_guided = " run " in command, " first-drive " in command
    if " connect" in command:
        command += " sensorlogger://0.0.0.0:8000"  # which is what it listens to without a word
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        ours(command.replace(":8000", f":{port}")),
        cwd=workspace,
        env={**environment(), "XDG_STATE_HOME": str(workspace / "state")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        heard, found = "", None
        while not found and (line := process.stdout.readline()):
            heard += line
            found = re.search(r"push to http://[\d.]+(:\d+/\?token=\S+)$", line)
        assert found, heard
        for number in range(10):
            sent = json.dumps(
                {"messageId": number, "sessionId": "s", "deviceId": "d", "payload": second(number)}
            )
            request = urllib.request.Request(f"http://127.0.0.1{found[1]}", sent.encode())
            assert urllib.request.urlopen(request, timeout=20).status == 200
        time.sleep(1)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == int(is_guided), out
    assert "phone d: connected" in out
    assert not is_guided or ("Stand still: gyroscope" in out and "ended after 0 of 3 passes" in out)
    assert is_run or is_guided or "1000 samples" in out or "IMU: 100.0 Hz, no gaps" in out


def second(number: int) -> list[dict]:
    """A second of standing, as Sensor Logger sends it: the phone leans back by 15°, as in the bundled drives."""
    t = [1_700_000_000_000_000_000 + number * 1_000_000_000 + k * 10_000_000 for k in range(100)]
    sensors = {"totalacceleration": (9.476, 2.539), "gyroscope": (0.0, 0.0)}
    return [
        {"name": name, "time": at, "values": {"x": 0.0, "y": y, "z": z}}
        for name, (y, z) in sensors.items()
        for at in t
    ]


@pytest.mark.long
@pytest.mark.parametrize("command", PYTHON)
def test_the_python_commands_run(command, workspace):
    if "make_bags" in command:
        pytest.importorskip("mujoco")
    run([sys.executable, *shlex.split(command)[1:]], workspace)


@pytest.mark.parametrize("command", BOOTSTRAP)
def test_the_set_up_knows_its_commands(command):
    """The demo and the set-up itself have tests of their own."""
    _, script, name, *rest = shlex.split(command)
    assert name in {"test", "check"} | {s.name for s in subcommands()}
    assert name in run([sys.executable, script, "--help"], ROOT)
    for argument in rest:
        assert argument.startswith("-") or (ROOT / argument).exists()


def test_the_steps_in_an_apt_jazzy_bring_everything_that_the_package_needs():
    """What pip installs there, together with what rosdep finds by package.xml, is what setup.py asks for."""
    assert "colcon build --base-paths . suspension_twin_interfaces" in APT
    manifest = ElementTree.parse(ROOT / "package.xml")
    apt = {
        e.text.removeprefix("python3-") for e in manifest.iter("exec_depend") if e.text.startswith("python3-")
    }
    (pip,) = (shlex.split(c)[2:] for c in APT if c.startswith("pip install"))
    given = {re.match(r"[\w-]+", requirement)[0]: requirement for requirement in pip}
    source = (ROOT / "setup.py").read_text(encoding="utf-8")
    required = next(
        ast.literal_eval(n.value)
        for n in ast.parse(source).body
        if isinstance(n, ast.Assign) and n.targets[0].id == "REQUIRED"
    )
    brought = {"suspension-twin-interfaces", "llvmlite", "cycler", "markupsafe"}  # by the others
    names = {"pyyaml": "yaml"}
    for requirement in required:
        name = re.match(r"[\w-]+", requirement)[0]
        if name in given:
            assert given[name] in (requirement.partition(";")[0], name), requirement
        else:
            assert name in brought or names.get(name, name) in apt, f"{requirement} comes from nowhere"


def test_the_launch_file_takes_the_argument_named():
    tree = ast.parse((ROOT / "launch" / "suspension_twin.launch.py").read_text(encoding="utf-8"))
    declared = {
        n.args[0].value
        for n in ast.walk(tree)
        if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "DeclareLaunchArgument"
    }
    assert "twin" in declared
    assert (ROOT / "suspension_twin_interfaces" / "package.xml").is_file()


def test_tables_are_the_program_s():
    assert load(ROOT / "docs" / "make_docs.py").brought_up_to_date(COMMANDS) == COMMANDS.read_text("utf-8"), (
        "run: python docs/make_docs.py tables"
    )


def test_it_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) < 130


def test_links_and_pictures_lead_somewhere():
    links = re.findall(r"\]\(([^)]+)\)", README.read_text(encoding="utf-8"))
    assert len(links) > 8
    for link in links:
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        page = ROOT / path if path else README
        assert page.exists(), link
        headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE) if anchor else []
        anchors = {re.sub(r"[^a-z0-9 -]", "", h.lower()).replace(" ", "-") for h in headings}
        assert not anchor or anchor in anchors, link


def test_every_benchmark_has_its_line():
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    programs = [
        p.name for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text(encoding="utf-8")
    ]
    assert len(programs) > 30
    assert [name for name in programs if not re.search(rf"[/`]{name}`|/{name} ", page)] == []
