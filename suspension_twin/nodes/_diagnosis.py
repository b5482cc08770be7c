# SPDX-License-Identifier: Apache-2.0
"""What passes between the calibrator node and the process that diagnoses. No ROS in here."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suspension_twin.diagnosis.output import write
from suspension_twin.diagnosis.request import DiagnosisRequest, Progress
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.diagnosis.tracked import diagnose_tracked_files
from suspension_twin.drive.read import drive_name
from suspension_twin.errors import InputError
from suspension_twin.nodes._calibration import recordings_of, start_of, use_threads, writable
from suspension_twin.report.diagnosis import diagnosis_page
from suspension_twin.report.tracked import diagnosis_page as tracked_page
from suspension_twin.vehicle.tracked import TrackedTwin

__all__ = ["DiagnosisJob", "DiagnosisOutcome", "DiagnosisStep", "diagnose_job", "diagnosis_job_of"]

#: Share of the whole from which on the time that it took says how long the rest will take.
_TELLING = 0.05


@dataclass(frozen=True)
class DiagnosisJob:
    """One diagnosis, the folder for its result, how many threads it may use (0: all), and whether it is of a twin on
    tracks, whose drives are marker runs."""

    request: DiagnosisRequest
    output: str
    threads: int
    tracked: bool = False


@dataclass(frozen=True)
class DiagnosisStep:
    """Where it stands: ``progress`` 0 to 1 of the whole, ``seconds_left`` NaN while unknown."""

    stage: str
    progress: float = 0.0
    seconds_left: float = math.nan
    note: str = ""


@dataclass(frozen=True)
class DiagnosisOutcome:
    """How a diagnosis ended; ``message`` is one line for the user, ``diagnosis`` the document as JSON."""

    success: bool
    message: str
    diagnosis: str = ""
    output: str = ""


def diagnosis_job_of(goal: Any, twin_file: str, threads: int) -> DiagnosisJob:
    """The job that a goal asks for; raises InputError that names what is wrong with the goal."""
    twin = goal.twin or twin_file
    tracked = isinstance(start_of(twin), TrackedTwin)
    bags = recordings_of(goal.bags, "bags")
    reference = recordings_of(goal.reference, "reference", needed=False)
    first = Path(bags[0])
    output = Path(goal.output) if goal.output else first.parent / f"{drive_name(first)}_diagnosis"
    if (output.exists() and not output.is_dir()) or not writable(
        output if output.is_dir() else output.parent
    ):
        raise InputError(output, "cannot be written: name a folder, in one that exists")
    return DiagnosisJob(
        DiagnosisRequest(twin, bags, reference, int(goal.seed)), str(output), threads, tracked
    )


def diagnose_job(
    job: DiagnosisJob, progress: Callable[[DiagnosisStep], None], should_stop: Callable[[], bool]
) -> DiagnosisOutcome:
    """Diagnose in this process and write ``diagnosis.json``, ``twin.yaml`` and ``report.html``."""
    use_threads(job.threads)
    began = time.monotonic()

    def tell(stage: Progress) -> None:
        done = min(max(stage.done, 0.0), 1.0)
        left = (time.monotonic() - began) * (1.0 - done) / done if done >= _TELLING else math.nan
        progress(DiagnosisStep(stage.stage, done, left, stage.note))

    folder, asked = Path(job.output), job.request
    if job.tracked:
        found = diagnose_tracked_files(asked.twin, asked.bags, asked.reference, asked.seed, tell)
        write(found, folder)
        page, contents = tracked_page(found), found.document
    else:
        result = diagnose(asked, tell, should_stop)
        write(result, folder)
        page, contents = diagnosis_page(result), result.document
    page.write(folder / "report.html")
    document = json.dumps(contents, ensure_ascii=False, allow_nan=False)
    return DiagnosisOutcome(True, f"{folder}: {contents['message']}", document, str(folder))
