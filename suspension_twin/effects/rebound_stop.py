# SPDX-License-Identifier: Apache-2.0
"""A progressive stop at the end of rebound travel."""

from __future__ import annotations

from suspension_twin.drive.types import Floats
from suspension_twin.effects.base import Effect, Parameter, Values, neutral, per_corner
from suspension_twin.models.hooks import Hook
from suspension_twin.models.rows import REBOUND_GAP, REBOUND_RATE, REBOUND_RISE

__all__ = ["EFFECT"]

#: Compression of the stop in m that doubles its stiffness' share in the force: progressive foam.
DOUBLING = 0.02

_PARAMETERS = (
    Parameter(
        "front_clearance",
        "m",
        0.002,
        0.3,
        0.06,
        0.05,
        2.0,
        "rebound at the wheel until it touches, front",
        log=True,
    ),
    Parameter("rear_clearance", "m", 0.002, 0.3, 0.06, 0.05, 2.0, "the same at the rear", log=True),
    Parameter("stiffness", "N/m", 0.0, 1.0e6, 0.0, 0.0, 8.0e4, "at first touch, at the wheel"),
)


def _terms(rows: Floats, p: Values) -> None:
    per_corner(rows, REBOUND_GAP, p["front_clearance"], p["rear_clearance"])
    rows[REBOUND_RATE : REBOUND_RATE + 4] += p["stiffness"]
    rows[REBOUND_RISE : REBOUND_RISE + 4] += p["stiffness"] / DOUBLING


EFFECT = Effect(
    id="rebound_stop",
    title="rebound stop",
    where="strut",
    doc="Beyond a clearance of rebound from standing the strut extends against a stop: "
    "stiffness times its compression, twice that at 20 mm and growing with the square.",
    parameters=_PARAMETERS,
    severity=("stiffness",),
    excited_by=("large rebound", "bumps and potholes at speed"),
    confused_with=("the last points of the spring", "damper_pull at high velocity"),
    hook=Hook(neutral(_PARAMETERS), terms=_terms, models=("full_car",)),
)
