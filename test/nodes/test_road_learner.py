# SPDX-License-Identifier: Apache-2.0
"""A road that is learnt while driving is loaded for the next pass, and what goes wrong with it is said."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from nodes_bench import PATIENT
from rclpy.parameter import Parameter
from stand_ins import finds_no_pass, knows_the_road

from suspension_twin.addons.nodes.road_learner import RoadLearnerNode
from suspension_twin.addons.roads.drives.learning import read_lesson
from suspension_twin.cli._status import line
from suspension_twin.cli.main import main
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.nodes.composed import Composed, Playback
from suspension_twin.nodes.jobs import Job, News
from suspension_twin.nodes.process import ros_context
from suspension_twin.vehicle.twin import Twin, save_twin

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture
def roadless(twin: Twin, twin_path: Path) -> Path:
    """A twin file without a road, in the folder of one."""
    save_twin(twin, twin_path.parent / "roadless.yaml")
    return twin_path.parent / "roadless.yaml"


def step_until(one: Composed, condition: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s"
        one.step()


class AtOnce:
    """A worker that needs no process: the work is done when its news are asked for."""

    def __init__(self, work: Any, job: Job) -> None:
        self.work, self.job = work, job

    def news(self) -> list[News]:
        steps: list[Any] = []
        outcome = self.work(self.job, steps.append, lambda: False)
        return [*(News("progress", step) for step in steps), News("done", outcome)]

    def kill(self) -> None:
        pass


@pytest.mark.long
def test_the_second_round_has_a_road(roadless: Path, drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "learnt.crg"
    with ros_context(PATIENT) as context:
        one = Composed(context, roadless, playback=Playback(drive, 8.0, loop=True), learn=out)
        try:
            learner, model = one.learner, one.nodes["suspension_model"]
            assert learner is not None and one.player is not None
            learner.work = knows_the_road
            step_until(one, lambda: one.player.position > 13.0)
            before = one.condition()
            assert before.learning is not None and before.learning.startswith("road: nothing yet | pass now ")
            # The bag begins again: the first pass is over, and while it is learnt the replay goes on.
            step_until(one, lambda: model.values["twin"] == str(out.with_suffix(".yaml")))
            rounds = one.condition().played.rounds
            assert rounds >= 1

            def passed_again() -> bool:
                """Late in a later round, with a gap: a road that is loaded just then begins a new one."""
                now = one.condition()
                return now.played.rounds > rounds and one.player.position > 13.0 and now.gap is not None

            step_until(one, passed_again)
            after = one.condition()
            assert before.gap is not None and after.gap is not None
            assert after.gap.rms < 0.3 * before.gap.rms
            assert "road: 100 m from " in str(line(after))
            learner.report()
            assert learner.health.values["road"].startswith("100 m from ")
        finally:
            one.close()


def test_a_twin_that_was_loaded_meanwhile_is_not_replaced_by_an_older_one(
    roadless: Path, drive: Drive, twin: Twin, tmp_path: Path
) -> None:
    out, calibrated = tmp_path / "learnt.crg", roadless.parent / "calibrated.yaml"
    save_twin(twin, calibrated)
    learnt_with: list[str] = []

    def work(job: Job, progress: Any, should_stop: Any) -> Any:
        learnt_with.append(read_lesson(Path(job.request)).twin)
        if len(learnt_with) == 1:
            model.set_parameters([Parameter("twin", value=str(calibrated))])
        return knows_the_road(job, progress, should_stop)

    with ros_context(PATIENT) as context:
        one = Composed(context, roadless, playback=Playback(drive, math.inf), learn=out)
        try:
            learner, model = one.learner, one.nodes["suspension_model"]
            assert learner is not None
            learner.work, learner.worker = work, AtOnce
            step_until(one, lambda: one.finished)
            assert not learner.pending  # nobody came back to anywhere
            learner.close_pass()
            step_until(one, lambda: not learner.pending)
            step_until(one, lambda: model.values["twin"] == str(out.with_suffix(".yaml")))
            assert learnt_with == [str(roadless), str(calibrated)]
        finally:
            one.close()


def test_a_road_that_cannot_be_learnt_is_told_and_the_twin_goes_on(
    roadless: Path, drive: Drive, tmp_path: Path
) -> None:
    with ros_context(PATIENT) as context:
        one = Composed(context, roadless, playback=Playback(drive, math.inf), learn=tmp_path / "a.crg")
        try:
            learner = one.learner
            assert learner is not None
            learner.work = finds_no_pass  # in a process of its own
            step_until(one, lambda: one.finished)
            learner.close_pass()
            assert learner.pending
            step_until(one, lambda: not learner.pending)
            assert not learner.learnt
            assert "pass 1: has less than 4 s" in learner.why
            assert any("could not be learnt" in text for text in one.condition().complaints)
            assert one.condition().answers > 1000
        finally:
            one.close()


def test_a_learner_needs_a_road_to_write(bench, tmp_path: Path) -> None:
    for out, words in (("", "give the path"), (str(tmp_path / "a.yaml"), "written as .crg")):
        with pytest.raises(InputError, match=words):
            bench.make(RoadLearnerNode, out=out)


def test_nothing_that_the_twin_is_made_of_is_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    car = BAGS / "crg_road" / "twin.yaml"
    tracked = BAGS.parent / "config" / "tracked" / "pt91.yaml"
    for twin, out, words in (
        (car, car.with_suffix(".crg"), "which the twin is made of"),
        (car, BAGS / "crg_road" / "road.crg", "which the twin is made of"),
        (tracked, tmp_path / "a.crg", "needs a car"),
        (car, tmp_path / "a.txt", "written as .crg"),
    ):
        assert main(["run", "--twin", str(twin), "--learn-road", str(out), "--force"]) == 2
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
