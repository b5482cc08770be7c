# SPDX-License-Identifier: Apache-2.0
"""Effects of one station of a tracked vehicle: the parameter that says which road wheel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from suspension_twin.effects.base import Floats, Parameter, Prior
from suspension_twin.vehicle.twin import Twin

__all__ = ["STATION", "add", "exists"]

_MOST = 12

STATION = Parameter(
    "station",
    (1, _MOST),
    Prior(1, 3),
    "",
    "which road wheel, 1 in front",
    neutral=1,
    choices=tuple(range(1, _MOST + 1)),
)


def exists(twin: Twin, p: Mapping[str, float]) -> bool:
    """Whether the vehicle has such a station."""
    return bool(p["station"] <= len(twin.vehicle.stations))


def add(numbers: dict[str, Floats], name: str, station: Floats, change: Floats) -> None:
    """Add ``change`` (L,) to a number of the ``station`` (L,) of each candidate; a station that there is not stays
    nothing, and the candidate fails."""
    for i in range(_MOST):
        own, key = station == i + 1, f"vehicle.stations.{i}.{name}"
        if not own.any():
            continue
        numbers[key] = np.where(
            own, numbers.get(key, np.full(own.shape, np.nan)) + change, numbers.get(key, 0.0)
        )
