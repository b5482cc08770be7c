# SPDX-License-Identifier: Apache-2.0
"""The map shifted along the road."""

from __future__ import annotations

from suspension_twin.effects.base import Effect, Hook, Parameter, Prior, RoadChange, Values, plain


def _road(change: RoadChange, p: Values) -> None:
    change.ahead[:] += p["offset"]


EFFECT = Effect(
    id="position_offset",
    title="map shifted along the road",
    where="road",
    doc="The vehicle is, on the road of the file, this much further along than its pose says.",
    parameters=(
        Parameter("offset", (-10.0, 10.0), Prior(0.0, 0.3), "m", "along the reference line, forward"),
    ),
    order=200,
    severity=("offset",),
    excited_by=("bumps at several speeds",),
    confused_with=("time_offset (at one speed they are the same)",),
    hook=Hook(road=_road, models=("full_car", "msd")),
    finding=lambda p: f"the road map is off by {plain(abs(p['offset']), 'm')} along the road",
)
