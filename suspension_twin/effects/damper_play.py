# SPDX-License-Identifier: Apache-2.0
"""Play in the joints of the dampers."""

from __future__ import annotations

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral, per_corner
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import PLAY

__all__ = ["EFFECT"]

_PARAMETERS = (
    Parameter("front", "m", 0.0, 0.05, 0.0, 0.0, 0.004, "play at the wheel, front"),
    Parameter("rear", "m", 0.0, 0.05, 0.0, 0.0, 0.004, "the same at the rear"),
)


def _terms(rows: Floats, p: Values) -> None:
    per_corner(rows, PLAY, 0.5 * p["front"], 0.5 * p["rear"])


EFFECT = Effect(
    id="damper_play",
    title="play in the dampers",
    where="strut",
    doc="After each reversal a damper holds only once the play is taken up: worn bushes and joints, a loose piston "
    "rod, oil that has torn and leaves a void.",
    parameters=_PARAMETERS,
    severity=("front", "rear"),
    excited_by=("many reversals of small travel", "rough road at medium speed"),
    confused_with=("top_mount", "damper_fade", "the first points of the dampers"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
