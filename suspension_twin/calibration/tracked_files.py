# SPDX-License-Identifier: Apache-2.0
"""Preset ``tracked_paper`` from files to a file: what the command line and the calibrator node both do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspension_twin.calibration.request import Progress
from suspension_twin.calibration.tracked_paper import (
    SETTINGS,
    Objective,
    TrackedResult,
    calibrate_tracked,
    compare,
    simulate_runs,
)
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.marker_runs import MarkerRun, read_run
from suspension_twin.vehicle.tracked import TrackedTwin, TrackedVehicle
from suspension_twin.vehicle.twin import load_twin, save_twin

__all__ = ["PRESET", "TrackedCalibration", "calibrate_tracked_files"]

PRESET = "tracked_paper"


@dataclass(frozen=True)
class TrackedCalibration:
    """``result`` from ``start``; of all ``runs`` the ``told`` motion of what was found and which were ``fitted``.

    ``initial_cost``: what the objective made of the start. ``stopped``: told to stop, the best until then."""

    start: TrackedVehicle
    result: TrackedResult
    runs: tuple[MarkerRun, ...]
    told: tuple[MarkerRun, ...]
    fitted: tuple[bool, ...]
    initial_cost: float
    stopped: bool

    @property
    def message(self) -> str:
        """One line: what came out."""
        state = "stopped, the best so far: " if self.stopped else ""
        cost = f"cost {self.initial_cost:.4g} to {self.result.best[-1]:.4g} in {self.result.evaluations} evaluations"
        used = sum(self.fitted)
        return f"{state}{cost}; {used} runs fitted, {len(self.runs) - used} to validate"


def calibrate_tracked_files(
    twin: str | Path,
    paths: Sequence[str | Path],
    out: Path,
    *,
    objective: Objective = "correlation",
    seed: int = 0,
    generations: int = 0,
    tell: Callable[[Progress], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrackedCalibration:
    """Fit the slowest of the marker runs ``paths``, try the others, and write the calibrated twin to ``out``.

    ``generations`` 0: the preset's. Raises InputError for a twin or runs that cannot be used, WorkError where what
    was found diverges or it was stopped before anything was.
    """
    tell(Progress("reading"))
    loaded = load_twin(twin)
    if not isinstance(loaded, TrackedTwin):
        raise InputError(str(twin), "model", f"is {loaded.model}: {PRESET} is for a twin on tracks")
    start = loaded.vehicle
    runs = tuple(read_run(p, start) for p in paths)
    if not runs:
        raise InputError(PRESET, "runs", "none is given")
    slowest = min(r.speed for r in runs)
    fitted = tuple(r.speed <= 1.02 * slowest for r in runs)
    own = [r for r, used in zip(runs, fitted, strict=True) if used]
    settings = replace(SETTINGS, generations=generations or SETTINGS.generations)
    asked = False

    def stop() -> bool:
        nonlocal asked
        asked = asked or should_stop()
        return asked

    result = calibrate_tracked(
        start, own, objective=objective, seed=seed, settings=settings, tell=tell, should_stop=stop
    )
    tell(Progress("writing"))
    save_twin(loaded.model_copy(update={"vehicle": result.vehicle}), out)
    before, told = simulate_runs([start, result.vehicle], runs)
    if told is None:
        raise WorkError(f"{PRESET}: what was found diverges on a validation run")
    costs = [
        compare(r, b).cost(objective) for r, b, used in zip(runs, before or (), fitted, strict=False) if used
    ]
    initial = float(np.mean(costs)) if costs else float("inf")
    return TrackedCalibration(start, result, runs, tuple(told), fitted, initial, asked)
