# SPDX-License-Identifier: Apache-2.0
"""A spring whose rate grows with travel."""

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
    Variant,
    by_corner,
    fma,
    inlined,
    of_one_corner,
)

#: Linkage, bushings and the first of a stop make any car's wheel rate grow on one way by up to 12 kN/m in 3 cm; on both
#: ways, which takes two stops, by less than half of that.
_rise, _square = (
    ((-2.0e6, 2.0e6), Prior(0.0, 1.5e5, usual=4.0e5), "N/m²"),
    ((0.0, 1.0e9), Prior(0.0, 1.5e7, usual=6.0e6), "N/m³"),
)
_PARAMETERS = (
    Parameter("front_rise", *_rise, "growth of the rate with jounce, front"),
    Parameter("rear_rise", *_rise, "the same at the rear"),
    Parameter("front_square", *_square, "growth with the square of travel, front"),
    Parameter("rear_square", *_square, "the same at the rear"),
)


_FIELDS = Fields()
_RISE = _FIELDS.add(CORNER)  # growth of the rate with jounce from static, N/m²
_SQUARE = _FIELDS.add(CORNER)  # and with its square, N/m³


@inlined
def _spring(w: Floats, e: int, c: int, i: int, x: float) -> tuple[float, float]:
    """A rate of a x + b x² more at travel x from static, so a x²/2 + b x³/3 more force."""
    rise, square = w[(e + _RISE + c) * WIDTH + i], w[(e + _SQUARE + c) * WIDTH + i]
    return x * x * fma(square / 3.0, x, 0.5 * rise), x * (rise + square * x)


EFFECT = Effect(
    id="progressive_spring",
    title="progressive spring",
    where="strut",
    doc="The rate of an axle's springs is (rise x + square x²) more than its characteristic says, x the jounce from "
    "standing: coils of a varying pitch, a rubber or air spring, both stops in one.",
    parameters=_PARAMETERS,
    order=50,
    severity=("front_rise", "rear_rise", "front_square", "rear_square"),
    excited_by=("large travel both ways", "braking and cornering on top of a rough road"),
    confused_with=("bump_stop", "rebound_stop", "the points of the spring"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS,
            lambda p: {
                _RISE: by_corner(p["front_rise"], p["rear_rise"]),
                _SQUARE: by_corner(p["front_square"], p["rear_square"]),
            },
            elastic=(_spring, CORNER),
        )
    ),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS))},
    finding=lambda _: "the springs get stiffer with travel than their file says",
)
