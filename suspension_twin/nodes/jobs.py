# SPDX-License-Identifier: Apache-2.0
"""Calibration and diagnosis as jobs of the calibrator node, each in a worker process. No ROS in here.

A worker process is spawned, not forked: a child that inherits the middleware's threads hangs. It has
a lower priority than the live twin, ignores the terminal's Ctrl-C, which is its parent's to handle,
and ends with its parent. What only the worker needs is imported there: the live twin starts a second
earlier without it.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, NamedTuple

from suspension_twin.calibration import request as calibration
from suspension_twin.calibration.output import details_path, write_result
from suspension_twin.calibration.presets import preset_named
from suspension_twin.diagnosis import request as diagnosis
from suspension_twin.drive.read import drive_name
from suspension_twin.errors import InputError, SuspensionTwinError, printable
from suspension_twin.files import Folders, for_peers, together, unused
from suspension_twin.vehicle.twin import load_twin

__all__ = [
    "DiagnosisStep",
    "Failure",
    "Job",
    "News",
    "Outcome",
    "Step",
    "Work",
    "Worker",
    "calibration_job",
    "check_paths",
    "diagnosis_job",
    "run_calibration",
    "run_diagnosis",
]

#: Fraction of a diagnosis from which on its remaining time is extrapolated.
_EXTRAPOLATED = 0.05


@dataclass(frozen=True)
class Job:
    """A request, the path of its result and the number of threads it may use (0: all)."""

    request: Any
    output: str
    threads: int = 0


#: Fields of an action's result, without those that keep their defaults; ``message`` is one line for the user.
Outcome = dict[str, Any]


@dataclass(frozen=True)
class DiagnosisStep:
    """Progress of a diagnosis: ``progress`` 0 to 1 of the whole, ``seconds_left`` NaN while unknown."""

    stage: str
    progress: float = 0.0
    seconds_left: float = math.nan
    note: str = ""


def _twin_of(goal: Any, twin_file: str) -> str:
    """Path of the twin file, which is loaded to check it. One that runs a program is that of the node alone: whoever
    may send goals must not choose what runs here."""
    path = goal.twin or twin_file
    if not path:
        raise InputError("twin", "is empty: give the path of a twin file")
    twin = load_twin(path)
    if twin.program is not None and goal.twin and goal.twin != twin_file:
        raise InputError(
            path, "model", f"{twin.model} runs a program: name it when the node is started, not by a goal"
        )
    return path


def check_paths(goal: Any, folders: Folders, twin_file: str) -> None:
    """Raise InputError where a goal names a file out of the folders of the node, or a result over something else."""
    if goal.twin and goal.twin != twin_file:
        folders.check(goal.twin, ".yaml")
    for path in (*goal.bags, *getattr(goal, "reference", ())):
        folders.check(path)
    if goal.output:
        folders.check(goal.output, "" if hasattr(goal, "reference") else ".yaml")


def _recordings(paths: Sequence[str], name: str, needed: bool = True) -> tuple[str, ...]:
    """Paths of recordings, checked to exist; ``name`` is the goal's field."""
    if needed and not paths:
        raise InputError(name, "is empty: give at least one recorded drive")
    for path in paths:
        if not path or not Path(path).exists():
            raise InputError(path or name, "no such recording")
    return tuple(paths)


def _output(given: str, first: str, suffix: str) -> Path:
    """The path of the result: as given, else beside the first recording, where nothing is yet."""
    recording = Path(first)
    return Path(given) if given else unused(recording.parent / f"{drive_name(recording)}_{suffix}")


def _writable(folder: Path) -> bool:
    return folder.is_dir() and os.access(folder, os.W_OK)


def calibration_job(goal: Any, twin_file: str, threads: int, keep_sensor: bool = False) -> Job:
    """The job of a goal of ``calibrate``; raises InputError that names the wrong field of the goal."""
    twin = _twin_of(goal, twin_file)
    bags = _recordings(goal.bags, "bags")
    preset = preset_named(goal.preset or "fast").name
    output = _output(goal.output, bags[0], "calibrated.yaml")
    if output.is_dir() or not _writable(output.parent):
        raise InputError(output, "cannot be written: name a file in a folder that exists")
    if output.exists() and not (goal.overwrite or details_path(output).exists()):
        raise InputError(
            output, "is no result of a calibration: not overwritten, unless the goal says overwrite"
        )
    request = calibration.CalibrationRequest(
        twin=twin,
        bags=bags,
        preset=preset,
        seed=int(goal.seed),
        free=tuple(goal.free),
        max_generations=int(goal.max_generations),
        keep_sensor=keep_sensor,
    )
    return Job(request, str(output), threads)


def diagnosis_job(goal: Any, twin_file: str, threads: int) -> Job:
    """The job of a goal of ``diagnose``; raises InputError that names the wrong field of the goal."""
    twin = _twin_of(goal, twin_file)
    bags = _recordings(goal.bags, "bags")
    reference = _recordings(goal.reference, "reference", needed=False)
    folder = _output(goal.output, bags[0], "diagnosis")
    if not _writable(folder if folder.exists() else folder.parent):
        raise InputError(folder, "cannot be written: name a folder, in one that exists")
    kept = folder.exists() and any(folder.iterdir()) and not (folder / "diagnosis.json").exists()
    if kept and not goal.overwrite:
        raise InputError(
            folder, "is no folder of a diagnosis: not overwritten, unless the goal says overwrite"
        )
    request = diagnosis.DiagnosisRequest(twin, bags, reference, int(goal.seed))
    return Job(request, str(folder), threads)


def run_calibration(
    job: Job, on_progress: Callable[[calibration.Progress], None], should_stop: Callable[[], bool]
) -> Outcome:
    """Calibrate in this process and write the twin and its details; stopped early, the best so far."""
    from suspension_twin.calibration.run import calibrate

    result = calibrate(job.request, on_progress, should_stop)
    if not result.estimates:
        return {"success": False, "message": "stopped before the search began"}
    write_result(result, Path(job.output))
    return {
        "success": True,
        "message": f"{job.output}: {result.message}",
        "output": job.output,
        "cost": result.cost,
        "initial_cost": result.initial_cost,
        "evaluations": result.evaluations,
        "generations": result.generations,
        "names": [e.key for e in result.estimates],
        "values": [e.value for e in result.estimates],
        "excited": [e.status == "identified" for e in result.estimates],
    }


def run_diagnosis(
    job: Job, on_progress: Callable[[DiagnosisStep], None], should_stop: Callable[[], bool]
) -> Outcome:
    """Diagnose in this process and write ``diagnosis.json``, ``twin.yaml`` and ``report.html``."""
    from suspension_twin.diagnosis.answer import write
    from suspension_twin.diagnosis.run import diagnose
    from suspension_twin.report.diagnosis import diagnosis_page

    began = time.monotonic()

    def step(stage: diagnosis.DiagnosisProgress) -> None:
        done = min(max(stage.done, 0.0), 1.0)
        left = (time.monotonic() - began) * (1.0 - done) / done if done >= _EXTRAPOLATED else math.nan
        on_progress(DiagnosisStep(stage.stage, done, left, stage.note))

    folder, asked = Path(job.output), job.request
    result = diagnose(asked, step, should_stop)
    with together():
        write(result, folder)
        diagnosis_page(result).write(folder / "report.html")
    return {
        "success": True,
        "message": f"{folder}: {result.document['message']}",
        "diagnosis": json.dumps(result.document, ensure_ascii=False, allow_nan=False),
        "output": str(folder),
    }


#: Progress of either job.
Step = calibration.Progress | DiagnosisStep
#: Work of the worker process: the job, a function for progress, a function that asks whether to stop.
Work = Callable[[Job, Callable[[Any], None], Callable[[], bool]], Outcome]


class News(NamedTuple):
    """A message of the worker process: progress, and in the end the outcome or a :class:`Failure`."""

    kind: Literal["progress", "done", "failed"]
    content: Any


class Failure(NamedTuple):
    """Why a worker has failed: a line that anybody may read, and where it leaves out what stands in a file the whole
    one, for the log of this machine."""

    text: str
    whole: str = ""


class Worker:
    """``work(job, on_progress, should_stop)`` in a process of its own; ``work`` and ``job`` are pickled."""

    def __init__(self, work: Work, job: Job) -> None:
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe()
        self._process = context.Process(target=_run, args=(work, job, there), daemon=True)
        self._process.start()
        there.close()

    def news(self) -> list[News]:
        """All messages since the last call; the end of the process without an outcome is a failure."""
        found = []
        try:
            while self._here.poll():
                found.append(self._here.recv())
        except (EOFError, OSError):
            self._process.join(0.1)
            found.append(
                News("failed", Failure(f"the worker process ended (exit status {self._process.exitcode})"))
            )
        return found

    def stop(self) -> None:
        """Ask it to end with the best result so far."""
        with contextlib.suppress(OSError):  # it has ended
            self._here.send(None)

    def kill(self) -> None:
        """End it now."""
        self._process.kill()
        self._process.join(1.0)
        self._here.close()


def _run(work: Work, job: Job, parent: Connection) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(10)
    stop = threading.Event()

    def listen() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                parent.recv()
                stop.set()
        os._exit(1)  # the parent has ended, and may have done so in the middle of starting this process

    threading.Thread(target=listen, daemon=True).start()
    if job.threads:
        import numba

        numba.set_num_threads(min(job.threads, numba.config.NUMBA_NUM_THREADS))

    whole: list[str] = []
    try:
        with for_peers(whole.append):
            outcome = work(job, lambda content: parent.send(News("progress", content)), stop.is_set)
        last = News("done", outcome)
    except SuspensionTwinError as error:
        last = News("failed", Failure(str(error), "".join(whole)))
    except Exception as error:
        text = f"unexpected error, {type(error).__name__}"
        last = News("failed", Failure(text, printable(f"{text}: {error}")))
    with contextlib.suppress(OSError):  # the parent no longer listens
        parent.send(last)
