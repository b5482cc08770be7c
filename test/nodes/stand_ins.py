# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for calibration and diagnosis. They run in the worker's process, which imports them from here."""

from __future__ import annotations

import os
import time
from pathlib import Path

from suspension_twin.addons.roads.drives.learning import read_lesson
from suspension_twin.calibration.request import Progress
from suspension_twin.errors import InputError
from suspension_twin.nodes.jobs import DiagnosisStep
from suspension_twin.vehicle.twin import RoadFile, load_twin, save_twin


def outcome(job, message, generations):
    """The fields of the result of a calibration."""
    counts = {"evaluations": generations, "generations": generations}
    found = {"names": ["vehicle.mass"], "values": [1700.0], "excited": [True]}
    costs = {"cost": 0.5, "initial_cost": 2.0}
    return {"success": True, "message": message, "output": job.output, **counts, **costs, **found}


def search_until_stopped(job, progress, should_stop):
    """Generations without end."""
    generation = 0
    while not should_stop():
        generation += 1
        progress(Progress("search", generation, 10 * generation, 100.0 / generation, 200.0 / generation, 1.0))
        time.sleep(0.02)
    Path(job.output).write_text("best so far")
    return outcome(job, f"stopped in generation {generation}", generation)


def repeats_its_job(job, progress, should_stop):
    """Says what it was asked to do with the sensor."""
    return outcome(job, f"keep_sensor={job.request.keep_sensor}", 0)


def five_generations(job, progress, should_stop):
    """Five at once, to see that all of them arrive before the result."""
    for generation in range(1, 6):
        progress(Progress("search", generation, generation, 1.0, 2.0, float("nan")))
    return outcome(job, "found", 5)


def cannot(job, progress, should_stop):
    raise InputError(job.request.bags[0], "no GPS")


def stumbles_on_a_file(job, progress, should_stop):
    path = Path(job.output).with_name("other.yaml")
    path.write_text("hunter2: 1\n")
    load_twin(path)


def breaks(job, progress, should_stop):
    raise ZeroDivisionError("inside")


def dies(job, progress, should_stop):
    os._exit(3)


def deaf(job, progress, should_stop):
    progress(Progress("search", 1))
    time.sleep(60.0)


def judge_until_stopped(job, progress, should_stop):
    """A diagnosis that does not even ask whether to stop, as while a solver is at work."""
    for k in range(3000):
        progress(DiagnosisStep("effects", min(0.1 + 0.001 * k, 1.0), 20.0, "strut_friction"))
        time.sleep(0.02)


def judged(job, progress, should_stop):
    progress(DiagnosisStep("effects", 0.5, 1.0))
    Path(job.output).mkdir(exist_ok=True)
    document = '{"verdict": "effect"}'
    return {"success": True, "message": "friction", "diagnosis": document, "output": job.output}


def lighter(job, progress, should_stop):
    """A calibrated twin of less mass."""
    twin = load_twin(job.request.twin)
    progress(Progress("search", 1, 10, 0.5, 1.0, 3.0))
    save_twin(twin.with_changes({"vehicle.mass": 1700.0}), job.output)
    return outcome(job, "the mass", 1)


def reported(job, progress, should_stop):
    """A diagnosis with a twin and a page."""
    folder = Path(job.output)
    folder.mkdir()
    save_twin(load_twin(job.request.twin), folder / "twin.yaml")
    (folder / "report.html").write_text("<p>friction</p>")
    return {"success": True, "message": "friction", "diagnosis": "{}", "output": job.output}


def knows_the_road(job, progress, should_stop):
    """Says that the road beside the twin file was learnt, and from which twin."""
    lesson = read_lesson(Path(job.request))
    progress(("iteration 1 of 1", 0.5))
    found = load_twin(lesson.twin).model_copy(
        update={"road": RoadFile(file=Path(lesson.twin).parent / "road.crg")}
    )
    out = Path(lesson.out).with_suffix(".yaml")
    save_twin(found, out)
    count = len(lesson.passes)
    seconds = [round(end - start) for _, start, end in lesson.passes]
    return {"twin": str(out), "passes": count, "length": 99.6, "warnings": [f"{lesson.twin}: {seconds} s"]}


def finds_no_pass(job, progress, should_stop):
    raise InputError("pass 1", "has less than 4 s on the road of the other drives")
