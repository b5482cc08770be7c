# SPDX-License-Identifier: Apache-2.0
"""Both actions of the calibrator with a twin on tracks, whose drives are marker runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from nodes_bench import Client
from stand_ins import judged

from suspension_twin.inference.problem import Interrupted
from suspension_twin.nodes.calibrator import CalibratorNode
from suspension_twin.nodes.jobs import calibration_job, diagnosis_job, run_calibration, run_diagnosis
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


@pytest.mark.long
def test_a_calibration_finds_the_tracks_parameters_and_writes_a_twin(bench, given, tmp_path):
    bench.make(CalibratorNode)
    client = Client(bench, Calibrate, "calibrate")
    free = ["vehicle.track.stiffness", "vehicle.idler.setting"]
    goal = Calibrate.Goal(**given, free=free, output=str(tmp_path / "calibrated.yaml"), max_generations=1)
    status, result = client.result(client.send(goal), 120.0)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert "13kmh_2" in result.message and "\n" not in result.message
    assert result.cost < result.initial_cost and result.evaluations > 0
    twin = load_twin(result.output)
    found = dict(zip(result.names, result.values, strict=True))
    assert list(found) == free
    assert twin.model == "tracked" and twin.vehicle.track.stiffness == found["vehicle.track.stiffness"]
    assert [f.generation for f in client.feedback if f.stage == "search"]


def test_a_calibration_ends_when_asked_with_the_best_so_far(given, tmp_path):
    goal = Calibrate.Goal(**given, preset="tracked_paper", output=str(tmp_path / "calibrated.yaml"))
    heard: list[Any] = []
    job = calibration_job(goal, "", 0)
    outcome = run_calibration(job, heard.append, lambda: any(p.stage == "search" for p in heard))
    assert outcome["success"] and "stopped" in outcome["message"] and 1 <= outcome["generations"] <= 2
    assert load_twin(outcome["output"]).vehicle.track.stiffness == outcome["values"][0]


def test_a_diagnosis_ends_when_asked_and_writes_nothing(given, tmp_path):
    goal = Diagnose.Goal(twin=given["twin"], bags=given["bags"][:1], output=str(tmp_path / "found"))
    heard: list[Any] = []
    job = diagnosis_job(goal, "", 0)
    with pytest.raises(Interrupted):
        run_diagnosis(job, heard.append, lambda: any(step.stage == "calibrating" for step in heard))
    assert heard[-1].stage == "calibrating" and not Path(goal.output).exists()


@pytest.mark.long
def test_a_drive_that_is_no_marker_run_is_answered_in_a_line(bench, given, recorded, tmp_path):
    bench.make(CalibratorNode)
    client = Client(bench, Diagnose, "diagnose")
    goal = Diagnose.Goal(twin=given["twin"], bags=[str(recorded)], output=str(tmp_path / "found"))
    status, result = client.result(client.send(goal))
    assert status == GoalStatus.STATUS_ABORTED and not result.success
    # whoever sent the goal is told which file, the log what is in it
    assert result.message.endswith("bumpy: cannot be used: the log of the node says why")


def test_the_node_takes_a_diagnosis_of_a_twin_on_tracks(bench, given, tmp_path):
    bench.make(CalibratorNode, {"diagnose": judged})
    client = Client(bench, Diagnose, "diagnose")
    status, result = client.result(client.send(Diagnose.Goal(**given, output=str(tmp_path / "found"))))
    assert status == GoalStatus.STATUS_SUCCEEDED and result.success
