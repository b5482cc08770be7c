# SPDX-License-Identifier: Apache-2.0
"""Constants of the model msd, per lane: weights on its corners, springs, dampers, wheels."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.models import rows
from suspension_twin.models.characteristics import (
    Curves,
    Problems,
    checker,
    compression_at,
    hinges_of,
    shorten_spring,
    write_curves,
)
from suspension_twin.models.hooks import CornerChange
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.corners import AXLES

__all__ = ["msd_rows"]

_SPRING_PHASE = 1.0


def msd_rows(
    numbers: dict[str, Floats],
    stance: dict[str, Floats],
    corners: CornerChange,
    curves: Curves,
    problems: Problems,
    max_step: float,
) -> Floats:
    """Rows of a block (rows, L) of ``msd``.

    ``numbers`` of the twin as changed by effects, ``stance`` of the twin from whose standing heights
    are counted; of ``corners`` the mass of each wheel, 0 for none, and the sag of each axle's springs.
    """
    unsprung = corners.wheel_mass
    hinges, check = hinges_of(curves), checker(problems)
    out = np.zeros((rows.block_rows(hinges), unsprung.size))

    def shares(of: dict[str, Floats]) -> tuple[Floats, Floats]:
        """Weight on the four corners, and the vehicle's, N."""
        ahead, left = of["vehicle.cog.0"] / of["vehicle.wheelbase"], of["vehicle.cog.1"]
        weight = of["vehicle.mass"] * G
        tracks = of["vehicle.front_track"], of["vehicle.rear_track"]
        return weight, np.stack(
            [
                weight * (ahead if a == 0 else 1 - ahead) * (0.5 + sign * left / tracks[a])
                for a in range(2)
                for sign in (1, -1)
            ]
        )

    base, height = numbers["vehicle.wheelbase"], numbers["vehicle.cog.2"]
    with np.errstate(all="ignore"):
        weight, _ = shares(numbers)
        _, standing = shares(stance)
        corner = numbers["vehicle.mass"] / 4 - unsprung
        check(~(corner > 0), "effects.unsprung_mass", "leaves no mass above the wheels")
        out[rows.TYRE] = numbers["vehicle.tyre.vertical_stiffness"]
        out[rows.COG], out[rows.COG + 1] = numbers["vehicle.cog.0"], numbers["vehicle.cog.1"]
        out[rows.HEIGHT] = height
        for i in range(3):
            out[rows.SENSOR + i] = numbers[f"imu.position.{i}"]
        out[rows.WEIGHT] = weight
        out[rows.SHARE] = numbers["vehicle.cog.0"] / base
        out[rows.SHARE + 1] = 1 - out[rows.SHARE]
        out[rows.PITCH_SHIFT] = height / (G * base)
        for a, axle in enumerate(AXLES):
            track = numbers[f"vehicle.{axle}_track"]
            out[rows.ROLL_SHIFT + a] = height / (G * track)
            out[rows.SIDE + a] = numbers["vehicle.cog.1"] / track
            out[rows.ARM_X + a] = base / 2 if a == 0 else -base / 2
            out[rows.ARM_Y + 2 * a], out[rows.ARM_Y + 2 * a + 1] = track / 2, -track / 2
        out[rows.INV_CORNER] = 1 / corner
        out[rows.INV_UNSPRUNG] = np.where(unsprung > 0, 1 / np.where(unsprung > 0, unsprung, 1.0), 0.0)
        out[rows.SPRUNG] = base / 2
        out[rows.SPRUNG + 1] = 0.0
        out[rows.SPRUNG + 2] = height
        out[rows.LOAD : rows.LOAD + 4] = standing
        for a, axle in enumerate(AXLES):
            spring = curves[axle, "spring"]
            for c in (2 * a, 2 * a + 1):
                load = standing[c] - unsprung * G
                check(~(load > 0), "vehicle.cog", f"puts no load on the {axle} springs")
                out[rows.STATIC + c] = compression_at(spring, load)
                unreachable = ~np.isfinite(out[rows.STATIC + c])
                check(unreachable, f"vehicle.{axle}.spring.force", "the spring never carries its static load")
            beta = max_step / 2 * (out[rows.INV_CORNER] + out[rows.INV_UNSPRUNG])
            out[rows.IMPLICIT + a] = beta
            push, pull = curves[axle, "damper_push"], curves[axle, "damper_pull"]
            first = rows.CURVES + a * rows.axle_rows(hinges)
            write_curves(out, first, hinges, spring, push, pull, beta)
            shorten_spring(out, first, hinges, corners.sag[2 * a])
            stiff = spring.slope.max(axis=0) * (out[rows.INV_CORNER] + out[rows.INV_UNSPRUNG])
            stiff = np.maximum(stiff, (out[rows.TYRE] + spring.slope.max(axis=0)) * out[rows.INV_UNSPRUNG])
            check(
                ~(np.sqrt(stiff) * max_step < _SPRING_PHASE),
                f"vehicle.{axle}.spring.force",
                f"too stiff on its mass for a step of {max_step:g} s: take a smaller step",
            )
    return out
