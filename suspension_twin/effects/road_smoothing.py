# SPDX-License-Identifier: Apache-2.0
"""Short waves filtered out of the road file."""

from __future__ import annotations

from suspension_twin.effects.base import Effect, Hook, Parameter, Prior, RoadChange, Values, plain


def _road(change: RoadChange, p: Values) -> None:
    change.sharpening[:] += p["sigma"]


EFFECT = Effect(
    id="road_smoothing",
    title="road file too smooth",
    where="road",
    doc="The file was smoothed along the road with a Gaussian of this standard deviation; the effect undoes it "
    "as far as that can be done, short waves by a factor of ten at most.",
    parameters=(Parameter("sigma", (0.005, 2.0), Prior(0.1, 2.0, "factor"), "m", "of the Gaussian"),),
    order=170,
    severity=("sigma",),
    excited_by=("short bumps", "rough road"),
    confused_with=("road_scale", "tyre_envelope (the other way round)", "sensor_bandwidth"),
    hook=Hook(road=_road, models=("full_car", "msd")),
    finding=lambda p: (
        f"the road file is too smooth: it was averaged over about {plain(2.0 * p['sigma'], 'm')}"
    ),
)
