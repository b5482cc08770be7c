# SPDX-License-Identifier: Apache-2.0
"""Priors of the parameters, by their keys in the twin file.

A prior is normal about the value of the twin file, in the logarithm for positive quantities. Quantities from a
weighbridge have a smaller standard deviation than those that are rarely measured. Bounds from a paper are used as they
are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from suspension_twin.vehicle.tracked import BOUNDS

__all__ = ["PRIORS", "Prior", "prior_of"]


@dataclass(frozen=True)
class Prior:
    """``spread``: standard deviation, of the logarithm where ``log``; ``reach``: factor or distance of the bounds, or
    the ``bounds`` themselves; ``usual``: free by default on a vehicle without characteristics."""

    log: bool
    reach: float
    spread: float
    bounds: tuple[float, float] | None = None
    usual: bool = False

    def around(self, nominal: float) -> tuple[float, float]:
        """Bounds of a number whose value in the file is ``nominal``."""
        if self.bounds is not None:
            return self.bounds
        if self.log:
            return nominal / self.reach, nominal * self.reach
        return nominal - self.reach, nominal + self.reach


def _of_the_track(key: str) -> Prior:
    """Bounds of the tracked paper, eqs (10) to (14); standard deviation 15 % of their range."""
    low, high = BOUNDS[key]
    log = low > 0
    width = float(np.log(high / low)) if log else high - low
    return Prior(log, 0.0, 0.15 * width, (low, high), usual=True)


PRIORS: Final[Mapping[str, Prior]] = {
    "vehicle.mass": Prior(True, 1.4, 0.05),
    "vehicle.cog.0": Prior(False, 0.6, 0.10),
    "vehicle.cog.1": Prior(False, 0.2, 0.02),
    "vehicle.cog.2": Prior(True, 1.6, 0.10),
    "vehicle.sprung_inertia.roll": Prior(True, 2.5, 0.15),
    "vehicle.sprung_inertia.pitch": Prior(True, 2.5, 0.15),
    "vehicle.tyre.vertical_stiffness": Prior(True, 3.0, 0.10),
    "vehicle.front.unsprung_mass": Prior(True, 2.5, 0.10),
    "vehicle.rear.unsprung_mass": Prior(True, 2.5, 0.10),
    "vehicle.sprung_mass": Prior(True, 1.4, 0.05),
    "vehicle.unsprung_mass": Prior(True, 2.5, 0.10),
    "imu.position.0": Prior(False, 0.5, 0.05),
    "imu.position.1": Prior(False, 0.5, 0.05),
    "imu.position.2": Prior(False, 0.5, 0.05),
    # of a tracked vehicle: scatter of specimens of one type (age of the oil, steel, load)
    **{f"vehicle.{key}": _of_the_track(key) for key in BOUNDS},
    "vehicle.stations.*.damping": Prior(True, 2.5, 0.15, usual=True),
    "vehicle.arm.stiffness": Prior(True, 1.5, 0.05, usual=True),
    "vehicle.gyration": Prior(True, 1.5, 0.05, usual=True),
    "vehicle.idler.taut_at": Prior(False, 36.0, 12.0, usual=True),
    "vehicle.driver.gain": Prior(True, 4.5, 0.5, usual=True),
}


def prior_of(key: str) -> Prior | None:
    """The prior of a key; None where there is none."""
    return PRIORS.get(key) or PRIORS.get(re.sub(r"\.\d+\.", ".*.", key))
