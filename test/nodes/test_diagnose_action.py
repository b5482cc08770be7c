# SPDX-License-Identifier: Apache-2.0
"""The action ``diagnose``: goals taken and refused, word on the way, cancelled at once, one at a time."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from pathlib import Path

import pytest
from action_msgs.msg import GoalStatus
from nodes_bench import Client, PlainPage, worst
from stand_ins import cannot, five_generations, judge_until_stopped, judged

from suspension_twin.diagnosis.request import DiagnosisProgress, DiagnosisResult
from suspension_twin.errors import InputError
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.jobs import diagnosis_job, run_diagnosis
from suspension_twin.vehicle.twin import load_twin
from suspension_twin_interfaces.action import Calibrate, Diagnose


@pytest.fixture
def goal(twin_path, recorded, tmp_path) -> Diagnose.Goal:
    return Diagnose.Goal(twin=str(twin_path), bags=[str(recorded)], output=str(tmp_path / "found"), seed=7)


def test_a_goal_is_taken_followed_and_answered(bench, goal):
    node = bench.make(CalibratorNode, {"diagnose": judged})
    client = Client(bench, Diagnose, "diagnose")
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_SUCCEEDED and result.success
    assert json.loads(result.diagnosis) == {"verdict": "effect"} and result.output == goal.output
    assert [(f.stage, f.progress) for f in client.feedback] == [("reading", 0.0), ("effects", 0.5)]
    assert math.isnan(client.feedback[0].seconds_left) and client.feedback[1].seconds_left == 1.0
    assert node.health.values["state"] == "idle"


@pytest.mark.long
def test_a_cancelled_diagnosis_ends_at_once_and_the_next_goal_is_taken(bench, goal):
    node = bench.make(CalibratorNode, {"diagnose": judge_until_stopped})
    client = Client(bench, Diagnose, "diagnose")
    handle = client.send(goal)
    bench.until(lambda: len(client.feedback) > 3, "word of the diagnosis")
    assert node.health.values["state"].startswith("effects (strut_friction), 10 %")
    process = node._running.worker._process
    began = time.monotonic()
    handle.cancel_goal_async()
    status, result = client.result(handle)
    took = time.monotonic() - began
    assert (
        status == GoalStatus.STATUS_CANCELED
        and not result.success
        and "nothing was written" in result.message
    )
    assert took < 0.5 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    assert process.exitcode is not None and not Path(goal.output).exists()
    node.works["diagnose"] = judged
    assert client.result(client.send(goal))[0] == GoalStatus.STATUS_SUCCEEDED


def test_one_goal_at_a_time_whichever_action_it_is_of(bench, goal, tmp_path):
    node = bench.make(CalibratorNode, {"diagnose": judge_until_stopped, "calibrate": five_generations})
    client, other = Client(bench, Diagnose, "diagnose"), Client(bench, Calibrate, "calibrate")
    handle = client.send(goal)
    assert not client.send(goal).accepted
    assert "diagnose: goal rejected, a goal of diagnose is running" in worst(node)[1]
    second = Calibrate.Goal(twin=goal.twin, bags=goal.bags, output=str(tmp_path / "calibrated.yaml"))
    assert not other.send(second).accepted
    assert "calibrate: goal rejected, a goal of diagnose is running" in worst(node)[1]
    handle.cancel_goal_async()
    client.result(handle)
    assert other.result(other.send(second))[0] == GoalStatus.STATUS_SUCCEEDED


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"twin": "/nowhere/twin.yaml"}, "/nowhere/twin.yaml"),
        ({"twin": ""}, "twin: is empty"),
        ({"bags": []}, "bags: is empty"),
        ({"bags": [f"{tempfile.gettempdir()}/nowhere/bag"]}, "/nowhere/bag: no such recording"),
        ({"reference": [f"{tempfile.gettempdir()}/nowhere/before"]}, "/nowhere/before: no such recording"),
        ({"reference": [""]}, "reference: no such recording"),
        ({"output": f"{tempfile.gettempdir()}/nowhere/at/all"}, "/nowhere/at/all: cannot be written"),
        ({"output": __file__}, "cannot be written: name a folder"),
    ],
)
def test_a_goal_that_cannot_be_is_answered_with_what_is_wrong(bench, goal, change, words):
    bench.make(CalibratorNode, {"diagnose": judged})
    client = Client(bench, Diagnose, "diagnose")
    for name, value in change.items():
        setattr(goal, name, value)
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and not result.success
    assert words in result.message and "\n" not in result.message


def test_work_that_fails_is_told_in_a_line(bench, goal):
    node = bench.make(CalibratorNode, {"diagnose": cannot})
    client = Client(bench, Diagnose, "diagnose")
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and "bumpy: no GPS" in result.message
    assert "diagnose: " in worst(node)[1]


def test_the_nodes_twin_and_a_folder_beside_the_bag_are_the_defaults(goal, twin_path, recorded):
    goal.twin = goal.output = ""
    job = diagnosis_job(goal, str(twin_path), 2)
    assert (
        job.request.twin == str(twin_path) and job.request.bags == (str(recorded),) and job.request.seed == 7
    )
    assert job.output == str(recorded.parent / "bumpy_diagnosis") and job.threads == 2


def test_a_folder_with_something_else_is_written_into_where_the_goal_says_so(goal, twin_path):
    (folder := Path(goal.output)).mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not overwritten, unless the goal says overwrite"):
        diagnosis_job(goal, str(twin_path), 0)
    goal.overwrite = True
    assert diagnosis_job(goal, str(twin_path), 0).output == goal.output


def test_the_work_hands_on_the_stages_and_leaves_the_three_files(goal, twin_path, tmp_path, monkeypatch):
    document = {"verdict": "no_gap", "message": "nothing to see"}
    result = DiagnosisResult(document, load_twin(twin_path), (), 1.0)

    def diagnose(request, tell, should_stop):
        for done in (0.0, 0.5, 2.0):
            tell(DiagnosisProgress("effects", done, "top_mount"))
        return result

    monkeypatch.setattr("suspension_twin.diagnosis.run.diagnose", diagnose)
    monkeypatch.setattr("suspension_twin.report.diagnosis.diagnosis_page", lambda found: PlainPage())
    told = []
    outcome = run_diagnosis(diagnosis_job(goal, "", 0), told.append, lambda: False)
    assert outcome["success"] and outcome["message"] == f"{goal.output}: nothing to see"
    assert json.loads(outcome["diagnosis"]) == document
    assert sorted(p.name for p in Path(goal.output).iterdir()) == [
        "diagnosis.json",
        "evidence.json",
        "report.html",
        "twin.yaml",
    ]
    assert [s.progress for s in told] == [0.0, 0.5, 1.0]
    assert math.isnan(told[0].seconds_left) and told[1].seconds_left >= 0 and told[2].seconds_left == 0
