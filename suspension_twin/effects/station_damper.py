# SPDX-License-Identifier: Apache-2.0
"""One station of a tracked vehicle has a damper that has lost damping, or a wrong one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from suspension_twin.effects._station import STATION, add, exists
from suspension_twin.effects.base import Effect, Floats, Hook, Parameter, Prior, Values, changed
from suspension_twin.vehicle.twin import Twin


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    stations = [numbers.get(f"vehicle.stations.{i}.damping") for i in range(12)]
    own = np.zeros_like(p["change"])
    for i, damping in enumerate(stations):
        if damping is not None:
            own = np.where(p["station"] == i + 1, damping, own)
    add(numbers, "damping", p["station"], own * p["change"])


def _possible(twin: Twin, p: Mapping[str, float]) -> bool:
    return exists(twin, p) and twin.vehicle.stations[int(p["station"]) - 1].damping > 0


EFFECT = Effect(
    id="station_damper",
    title="one odd station's damper",
    where="strut",
    doc="The damper of one road wheel's arm has (1 + change) times its damping.",
    parameters=(STATION, Parameter("change", (-1.0, 1.0), Prior(0.0, 0.5), "", "of its damping, as a share")),
    order=133,
    severity=("change",),
    excited_by=("speed over an obstacle",),
    confused_with=("station_damper of another station",),
    hook=Hook(vehicle=_vehicle, models=("tracked",), possible=_possible),
    finding=lambda p: f"the damper of road wheel {p['station']:.0f} {changed(p['change'], 'damping')}",
)
