# SPDX-License-Identifier: Apache-2.0
"""One wheel's spring differs from its axle's."""

from __future__ import annotations

import numpy as np

from suspension_twin.drive.types import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import SPRING_SCALE

__all__ = ["EFFECT"]

_PARAMETERS = (
    Parameter(
        "corner",
        "",
        0.0,
        3.0,
        0.0,
        0.0,
        3.0,
        "0 front left, 1 front right, 2 rear left, 3 rear right",
        choices=(0.0, 1.0, 2.0, 3.0),
    ),
    Parameter("change", "", -0.98, 2.0, 0.0, 0.0, 0.4, "of its force, as a share"),
)


def _terms(rows: Floats, p: Values) -> None:
    for corner in range(4):
        rows[SPRING_SCALE + corner] += np.where(p["corner"] == corner, p["change"], 0.0)


EFFECT = Effect(
    id="corner_spring",
    title="one odd spring",
    where="strut",
    doc="The spring of one corner has (1 + change) times the force of its axle's characteristic: worn, broken or "
    "the wrong part.",
    parameters=_PARAMETERS,
    severity=("change",),
    excited_by=("one-sided bumps", "heave coupled with roll", "roll rate on a straight even road"),
    confused_with=("the axle's spring", "corner_damper", "payload on one side", "lateral_offset"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
