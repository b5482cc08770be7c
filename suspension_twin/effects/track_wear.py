# SPDX-License-Identifier: Apache-2.0
"""The links of a tracked vehicle's track have become softer and longer."""

from __future__ import annotations

import numpy as np

from suspension_twin.effects.base import Effect, Floats, Given, Hook, Parameter, Prior, Values, plain
from suspension_twin.vehicle.tracked import BOUNDS


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    for key in ("track.stiffness", "track.bending_stiffness"):
        numbers[f"vehicle.{key}"] = np.clip(numbers[f"vehicle.{key}"] * p["stiffness"], *BOUNDS[key])
    # both the run above and the run below reach as far
    taut = "vehicle.idler.taut_at"
    numbers[taut] = numbers[taut] - 0.5e3 * p["elongation"]


def _finding(p: Given) -> str:
    stiff, longer = plain(p["stiffness"], ""), plain(p["elongation"], "m")
    return f"the track is worn: its links keep {stiff} of their stiffness, and it is {longer} longer"


EFFECT = Effect(
    id="track_wear",
    title="worn track",
    where="track",
    doc="Links softer than the file says, in pull and in bending, and a longer track.",
    parameters=(
        Parameter(
            "stiffness",
            (0.02, 2.0),
            Prior(1.0, 0.7),
            "",
            "remaining share of the links' stiffness",
            neutral=1.0,
        ),
        Parameter(
            "elongation", (0.0, 0.06), Prior(0.0, 0.01), "m", "how much longer the whole track has become"
        ),
    ),
    order=132,
    severity=("stiffness", "elongation"),
    excited_by=("an approach to an obstacle",),
    confused_with=("track_tension",),
    hook=Hook(vehicle=_vehicle, models=("tracked",)),
    finding=_finding,
)
