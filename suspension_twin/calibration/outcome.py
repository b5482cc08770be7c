# SPDX-License-Identifier: Apache-2.0
"""From the end of a search to a result: the calibrated twin, intervals, status of each parameter, gaps."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.checks import check_agreement
from suspension_twin.calibration.drivefit import drive_fits, paper_distance
from suspension_twin.calibration.labels import parameter_label, parameter_unit
from suspension_twin.calibration.recorder import Recorder, SearchOutcome
from suspension_twin.calibration.request import (
    CalibrationRequest,
    CalibrationResult,
    DriveFit,
    Estimate,
    NuisanceEstimate,
    SensorEstimate,
    Yardstick,
)
from suspension_twin.calibration.searches import costs_of
from suspension_twin.calibration.sensor import sensor_estimates, with_sensor
from suspension_twin.calibration.setup import Setup
from suspension_twin.calibration.squares import LATENCY
from suspension_twin.calibration.uncertainty import HALF_WIDTH, Uncertainty, assess, curve_estimates
from suspension_twin.calibration.yardstick import yardstick
from suspension_twin.inference.gap import channel_unit
from suspension_twin.inference.objectives import Objective
from suspension_twin.inference.problem import REACH, Interrupted
from suspension_twin.vehicle.twin import Twin, value_at

__all__ = ["conclude", "unfinished"]

_KEPT = (
    "kept at their start, as they made up for an error of another kind when left free: {}; that is outside the 90 % "
    "intervals of their priors (those of the results count the error of the model too and may be wider) though the "
    "drives carry less information on them than the priors"
)
_ONE_PASS = (
    "one pass over what excites: nothing can be held out, how well the twin predicts another is not known"
)


def unfinished(request: CalibrationRequest, twin: Twin, seconds: float) -> CalibrationResult:
    """The result of a calibration that was stopped before it began to search."""
    return CalibrationResult(
        twin=twin,
        start=twin,
        preset=request.preset,
        objective=request.objective,
        seed=request.seed,
        seconds=seconds,
        stopped=True,
    )


def conclude(recorder: Recorder, outcome: SearchOutcome, start: float, began: float) -> CalibrationResult:
    """The result with its uncertainty and its drives; a stopped calibration goes without both.

    ``start`` is the cost that the twin began with, ``began`` the monotonic clock then.
    """
    request, setup = recorder.request, recorder.setup
    space = setup.space
    drives: tuple[DriveFit, ...] = ()
    found: Uncertainty | None = None
    measure: Yardstick | None = None
    stopped = outcome.stopped
    evaluations, nan = recorder.evaluations, float("nan")
    try:
        if not stopped:
            found = assess(setup, outcome, request.seed)
            outcome = _settled(outcome, setup.objective, found)
    except Interrupted:
        stopped = True
    values = np.clip([float(f"{v:.7g}") for v in outcome.values], space.lower, space.upper)
    sensor = sensor_estimates(setup, outcome, found, request.keep_sensor) if found and setup.on_road else ()
    estimates = _estimates(setup, values, found)
    nuisances = _nuisances(outcome, found)
    twin = _with_uncertainty(with_sensor(space.applied(setup.twin, values), sensor), estimates)
    try:
        if not stopped:
            drives = drive_fits(setup, outcome, twin, values)
            if found is not None:
                measure = yardstick(setup, outcome, np.array(found.status) == "kept")
            if setup.on_road:
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
        estimates=estimates,
        nuisances=nuisances,
        sensor=sensor,
        curves=curve_estimates(setup, twin, found) if found else (),
        drives=drives,
        cost=outcome.cost,
        initial_cost=start,
        distance=nan if stopped else paper_distance(setup, twin),
        initial_distance=nan if stopped else paper_distance(setup, setup.original),
        yardstick=measure,
        evaluations=evaluations,
        history=np.array(recorder.history).reshape(-1, 4),
        stopped=stopped,
        seconds=time.monotonic() - began,
        warnings=(
            *setup.warnings,
            *_against_the_tape(outcome, nuisances),
            *_early(sensor),
            *_late(setup, values, found),
            *_remarks(drives, twin, estimates),
            *_absorbed(twin, found),
            *([_ONE_PASS] if found is not None and not stopped and measure is None else []),
        ),
    )


def _with_uncertainty(twin: Twin, estimates: Sequence[Estimate]) -> Twin:
    """The twin with the standard deviations of what was estimated; of a characteristic where each point has one."""
    known = dict(twin.uncertainty or {})
    points: dict[str, list[float]] = {}
    for one in estimates:
        sigma = float(f"{(one.high - one.low) / (2.0 * HALF_WIDTH):.3g}")
        whole, _, index = one.key.rpartition(".")
        if index.isdecimal():
            points.setdefault(whole, []).append(sigma)
        elif not one.key.startswith("effects.") and math.isfinite(sigma):
            known[one.key] = sigma
    for key, sigmas in points.items():
        values = value_at(twin, key)
        if all(map(math.isfinite, sigmas)) and isinstance(values, Sequence) and len(values) == len(sigmas):
            known[key] = tuple(sigmas)
    return twin.with_changes({"uncertainty": known}) if known else twin


def _settled(outcome: SearchOutcome, objective: Objective, found: Uncertainty) -> SearchOutcome:
    """The outcome at the coordinates that the uncertainty was taken around, if those are its search's."""
    squares = outcome.squares
    if squares is None or (squares.likelihood is None and np.array_equal(squares.x, found.x)):
        return outcome
    d, space = len(found.space), outcome.problem.space
    values = np.clip(found.space.from_slopes(found.x[:d]), space.lower, space.upper)
    cost = float(costs_of(outcome.problem, objective, values[:, None], found.x[d:])[0])
    settled = replace(squares, x=found.x)
    return replace(outcome, values=values, nuisance=found.x[d:] + outcome.placed, squares=settled, cost=cost)


def _remarks(drives: tuple[DriveFit, ...], twin: Twin, estimates: Sequence[Estimate]) -> list[str]:
    """Warnings about drives whose gap did not shrink."""
    bound = ", ".join(parameter_label(twin, e.key) for e in estimates if e.on_bound)
    remarks = []
    for d in drives:
        if d.gap_after.rms <= d.gap_before.rms:
            continue
        if d.nuisance_free < 0.5 * d.gap_after.rms:
            remarks.append(
                f"{d.name}: the gap is {d.gap_after.rms:.3g} {channel_unit(d.channel)}, "
                f"{d.nuisance_free:.3g} with the nuisances corrected: "
                "clocks or map are off by the values found for them"
            )
        else:
            remarks.append(
                f"the calibrated twin is farther from {d.name} than the one it started from"
                + (f"; on their bounds, which --bound moves: {bound}" if bound else "")
            )
    return remarks


#: Errors of a tape in words, where they are positive and where they are not.
_TAPE = {"height": ("higher", "lower"), "length": ("longer", "shorter"), "place": ("farther on", "nearer")}


def _against_the_tape(outcome: SearchOutcome, nuisances: Sequence[NuisanceEstimate]) -> list[str]:
    """A line for each size that differs from the tape by more than its standard deviation."""
    taped, lines = outcome.problem.nuisances.taped, []
    for n in nuisances:
        if taped is None or not n.name.startswith("tape.") or abs(n.value) <= n.prior:
            continue
        _, number, kind = n.name.split(".")
        off, sure = 1e3 * abs(n.value), 1e3 * HALF_WIDTH * n.sigma
        how = _TAPE[kind][n.value < 0.0]
        lines.append(f"{taped.features[int(number)]}: found {off:.0f} mm {how} than by tape (± {sure:.0f})")
    return lines


def _early(sensor: tuple[SensorEstimate, ...]) -> list[str]:
    """A warning where the sensor seems to be early, beyond its uncertainty."""
    return [
        f"the samples of the IMU seem to come {-1e3 * s.value:.0f} ms before they are taken ({-1e3 * s.high:.0f} to "
        f"{-1e3 * s.low:.0f}): the positions of the receiver come late, or its clock is; {s.key} stays {s.start:g} s"
        for s in sensor
        if s.key == LATENCY and s.high < 0.0
    ]


def _late(setup: Setup, values: Floats, found: Uncertainty | None) -> list[str]:
    """A warning where the responses on a rig come after or before what excites them, beyond three deviations."""
    if found is None or LATENCY not in setup.space.keys:
        return []
    row = setup.space.keys.index(LATENCY)
    low, value, high = (1e3 * float(v[row]) for v in (found.low, values, found.high))
    start = 1e3 * setup.space.parameters[row].prior.typical
    if abs(value - start) <= REACH * (high - low) / (2.0 * HALF_WIDTH):
        return []
    side = "after" if value > 0 else "before"
    return [
        f"the responses come {abs(value):.1f} ms {side} road and force ({low:.1f} to {high:.1f}): filters or clocks of "
        f"the channels differ; {LATENCY} is written as {value:.1f} ms"
    ]


def _absorbed(twin: Twin, found: Uncertainty | None) -> list[str]:
    """A warning that lists the parameters that made up for an error elsewhere while they were free."""
    names = [
        f"{parameter_label(twin, key)} at {value:{'.0f' if value > 1e3 else '.4g'}} {parameter_unit(key)}".strip()
        for key, value in (zip(found.space.keys, found.absorbed, strict=True) if found else ())
        if np.isfinite(value)
    ]
    return [_KEPT.format(", ".join(names))] if names else []


def _estimates(setup: Setup, values: Floats, found: Uncertainty | None) -> tuple[Estimate, ...]:
    space = setup.space
    bound = space.on_bound(values)
    unknown = np.full(len(space), float("nan"))
    low, high = (found.low, found.high) if found else (unknown, unknown)
    status = found.status if found else ("not identified",) * len(space)
    return tuple(
        Estimate(
            key=key,
            start=float(space.parameters[i].prior.typical),
            value=float(values[i]),
            low=float(low[i]),
            high=float(high[i]),
            lower=float(space.lower[i]),
            upper=float(space.upper[i]),
            status="on bound" if bound[i] and status[i] != "kept" else status[i],
        )
        for i, key in enumerate(space.keys)
    )


def _nuisances(outcome: SearchOutcome, found: Uncertainty | None) -> tuple[NuisanceEstimate, ...]:
    nuisances = outcome.problem.nuisances
    sigma = found.posterior.sigma if found else np.full(len(nuisances), float("nan"))
    return tuple(
        NuisanceEstimate(p.key, float(value), float(s), p.prior.spread, p.unit)
        for p, value, s in zip(nuisances.parameters, outcome.nuisance, sigma, strict=True)
    )
