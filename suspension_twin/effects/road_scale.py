# SPDX-License-Identifier: Apache-2.0
"""Heights of the road file wrong by a factor."""

from __future__ import annotations

from suspension_twin.effects.base import Effect, Hook, Parameter, Prior, RoadChange, Values, more


def _road(change: RoadChange, p: Values) -> None:
    change.scale[:] *= 1 + p["scale"]


EFFECT = Effect(
    id="road_scale",
    title="road heights off by a factor",
    where="road",
    doc="The road is (1 + scale) times as high as its file says.",
    parameters=(Parameter("scale", (-0.8, 2.0), Prior(0.0, 0.15, usual=0.03), "", "factor less one"),),
    order=190,
    severity=("scale",),
    excited_by=("every unevenness",),
    confused_with=("sensor_scale (which gravity gives away)",),
    hook=Hook(road=_road, models=("full_car", "msd")),
    finding=lambda p: f"the road is {more(p['scale'], '', 'higher', 'lower')} than its file says",
)
