# SPDX-License-Identifier: Apache-2.0
"""What passes between the calibrator node and the process that calibrates. No ROS in here."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba

from suspension_twin.calibration.presets import PRESETS
from suspension_twin.calibration.request import CalibrationRequest, Progress
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import drive_name
from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import load_twin, save_twin

__all__ = ["CalibrationJob", "Outcome", "calibrate_job", "job_of"]


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


def job_of(request: Any, twin_file: str, threads: int) -> CalibrationJob:
    """The job that a goal asks for; raises InputError that names what is wrong with the goal."""
    twin = request.twin or twin_file
    if not twin:
        raise InputError("twin", "is empty: give the path of the twin file to start from")
    load_twin(twin)
    bags = tuple(request.bags)
    if not bags:
        raise InputError("bags", "is empty: give at least one recorded drive")
    for bag in bags:
        if not Path(bag).exists():
            raise InputError(bag, "no such recording")
    preset = request.preset or "fast"
    if preset not in PRESETS:
        raise InputError("preset", f"must be one of {', '.join(PRESETS)}, is {preset!r}")
    first = Path(bags[0])
    output = Path(request.output) if request.output else first.parent / f"{drive_name(first)}_calibrated.yaml"
    folder = output.parent
    if output.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
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
    """Calibrate in this process and write the result, the best so far if it was told to stop."""
    if job.threads:
        numba.set_num_threads(min(job.threads, numba.config.NUMBA_NUM_THREADS))
    result = calibrate(job.request, progress, should_stop)
    if not result.estimates:
        return Outcome(success=False, message="stopped before the search began")
    save_twin(result.twin, job.output)
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
        excited=tuple(e.excited for e in result.estimates),
    )
