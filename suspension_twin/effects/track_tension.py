# SPDX-License-Identifier: Apache-2.0
"""The track of a tracked vehicle is tighter or slacker than its file says."""

from __future__ import annotations

import numpy as np

from suspension_twin.effects.base import Effect, Floats, Hook, Parameter, Prior, Values, more
from suspension_twin.vehicle.tracked import BOUNDS

_KEY = "vehicle.idler.setting"


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    # beyond the range in which an idler can be set a track is simply slack, or as tight as it goes
    numbers[_KEY] = np.clip(numbers[_KEY] - p["tighter"], *BOUNDS["idler.setting"])


EFFECT = Effect(
    id="track_tension",
    title="track tension off",
    where="track",
    doc="The idler is set further out (tighter) or in than the file says.",
    parameters=(
        Parameter("tighter", (-40.0, 40.0), Prior(0.0, 10.0), "mm", "displacement of the idler outwards"),
    ),
    order=131,
    severity=("tighter",),
    excited_by=("an approach to an obstacle", "ends of obstacles"),
    confused_with=("track_wear",),
    hook=Hook(vehicle=_vehicle, models=("tracked",)),
    finding=lambda p: (
        f"the track is {more(1e-3 * p['tighter'], 'm', 'tighter', 'slacker')} than its file says"
    ),
)
