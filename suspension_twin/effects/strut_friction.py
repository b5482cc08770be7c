# SPDX-License-Identifier: Apache-2.0
"""Dry friction in the struts: seals, guides and bushings hold until they slip."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral, per_corner
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import FRICTION_LIMIT, FRICTION_RATE

__all__ = ["EFFECT"]

#: Stiffness before it slips, N/m: the bushings that give way while the strut still sticks.
STICKING = 3.0e5

_force = ("N", 0.0, 1500.0, 0.0, 0.0, 200.0)

_PARAMETERS = (
    Parameter("front_force", *_force, "friction of each front strut", usual=10.0),
    Parameter("rear_force", *_force, "friction of each rear strut", usual=10.0),
)


def _terms(rows: Floats, p: Values) -> None:
    per_corner(rows, FRICTION_LIMIT, p["front_force"], p["rear_force"])
    rows[FRICTION_RATE : FRICTION_RATE + 4] += STICKING


EFFECT = Effect(
    id="strut_friction",
    title="dry friction in the struts",
    where="strut",
    doc="A force of fixed size against the motion of each strut, at the wheel; below it the strut sticks and "
    "only its bushings (300 N/mm) give way. Its loop of force over travel has an area at any speed.",
    parameters=_PARAMETERS,
    severity=("front_force", "rear_force"),
    excited_by=("small and slow suspension travel", "smooth road", "reversals of damper velocity"),
    confused_with=("damper_pull and damper_push at low velocity", "top_mount", "tyre_damping"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
