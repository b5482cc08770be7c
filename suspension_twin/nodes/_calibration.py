# SPDX-License-Identifier: Apache-2.0
"""What passes between the calibrator node and the process that calibrates. No ROS in here."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba

from suspension_twin.calibration.output import write_result
from suspension_twin.calibration.presets import PRESETS
from suspension_twin.calibration.request import CalibrationRequest, Progress
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.tracked_files import PRESET as TRACKED
from suspension_twin.calibration.tracked_files import calibrate_tracked_files
from suspension_twin.drive.read import drive_name
from suspension_twin.errors import InputError
from suspension_twin.vehicle.tracked import TrackedTwin
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = [
    "CalibrationJob",
    "Outcome",
    "calibrate_job",
    "job_of",
    "recordings_of",
    "start_of",
    "use_threads",
    "writable",
]


@dataclass(frozen=True)
class CalibrationJob:
    """One calibration, where its result is to go, and how many threads it may use (0: all)."""

    request: CalibrationRequest
    output: str
    threads: int


@dataclass(frozen=True)
class Outcome:
    """How a calibration ended; ``message`` is one line for the user."""

    success: bool
    message: str
    output: str = ""
    cost: float = math.nan
    initial_cost: float = math.nan
    evaluations: int = 0
    generations: int = 0
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    excited: tuple[bool, ...] = ()


def start_of(twin: str) -> Twin:
    """The twin in a file, which is there and right."""
    if not twin:
        raise InputError("twin", "is empty: give the path of the twin file to start from")
    return load_twin(twin)


def recordings_of(paths: Sequence[str], name: str, needed: bool = True) -> tuple[str, ...]:
    """Paths of recordings, which are there; ``name`` is what the goal calls them."""
    if needed and not paths:
        raise InputError(name, "is empty: give at least one recorded drive")
    for path in paths:
        if not path or not Path(path).exists():
            raise InputError(path or name, "no such recording")
    return tuple(paths)


def writable(folder: Path) -> bool:
    """Whether files can be made in ``folder``."""
    return folder.is_dir() and os.access(folder, os.W_OK)


def use_threads(number: int) -> None:
    """Let compiled code use so many threads; 0: all of the machine's."""
    if number:
        numba.set_num_threads(min(number, numba.config.NUMBA_NUM_THREADS))


def job_of(request: Any, twin_file: str, threads: int) -> CalibrationJob:
    """The job that a goal asks for; raises InputError that names what is wrong with the goal."""
    twin = request.twin or twin_file
    tracked = isinstance(start_of(twin), TrackedTwin)
    bags = recordings_of(request.bags, "bags")
    preset = request.preset or (TRACKED if tracked else "fast")
    if tracked and preset != TRACKED:
        raise InputError("preset", f"must be {TRACKED} for a twin on tracks, is {preset!r}")
    if tracked and request.free:
        raise InputError(
            "free", f"{TRACKED} searches five parameters of the track, no others: leave it empty"
        )
    if not tracked and preset not in PRESETS:
        raise InputError("preset", f"must be one of {', '.join(PRESETS)}, is {preset!r}")
    first = Path(bags[0])
    output = Path(request.output) if request.output else first.parent / f"{drive_name(first)}_calibrated.yaml"
    if output.is_dir() or not writable(output.parent):
        raise InputError(output, "cannot be written: name a file in a folder that exists")
    asked = CalibrationRequest(
        twin=twin,
        bags=bags,
        preset=preset,
        seed=int(request.seed),
        free=tuple(request.free),
        max_generations=int(request.max_generations),
    )
    return CalibrationJob(asked, str(output), threads)


def calibrate_job(
    job: CalibrationJob, progress: Callable[[Progress], None], should_stop: Callable[[], bool]
) -> Outcome:
    """Calibrate in this process and write the twin and its details, the best so far if it was told to stop."""
    use_threads(job.threads)
    if job.request.preset == TRACKED:
        return _calibrate_tracked(job, progress, should_stop)
    result = calibrate(job.request, progress, should_stop)
    if not result.estimates:
        return Outcome(success=False, message="stopped before the search began")
    write_result(result, Path(job.output))
    return Outcome(
        success=True,
        message=f"{job.output}: {result.message}",
        output=job.output,
        cost=result.cost,
        initial_cost=result.initial_cost,
        evaluations=result.evaluations,
        generations=result.generations,
        names=tuple(e.key for e in result.estimates),
        values=tuple(e.value for e in result.estimates),
        excited=tuple(e.status == "identified" for e in result.estimates),
    )


def _calibrate_tracked(
    job: CalibrationJob, progress: Callable[[Progress], None], should_stop: Callable[[], bool]
) -> Outcome:
    """The same of a twin on tracks, whose drives are marker runs."""
    asked = job.request
    done = calibrate_tracked_files(
        asked.twin,
        asked.bags,
        Path(job.output),
        seed=asked.seed,
        generations=asked.max_generations,
        tell=progress,
        should_stop=should_stop,
    )
    result = done.result
    return Outcome(
        success=True,
        message=f"{job.output}: {done.message}",
        output=job.output,
        cost=float(result.best[-1]),
        initial_cost=done.initial_cost,
        evaluations=result.evaluations,
        generations=len(result.best) - 1,
        names=tuple(f"vehicle.{key}" for key in result.values),
        values=tuple(result.values.values()),
        excited=(True,) * len(result.values),
    )
