# SPDX-License-Identifier: Apache-2.0
"""``calibrate``: from a request to a result. A pure function of picklable arguments.

It may run in a spawned process: the request names all that it reads, and it writes nothing but the
checkpoints of ``request.state``. It asks ``should_stop`` between pieces of work that take a
fraction of a second, and then returns the best so far.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from suspension_twin.calibration.outcome import conclude, unfinished
from suspension_twin.calibration.recorder import Recorder, SearchOutcome, fingerprint
from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult, Progress
from suspension_twin.calibration.searches import costs_of, run_evolution, run_genetic
from suspension_twin.calibration.setup import Setup, set_up
from suspension_twin.calibration.squares import run_squares
from suspension_twin.errors import WorkError
from suspension_twin.inference.checkpoint import Checkpoint
from suspension_twin.inference.parallel import one_blas_thread
from suspension_twin.inference.problem import Interrupted
from suspension_twin.models.parameters import twin_value
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["calibrate"]

#: Calibrations at most after the first, until the free lengths of springs are their own: a tolerance of numerics, two
#: published trucks needed one and two.
_AGAIN = 2
#: Difference of the slope from the free length on from the next one, as a share, that is none: a tolerance of numerics,
#: of the size of the springs' own errors on those trucks.
_SAME_SLOPE = 0.1


def calibrate(
    request: CalibrationRequest,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> CalibrationResult:
    """Calibrate a twin on recorded drives.

    Parameters
    ----------
    request : CalibrationRequest
        Twin file, drives and choices.
    on_progress : callable, optional
        Called with a :class:`~suspension_twin.calibration.request.Progress`.
    should_stop : callable, optional
        Asked between pieces of work of a fraction of a second; True ends the search with the best so far.

    Returns
    -------
    CalibrationResult
        The calibrated twin, an interval for every parameter, the gap before and after; ``stopped`` is set
        if it was stopped.

    Raises
    ------
    InputError
        What cannot be used: names file, drive or key.
    WorkError
        No candidate can be simulated.

    Examples
    --------
    >>> request = CalibrationRequest(twin="bags/bump_15kmh/twin.yaml", bags=("bags/bump_15kmh",))
    >>> result = calibrate(request)  # doctest: +SKIP
    >>> result.drives[0].gap_after.rms < result.drives[0].gap_before.rms  # doctest: +SKIP
    True
    """
    began = time.monotonic()
    report = on_progress or (lambda progress: None)
    stop = should_stop or (lambda: False)
    report(Progress("reading", note="twin and road"))
    try:
        with one_blas_thread():
            return _calibrated(request, report, stop, began)
    except Interrupted:
        return unfinished(request, load_twin(request.twin), time.monotonic() - began)


def _calibrated(
    request: CalibrationRequest, report: Callable[[Progress], None], stop: Callable[[], bool], began: float
) -> CalibrationResult:
    """The calibration: once more where drives were placed to the side, which no nuisance parameter does, by the twin
    that was found; and where springs were driven out farther than the curve of the twin file lets them."""

    def note(text: str) -> None:
        report(Progress("reading", note=text))

    def once_more(
        name: str, further: Mapping[str, float], by: Twin | None
    ) -> tuple[Setup, CalibrationResult] | None:
        """The calibration on a set-up of its own; None where it comes to no end."""
        try:
            setup = set_up(request, note, stop, further, by)
            other = solve(request, setup, report, stop, began, name)
        except WorkError:
            return None
        return setup, replace(other, evaluations=result.evaluations + other.evaluations)

    setup = set_up(request, note, stop)
    result = solve(request, setup, report, stop, began)
    further, by = dict[str, float](), None
    try:
        beside = any(np.any(p.left) for p in setup.placements if p is not None)
        if beside and not (result.stopped or result.refusal):
            by = result.twin
            found = once_more("placed", further, by)
            if found is not None and found[1].stopped:
                return replace(result, stopped=True)
            setup, result = found or (setup, result)
        for again in range(1, _AGAIN + 1):
            off = _free_lengths(setup, result) if setup.preset.refined else {}
            if not off:
                break
            moved = further | {axle: further.get(axle, 0.0) - x for axle, x in off.items()}
            found = once_more(f"{again}", moved, by)
            if found is None:
                break
            if found[1].stopped:
                return replace(result, stopped=True)
            if found[1].cost >= result.cost:  # what ends there is no spring of another length
                break
            further, (setup, result) = moved, found
    except Interrupted:
        return replace(result, stopped=True)
    longer = (
        f"{axle} spring: its compression counts from a free length {1e3 * x:+.0f} mm off that of the twin file, which "
        "the drives would else have taken for an end of its travel"
        for axle, x in further.items()
    )
    return replace(result, warnings=(*result.warnings, *longer))


def _free_lengths(setup: Setup, result: CalibrationResult) -> dict[str, float]:
    """Compressions in m, by axle, at which the lowest slope that was found of a refined spring would end in no force,
    where that is not the free length and the drives went below the first point.

    Springs are found about the standing car, whose compression is the twin file's. Of a spring that is much softer than
    that the segment from the free length on would be far stiffer than the spring.
    """
    found = {}
    for curve in result.curves:
        axle, _, part = curve.key.removeprefix("vehicle.").rpartition(".")
        x, force = twin_value(result.twin, curve.key).points
        if part != "spring" or x.size < 2 or not curve.span[0] < x[0]:
            continue
        end = float(x[0] - force[0] * (x[1] - x[0]) / (force[1] - force[0]))
        if abs(end) > _SAME_SLOPE * x[0] and not np.array_equal(
            x, twin_value(setup.original, curve.key).points[0]
        ):
            found[axle] = end
    return found


def solve(
    request: CalibrationRequest,
    setup: Setup,
    on_progress: Callable[[Progress], None],
    stop: Callable[[], bool],
    began: float,
    name: str = "",
) -> CalibrationResult:
    """Search, then assess the result, on a problem that is set up; ``name`` of the state that is kept of it."""
    store = Checkpoint(Path(request.state), fingerprint(request, setup)) if request.state else None
    recorder = Recorder(request, setup, on_progress, stop, store, name)
    problem = setup.problem
    aligned = setup.preset.synchronise or not setup.objective.is_least_squares
    quiet = np.zeros(len(problem.nuisances))
    try:
        nominal = problem.space.nominal[:, None]
        start = float(costs_of(problem, setup.objective, nominal, quiet, aligned)[0])
    except Interrupted:
        return unfinished(request, setup.original, time.monotonic() - began)
    outcome = _search(recorder)
    if not np.isfinite(outcome.cost) and not outcome.stopped:
        raise WorkError(
            "no candidate could be simulated: are the twin's masses and the road's heights right?"
        )
    on_progress(
        Progress(
            "writing",
            recorder.generations,
            recorder.evaluations,
            outcome.cost,
            outcome.cost,
            note="uncertainty",
        )
    )
    return conclude(recorder, outcome, start, began)


def _search(recorder: Recorder) -> SearchOutcome:
    if recorder.setup.preset.search == "genetic":
        return run_genetic(recorder)
    if not recorder.setup.objective.is_least_squares:
        return run_evolution(recorder)
    return run_squares(recorder)
