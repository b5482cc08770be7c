# SPDX-License-Identifier: Apache-2.0
"""Marker runs simulated with given parameters of a tracked vehicle, and how far they agree with measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.marker_runs import MarkerRun, low_pass
from suspension_twin.models.tracked import TrackedResponse, simulate_tracked_lanes
from suspension_twin.vehicle.tracked import TrackedVehicle

_LONGEST_DELAY: Final = 0.2  # s that the clock of a run may be off


@dataclass(frozen=True)
class Agreement:
    """Agreement of two runs. For A and B (2,): ``correlation`` of the displacements, eqs (7), (8); ``residual`` rms of
    the difference over the measured rms; ``gain`` simulated over measured rms. ``motion`` (3, k): the same residuals of
    displacement, velocity and acceleration of each marker seen, with the clock moved by ``delay`` s."""

    correlation: Floats
    residual: Floats
    gain: Floats
    motion: Floats
    delay: float


def compare(measured: MarkerRun, simulated: MarkerRun) -> Agreement:
    """Both at the same stamps; everything about its mean. InputError where a marker does not move."""
    m, s = (_centred(r.markers[:, :2]) for r in (measured, simulated))
    size, other = _rms(m), _rms(s)
    if not (size > 0).all():
        raise InputError(measured.name, "markers", "do not move: nothing to compare with")
    correlation = (m * s).mean(axis=0) / np.maximum(size * other, np.finfo(float).tiny)
    seen = np.array(measured.seen)
    pairs = [
        (getattr(measured, kind)[:, seen], getattr(simulated, kind)[:, seen])
        for kind in ("markers", "velocity", "acceleration")
    ]
    delay = _delay(measured, simulated, seen)
    motion = []
    for have, other_motion in pairs:
        moved = np.stack([np.interp(measured.t - delay, measured.t, c) for c in other_motion.T], axis=1)
        motion.append(_rms(_centred(have) - _centred(moved)) / np.maximum(_rms(_centred(have)), 1e-12))
    return Agreement(correlation, _rms(m - s) / size, other / size, np.array(motion), delay)


def _delay(measured: MarkerRun, simulated: MarkerRun, seen: Floats) -> float:
    """Seconds by which the measured displacements come after the simulated ones: least squares, three steps."""
    delay = 0.0
    have = _centred(measured.markers[:, seen])
    for _ in range(3):
        at = measured.t - delay
        moved = np.stack([np.interp(at, measured.t, c) for c in simulated.markers[:, seen].T], axis=1)
        slope = np.stack([np.interp(at, measured.t, c) for c in simulated.velocity[:, seen].T], axis=1)
        slope = _centred(slope)
        step = -float((slope * (have - _centred(moved))).sum() / max(float((slope**2).sum()), 1e-12))
        delay = float(np.clip(delay + step, -_LONGEST_DELAY, _LONGEST_DELAY))
    return delay


def _centred(x: Floats) -> Floats:
    return np.asarray(x - x.mean(axis=0))


def _rms(x: Floats) -> Floats:
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


def _cut(response: TrackedResponse, run: MarkerRun) -> MarkerRun:
    first = round(run.t[0] * run.rate)
    part = slice(first, first + run.t.size)
    motion = (response.markers, response.marker_velocity, response.marker_acceleration)
    z, v, a = (low_pass(m, run.rate)[part] for m in motion)
    return MarkerRun(run.t, z, v, a, run.speed, run.name)


def simulate_runs(
    vehicles: Sequence[TrackedVehicle], runs: Sequence[MarkerRun]
) -> list[list[MarkerRun] | None]:
    """For each vehicle its motion at the stamps of each run; None where one diverged.

    Repeats at one speed and rate are one simulation.
    """
    kinds = {(r.speed, r.rate): 0.0 for r in runs}
    for run in runs:
        kinds[run.speed, run.rate] = max(kinds[run.speed, run.rate], float(run.t[-1]))
    known = {
        kind: simulate_tracked_lanes(vehicles, [kind[0]] * len(vehicles), seconds, rate=kind[1])
        for kind, seconds in kinds.items()
    }
    out: list[list[MarkerRun] | None] = []
    for i in range(len(vehicles)):
        responses = [known[r.speed, r.rate][i] for r in runs]
        failed = any(r.failed for r in responses)
        out.append(None if failed else [_cut(a, b) for a, b in zip(responses, runs, strict=True)])
    return out
