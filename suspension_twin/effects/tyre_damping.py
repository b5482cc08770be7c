# SPDX-License-Identifier: Apache-2.0
"""A viscous tyre."""

from __future__ import annotations

from collections.abc import Mapping

from suspension_twin.arrays import Floats
from suspension_twin.compiled import inlined
from suspension_twin.effects.base import Effect, Parameter, Values
from suspension_twin.models import rows
from suspension_twin.models.hooks import Hook, KernelTerms
from suspension_twin.models.rows import CORNER, WIDTH, Fields

__all__ = ["EFFECT"]

_PARAMETERS = (
    Parameter("damping", "N s/m", 0.0, 5000.0, 0.0, 0.0, 500.0, "of one tyre, in the vertical", usual=50.0),
)


_FIELDS = Fields()
_DAMPING = _FIELDS.add()  # of each tyre, N s/m


def _constants(p: Values) -> Mapping[int, Floats]:
    return {_DAMPING: p["damping"]}


@inlined
def _damp(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """Force by the rate at which road and wheel approach each other in the middle of the step."""
    closing = w[(rows.ROAD_RATE + c) * WIDTH + i] - w[(rows.WHEEL_RATE + c) * WIDTH + i]
    w[(rows.GROUND + c) * WIDTH + i] += w[(e + _DAMPING) * WIDTH + i] * closing


EFFECT = Effect(
    id="tyre_damping",
    title="viscous tyre",
    where="tyre",
    doc="A damper beside the tyre's spring, between wheel and road; the two together cannot pull.",
    parameters=_PARAMETERS,
    order=120,
    severity=("damping",),
    excited_by=("wheel hop", "sharp edges"),
    confused_with=("damper points at high velocity", "tyre_envelope", "top_mount"),
    hook=Hook(kernel=KernelTerms(_FIELDS, _constants, {"tyre": (_damp, CORNER)})),
)
