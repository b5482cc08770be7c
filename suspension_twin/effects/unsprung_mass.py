# SPDX-License-Identifier: Apache-2.0
"""Wheels with a mass on elastic tyres, for the game-engine model that has neither."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import UNSPRUNG

__all__ = ["EFFECT"]

_PARAMETERS = (Parameter("mass", "kg", 0.0, 300.0, 0.0, 40.0, 20.0, "of one wheel with hub and brake"),)


def _terms(rows: Floats, p: Values) -> None:
    rows[UNSPRUNG] += p["mass"]


EFFECT = Effect(
    id="unsprung_mass",
    title="unsprung masses",
    where="tyre",
    doc="Each spring and damper of the model stands on a wheel of this mass, and the wheel on the vehicle's tyre "
    "stiffness, instead of on the road itself.",
    parameters=_PARAMETERS,
    severity=("mass",),
    excited_by=("sharp edges", "wheel hop, 8 to 16 Hz"),
    confused_with=("damper points at high velocity", "road_smoothing", "tyre_envelope"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("msd",)),
)
