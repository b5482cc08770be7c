# SPDX-License-Identifier: Apache-2.0
"""Selection of a tracked vehicle's damping, section 6 of the tracked paper: Table 1 and Fig. 13.

Variance of the pitch over 15 s for speeds of 5 to 55 km/h in steps of 5 and the seven dampings of
Table 1, 77 runs, and the damping to take for a range of speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, WorkError
from suspension_twin.inference.priors import TABLES
from suspension_twin.models.tracked import simulate_tracked_lanes
from suspension_twin.vehicle.tracked import TrackedVehicle

__all__ = ["DAMPINGS", "DURATION", "PAPER_CURVE", "SPEEDS", "Selection", "pitch_variances", "select_damping"]

#: Dampings in N m s/rad, speeds in km/h, s of a run, and the number of the damping that the paper recommends over all
#: speeds.
DAMPINGS, SPEEDS = TABLES.damping.dampings, TABLES.damping.speeds
DURATION, PAPER_CURVE = TABLES.damping.duration, TABLES.damping.recommended


@dataclass(frozen=True)
class Selection:
    """Variances of the pitch, ``table`` (dampings, speeds) rad², NaN where a run diverged, and the damping to take from
    ``low`` to ``high`` km/h."""

    dampings: tuple[float, ...]
    speeds: tuple[float, ...]
    table: Floats
    low: float
    high: float

    @property
    def _within(self) -> Floats:
        """The table's columns from ``low`` to ``high``."""
        return self.table[:, [self.low <= v <= self.high for v in self.speeds]]

    @property
    def mean(self) -> Floats:
        """(dampings,) mean variance within the range."""
        return np.asarray(self._within.mean(axis=1))

    @property
    def regret(self) -> Floats:
        """(dampings,) largest variance over the least of all dampings at that speed."""
        return np.asarray((self._within / np.nanmin(self._within, axis=0)).max(axis=1))

    @property
    def best(self) -> int:
        """The damping of least mean."""
        return int(np.nanargmin(self.mean))

    @property
    def near(self) -> tuple[int, ...]:
        """Dampings whose mean is within a tenth of the least."""
        mean = self.mean
        return tuple(int(i) for i in np.flatnonzero(mean <= 1.1 * mean[self.best]))


def pitch_variances(
    vehicle: TrackedVehicle,
    dampings: Sequence[float] = DAMPINGS,
    speeds: Sequence[float] = SPEEDS,
    tell: Callable[[str, float], None] = lambda text, share: None,
) -> Floats:
    """Variance of the pitch in rad² (dampings, speeds); NaN for a run that diverged.

    ``tell`` is called before each damping's runs with a text and the share of the runs that is done.
    """
    rows = []
    for i, damping in enumerate(dampings):
        tell(f"simulating {len(speeds)} runs with {damping:.0f} N m s/rad", i / len(dampings))
        vehicles = [vehicle.with_dampers(damping)] * len(speeds)
        runs = simulate_tracked_lanes(vehicles, [v / 3.6 for v in speeds], DURATION)
        rows.append([np.nan if r.failed else float(r.pitch.var()) for r in runs])
    return np.array(rows)


def select_damping(
    vehicle: TrackedVehicle,
    low: float = 5.0,
    high: float = 55.0,
    tell: Callable[[str, float], None] = lambda text, share: None,
) -> Selection:
    """The damping of Table 1 with the least mean variance of the pitch from ``low`` to ``high`` km/h.

    ``tell`` as for :func:`pitch_variances`. Raises InputError where no speed of the table lies within, WorkError
    where every damping diverged.
    """
    if not any(low <= v <= high for v in SPEEDS):
        raise InputError("--range", f"no speed of 5, 10 ... 55 km/h lies between {low:g} and {high:g}")
    found = Selection(DAMPINGS, SPEEDS, pitch_variances(vehicle, tell=tell), low, high)
    if np.isnan(found.mean).all():
        raise WorkError("damping: every damping diverged within the range")
    return found
