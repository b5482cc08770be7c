# SPDX-License-Identifier: Apache-2.0
"""Both actions of the calibrator with a twin on tracks, whose drives are marker runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from nodes_bench import Client, PlainPage
from stand_ins import five_generations, judged

from suspension_twin.nodes import jobs
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.jobs import calibration_job, diagnosis_job, run_diagnosis
from suspension_twin.vehicle.tracked import BOUNDS, TrackedTwin
from suspension_twin.vehicle.twin import load_twin
from suspension_twin_interfaces.action import Calibrate, Diagnose


@pytest.fixture
def given(repository: Path, tmp_path: Path) -> dict[str, Any]:
    """What goals of both kinds have in common: the bundled twin, and two seconds of its fastest runs."""
    folder = repository / "config" / "tracked"
    for i in (1, 2):
        lines = (folder / "runs" / f"13kmh_{i}.csv").read_text(encoding="utf-8").splitlines()
        (tmp_path / f"13kmh_{i}.csv").write_text("\n".join(lines[:101]) + "\n", encoding="utf-8")
    return {"twin": str(folder / "pt91.yaml"), "bags": [str(tmp_path / f"13kmh_{i}.csv") for i in (1, 2)]}


def test_a_calibration_finds_the_tracks_parameters_and_writes_a_twin(bench, given, tmp_path):
    bench.make(CalibratorNode)
    client = Client(bench, Calibrate, "calibrate")
    goal = Calibrate.Goal(**given, output=str(tmp_path / "calibrated.yaml"), max_generations=1, seed=3)
    status, result = client.result(client.send(goal), 120.0)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert "2 runs fitted" in result.message and "\n" not in result.message
    assert list(result.names) == [f"vehicle.{key}" for key in BOUNDS] and result.generations == 1
    assert result.cost < result.initial_cost and result.evaluations > 40
    twin = load_twin(result.output)
    assert isinstance(twin, TrackedTwin)
    found = dict(zip(result.names, result.values, strict=True))
    assert twin.vehicle.track.stiffness == found["vehicle.track.stiffness"]
    assert [f.generation for f in client.feedback if f.stage == "search"] == [0, 1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"preset": "paper"}, "preset: must be one of tracked_paper for a tracked vehicle, is 'paper'"),
        ({"free": ["vehicle.mass"]}, "free: tracked_paper searches its own five parameters"),
        ({"bags": ["/nowhere/13kmh_1.csv"]}, "/nowhere/13kmh_1.csv: no such recording"),
    ],
)
def test_a_goal_that_a_twin_on_tracks_does_not_take(bench, given, tmp_path, change, words):
    bench.make(CalibratorNode, {"calibrate": five_generations})
    client = Client(bench, Calibrate, "calibrate")
    goal = Calibrate.Goal(**{**given, "output": str(tmp_path / "calibrated.yaml"), **change})
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and words in result.message and "\n" not in result.message


def test_a_drive_that_is_no_marker_run_is_answered_in_a_line(bench, given, recorded, tmp_path):
    bench.make(CalibratorNode)
    client = Client(bench, Diagnose, "diagnose")
    goal = Diagnose.Goal(twin=given["twin"], bags=[str(recorded)], output=str(tmp_path / "found"))
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and not result.success
    assert "bumpy: speed: the name has none" in result.message and "\n" not in result.message


def test_goals_become_jobs_of_their_own_kind(given, twin_path, recorded):
    assert calibration_job(Calibrate.Goal(**given), "", 0).request.preset == "tracked_paper"
    assert diagnosis_job(Diagnose.Goal(**given), "", 0).tracked
    car = {"twin": str(twin_path), "bags": [str(recorded)]}
    assert calibration_job(Calibrate.Goal(**car), "", 0).request.preset == "fast"
    assert not diagnosis_job(Diagnose.Goal(**car), "", 0).tracked


def test_a_diagnosis_goes_through_what_the_command_line_uses(given, tmp_path, monkeypatch):
    """The work is done where the goal is; what is diagnosed has tests of its own."""
    document = {"verdict": "no_gap", "message": "nothing to see"}

    class Found:
        twin = load_twin(given["twin"])

    Found.document = document
    asked = []

    def diagnose(twin, runs, reference, seed, tell):
        asked.append((twin, list(runs), list(reference), seed))
        return Found

    monkeypatch.setattr(jobs, "diagnose_tracked_files", diagnose)
    monkeypatch.setattr(jobs, "tracked_page", lambda found: PlainPage())
    goal = Diagnose.Goal(**given, reference=given["bags"][:1], output=str(tmp_path / "found"), seed=5)
    outcome = run_diagnosis(diagnosis_job(goal, "", 0), lambda _: None, lambda: False)
    assert asked == [(given["twin"], given["bags"], given["bags"][:1], 5)]
    assert outcome["success"] and outcome["message"] == f"{goal.output}: nothing to see"
    assert json.loads(outcome["diagnosis"]) == document
    assert sorted(p.name for p in Path(goal.output).iterdir()) == [
        "diagnosis.json",
        "report.html",
        "twin.yaml",
    ]


def test_the_node_takes_a_diagnosis_of_a_twin_on_tracks(bench, given, tmp_path):
    bench.make(CalibratorNode, {"diagnose": judged})
    client = Client(bench, Diagnose, "diagnose")
    status, result = client.result(client.send(Diagnose.Goal(**given, output=str(tmp_path / "found"))))
    assert status == GoalStatus.STATUS_SUCCEEDED and result.success
