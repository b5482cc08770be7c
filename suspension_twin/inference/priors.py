# SPDX-License-Identifier: Apache-2.0
"""Priors of the numbers of a twin file, by their keys.

A prior is normal about the value of the twin file, in the logarithm for positive quantities. Quantities from a
weighbridge have a smaller standard deviation than those that are rarely measured. Bounds from a paper are used as they
are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from suspension_twin.models.parameters import Parameter, Prior
from suspension_twin.vehicle.tracked import BOUNDS

__all__ = ["PRIORS", "TwinPrior", "prior_of"]


@dataclass(frozen=True)
class TwinPrior:
    """Prior of a number of the twin file about the file's value.

    ``spread`` is the standard deviation, of the logarithm for the ``scale`` "log"; ``reach`` the factor or distance of
    the bounds where these are no ``bounds`` of their own; ``free``: searched by default on a vehicle without
    characteristics.
    """

    scale: Literal["linear", "log"]
    reach: float
    spread: float
    bounds: tuple[float, float] | None = None
    free: bool = False

    def around(self, nominal: float) -> tuple[float, float]:
        """Bounds of a number whose value in the file is ``nominal``."""
        if self.bounds is not None:
            return self.bounds
        if self.scale == "log":
            return nominal / self.reach, nominal * self.reach
        return nominal - self.reach, nominal + self.reach

    def about(self, key: str, nominal: float, bounds: tuple[float, float] | None = None) -> Parameter:
        """The parameter of a twin whose file has the value ``nominal``; other ``bounds`` where they are given."""
        return Parameter(key, bounds or self.around(nominal), Prior(nominal, self.spread, self.scale))


def _of_the_track(key: str) -> TwinPrior:
    """Bounds of the tracked paper, eqs (10) to (14); standard deviation 15 % of their range."""
    low, high = BOUNDS[key]
    log = low > 0
    width = float(np.log(high / low)) if log else high - low
    return TwinPrior("log" if log else "linear", 0.0, 0.15 * width, (low, high), free=True)


PRIORS: Final[Mapping[str, TwinPrior]] = {
    "vehicle.mass": TwinPrior("log", 1.4, 0.05),
    "vehicle.cog.0": TwinPrior("linear", 0.6, 0.10),
    "vehicle.cog.1": TwinPrior("linear", 0.2, 0.02),
    "vehicle.cog.2": TwinPrior("log", 1.6, 0.10),
    "vehicle.sprung_inertia.roll": TwinPrior("log", 2.5, 0.15),
    "vehicle.sprung_inertia.pitch": TwinPrior("log", 2.5, 0.15),
    "vehicle.tyre.vertical_stiffness": TwinPrior("log", 3.0, 0.10),
    "vehicle.front.unsprung_mass": TwinPrior("log", 2.5, 0.10),
    "vehicle.rear.unsprung_mass": TwinPrior("log", 2.5, 0.10),
    "vehicle.sprung_mass": TwinPrior("log", 1.4, 0.05),
    "vehicle.unsprung_mass": TwinPrior("log", 2.5, 0.10),
    "imu.position.0": TwinPrior("linear", 0.5, 0.05),
    "imu.position.1": TwinPrior("linear", 0.5, 0.05),
    "imu.position.2": TwinPrior("linear", 0.5, 0.05),
    # of a tracked vehicle: scatter of specimens of one type (age of the oil, steel, load)
    **{f"vehicle.{key}": _of_the_track(key) for key in BOUNDS},
    "vehicle.stations.*.damping": TwinPrior("log", 2.5, 0.15, free=True),
    "vehicle.arm.stiffness": TwinPrior("log", 1.5, 0.05, free=True),
    "vehicle.gyration": TwinPrior("log", 1.5, 0.05, free=True),
    "vehicle.idler.taut_at": TwinPrior("linear", 36.0, 12.0, free=True),
    "vehicle.driver.gain": TwinPrior("log", 4.5, 0.5, free=True),
}


def prior_of(key: str) -> TwinPrior | None:
    """The prior of a key; None where there is none."""
    return PRIORS.get(key) or PRIORS.get(re.sub(r"\.\d+\.", ".*.", key))
