# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin run`` and the nodes as programs: how they start, fail and end."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from rich.console import Console

from suspension_twin.addons.nodes.source import SourceNode
from suspension_twin.cli._status import UpdatedLines, conclusion, line
from suspension_twin.cli.main import main
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.live.gap import GapNow
from suspension_twin.nodes.composed import KINDS, Condition, Played
from suspension_twin.nodes.parameters import check_names, read_param_file
from suspension_twin.vehicle.twin import load_twin

NODES = ("imu_ingest", "pose_injector", "suspension_model", "calibrator")


def start(arguments: list[str], **environment: str) -> subprocess.Popen[str]:
    """A program of its own; its words are piped."""
    return subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )


def program(node: type) -> list[str]:
    """A node as a program, which an installation has under the node's name."""
    call = f"import sys; from {node.__module__} import {node.__name__} as node; sys.exit(node.main())"
    return [sys.executable, "-c", call]


def run_command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "suspension_twin", "run", *map(str, arguments)]


def wait_for(bench, name: str) -> None:
    """Until a node of that name is seen."""
    bench.until(lambda: name in bench.side.get_node_names(), f"the node {name}", 60.0)


def end(process: subprocess.Popen[str], number: int) -> float:
    """Send the signal; seconds until the process was gone."""
    began = time.monotonic()
    process.send_signal(number)
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return time.monotonic() - began


@pytest.mark.parametrize(("mode", "number"), [("live", signal.SIGTERM), ("looped", signal.SIGINT)])
@pytest.mark.long
def test_it_ends_within_a_second_with_status_0(bench, twin_path, recorded, mode, number):
    more = [] if mode == "live" else ["--bag", recorded, "--rate", "max", "--loop"]
    process = start(run_command("--twin", twin_path, *more))
    wait_for(bench, "suspension_model")
    bench.spin(0.5)
    took = end(process, number)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert took < 1.0


def test_a_signal_that_is_lost_in_a_destructor_ends_it_without_a_word():
    script = """
import os, signal, time, weakref
from suspension_twin.nodes.process import stopping

class Thing:
    pass

def dying(_):
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.1)

with stopping():
    thing = Thing()
    watch = weakref.ref(thing, dying)
    del thing
    print("went on", flush=True)
    time.sleep(30.0)
"""
    process = start([sys.executable, "-c", script])
    words, errors = process.communicate(timeout=60.0)
    assert process.returncode == 0 and words == "went on\n" and errors == ""


def test_it_ends_in_time_even_from_within_compiled_code():
    script = """
import numba
from suspension_twin.nodes.process import stopping

@numba.njit(nogil=True)
def compute(n):
    x = 1.0
    for i in range(n):
        x = (x * 1.000001 + i) % 1e9
    return x

compute(10)
with stopping():
    print("deep", flush=True)
    compute(10**12)
"""
    process = start([sys.executable, "-c", script])
    assert process.stdout is not None and process.stdout.readline() == "deep\n"
    assert end(process, signal.SIGTERM) < 1.2
    assert process.returncode == 0


@pytest.mark.long
def test_each_node_is_a_program_of_its_own(bench, twin_path):
    programs = {}
    for node in NODES:
        arguments = ["--ros-args", "-p", f"twin:={twin_path}", "-r", f"__node:={node}_alone"]
        programs[node] = start([*program(KINDS[node]), *arguments])
    for node in NODES:
        wait_for(bench, f"{node}_alone")
    for number, (_, process) in enumerate(programs.items()):
        took = end(process, signal.SIGTERM if number % 2 else signal.SIGINT)
        _, errors = process.communicate()
        assert process.returncode == 0, errors
        assert "Traceback" not in errors
        assert took < 1.0


@pytest.mark.long
def test_a_node_with_a_wrong_parameter_ends_with_status_2_and_one_line():
    arguments = ["--ros-args", "-p", "filter.cutoff:=-3.0"]
    process = start([*program(KINDS["imu_ingest"]), *arguments])
    _, errors = process.communicate(timeout=60.0)
    assert process.returncode == 2
    assert errors.count("\n") == 1 and "filter.cutoff" in errors


@pytest.mark.parametrize("given", [["stray"], ["--ros-args", "-p", "threads:=1", "--", "--late"]])
def test_a_node_names_an_argument_that_it_does_not_know(given, capsys):
    assert KINDS["calibrator"].main(["calibrator", *given]) == 2
    assert capsys.readouterr().err == f"{given[-1]}: unknown argument: arguments for ROS follow --ros-args\n"


@pytest.mark.long
def test_a_recording_is_replayed_at_full_speed_to_its_end(recorded, twin_path, drive):
    process = start(run_command("--twin", twin_path, "--bag", recorded, "--rate", "max"))
    _, errors = process.communicate(timeout=120.0)
    assert process.returncode == 0, errors
    answers, live, last = errors.strip().splitlines()[-3:]
    assert answers.startswith(f"{len(drive.imu) - 16} answers to {len(drive.imu)} IMU samples")
    assert "clock has not advanced" not in errors and "loop" not in errors
    gap = simulate_drive(read_drive(recorded), load_twin(twin_path)).gap
    assert last == f"Gap over all driving: {gap.rms:.3f} m/s² rms"
    now, offline = map(float, re.findall(r"\d\.\d{3}", live))
    # the true twin: live, the errors of the pose are most of its gap
    assert live.startswith("Live gap since the twin settled: ") and 0.0 < offline < now < 2.0 * offline


@pytest.mark.long
def test_at_full_speed_a_subscriber_gets_every_answer_and_does_not_hold_up_the_replay(
    bench, recorded, twin_path, drive
):
    from geometry_msgs.msg import AccelStamped

    heard = bench.hear(AccelStamped, "twin/vertical_acceleration")
    process = start(run_command("--twin", twin_path, "--bag", recorded, "--rate", "max", "--loop"))

    def beginnings() -> np.ndarray:
        """Where time has jumped back: from the second round on the two have found each other for long."""
        stamps = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in heard])
        return 1 + np.flatnonzero(np.diff(stamps) < 0.0)

    bench.until(lambda: beginnings().size > 0, "the second round", 120.0)
    began = time.monotonic()
    bench.until(lambda: beginnings().size > 1, "the third round", 120.0)
    took = time.monotonic() - began
    end(process, signal.SIGTERM)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    first, last = beginnings()[:2]
    assert last - first == len(drive.imu) - 16
    # It would wait for most of a second after every 50 messages if it asked for them every 3 s: 34 s for these 14.
    assert took < 2.0 * np.ptp(drive.imu.t)


@pytest.mark.long
def test_parameters_come_from_a_file_and_names_from_a_namespace(bench, recorded, twin_path, tmp_path):
    params = tmp_path / "params.yaml"
    params.write_text(
        yaml.safe_dump(
            {
                "/**": {"ros__parameters": {"filter": {"cutoff": 15.0}}},
                "/car/suspension_model": {"ros__parameters": {"gap.window": 4.0}},
            }
        )
    )
    process = start(run_command("--twin", twin_path, "--namespace", "car", "--params", params))
    wait_for(bench, "suspension_model")
    from rcl_interfaces.srv import GetParameters

    request = GetParameters.Request(names=["filter.cutoff", "gap.window", "twin"])
    values = bench.call(GetParameters, "/car/suspension_model/get_parameters", request).values
    assert (values[0].double_value, values[1].double_value) == (15.0, 4.0)
    assert values[2].string_value == str(twin_path)
    end(process, signal.SIGTERM)
    assert process.returncode == 0


def test_topics_are_renamed_by_ros_arguments(bench, twin_path):
    from sensor_msgs.msg import Imu

    process = start(run_command("--twin", twin_path, "--", "--ros-args", "-r", "imu/data_raw:=/phone/imu"))
    bench.speak(Imu, "/phone/imu")
    end(process, signal.SIGINT)
    assert process.returncode == 0


WRONG = [
    (["--twin", "absent.yaml"], "absent.yaml"),
    (["--rate", "fast", "--bag", "BAG"], "--rate: must be a number above 0, or 'max', is 'fast'"),
    (["--rate", "-1", "--bag", "BAG"], "--rate"),
    (["--rate", "2"], "needs --bag"),
    (["--loop"], "needs --bag"),
    (["--bag", "absent"], "absent"),
    (["--namespace", "3d"], "--namespace"),
    (["--params", "absent.yaml"], "absent.yaml"),
    (["--params", "PARAMS"], "imu_ingest: filter.cutof: no such parameter"),
    (["--", "--ros-args", "-r", "half"], "half"),
    (["--", "stray"], "stray: unknown argument"),
    (["--", "--ros-args", "-r", "a:=b", "--", "--late"], "--late: unknown argument"),
    (["--twin", "EFFECT"], "effect.yaml: effects: there is no effect magic"),
    (["--twin", "DEEP"], "deep.yaml: not YAML"),
    (["--twin", "DATE"], "date.yaml: model: must be one of full_car, msd, tracked"),
    (["--twin=EFFECT"], "effect.yaml: effects: there is no effect magic"),
]


@pytest.mark.parametrize(("arguments", "words"), WRONG)
def test_wrong_arguments_end_with_status_2_and_one_line(
    arguments, words, twin_path, recorded, tmp_path, capfd
):
    (tmp_path / "params.yaml").write_text("imu_ingest: {ros__parameters: {filter: {cutof: 3.0}}}\n")
    effect = yaml.safe_load(twin_path.read_text(encoding="utf-8")) | {"effects": [{"id": "magic"}]}
    (tmp_path / "effect.yaml").write_text(yaml.safe_dump(effect))
    (tmp_path / "road.crg").symlink_to(twin_path.parent / "road.crg")
    (tmp_path / "deep.yaml").write_text("[" * 3000)
    (tmp_path / "date.yaml").write_text("model: 2020-99-99")
    known = {
        "DEEP": str(tmp_path / "deep.yaml"),
        "DATE": str(tmp_path / "date.yaml"),
        "BAG": str(recorded),
        "PARAMS": str(tmp_path / "params.yaml"),
        "EFFECT": str(tmp_path / "effect.yaml"),
        "--twin=EFFECT": f"--twin={tmp_path / 'effect.yaml'}",
    }
    given = [known.get(a, a) for a in arguments]
    if not any(a.startswith("--twin") for a in given):
        given = ["--twin", str(twin_path), *given]
    assert main(["run", *given]) == 2
    out, errors = capfd.readouterr()
    assert words in errors and errors.count("\n") == 1 and not out


def test_parameter_files_are_read_with_namespaces_nested_or_written_out(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(
        "/**: {ros__parameters: {use_sim_time: true, filter: {order: 2}}}\n"
        "car: {imu_ingest: {ros__parameters: {max_bias: 0.1}}}\n"
        "/car/calibrator: {ros__parameters: {threads: 1}}\n"
        "someone_else: {ros__parameters: {colour: blue}}\n"
    )
    wanted = read_param_file(path)
    assert wanted["/**"] == {"use_sim_time": True, "filter.order": 2}
    assert wanted["car/imu_ingest"] == {"max_bias": 0.1}
    known = {"imu_ingest": ["use_sim_time", "filter.order", "max_bias"], "calibrator": ["threads"]}
    check_names(path, wanted, known)
    with pytest.raises(InputError, match="threads"):
        check_names(path, wanted, {**known, "calibrator": []})
    with pytest.raises(InputError, match=r"filter\.order"):
        check_names(path, wanted, {"imu_ingest": ["use_sim_time", "max_bias"]})


@pytest.mark.parametrize(
    "text",
    ["- a\n", "a: 3\n", "a: {ros__parameters: 3}\n", "a: {b: c}\n", ": :", "\t", "[" * 3000, "a: 2020-99-99"],
)
def test_what_is_no_parameter_file_is_refused_by_name(tmp_path, text):
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"params\.yaml"):
        read_param_file(path)


CONDITION = Condition(
    rates={"imu": 100.0, "fix": 10.0},
    samples=500,
    answers=484,
    gap=GapNow(0.1834, 0.5, 0.07, 2.71, (), 100),
    complaints=["imu_ingest: too loud", "another"],
    failing=False,
    played=Played(12.04, 44.9, 1),
)


def test_the_status_line_says_where_it_is_and_what_is_wrong():
    text = line(CONDITION).plain
    assert "12 of 45 s, loop 2" in text and "imu 100, fix 10 Hz" in text
    assert "gap now 0.18 m/s² (2.7 × noise)" in text and "imu_ingest: too loud (+1)" in text
    from dataclasses import replace

    live = line(replace(CONDITION, played=None, gap=None, complaints=[], rates={"imu": float("nan")})).plain
    assert "of" not in live and "gap now -" in live and "nan" not in live


def test_the_status_line_fits_80_columns():
    from dataclasses import replace

    rates = {"imu": 1600.0, "fix": 20.0, "vel": 20.0, "twin": 1600.0}
    for position, rounds, gap in ((12.0, 0, 0.2), (3599.0, 12, 12.34), (12.0, 1, None)):
        shown = replace(
            CONDITION,
            rates=rates,
            played=Played(position, 3600.0, rounds),
            gap=gap and replace(CONDITION.gap, rms=gap, normalised=123.4),
        )
        first, second = line(shown).plain.split("\n")
        assert len(first) <= 80 and "imu 1600" in first and "twin 1600" in first
        assert (gap is None or f"gap now {gap:.2f} m/s²" in first) and second.startswith(
            "imu_ingest: too loud"
        )


@pytest.mark.parametrize("node", NODES)
def test_a_node_program_answers_help(node, capsys):
    assert KINDS[node].main([node, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"Usage: {node} [--ros-args") and max(map(len, out.splitlines())) <= 80
    assert all(f"  {p.name} = " in out for p in KINDS[node].parameters) and "``" not in out


def test_help_into_a_pipe_that_is_closed_is_no_traceback():
    node = subprocess.Popen(
        [*program(SourceNode), "--help"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    node.stdout.close()
    assert node.wait(60) == 1 and node.stderr.read() == ""
    node.stderr.close()


@pytest.mark.parametrize("terminal", [True, False])
def test_the_status_is_shown_on_a_terminal_and_in_a_log(terminal):
    class Fake:
        model = SimpleNamespace(whole_gap=lambda: 0.21)

        def condition(self) -> Condition:
            return CONDITION

    out = io.StringIO()
    with UpdatedLines(Console(file=out, force_terminal=terminal, width=200), 0.0, 60.0) as lines:
        lines.show(lambda: [line(CONDITION)])
        lines.show(lambda: [line(CONDITION)])
        lines.conclude(conclusion(Fake(), 1.0))  # type: ignore[arg-type]
    shown = out.getvalue()
    assert "gap now 0.18" in shown and "484 answers to 500 IMU samples" in shown
    assert shown.count("too loud") == (2 if terminal else 1) or terminal


def test_a_bag_without_an_answer_ends_with_status_1_and_one_line(twin_path, drive, tmp_path, capfd):
    """No fix is usable, so the twin never learns where it is."""
    from dataclasses import replace

    lost = replace(drive.fix, status=np.full(len(drive.fix), -1, dtype=np.int8))
    write_drive(replace(drive, fix=lost), tmp_path / "lost")
    assert main(["run", "--twin", str(twin_path), "--bag", str(tmp_path / "lost"), "--rate", "max"]) == 1
    _, errors = capfd.readouterr()
    last = errors.strip().splitlines()[-1]
    assert last.startswith(f"suspension-twin: {tmp_path / 'lost'}: the twin answered none of ")
    assert "answers to" not in errors
