# SPDX-License-Identifier: Apache-2.0
"""A structural mode of the body where the sensor sits."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import BEND_DAMPING, BEND_GAIN, BEND_STIFFNESS

__all__ = ["EFFECT"]

_PARAMETERS = (
    Parameter("gain", "", -3.0, 3.0, 0.0, 0.0, 0.5, "share of the body's acceleration that drives the mode"),
    Parameter("frequency", "Hz", 5.0, 45.0, 22.0, 22.0, 1.4, "of the mode", log=True),
    Parameter("damping_ratio", "", 0.005, 0.3, 0.03, 0.03, 2.0, "of the mode", log=True),
)


def _terms(rows: Floats, p: Values) -> None:
    omega = 2 * np.pi * p["frequency"]
    rows[BEND_STIFFNESS] += omega**2
    rows[BEND_DAMPING] += 2 * p["damping_ratio"] * omega
    rows[BEND_GAIN] += p["gain"]


EFFECT = Effect(
    id="body_bending",
    title="body bending",
    where="body",
    doc="The first bending mode of the body, driven by the forces of the struts: the sensor rides on it and "
    "feels its acceleration on top of the rigid body's.",
    parameters=_PARAMETERS,
    severity=("gain",),
    excited_by=("wheel hop", "sharp edges", "rough road at speed"),
    confused_with=("mount_resonance", "powertrain_mount"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
