# SPDX-License-Identifier: Apache-2.0
"""Static roll and pitch of a vehicle that its effects load or whose springs they change."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.models import rows
from suspension_twin.models.characteristics import Curves, compression_at
from suspension_twin.models.hooks import CornerChange
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.corners import AXLES

__all__ = ["static_attitude"]

#: Share of its load by which a spring's rate about it is taken.
_ABOUT = 0.1


def static_attitude(
    loaded: Floats, stance: Floats, change: CornerChange, curves: Curves
) -> tuple[Floats, Floats]:
    """Pitch (nose down positive) and roll (right side down positive) in rad, (L,) each, against the vehicle without
    its effects.

    ``loaded`` and ``stance`` are rows of blocks with and without the load that effects add, ``change`` what they
    change of single springs and tyres. A rigid body on four springs in series with tyres: the unbalanced loads of the
    corners over the rates there. Exactly 0 without any.
    """
    count = loaded.shape[1]
    force, stiffness = np.zeros((3, count)), np.zeros((3, 3, count))
    for i in range(4):
        spring, scale = curves[AXLES[i // 2], "spring"], 1.0 + change.spring[i]
        carried = stance[rows.LOAD + i] - G / stance[rows.INV_WHEEL + i // 2]
        wanted = loaded[rows.LOAD + i] - G / loaded[rows.INV_WHEEL + i // 2]
        more = wanted - scale * carried
        # about the middle of the way from the one load to the other
        middle = carried + 0.5 * more / scale
        low, high = (compression_at(spring, (1.0 + s * _ABOUT) * middle) for s in (-1.0, 1.0))
        rate = scale * 2.0 * _ABOUT * middle / (high - low)
        tyre = loaded[rows.TYRE] * (1.0 + change.tyre[i])
        rate = 1.0 / (1.0 / rate + 1.0 / tyre)
        # a shorter spring and a softer tyre let the corner down by as much as they give more
        more = more + rate * (change.sag[i] - change.tyre[i] * loaded[rows.LOAD + i] / tyre)
        arm = np.stack([np.ones(count), stance[rows.ARM_X + i // 2], -stance[rows.ARM_Y + i]])
        force += more * arm
        stiffness += rate * arm[:, None] * arm[None]
    good = np.isfinite(stiffness).all(axis=(0, 1)) & np.isfinite(force).all(axis=0)
    out = np.zeros((3, count))
    out[:, good] = np.linalg.solve(stiffness[:, :, good].transpose(2, 0, 1), force[:, good].T[:, :, None])[
        :, :, 0
    ].T
    return out[1], out[2]
