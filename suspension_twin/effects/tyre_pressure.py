# SPDX-License-Identifier: Apache-2.0
"""A tyre, or the tyres of an axle, with the wrong pressure."""

from __future__ import annotations

import numpy as np

from suspension_twin.effects.base import (
    CornerChange,
    Effect,
    Floats,
    Given,
    Hook,
    Parameter,
    Prior,
    Values,
    Variant,
    more,
    of_wheel,
)
from suspension_twin.vehicle.corners import WHEELS

#: A tyre's vertical stiffness goes with this power of its pressure: near the nominal one a relative change of the
#: pressure changes it by that share, the factor p_Fz1 of a passenger car's tyre (Besselink, Schmeitz and Pacejka,
#: Vehicle System Dynamics 48, 2010), because the carcass carries a part; and a flat tyre carries nothing.
EXPONENT = 0.7
#: Wheels of each place, in the usual order.
_PLACES = ((0,), (1,), (2,), (3,), (0, 1), (2, 3), (0, 1, 2, 3))
_NAMES = "0 front left, 1 front right, 2 rear left, 3 rear right, 4 front axle, 5 rear axle, 6 all"

_PARAMETERS = (
    Parameter(
        "corner",
        (0.0, 6.0),
        Prior(0.0, 6.0),
        "",
        _NAMES,
        choices=tuple(float(i) for i in range(len(_PLACES))),
    ),
    # 0.2 bar of 2.3
    Parameter("change", (-0.95, 1.0), Prior(0.0, 0.3, usual=0.09), "", "of the pressure, as a share"),
)


def _stiffening(change: Floats) -> Floats:
    """Share by which a tyre is stiffer for a change of its pressure."""
    return np.asarray(np.maximum(1.0 + change, 0.0) ** EXPONENT - 1.0)


def _corners(change: CornerChange, p: Values) -> None:
    for place, wheels in enumerate(_PLACES):
        more = np.where(p["corner"] == place, _stiffening(p["change"]), 0.0)
        for wheel in wheels:
            change.tyre[wheel] += more


def _every_corner(change: CornerChange, p: Values) -> None:
    change.tyre[:] += _stiffening(p["change"])


def _finding(p: Given) -> str:
    if "corner" not in p:
        place = "the tyre"
    elif p["corner"] < len(WHEELS):
        place = of_wheel(p, "tyre")
    else:
        place = ("both front tyres", "both rear tyres", "all tyres")[round(p["corner"]) - len(WHEELS)]
    return f"the pressure of {place} is {more(p['change'], '', 'too high', 'too low')}"


EFFECT = Effect(
    id="tyre_pressure",
    title="tyre pressure off",
    where="tyre",
    doc="The pressure of one tyre, of an axle's or of all is (1 + change) times what it should be. The tyre's vertical "
    "stiffness goes with the power 0.7 of it, and the wheel stands lower or higher by what the tyre then gives.",
    parameters=_PARAMETERS,
    order=118,
    severity=("change",),
    excited_by=("wheel hop, 8 to 16 Hz", "sharp edges", "standing still"),
    confused_with=(
        "the tyre's vertical_stiffness",
        "unsprung_mass of the file",
        "corner_spring",
        "tyre_envelope",
    ),
    hook=Hook(corners=_corners, upright=True),
    variants={"quarter_car": Variant(_PARAMETERS[1:], Hook(corners=_every_corner, upright=True))},
    finding=_finding,
)
