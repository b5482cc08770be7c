# SPDX-License-Identifier: Apache-2.0
"""A contact patch that averages short bumps."""

from __future__ import annotations

from suspension_twin.effects.base import Effect, Hook, Parameter, Prior, RoadChange, Values, plain

#: m, of a car's tyre: a load of 4 kN over a pressure of 220 kPa and a width in contact of 0.16 m is 0.114 m (a prior).
_USUAL = 0.12


def _road(change: RoadChange, p: Values) -> None:
    change.patch[:] += p["length"]


EFFECT = Effect(
    id="tyre_envelope",
    title="contact patch",
    where="tyre",
    doc="The wheel follows the mean height over the length of its contact patch instead of the height at a point.",
    parameters=(
        Parameter(
            "length",
            (0.01, 2.0),
            Prior(0.15, 1.8, "factor", usual=_USUAL),
            "m",
            "of the contact patch, along the road",
        ),
    ),
    order=180,
    severity=("length",),
    excited_by=("short bumps", "sharp edges"),
    confused_with=("tyre_damping", "sensor_bandwidth", "road_smoothing (the other way round)"),
    hook=Hook(road=_road, models=("full_car", "msd")),
    finding=lambda p: f"the tyres roll over short bumps with a contact patch of {plain(p['length'], 'm')}",
)
