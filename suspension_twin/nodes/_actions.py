# SPDX-License-Identifier: Apache-2.0
"""What sets the actions of the calibrator node apart: their messages, and the work behind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from suspension_twin.calibration.request import Progress
from suspension_twin.nodes._calibration import Outcome, calibrate_job, job_of
from suspension_twin.nodes._diagnosis import DiagnosisOutcome, DiagnosisStep, diagnose_job, diagnosis_job_of
from suspension_twin.nodes._worker import Work
from suspension_twin_interfaces.action import Calibrate, Diagnose

__all__ = ["CALIBRATE", "DIAGNOSE", "Action"]


@dataclass(frozen=True)
class Action:
    """One action. ``job_of(goal, twin file, threads)`` raises InputError for a goal that cannot be; ``work``
    turns the job into an ``outcome``, which has the fields of the action's result, and says ``step`` after
    step on the way. ``hands_over``: told to stop, the work ends with the best so far."""

    kind: Any
    name: str
    noun: str
    job_of: Callable[[Any, str, int], Any]
    work: Work
    step: Callable[..., Any]
    outcome: Callable[..., Any]
    feedback: Callable[[Any], Any]
    said: Callable[[Any], str]
    hands_over: bool

    def failed(self, message: str) -> Any:
        """The outcome of work that came to nothing."""
        return self.outcome(success=False, message=message)

    def result(self, outcome: Any) -> Any:
        """``outcome`` as the action's result."""
        return self.kind.Result(
            **{k: list(v) if isinstance(v, tuple) else v for k, v in vars(outcome).items()}
        )

    @property
    def given_up(self) -> str:
        """What a client is told whose cancelled goal left nothing."""
        return (
            "cancelled; nothing was handed over in time"
            if self.hands_over
            else "cancelled; nothing was written"
        )


def _calibrate_feedback(step: Progress) -> Calibrate.Feedback:
    return Calibrate.Feedback(
        stage=step.stage,
        generation=step.generation,
        evaluations=step.evaluations,
        best_cost=step.best_cost,
        mean_cost=step.mean_cost,
        seconds_left=step.seconds_left,
    )


def _calibrate_said(step: Progress) -> str:
    return f"{step.stage}{_noted(step.note)}, generation {step.generation}, best cost {step.best_cost:.4g}"


def _diagnose_feedback(step: DiagnosisStep) -> Diagnose.Feedback:
    return Diagnose.Feedback(stage=step.stage, progress=step.progress, seconds_left=step.seconds_left)


def _diagnose_said(step: DiagnosisStep) -> str:
    return f"{step.stage}{_noted(step.note)}, {100 * step.progress:.0f} %"


def _noted(note: str) -> str:
    return f" ({note})" if note else ""


CALIBRATE = Action(
    Calibrate,
    "calibrate",
    "calibration",
    job_of,
    calibrate_job,
    Progress,
    Outcome,
    _calibrate_feedback,
    _calibrate_said,
    hands_over=True,
)
DIAGNOSE = Action(
    Diagnose,
    "diagnose",
    "diagnosis",
    diagnosis_job_of,
    diagnose_job,
    DiagnosisStep,
    DiagnosisOutcome,
    _diagnose_feedback,
    _diagnose_said,
    hands_over=False,
)
