# SPDX-License-Identifier: Apache-2.0
"""Dampers that a controller makes harder and softer: sky-hook and ground-hook."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from suspension_twin.effects.base import (
    CORNER,
    WIDTH,
    Effect,
    Fields,
    Floats,
    Given,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    Values,
    Variant,
    axles,
    by_corner,
    fma,
    inlined,
    of_one_corner,
    rows,
    travel_rate,
)

#: The controller integrates accelerometers behind a high-pass with this corner in Hz: a climb is no bounce.
HIGH_PASS = 0.1
#: m/s: squared, the product of the two velocities at which half of the force acts.
SWITCHING = 0.02

_force = ((0.0, 12000.0), Prior(0.0, 1500.0, usual=50.0), "N s/m")
_PARAMETERS = (
    Parameter(
        "law",
        (0.0, 1.0),
        Prior(0.0, 1.0),
        "",
        "0 sky-hook, on the body; 1 ground-hook, on the wheel",
        choices=(0.0, 1.0),
    ),
    Parameter("front", *_force, "of each front damper"),
    Parameter("rear", *_force, "of each rear damper"),
)


_FIELDS = Fields()
_SKY = _FIELDS.add(CORNER)  # force for the body's velocity, N s/m
_GROUND = _FIELDS.add(CORNER)  # force for the wheel's velocity, N s/m
_SLOW_BODY = _FIELDS.state(CORNER)  # what the high-pass takes off them, m/s
_SLOW_WHEEL = _FIELDS.state(CORNER)
_PACE = 2.0 * math.pi * HIGH_PASS


def _constants(p: Values) -> Mapping[int, Floats]:
    both = by_corner(p["front"], p["rear"])
    sky = np.where(p["law"] == 0.0, both, 0.0)
    return {_SKY: sky, _GROUND: np.where(p["law"] == 0.0, 0.0, both)}


@inlined
def _share(power: float) -> float:
    """Share of the wanted force that a damper can give: all where it dissipates, none where it would have to push."""
    p = power if power > 0.0 else 0.0
    return p / (p + SWITCHING * SWITCHING)


@inlined
def _hook(w: Floats, e: int, c: int, i: int, h: float) -> None:
    sky, ground = w[(e + _SKY + c) * WIDTH + i], w[(e + _GROUND + c) * WIDTH + i]
    closing, wheel = travel_rate(w, c, i), w[(rows.WHEEL_RATE + c) * WIDTH + i]
    body = wheel - closing
    slow_body, slow_wheel = w[(e + _SLOW_BODY + c) * WIDTH + i], w[(e + _SLOW_WHEEL + c) * WIDTH + i]
    w[(e + _SLOW_BODY + c) * WIDTH + i] = fma(h * _PACE, body - slow_body, slow_body)
    w[(e + _SLOW_WHEEL + c) * WIDTH + i] = fma(h * _PACE, wheel - slow_wheel, slow_wheel)
    body, wheel = body - slow_body, wheel - slow_wheel
    f = ground * wheel * _share(wheel * closing) - sky * body * _share(-body * closing)
    w[(rows.STRUT + c) * WIDTH + i] += f


def _finding(p: Given) -> str:
    kind = "ground-hook" if p["law"] else "sky-hook"
    return f"the dampers are controlled, as a {kind} of {axles(p, '', 'N s/m')}"


EFFECT = Effect(
    id="semi_active_damper",
    title="semi-active dampers",
    where="strut",
    doc="Beside its passive characteristic a damper brakes the body's own vertical velocity at its corner (sky-hook), "
    "or the wheel's (ground-hook), but only while that takes energy out: a valve is opened and shut, nothing pushes.",
    parameters=_PARAMETERS,
    order=98,
    severity=("front", "rear"),
    excited_by=("body resonance, 1 to 2 Hz", "long waves at speed"),
    confused_with=("the whole damper curve", "worn_dampers", "strut_friction"),
    hook=Hook(kernel=KernelTerms(_FIELDS, _constants, {"strut": (_hook, CORNER)})),
    variants={"quarter_car": Variant(of_one_corner(_PARAMETERS))},
    finding=_finding,
)
