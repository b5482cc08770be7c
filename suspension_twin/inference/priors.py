# SPDX-License-Identifier: Apache-2.0
"""Priors of the numbers of a twin file and of nuisance parameters, and the papers' tables, from ``priors.yaml``.

A prior is normal about the value of the twin file, in the logarithm for positive quantities. Quantities from a
weighbridge have a smaller standard deviation than those that are rarely measured. Bounds from a paper are used as they
are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal

import numpy as np

from suspension_twin.files import read_yaml
from suspension_twin.models.parameters import Parameter, Prior
from suspension_twin.schema import Strict, checked
from suspension_twin.vehicle.tracked import BOUNDS

__all__ = ["PRIORS", "TABLES", "NuisancePrior", "PointBounds", "TwinPrior", "prior_of"]

_FILE: Final = Path(__file__).with_name("priors.yaml")


class TwinPrior(Strict):
    """Prior of numbers of the twin file about the file's value.

    ``spread`` is the standard deviation, of the logarithm for the ``scale`` "log"; ``reach`` the factor or distance of
    the bounds where these are no ``bounds`` of their own; ``free``: searched by default on a vehicle without
    characteristics.
    """

    keys: tuple[str, ...]
    unit: str
    source: str
    scale: Literal["linear", "log"]
    spread: float
    reach: float = 0.0
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
        return Parameter(
            key, bounds or self.around(nominal), Prior(nominal, self.spread, self.scale), self.unit
        )


class UnlistedPrior(Strict):
    """Prior of a number of the twin file that is not listed, from the bounds that are given for it."""

    log_spread: float
    share_of_bounds: float
    source: str

    def about(self, key: str, nominal: float, bounds: tuple[float, float]) -> Parameter:
        """The parameter of a twin, in the logarithm where it is positive."""
        if bounds[0] > 0 and nominal > 0:
            return Parameter(key, bounds, Prior(nominal, self.log_spread, "log"))
        return Parameter(key, bounds, Prior(nominal, self.share_of_bounds * (bounds[1] - bounds[0])))


class NuisancePrior(Strict):
    """Standard deviations of a nuisance parameter about zero by the kind of recording; 0 leaves it out."""

    unit: str
    source: str
    calibration: float | None = 0.0
    drive: float | None = 0.0
    planar_motion: float | None = 0.0
    run: float | None = 0.0
    rig: float | None = 0.0


class WholePriors(Strict):
    """Priors of the springs and of the dampers of an axle as a whole."""

    spring: TwinPrior
    damper: TwinPrior


class PointBounds(Strict):
    """Abscissae of the points of a characteristic, and the bounds of each."""

    x: tuple[float, ...]
    unit: str
    bounds: tuple[tuple[float, float], ...]


class Table2(Strict):
    """The car paper's Table 2 by part: spring, damper_push and damper_pull."""

    source: str
    unit: str
    parts: dict[str, PointBounds]


class TrackedPriors(Strict):
    """Priors of the tracked paper's five parameters: standard deviations as a share of their bounds."""

    share_of_bounds: float
    units: dict[str, str]
    source: str

    def of(self, key: str) -> TwinPrior:
        """The prior of a parameter, in the logarithm where it is positive."""
        low, high = BOUNDS[key]
        width = float(np.log(high / low)) if low > 0 else high - low
        return TwinPrior(
            keys=(f"vehicle.{key}",),
            unit=self.units[key],
            source=self.source,
            scale="log" if low > 0 else "linear",
            spread=self.share_of_bounds * width,
            bounds=(low, high),
            free=True,
        )


class DampingRuns(Strict):
    """The tracked paper's runs for the choice of a damping, and the number of the one that it recommends."""

    dampings: tuple[float, ...]
    dampings_unit: Literal["N m s/rad"]
    speeds: tuple[float, ...]
    speeds_unit: Literal["km/h"]
    duration: float
    duration_unit: Literal["s"]
    recommended: int
    source: str


class Tables(Strict):
    """The content of ``priors.yaml``."""

    numbers: tuple[TwinPrior, ...]
    point: TwinPrior
    unlisted: UnlistedPrior
    whole: WholePriors
    nuisances: dict[str, NuisancePrior]
    table_2: Table2
    tracked: TrackedPriors
    damping: DampingRuns


TABLES: Final = checked(Tables, read_yaml(_FILE), _FILE, "a file of priors")

#: By the key of a number, or by its pattern.
PRIORS: Final[Mapping[str, TwinPrior]] = {
    key: prior for prior in (*TABLES.numbers, *map(TABLES.tracked.of, BOUNDS)) for key in prior.keys
}


def prior_of(key: str) -> TwinPrior | None:
    """The prior of a key; None where there is none."""
    return PRIORS.get(key) or PRIORS.get(re.sub(r"\.\d+\.", ".*.", key))
