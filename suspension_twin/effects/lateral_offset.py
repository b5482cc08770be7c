# SPDX-License-Identifier: Apache-2.0
"""The map shifted across the road."""

from __future__ import annotations

from suspension_twin.effects.base import Effect, Hook, Parameter, Prior, RoadChange, Values, more


def _road(change: RoadChange, p: Values) -> None:
    change.left[:] += p["offset"]


EFFECT = Effect(
    id="lateral_offset",
    title="map shifted across the road",
    where="road",
    doc="The vehicle is, on the road of the file, this much further to the left than its pose says.",
    parameters=(
        Parameter(
            "offset", (-4.0, 4.0), Prior(0.0, 0.3, usual=0.03), "m", "across the reference line, to the left"
        ),
    ),
    order=210,
    severity=("offset",),
    excited_by=("roads whose wheel paths differ",),
    confused_with=("corner_damper", "road_scale"),
    hook=Hook(road=_road, models=("full_car", "msd")),
    finding=lambda p: (
        f"the car drives {more(p['offset'], 'm', 'further left', 'further right')} on the road than its pose says"
    ),
)
