# SPDX-License-Identifier: Apache-2.0
"""From where a search ended to a result: the calibrated twin, intervals, marks, gaps."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.checks import check_agreement
from suspension_twin.calibration.drivefit import drive_fits
from suspension_twin.calibration.recorder import Outcome, Recorder
from suspension_twin.calibration.request import (
    CalibrationRequest,
    CalibrationResult,
    DriveFit,
    Estimate,
    NuisanceEstimate,
)
from suspension_twin.calibration.setup import Setup
from suspension_twin.calibration.uncertainty import Told, curve_estimates, tell
from suspension_twin.identification.posterior import span_of
from suspension_twin.identification.problem import Interrupted
from suspension_twin.vehicle.twin import Twin

__all__ = ["conclude", "unfinished"]

_DIGITS = 7
#: A parameter is determined when half the logarithm of its interval's ends is below this (about 25 %).
_DETERMINED = 0.22


def unfinished(request: CalibrationRequest, twin: Twin, seconds: float) -> CalibrationResult:
    """The result of a calibration that was stopped before it began to search."""
    return CalibrationResult(
        twin=twin,
        start=twin,
        preset=request.preset,
        objective=request.objective,
        seed=request.seed,
        estimates=(),
        nuisances=(),
        curves=(),
        drives=(),
        cost=float("nan"),
        initial_cost=float("nan"),
        evaluations=0,
        generations=0,
        history=np.empty((0, 4)),
        stopped=True,
        seconds=seconds,
        warnings=(),
    )


def conclude(recorder: Recorder, outcome: Outcome, start: float, began: float) -> CalibrationResult:
    """Everything that is said about the best candidate; what takes time is left out once told to stop.

    ``start`` is the cost that the twin began with, ``began`` the monotonic clock then.
    """
    request, setup = recorder.request, recorder.setup
    space = setup.space
    drives: tuple[DriveFit, ...] = ()
    told: Told | None = None
    stopped = outcome.stopped
    evaluations = recorder.evaluations
    try:
        if not stopped:
            told = tell(setup, outcome, request.seed)
            outcome = _settled(outcome, told)
    except Interrupted:
        stopped = True
    values = np.clip(_rounded(outcome.values), space.lower, space.upper)
    twin = space.applied(setup.twin, values)
    try:
        if not stopped:
            drives = drive_fits(setup, outcome, twin, values)
            check_agreement(
                [d.name for d in drives], [d.correlation for d in drives], setup.drives[0].road.name
            )
    except Interrupted:
        stopped = True
    return CalibrationResult(
        twin=twin,
        start=setup.original,
        preset=setup.preset.name,
        objective=recorder.objective,
        seed=request.seed,
        estimates=_estimates(setup, values, told),
        nuisances=_nuisances(outcome, told),
        curves=curve_estimates(setup, twin, told) if told else (),
        drives=drives,
        cost=outcome.cost,
        initial_cost=start,
        evaluations=evaluations,
        generations=recorder.generations,
        history=np.array(recorder.history).reshape(-1, 4),
        stopped=stopped,
        seconds=time.monotonic() - began,
        warnings=(*setup.warnings, *_remarks(drives, setup, values)),
    )


def _settled(outcome: Outcome, told: Told) -> Outcome:
    """Where the likelihood was searched and looking around found a better place for a spring, that is it."""
    if outcome.likelihood is None or outcome.x is None:
        return outcome
    d = len(told.space)
    values = np.clip(
        told.space.from_slopes(told.x[:d]), outcome.problem.space.lower, outcome.problem.space.upper
    )
    cost = float(outcome.problem.costs(values[:, None], told.x[d:])[0])
    return replace(outcome, values=values, nuisance=told.x[d:] + outcome.placed, x=told.x, cost=cost)


def _remarks(drives: tuple[DriveFit, ...], setup: Setup, values: Floats) -> list[str]:
    """What a user should not overlook."""
    bound = int(np.count_nonzero(setup.space.on_bound(values)))
    tail = f": {bound} parameters ended on their bounds, let them go further" if bound else ""
    remarks = []
    for d in drives:
        if d.gap_after.rms <= d.gap_before.rms:
            continue
        if d.nuisance_free < 0.5 * d.gap_after.rms:
            remarks.append(
                f"{d.name}: {d.gap_after.rms:.3f} m/s² are left, {d.nuisance_free:.3f} without the nuisances: the "
                "clocks or the map are off by what is found there"
            )
        else:
            remarks.append(f"the calibrated twin is farther from {d.name} than the one it started from{tail}")
    return remarks


def _rounded(values: Floats) -> Floats:
    """To seven digits: what is written is what was found, and a file can be read by people."""
    return np.array([float(f"{v:.{_DIGITS}g}") for v in values])


def _estimates(setup: Setup, values: Floats, told: Told | None) -> tuple[Estimate, ...]:
    space = setup.space
    bound = space.on_bound(values)
    upper_half = values > 0.5 * (space.lower + space.upper)
    spans = {c.key: (c, span_of(c, told.where)) for c in space.curves} if told else {}
    estimates = []
    for i, key in enumerate(space.keys):
        low, high = (float(told.low[i]), float(told.high[i])) if told else (float("nan"), float("nan"))
        determined = bool(told) and _is_determined(
            low, high, space.parameters[i].log, space.parameters[i].spread
        )
        excited = determined
        curve_key, _, index = key.rpartition(".force.")
        if curve_key in spans:
            curve, (least, most) = spans[curve_key]
            excited = bool(least <= curve.x[int(index)] <= most)
        estimates.append(
            Estimate(
                key=key,
                start=float(setup.space.parameters[i].nominal),
                value=float(values[i]),
                low=low,
                high=high,
                lower=float(space.lower[i]),
                upper=float(space.upper[i]),
                on_bound=("upper" if upper_half[i] else "lower") if bound[i] else "",
                excited=excited,
                determined=determined,
            )
        )
    return tuple(estimates)


def _is_determined(low: float, high: float, log: bool, spread: float) -> bool:
    if log:
        return low > 0 and 0.5 * float(np.log(high / low)) < _DETERMINED
    return 0.5 * (high - low) < 0.5 * 1.645 * spread


def _nuisances(outcome: Outcome, told: Told | None) -> tuple[NuisanceEstimate, ...]:
    nuisances = outcome.problem.nuisances
    sigma = told.posterior.sigma if told else np.full(len(nuisances), float("nan"))
    return tuple(
        NuisanceEstimate(name, float(value), float(s), float(prior), _unit(name))
        for name, value, s, prior in zip(
            nuisances.names, outcome.nuisance, sigma, nuisances.spread, strict=True
        )
    )


def _unit(name: str) -> str:
    if name == "gain":
        return ""
    if name.startswith("tilt"):
        return "rad"
    if name.endswith("clock_offset"):
        return "s"
    if ".bias." in name:
        return "m/s²" if name.endswith("acceleration") else "rad/s"
    return "m"
