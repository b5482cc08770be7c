# SPDX-License-Identifier: Apache-2.0
"""One station's torsion bar of a tracked vehicle has set: its arm hangs higher."""

from __future__ import annotations

from suspension_twin.effects._station import STATION, add, exists
from suspension_twin.effects.base import Effect, Floats, Hook, Parameter, Prior, Values, more


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    add(numbers, "sag", p["station"], p["sag"])


EFFECT = Effect(
    id="station_bar",
    title="sagged torsion bar",
    where="strut",
    doc="The torsion bar of one road wheel's arm has set: its free angle is higher.",
    parameters=(
        STATION,
        Parameter("sag", (-0.2, 0.3), Prior(0.0, 0.06), "rad", "how far its free angle has gone up"),
    ),
    order=134,
    severity=("sag",),
    excited_by=("edges of obstacles",),
    confused_with=("payload", "station_bar of another station"),
    hook=Hook(vehicle=_vehicle, models=("tracked",), possible=exists),
    finding=lambda p: (
        f"the torsion bar of road wheel {p['station']:.0f} has set: its arm stands "
        f"{more(p['sag'], 'rad', 'higher', 'lower')}"
    ),
)
