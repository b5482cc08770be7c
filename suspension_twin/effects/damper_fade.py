# SPDX-License-Identifier: Apache-2.0
"""Damping that is lost as the drive goes on and the oil warms."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import FADE_LOSS, FADE_TIME

__all__ = ["EFFECT"]

_PARAMETERS = (
    Parameter("loss", "", 0.0, 0.95, 0.0, 0.0, 0.3, "share of the damping that is lost at last"),
    Parameter("time_constant", "s", 2.0, 5000.0, 60.0, 60.0, 3.0, "of the way there", log=True),
)


def _terms(rows: Floats, p: Values) -> None:
    rows[FADE_LOSS : FADE_LOSS + 4] += p["loss"]
    rows[FADE_TIME] += 1 / p["time_constant"]


EFFECT = Effect(
    id="damper_fade",
    title="damper fade",
    where="strut",
    doc="All damper forces fall from their cold value towards (1 - loss) of it, with a time constant, from the "
    "start of each drive.",
    parameters=_PARAMETERS,
    severity=("loss",),
    excited_by=("long drives", "the same road early and late"),
    confused_with=("the whole damper curve", "clock_drift"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
