# SPDX-License-Identifier: Apache-2.0
"""One question and one yardstick for every way of calibrating, for ``calibration.py`` and its peers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from calibration_cases import Case

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.searches import costs_of, synchronised
from suspension_twin.calibration.setup import set_up
from suspension_twin.calibration.squares import moved
from suspension_twin.inference.nuisance import NUISANCES
from suspension_twin.inference.space import curve_keys
from suspension_twin.vehicle.twin import load_twin

_ONE_CHANNEL = (("vertical_acceleration", 1.0),)


def same_question(case: Case, preset: str, seed: int, **more: Any) -> CalibrationRequest:
    """One drive, the paper's 24 points, eq. (1) and the clock: what both presets can be asked alike."""
    asked: dict[str, Any] = (
        {}
        if preset == "paper"
        else {
            "objective": "euclidean",
            "channels": _ONE_CHANNEL,
            "free": curve_keys(load_twin(case.twin)),
            "freeze": tuple(f"nuisances.{name}" for name in NUISANCES if name != "clock_offset"),
        }
    )
    drives = tuple(str(p) for p in case.drives.values())
    return CalibrationRequest(twin=str(case.twin), bags=drives, preset=preset, seed=seed, **asked, **more)


def judged_by(request: CalibrationRequest) -> Callable[[Floats], float]:
    """Eq. (1) of values (d,) aligned in time: their signals interpolated, or the pose moved and they simulated
    again, whichever costs less."""
    setup = set_up(request, lambda note: None, lambda: False)
    problem, objective = setup.problem, setup.objective
    quiet = np.zeros(len(problem.nuisances))

    def cost(values: Floats) -> float:
        one = values[:, None]
        signals, _ = problem.signals_of(one, np.zeros((0, 1)))
        offset = synchronised(problem, objective, signals, quiet[:, None])[:, 0]
        return min(
            float(costs_of(p, objective, one, quiet, synchronise=True)[0])
            for p in (problem, moved(problem, offset))
        )

    return cost


def traced(
    request: CalibrationRequest, judge: Callable[[Floats], float]
) -> tuple[CalibrationResult, list[tuple[int, float, float]]]:
    """A calibration and (evaluations, cost by ``judge``, seconds) of its best after each generation.

    Judging stops the clock."""
    trace: list[tuple[int, float, float]] = []
    began, judging = time.perf_counter(), 0.0

    def look(evaluations: int, values: Sequence[float]) -> None:
        nonlocal judging
        now = time.perf_counter()
        if not trace or trace[-1][0] != evaluations:
            trace.append((evaluations, judge(np.array(values)), now - began - judging))
        judging += time.perf_counter() - now

    result = calibrate(request, lambda p: look(p.evaluations, p.values) if p.values else None)
    look(result.evaluations, [e.value for e in result.estimates])
    return result, trace
