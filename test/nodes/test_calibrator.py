# SPDX-License-Identifier: Apache-2.0
"""The action ``calibrate``: goals taken and refused, word on the way, cancelled at once."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from action_msgs.msg import GoalStatus
from nodes_bench import Client, worst
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from stand_ins import breaks, cannot, deaf, dies, five_generations, repeats_its_job, search_until_stopped

from suspension_twin.live.gap import calibration_gap
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.jobs import calibration_job
from suspension_twin.vehicle.twin import load_twin
from suspension_twin_interfaces.action import Calibrate


@pytest.fixture
def goal(twin_path, recorded, tmp_path) -> Calibrate.Goal:
    return Calibrate.Goal(
        twin=str(twin_path), bags=[str(recorded)], output=str(tmp_path / "calibrated.yaml"), seed=7
    )


def test_a_goal_is_taken_followed_and_answered(bench, goal):
    bench.make(CalibratorNode, {"calibrate": five_generations})
    client = Client(bench, Calibrate, "calibrate")
    handle = client.send(goal)
    assert handle.accepted
    status, result = client.result(handle)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.success and result.message == "found"
    assert (result.cost, result.initial_cost, result.evaluations, result.generations) == (0.5, 2.0, 5, 5)
    assert (list(result.names), list(result.values), list(result.excited)) == (
        ["vehicle.mass"],
        [1700.0],
        [True],
    )
    assert [f.generation for f in client.feedback if f.stage == "search"] == [1, 2, 3, 4, 5]
    assert client.feedback[0].stage == "reading"


@pytest.mark.parametrize("keep", [False, True])
def test_the_sensor_is_kept_where_the_node_says_so(bench, goal, keep):
    bench.make(CalibratorNode, {"calibrate": repeats_its_job}, keep_sensor=keep)
    client = Client(bench, Calibrate, "calibrate")
    assert client.result(client.send(goal))[1].message == f"keep_sensor={keep}"


@pytest.mark.long
def test_while_it_works_the_node_answers_refuses_a_second_goal_and_cancels_at_once(bench, goal):
    node = bench.make(CalibratorNode, {"calibrate": search_until_stopped})
    client = Client(bench, Calibrate, "calibrate")
    handle = client.send(goal)
    bench.until(lambda: len(client.feedback) > 5, "word of the search")

    from rcl_interfaces.srv import GetParameters

    began = time.monotonic()
    assert bench.call(
        GetParameters, "/calibrator/get_parameters", GetParameters.Request(names=["twin"])
    ).values
    assert time.monotonic() - began < 2.0
    assert not client.send(goal).accepted
    assert "a goal of calibrate is running" in worst(node)[1]

    began = time.monotonic()
    cancelling = handle.cancel_goal_async()
    status, result = client.result(handle)
    took = time.monotonic() - began
    assert len(cancelling.result().goals_canceling) == 1
    assert (
        status == GoalStatus.STATUS_CANCELED and result.success and "stopped in generation" in result.message
    )
    assert Path(result.output).read_text() == "best so far"
    assert took < 0.5 * _slowness()
    generations = [f.generation for f in client.feedback if f.stage == "search"]
    assert generations == list(range(1, len(generations) + 1))

    node.works["calibrate"] = (
        five_generations  # the next goal is welcome, and what is no result of ours stays
    )
    client.feedback.clear()
    assert "is no result of a calibration: not overwritten" in client.result(client.send(goal))[1].message
    assert Path(result.output).read_text() == "best so far"
    Path(result.output).unlink()
    assert client.result(client.send(goal))[0] == GoalStatus.STATUS_SUCCEEDED


@pytest.mark.long
def test_goals_wait_for_their_turn_where_the_node_says_so(bench, goal):
    node = bench.make(
        CalibratorNode, {"calibrate": search_until_stopped}, waiting_goals=2, cancel_patience=60.0
    )
    clients = [Client(bench, Calibrate, "calibrate") for _ in range(4)]
    first, second, third = (client.send(goal) for client in clients[:3])
    assert first.accepted and second.accepted and third.accepted and not clients[3].send(goal).accepted
    assert "a goal of calibrate is running and 2 wait" in worst(node)[1]
    bench.until(lambda: [f.stage for f in clients[1].feedback + clients[2].feedback] == ["waiting"] * 2)
    second.cancel_goal_async()
    status, result = clients[1].result(second)
    assert status == GoalStatus.STATUS_CANCELED and result.message == "cancelled while it waited"
    bench.until(lambda: any(f.stage == "search" for f in clients[0].feedback))
    node.works["calibrate"] = five_generations
    goal.overwrite = True
    fourth = clients[3].send(goal)  # in the place that has become free
    first.cancel_goal_async()
    assert clients[0].result(first)[0] == GoalStatus.STATUS_CANCELED
    status, result = clients[2].result(third)
    assert (
        status == GoalStatus.STATUS_ABORTED
        and "not overwritten, unless the goal says overwrite" in result.message
    )
    assert clients[3].result(fourth)[0] == GoalStatus.STATUS_SUCCEEDED
    assert node.health.values["state"] == "idle" and not node._waiting


def test_a_goal_waits_until_its_client_can_hear_the_answer(bench, goal, monkeypatch):
    node = bench.make(CalibratorNode, {"calibrate": five_generations})
    client = Client(bench, Calibrate, "calibrate")
    with monkeypatch.context() as patch:  # the middleware has found the client's writer, its reader not yet
        patch.setattr(node, "get_subscriptions_info_by_topic", lambda *_, **__: [])
        asked = client.action.send_goal_async(goal)
        bench.spin(0.5)
        assert not asked.done() and not client.feedback
    bench.until(asked.done, "the answer")
    assert client.result(asked.result())[0] == GoalStatus.STATUS_SUCCEEDED


@pytest.mark.long
def test_a_client_that_never_hears_an_answer_stops_the_others_until_its_goal_ends(bench, goal, recwarn):
    node = bench.make(CalibratorNode, {"calibrate": five_generations})
    client = Client(bench, Calibrate, "calibrate")
    # It asks for answers that are kept for late comers, which no service offers.
    kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    deaf_client = ActionClient(bench.side, Calibrate, "calibrate", goal_service_qos_profile=kept)
    try:
        bench.spin(0.5)
        unanswered = deaf_client.send_goal_async(goal)
        bench.until(lambda: any("will not receive" in str(w.message) for w in recwarn), "a lost answer")
        state = node.health.values
        bench.until(lambda: state["state"] != "idle", "its goal to be worked on")
        bench.until(lambda: state["state"] == "idle", "the end of its goal", 60.0)
        assert not unanswered.done()
        assert client.result(client.send(goal))[0] == GoalStatus.STATUS_SUCCEEDED
    finally:
        deaf_client.destroy()


def _slowness() -> float:
    """How much slower than idle the machine is, from its load."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@pytest.mark.long
def test_work_that_fails_is_told_in_a_line_and_the_next_goal_is_taken(bench, goal):
    node = bench.make(CalibratorNode, {"calibrate": cannot})
    client = Client(bench, Calibrate, "calibrate")
    for work, words in (
        (cannot, "bumpy: no GPS"),
        (breaks, "unexpected error, ZeroDivisionError"),  # the rest stands in the log of the node
        (dies, "worker process ended (exit status 3)"),
    ):
        node.works["calibrate"] = work
        status, result = client.result(client.send(goal))
        assert status == GoalStatus.STATUS_ABORTED and not result.success
        assert words in result.message and "\n" not in result.message
        assert words in worst(node)[1]
    node.works["calibrate"] = five_generations
    assert client.result(client.send(goal))[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_worker_that_does_not_listen_is_ended(bench, goal):
    bench.make(CalibratorNode, {"calibrate": deaf}, cancel_patience=0.3)
    client = Client(bench, Calibrate, "calibrate")
    handle = client.send(goal)
    bench.until(lambda: any(f.stage == "search" for f in client.feedback))
    handle.cancel_goal_async()
    status, result = client.result(handle, 15.0)
    assert status == GoalStatus.STATUS_CANCELED and not result.success


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"twin": "/nowhere/twin.yaml"}, "/nowhere/twin.yaml"),
        ({"twin": ""}, "twin: is empty"),
        ({"bags": []}, "bags: is empty"),
        ({"bags": [f"{tempfile.gettempdir()}/nowhere/bag"]}, "/nowhere/bag: no such recording"),
        ({"preset": "best"}, "preset: best: one of fast, paper"),
        ({"output": "/nowhere/out.yaml"}, "/nowhere/out.yaml"),
        ({"twin": "x" * 10_000 + ".yaml"}, "File name too long"),
        ({"bags": ["x" * 10_000]}, "File name too long"),
        ({"output": "x/" * 10_000 + "a.yaml"}, "File name too long"),
    ],
)
def test_a_goal_that_cannot_be_is_answered_with_what_is_wrong(bench, goal, change, words):
    bench.make(CalibratorNode, {"calibrate": five_generations})
    client = Client(bench, Calibrate, "calibrate")
    for name, value in change.items():
        setattr(goal, name, value)
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and not result.success
    assert words in result.message and "\n" not in result.message


@pytest.mark.parametrize(
    ("field", "name", "words"),
    [
        ("output", "../elsewhere/out.yaml", "lies in none of the folders that the parameter folders names"),
        ("output", "link.yaml", "lies in none of the folders"),
        ("output", ".bashrc", "must end in .yaml"),
        ("output", "kept.yaml", "is no result of a calibration: not overwritten"),
        ("bags", "../elsewhere", "lies in none of the folders"),
        ("bags", "", "own_calibrated.yaml: lies in none of the folders"),
        ("twin", "../elsewhere/secret.yaml", "lies in none of the folders"),
        ("twin", "secret.txt", "must end in .yaml"),
        ("twin", "broken.yaml", "broken.yaml: cannot be used (vehicle"),
        (
            "twin",
            "secret.yaml",
            "secret.yaml: cannot be used (vehicle, imu, its first level): the log of the node says why",
        ),
        (
            "twin",
            "unclosed.yaml",
            "unclosed.yaml: cannot be used (not YAML, line 3): the log of the node says why",
        ),
    ],
)
def test_a_goal_reads_and_writes_in_the_folders_of_the_node_alone(bench, goal, tmp_path, field, name, words):
    """And nothing of what stands in a file comes back to who asked."""
    own, elsewhere = tmp_path / "own", tmp_path / "elsewhere"
    for folder in (own, elsewhere):
        folder.mkdir()
        (folder / "secret.yaml").write_text("root:$6$hash:19000:0:99999:7:::\n")
    (own / "link.yaml").symlink_to(elsewhere / "secret.yaml")
    (own / "kept.yaml").write_text("mine")
    (own / ".bashrc").write_text("mine")
    (own / "secret.txt").write_text("root: 1\n")
    (own / "broken.yaml").write_text("model: full_car\nvehicle: {hash: 5}\nimu: {position: [0, 0, 1]}\n")
    (own / "unclosed.yaml").write_text("hash: 1\n[hash\n")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    bags = [*map(Path, goal.bags), Path(goal.twin)]
    allowed = [str(own), *(str(path.parent) for path in bags)]
    bench.make(CalibratorNode, {"calibrate": five_generations}, folders=os.pathsep.join(allowed))
    client = Client(bench, Calibrate, "calibrate")
    goal.output = str(own / "new.yaml") if name else ""
    path = str(own / name)
    setattr(goal, field, [path] if field == "bags" else path)
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and words in result.message
    assert "hash" not in result.message and "root" not in result.message.replace(str(tmp_path), "")
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_what_is_no_result_is_replaced_where_the_goal_says_so(bench, goal):
    bench.make(CalibratorNode, {"calibrate": five_generations})
    client = Client(bench, Calibrate, "calibrate")
    Path(goal.output).write_text("mine")
    assert client.result(client.send(goal))[0] == GoalStatus.STATUS_ABORTED
    goal.overwrite = True
    assert client.result(client.send(goal))[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_calibration_without_a_name_takes_one_that_is_free(tmp_path, goal, twin_path):
    goal.output = ""
    first = Path(calibration_job(goal, str(twin_path), 0).output)
    first.write_text("mine")
    assert Path(calibration_job(goal, str(twin_path), 0).output) == first.with_stem(first.stem + "_2")
    first.unlink()


def test_the_nodes_twin_and_a_place_beside_the_bag_are_the_defaults(bench, goal, twin_path, recorded):
    node = bench.make(CalibratorNode, {"calibrate": five_generations}, twin=str(twin_path))
    client = Client(bench, Calibrate, "calibrate")
    goal.twin = goal.output = ""
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.output == str(recorded.parent / "bumpy_calibrated.yaml")
    assert node.health.values["state"] == "idle"


def test_a_node_taken_down_takes_its_worker_along(bench, goal):
    node = bench.make(CalibratorNode, {"calibrate": search_until_stopped})
    client = Client(bench, Calibrate, "calibrate")
    client.send(goal)
    bench.until(lambda: len(client.feedback) > 2)
    process = node._running.worker._process
    bench.executor.remove_node(node)
    bench.nodes.remove(node)
    node.destroy_node()
    process.join(5.0)
    assert process.exitcode is not None


def test_a_worker_that_never_looks_up_ends_with_its_parent(tmp_path):
    """The parent is gone without a word, as at SIGKILL, and what is left on the terminal is not the worker's."""
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, time\n"
        "from suspension_twin.nodes.jobs import Job, Worker\n"
        "def work(job, on_progress, should_stop):\n"
        "    on_progress(os.getpid())\n"
        "    time.sleep(60.0)\n"
        "if __name__ == '__main__':\n"
        "    worker = Worker(work, Job(None, ''))\n"
        "    while not (news := worker.news()):\n"
        "        time.sleep(0.01)\n"
        "    print(news[0].content, flush=True)\n"
        "    os._exit(0)\n"
    )
    began = time.monotonic()
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=50.0)
    took = time.monotonic() - began  # its output ends with the last process that holds it
    assert done.returncode == 0 and done.stderr == "" and int(done.stdout) > 0
    assert took < 40.0  # the work alone would take 60 s


@pytest.mark.long
def test_a_real_calibration_writes_a_twin_file_that_loads(bench, goal):
    bench.make(CalibratorNode)
    client = Client(bench, Calibrate, "calibrate")
    goal.free = ["vehicle.front.damper_pull", "vehicle.rear.damper_pull"]
    goal.max_generations = 3
    status, result = client.result(client.send(goal), 120.0)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.cost <= result.initial_cost
    twin = load_twin(result.output)
    found = dict(zip(result.names, result.values, strict=True))
    assert found["vehicle.front.damper_pull.force.0"] == twin.vehicle.front.damper_pull.force[0]
    assert any(f.stage == "search" and f.generation >= 1 for f in client.feedback)
    assert calibration_gap(0.0, result.output).rms > 0.0  # which the live gap is held against
