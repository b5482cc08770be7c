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

__all__ = ["PRIORS", "SINGLE", "TABLES", "NuisancePrior", "PointBounds", "TwinPrior", "prior_of"]

_FILE: Final = Path(__file__).with_name("priors.yaml")


class TwinPrior(Strict):
    """Prior of numbers of the twin file about the file's value.

    ``spread`` is the standard deviation, of the logarithm for the ``scale`` "log", or ``share_of_bounds`` is that as a
    share of the distance of the bounds; ``reach`` is the factor or distance of the bounds where these are no ``bounds``
    of their own; ``free``: searched by default on a vehicle without characteristics.
    """

    keys: tuple[str, ...]
    unit: str
    source: str
    scale: Literal["linear", "log"]
    spread: float = 0.0
    share_of_bounds: float = 0.0
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

    def within(self, bounds: tuple[float, float] | None) -> TwinPrior:
        """The prior with ``bounds`` of its own, if any, and its spread as a share of them."""
        if bounds is None:
            return self
        low, high = bounds
        width = float(np.log(high / low)) if self.scale == "log" else high - low
        return self.model_copy(update={"bounds": bounds, "spread": self.share_of_bounds * width})

    def about(self, key: str, nominal: float, bounds: tuple[float, float] | None = None) -> Parameter:
        """The parameter of a twin whose file has the value ``nominal``; other ``bounds`` where they are given."""
        return Parameter(
            key, bounds or self.around(nominal), Prior(nominal, self.spread, self.scale), self.unit
        )


class NuisancePrior(Strict):
    """Standard deviations of a nuisance parameter about zero by the kind of recording; 0 leaves it out."""

    unit: str
    source: str
    calibration: float | None = 0.0
    drive: float | None = 0.0
    planar_motion: float | None = 0.0
    run: float | None = 0.0
    rig: float | None = 0.0


class PointBounds(Strict):
    """Abscissae of the points of a characteristic in the ``unit``, and the bounds of each in N."""

    x: tuple[float, ...]
    unit: str
    source: str
    bounds: tuple[tuple[float, float], ...]


class DampingRuns(Strict):
    """The tracked paper's runs for the choice of a damping, and the number of the one that it recommends."""

    dampings: tuple[float, ...]
    speeds: tuple[float, ...]
    duration: float
    units: dict[str, str]
    recommended: int
    source: str


class SinglePrior(Strict):
    """A prior that is one number."""

    value: float
    unit: str
    source: str


class RefinedSpring(Strict):
    """Points of a refined spring in m of travel from the standing car, and the farthest; a spring with ``enough``
    points within ``near`` m keeps its own."""

    travel: tuple[float, ...]
    end: float
    enough: int
    near: float
    unit: str
    source: str


class TrackedSearch(Strict):
    """The tracked paper's genetic search, and the ``reach`` of a car's characteristics in it."""

    population: int
    generations: int
    elite_share: float
    reach: float
    source: str


class Tables(Strict):
    """The content of ``priors.yaml``. ``table_2`` and ``whole`` (springs and dampers of an axle) are by part."""

    numbers: tuple[TwinPrior, ...]
    point: TwinPrior
    unlisted: TwinPrior
    single: dict[str, SinglePrior]
    refined_spring: RefinedSpring
    whole: dict[str, TwinPrior]
    nuisances: dict[str, NuisancePrior]
    table_2: dict[str, PointBounds]
    damping: DampingRuns
    tracked_search: TrackedSearch


TABLES: Final = checked(Tables, read_yaml(_FILE), _FILE, "a file of priors")
#: Priors that are one number, by name.
SINGLE: Final[Mapping[str, float]] = {name: prior.value for name, prior in TABLES.single.items()}

#: By the key of a number, or by its pattern.
PRIORS: Final[Mapping[str, TwinPrior]] = {
    key: prior.within(BOUNDS.get(key.removeprefix("vehicle.")))
    for prior in TABLES.numbers
    for key in prior.keys
}


def prior_of(key: str, model: str = "") -> TwinPrior | None:
    """The prior of a key in a twin of a model; None where there is none."""
    return PRIORS.get(f"{model}:{key}") or PRIORS.get(key) or PRIORS.get(re.sub(r"\.\d+\.", ".*.", key))
