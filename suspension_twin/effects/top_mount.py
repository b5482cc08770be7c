# SPDX-License-Identifier: Apache-2.0
"""An elastic mount in series with the damper."""

from __future__ import annotations

import numpy as np

from suspension_twin.effects.base import (
    CornerChange,
    Effect,
    Hook,
    Parameter,
    Prior,
    Values,
    Variant,
    axles,
    by_corner,
    of_one_corner,
)

_stiffness = ((2.0e4, 5.0e6), Prior(3.0e5, 2.5, "factor"), "N/m")

_PARAMETERS = (
    Parameter("front_stiffness", *_stiffness, "of each front mount, at the wheel"),
    Parameter("rear_stiffness", *_stiffness, "of each rear mount, at the wheel"),
)


def _corners(change: CornerChange, p: Values) -> None:
    soft = [np.where(p[name] > 0, 1 / p[name], 0.0) for name in ("front_stiffness", "rear_stiffness")]
    change.compliance[:] += by_corner(*soft)


EFFECT = Effect(
    id="top_mount",
    title="elastic damper mount",
    where="strut",
    doc="The damper ends in a rubber mount: at high frequency the mount moves instead of the damper. "
    "0 is a rigid mount.",
    parameters=_PARAMETERS,
    order=60,
    severity=("front_stiffness", "rear_stiffness"),
    excited_by=("sharp edges", "wheel hop", "high damper velocity that changes quickly"),
    confused_with=("damper points at high velocity", "strut_friction", "tyre_envelope"),
    hook=Hook(corners=_corners),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS))},
    finding=lambda p: (
        f"the rubber mounts of the dampers give way: a stiffness of {axles(p, '_stiffness', 'N/m')}"
    ),
)
