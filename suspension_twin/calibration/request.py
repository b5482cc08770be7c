# SPDX-License-Identifier: Apache-2.0
"""What is asked of a calibration, what it says on the way and what it hands back: plain, picklable data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.drive.read import Topics
from suspension_twin.gap.measure import Gap
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "CalibrationRequest",
    "CalibrationResult",
    "CurveEstimate",
    "DriveFit",
    "Estimate",
    "NuisanceEstimate",
    "Progress",
]


@dataclass(frozen=True)
class CalibrationRequest:
    """One calibration. Only ``twin`` and ``bags`` are needed.

    ``preset`` names what ``presets.PRESETS`` holds. ``free`` replaces what the preset searches and
    ``also`` adds to it: dotted keys, or the key of a whole characteristic
    (``vehicle.front.spring``); ``freeze`` takes keys out again, nuisances too
    (``nuisances.gain``; the names of ``nuisance.NUISANCES``). ``bounds`` (key, lower, upper).
    ``objective`` and ``channels`` (name, weight) as in ``objectives``; empty for the preset's own.
    ``max_generations`` 0 is the preset's. ``state`` is a folder for checkpoints, empty for none.
    """

    twin: str
    bags: tuple[str, ...]
    preset: str = "fast"
    seed: int = 0
    free: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    freeze: tuple[str, ...] = ()
    bounds: tuple[tuple[str, float, float], ...] = ()
    objective: str = ""
    channels: tuple[tuple[str, float], ...] = ()
    max_generations: int = 0
    state: str = ""
    topics: Topics = Topics()


@dataclass(frozen=True)
class Progress:
    """Where a calibration stands: ``stage`` "reading", "search", "refine" or "writing"; costs in the
    objective's unit, NaN while unknown; ``seconds_left`` an estimate, NaN while unknown."""

    stage: str
    generation: int = 0
    evaluations: int = 0
    best_cost: float = float("nan")
    mean_cost: float = float("nan")
    seconds_left: float = float("nan")
    note: str = ""


@dataclass(frozen=True)
class Estimate:
    """One parameter found, in the units of the twin file.

    ``low`` and ``high`` bound its 90 % interval, NaN where none could be had; ``on_bound`` "lower",
    "upper" or ""; ``excited``: the drives took the suspension there; ``determined``: the drives, not
    the prior, say what it is.
    """

    key: str
    start: float
    value: float
    low: float
    high: float
    lower: float
    upper: float
    on_bound: str = ""
    excited: bool = True
    determined: bool = True


@dataclass(frozen=True)
class NuisanceEstimate:
    """One nuisance: not the vehicle's, found on the way. ``sigma`` its standard deviation; ``prior`` that
    of what was allowed: where both are alike the drives say nothing of it."""

    name: str
    value: float
    sigma: float
    prior: float
    unit: str


@dataclass(frozen=True, eq=False)
class CurveEstimate:
    """A characteristic with its band: ``grid`` (g,) abscissae, ``force``, ``low``, ``high``, ``start`` (g,) N;
    ``span`` the range that the drives excited, m or m/s (NaN, NaN where nothing was).

    A spring has ``static``, the compression that the vehicle stands at (else NaN), and ``rest_low``,
    ``rest_high`` (g,) N over ``rest_grid`` (g,) m of travel from there: what a drive can see of it, wherever
    the free length lies.
    """

    key: str
    unit: str
    grid: Floats
    force: Floats
    low: Floats
    high: Floats
    start: Floats
    span: tuple[float, float]
    static: float
    rest_grid: Floats
    rest_low: Floats
    rest_high: Floats


@dataclass(frozen=True, eq=False)
class DriveFit:
    """One drive, compared: gaps over the whole of it, and every channel (m,) on its grid ``t``.

    ``before`` and ``after`` are the twin as it was and as it is; ``nuisance_free`` what is left of the
    gap's rms on the compared samples (``compared`` (m,)) once the nuisances are taken out. ``profile`` are
    distances (k,) m along the road and the heights (k, 2) m of the left and right track.
    """

    name: str
    gap_before: Gap
    gap_after: Gap
    nuisance_free: float
    correlation: float
    rate: float
    t: Floats
    position: Floats
    profile: tuple[Floats, Floats]
    measured: dict[str, Floats]
    before: dict[str, Floats]
    after: dict[str, Floats]
    compared: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """What came out: ``twin`` calibrated from ``start``. ``history`` (k, 4): evaluations, best cost, mean cost
    and stage number (0 search,
    1 refine) after each generation. ``stopped``: it was told to stop, this is the best until then,
    and what takes time (intervals, drives) is missing."""

    twin: Twin
    start: Twin
    preset: str
    objective: str
    seed: int
    estimates: tuple[Estimate, ...]
    nuisances: tuple[NuisanceEstimate, ...]
    curves: tuple[CurveEstimate, ...]
    drives: tuple[DriveFit, ...]
    cost: float
    initial_cost: float
    evaluations: int
    generations: int
    history: Floats
    stopped: bool
    seconds: float
    warnings: tuple[str, ...]

    @property
    def message(self) -> str:
        """One line: what came out."""
        state = "stopped, the best so far: " if self.stopped else ""
        change = f"cost ({self.objective}) {self.initial_cost:.4g} to {self.cost:.4g} in {self.evaluations} evaluations"
        if not self.drives:
            return f"{state}{change}"
        gaps = ", ".join(
            f"{d.name} {d.gap_before.rms:.3g} to {d.gap_after.rms:.3g} m/s²" for d in self.drives
        )
        dark = sum(not e.excited for e in self.estimates)
        tail = f"; {dark} of {len(self.estimates)} parameters not excited" if dark else ""
        return f"{state}{change}; gap {gaps}{tail}"
