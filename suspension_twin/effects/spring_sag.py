# SPDX-License-Identifier: Apache-2.0
"""Springs of an axle that have set."""

from __future__ import annotations

from suspension_twin.effects.base import (
    CornerChange,
    Effect,
    Floats,
    Hook,
    Parameter,
    Prior,
    Values,
    Variant,
    axles,
    by_corner,
    of_one_corner,
)

_sag = ((0.0, 0.12), Prior(0.0, 0.02, usual=0.005), "m")
_PARAMETERS = (
    Parameter("front", *_sag, "by which the front springs are shorter when free, at the wheel"),
    Parameter("rear", *_sag, "the same at the rear"),
    # a spring that has set keeps its rate; one without the last of its seven coils is a sixth stiffer and 40 mm shorter
    Parameter(
        "rate", (-6.0, 6.0), Prior(0.0, 2.0), "1/m", "share by which their rate is more, for each m of sag"
    ),
)


def _corners(change: CornerChange, p: Values) -> None:
    sag: Floats = by_corner(p["front"], p["rear"])
    change.sag[:] += sag
    change.spring[:] += p["rate"] * sag


EFFECT = Effect(
    id="spring_sag",
    title="sagged springs",
    where="strut",
    doc="The springs of an axle are shorter when free than their characteristic says, so that the axle stands lower, "
    "and their rate has changed a little with that: set, or an end coil that is broken off.",
    parameters=_PARAMETERS,
    order=115,
    severity=("front", "rear"),
    excited_by=("standing still", "the static pitch before and after", "points of the springs in reach"),
    confused_with=("sensor_tilt", "payload", "the points of the spring"),
    hook=Hook(corners=_corners, models=("full_car", "msd"), upright=True),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS), Hook(corners=_corners, upright=True))},
    finding=lambda p: f"the springs have sagged by {axles(p, '', 'm')}",
)
