# SPDX-License-Identifier: Apache-2.0
"""An anti-roll bar: left and right of an axle coupled."""

from __future__ import annotations

import numpy as np

from suspension_twin.effects.base import (
    AXLE,
    WIDTH,
    Effect,
    Fields,
    Floats,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    axles,
    inlined,
)

_stiffness = ((0.0, 1.0e5), Prior(0.0, 1.5e4), "N/m")


_FIELDS = Fields()
_STIFFNESS = _FIELDS.add(AXLE)  # force per difference of compression, N/m


@inlined
def _bar(w: Floats, e: int, a: int, i: int, x: float) -> tuple[float, float]:
    """Force for a difference of x m between the compressions of left and right."""
    stiffness = w[(e + _STIFFNESS + a) * WIDTH + i]
    return stiffness * x, stiffness


EFFECT = Effect(
    id="anti_roll_bar",
    title="anti-roll bar",
    where="strut",
    doc="A torsion bar pulls the more compressed side of an axle up and the other down, in proportion to the "
    "difference of the two compressions. Nothing where both sides move together.",
    parameters=(
        Parameter("front_stiffness", *_stiffness, "force at each front wheel per difference of compression"),
        Parameter("rear_stiffness", *_stiffness, "the same at the rear"),
    ),
    order=80,
    severity=("front_stiffness", "rear_stiffness"),
    excited_by=("roll", "one-sided bumps", "cornering"),
    confused_with=("sprung_inertia.roll", "corner_spring"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS,
            lambda p: {_STIFFNESS: np.stack([p["front_stiffness"], p["rear_stiffness"]])},
            elastic=(_bar, AXLE),
            stiffness=(_STIFFNESS,),
        )
    ),
    finding=lambda p: f"the car has an anti-roll bar that its file lacks: {axles(p, '_stiffness', 'N/m')}",
)
