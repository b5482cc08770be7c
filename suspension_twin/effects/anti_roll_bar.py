# SPDX-License-Identifier: Apache-2.0
"""An anti-roll bar: left and right of an axle coupled."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import BAR

__all__ = ["EFFECT"]

_stiffness = ("N/m", 0.0, 1.0e5, 0.0, 0.0, 1.5e4)

_PARAMETERS = (
    Parameter("front_stiffness", *_stiffness, "force at each front wheel per difference of compression"),
    Parameter("rear_stiffness", *_stiffness, "the same at the rear"),
)


def _terms(rows: Floats, p: Values) -> None:
    rows[BAR] += p["front_stiffness"]
    rows[BAR + 1] += p["rear_stiffness"]


EFFECT = Effect(
    id="anti_roll_bar",
    title="anti-roll bar",
    where="strut",
    doc="A torsion bar pulls the more compressed side of an axle up and the other down, in proportion to the "
    "difference of the two compressions. Nothing where both sides move together.",
    parameters=_PARAMETERS,
    severity=("front_stiffness", "rear_stiffness"),
    excited_by=("roll", "one-sided bumps", "cornering"),
    confused_with=("sprung_inertia.roll", "corner_spring"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
