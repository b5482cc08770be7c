# SPDX-License-Identifier: Apache-2.0
"""A viscous tyre."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import TYRE_DAMPING

__all__ = ["EFFECT"]

_PARAMETERS = (
    Parameter("damping", "N s/m", 0.0, 5000.0, 0.0, 0.0, 500.0, "of one tyre, in the vertical", usual=50.0),
)


def _terms(rows: Floats, p: Values) -> None:
    rows[TYRE_DAMPING : TYRE_DAMPING + 2] += p["damping"]


EFFECT = Effect(
    id="tyre_damping",
    title="viscous tyre",
    where="tyre",
    doc="A damper beside the tyre's spring, between wheel and road; the two together cannot pull.",
    parameters=_PARAMETERS,
    severity=("damping",),
    excited_by=("wheel hop", "sharp edges"),
    confused_with=("damper points at high velocity", "tyre_envelope", "top_mount"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
