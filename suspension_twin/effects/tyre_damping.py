# SPDX-License-Identifier: Apache-2.0
"""A viscous tyre."""

from __future__ import annotations

from suspension_twin.effects.base import (
    CORNER,
    WIDTH,
    Effect,
    Fields,
    Floats,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    inlined,
    plain,
    rows,
)

_FIELDS = Fields()
_DAMPING = _FIELDS.add()  # of each tyre, N s/m


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
    parameters=(
        Parameter(
            "damping", (0.0, 5000.0), Prior(0.0, 500.0, usual=50.0), "N s/m", "of one tyre, in the vertical"
        ),
    ),
    order=120,
    severity=("damping",),
    excited_by=("wheel hop", "sharp edges"),
    confused_with=("damper points at high velocity", "tyre_envelope", "top_mount"),
    hook=Hook(
        kernel=KernelTerms(_FIELDS, lambda p: {_DAMPING: p["damping"]}, {"tyre": (_damp, CORNER)}),
        models=("full_car", "quarter_car"),
    ),
    finding=lambda p: f"the tyres damp more than their file says: {plain(p['damping'], 'N s/m')} each",
)
