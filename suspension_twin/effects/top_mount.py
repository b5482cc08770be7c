# SPDX-License-Identifier: Apache-2.0
"""An elastic mount in series with the damper."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral, per_corner
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import MOUNT

__all__ = ["EFFECT"]

_stiffness = ("N/m", 2.0e4, 5.0e6, 0.0, 3.0e5, 2.5)

_PARAMETERS = (
    Parameter("front_stiffness", *_stiffness, "of each front mount, at the wheel", log=True),
    Parameter("rear_stiffness", *_stiffness, "of each rear mount, at the wheel", log=True),
)


def _terms(rows: Floats, p: Values) -> None:
    with np.errstate(divide="ignore"):
        soft = [np.where(p[name] > 0, 1 / p[name], 0.0) for name in ("front_stiffness", "rear_stiffness")]
    per_corner(rows, MOUNT, *soft)


EFFECT = Effect(
    id="top_mount",
    title="elastic damper mount",
    where="strut",
    doc="The damper ends in a rubber mount: at high frequency the mount moves instead of the damper. "
    "0 is a rigid mount.",
    parameters=_PARAMETERS,
    severity=("front_stiffness", "rear_stiffness"),
    excited_by=("sharp edges", "wheel hop", "high damper velocity that changes quickly"),
    confused_with=("damper points at high velocity", "strut_friction", "tyre_envelope"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
