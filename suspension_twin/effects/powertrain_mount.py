# SPDX-License-Identifier: Apache-2.0
"""The engine as a mass on soft mounts."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import ENGINE_DAMPING, ENGINE_MASS, ENGINE_STIFFNESS, ENGINE_X

__all__ = ["EFFECT"]

#: Damping ratio of hydraulic engine mounts.
DAMPING_RATIO = 0.08

_PARAMETERS = (
    Parameter("mass", "kg", 0.0, 600.0, 0.0, 180.0, 80.0, "of the powertrain"),
    Parameter("frequency", "Hz", 3.0, 30.0, 10.0, 10.0, 1.4, "on its mounts, the body held still", log=True),
    Parameter("x", "m", -4.0, 4.0, 1.2, 1.2, 0.4, "of its centre, ahead of the sprung centre of gravity"),
)


def _terms(rows: Floats, p: Values) -> None:
    omega = 2 * np.pi * p["frequency"]
    rows[ENGINE_MASS] += p["mass"]
    rows[ENGINE_STIFFNESS] += omega**2
    rows[ENGINE_DAMPING] += 2 * DAMPING_RATIO * omega
    rows[ENGINE_X] += p["x"]


EFFECT = Effect(
    id="powertrain_mount",
    title="engine on soft mounts",
    where="body",
    doc="A part of the sprung mass, the powertrain, moves in the vertical on mounts of its own and works as an "
    "absorber on the body. The whole mass stays as the file has it.",
    parameters=_PARAMETERS,
    severity=("mass",),
    excited_by=("pitch and heave between 5 and 15 Hz",),
    confused_with=("body_bending", "mount_resonance", "unsprung_mass of the file"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
