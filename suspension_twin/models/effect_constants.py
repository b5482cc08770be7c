# SPDX-License-Identifier: Apache-2.0
"""Constants of a block with effects: every corner's own curves, and the constants of the effects' terms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from suspension_twin.arrays import Floats
from suspension_twin.models import rows
from suspension_twin.models.characteristics import (
    Curves,
    Problems,
    checker,
    hinges_of,
    shorten_spring,
    write_curves,
)
from suspension_twin.models.full_car_effects import COMPLIANT, SOFT, effect_kernels
from suspension_twin.models.hooks import CornerChange, Values
from suspension_twin.models.types import Ints
from suspension_twin.vehicle.corners import AXLES

__all__ = ["with_effects"]

#: Largest product of step and frequency with everything that a term can add to a wheel's stiffness.
_MAX_PHASE = 1.5


def with_effects(
    base: Floats,
    corners: CornerChange,
    effects: Mapping[str, tuple[Values, NDArray[np.bool_]]],
    curves: Curves,
    problems: Problems,
    max_step: float,
) -> tuple[Floats, Ints]:
    """Rows of a block with effects (rows, L) from those without (block_rows, L), and the flags (L,) of the lanes.

    ``effects`` gives the parameters (L,) of those effects that have terms in the kernel, and which lanes have them.
    """
    kernels, hinges, check = effect_kernels(), hinges_of(curves), checker(problems)
    count = base.shape[1]
    out, flags = np.zeros((kernels.rows(hinges), count)), np.zeros(count, dtype=np.int64)
    stride = rows.axle_rows(hinges)
    first, master = kernels.curves, kernels.curves + 4 * stride
    out[: rows.CURVES] = base[: rows.CURVES]
    out[rows.DAMPER_SHARE : rows.DAMPER_SHARE + 4] = 1.0
    out[rows.COMPLIANCE : rows.COMPLIANCE + 4] = corners.compliance
    out[rows.TYRE_CHANGE : rows.TYRE_CHANGE + 4] = corners.tyre
    flags[corners.compliance.any(axis=0)] |= COMPLIANT
    flags[corners.tyre.any(axis=0)] |= SOFT
    for c in range(4):
        axle = AXLES[c // 2]
        spring = curves[axle, "spring"].scaled(1 + corners.spring[c])
        push, pull = (
            curves[axle, side].scaled(1 + corners.damper[c]) for side in ("damper_push", "damper_pull")
        )
        beta = out[rows.CORNER_IMPLICIT + c] = base[rows.IMPLICIT + c // 2]
        with np.errstate(all="ignore"):
            write_curves(out, first + c * stride, hinges, spring, push, pull, beta)
            shorten_spring(out, first + c * stride, hinges, corners.sag[c])
        for curve in (push, pull):
            for row in (curve.x, curve.f, curve.slope):  # the last point repeated up to the number of hinges
                out[master : master + len(row)] = row
                out[master + len(row) : master + hinges + 1] = row[-1]
                master += hinges + 1

    with np.errstate(all="ignore"):
        springs = [curves[axle, "spring"].slope.max(axis=0) for axle in AXLES]
        tyre = out[rows.TYRE] * (1.0 + np.maximum(corners.tyre.max(axis=0), 0.0))
        stiff, fastest = tyre + np.maximum(*springs), np.zeros(count)
        given = (corners.spring, corners.damper, corners.compliance, corners.tyre, corners.sag)
        finite = np.isfinite(np.concatenate(given)).all(axis=0)
        check(~(corners.tyre > -1.0).all(axis=0), "effects", "leave a tyre no stiffness")
        for name, (values, armed) in effects.items():
            terms, e = kernels.terms[name], kernels.first[name]
            flags[armed] |= kernels.bit[name]
            for field, value in terms.constants(values).items():
                size = terms.fields.sizes[field]
                own = out[e + field : e + field + size]
                own[:] = value
                finite &= np.isfinite(own).all(axis=0)
                if field in terms.stiffness:  # of an axle: between left and right, which feel it twice
                    stiff = stiff + (2 if size == rows.AXLE else 1) * own.max(axis=0)
                if field in terms.modes:
                    fastest = np.maximum(fastest, own[0])
            if terms.check is not None:
                terms.check(out, e, check)
        check(~finite, "effects", "a parameter is not finite")
        phase = np.sqrt(stiff * out[rows.INV_WHEEL : rows.INV_WHEEL + 2].max(axis=0)) * max_step
        smaller = f"for a step of {max_step:g} s: take a smaller step"
        check(~(phase < _MAX_PHASE), "effects", f"too stiff {smaller}")
        check(~(np.sqrt(fastest) * max_step < 1.0), "effects", f"a mode is too fast {smaller}")
    return out, flags
