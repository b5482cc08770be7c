# SPDX-License-Identifier: Apache-2.0
"""Constants of a block with effects: every corner's own curves, and the terms of the effects."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.models import rows
from suspension_twin.models.characteristics import (
    Check,
    Curve,
    Curves,
    Problems,
    checker,
    hinges_of,
    write_curves,
)
from suspension_twin.vehicle.corners import AXLES

__all__ = ["with_terms"]

#: Largest product of step and frequency with everything that a term can add to a wheel's stiffness.
_MAX_PHASE = 1.5


def with_terms(base: Floats, terms: Floats, curves: Curves, problems: Problems, max_step: float) -> Floats:
    """Rows (effect_rows, L) of lanes with ``terms`` (CURVES, L) on top of ``base`` (block_rows, L)."""
    hinges, check = hinges_of(curves), checker(problems)
    out = np.zeros((rows.effect_rows(hinges), base.shape[1]))
    out[: base.shape[0]] = base
    out[rows.TERMS] = terms[rows.TERMS]
    out[rows.FADE : rows.FADE + 4] = 1.0
    for c in range(4):
        axle = AXLES[c // 2]
        spring = curves[axle, "spring"].scaled(1 + terms[rows.SPRING_SCALE + c])
        factor = 1 + terms[rows.DAMPER_SCALE + c]
        push = curves[axle, "damper_push"].scaled(factor)
        pull = curves[axle, "damper_pull"].scaled(factor)
        beta = base[rows.IMPLICIT + c // 2]
        out[rows.CORNER_IMPLICIT + c] = beta
        first = rows.corner_curves(hinges) + c * rows.axle_rows(hinges)
        with np.errstate(all="ignore"):
            write_curves(out, first, hinges, spring, push, pull, beta)
        master = rows.master_rows(hinges) + c * 6 * (hinges + 1)
        for side, curve in enumerate((push, pull)):
            _write_master(out, master + side * 3 * (hinges + 1), hinges + 1, curve)

    with np.errstate(all="ignore"):
        _check(out, terms, curves, check, max_step)
    return out


def _check(out: Floats, terms: Floats, curves: Curves, check: Check, max_step: float) -> None:
    """What no step of ``max_step`` s can follow."""
    check(~np.isfinite(terms).all(axis=0), "effects", "a parameter is not finite")
    give = out[rows.INV_MASS] + out[rows.ENGINE_X] ** 2 * out[rows.INV_MASS + 2]
    check(
        ~(out[rows.ENGINE_MASS] * give < 0.8),
        "effects.powertrain_mount",
        "the engine is too heavy for the sprung mass",
    )
    springs = [curves[axle, "spring"].slope.max(axis=0) for axle in AXLES]
    stiff = out[rows.TYRE] + np.maximum(*springs)
    for row in (rows.FRICTION_RATE, rows.BUMP_RATE, rows.REBOUND_RATE):
        stiff = stiff + out[row : row + 4].max(axis=0)
    stiff = stiff + 2 * out[rows.BAR : rows.BAR + 2].max(axis=0)
    phase = np.sqrt(stiff * out[rows.INV_WHEEL : rows.INV_WHEEL + 2].max(axis=0)) * max_step
    check(~(phase < _MAX_PHASE), "effects", f"too stiff for a step of {max_step:g} s: take a smaller step")
    check(
        ~(np.sqrt(np.maximum(out[rows.BEND_STIFFNESS], out[rows.ENGINE_STIFFNESS])) * max_step < 1.0),
        "effects",
        f"a mode is too fast for a step of {max_step:g} s: take a smaller step",
    )


def _write_master(out: Floats, first: int, points: int, curve: Curve) -> None:
    """Speeds, forces and slopes of one damper curve, its last point repeated up to ``points``."""
    known = curve.x.shape[0]
    for k, values in enumerate((curve.x, curve.f, curve.slope)):
        at = first + k * points
        out[at : at + known] = values
        out[at + known : at + points] = values[-1]
