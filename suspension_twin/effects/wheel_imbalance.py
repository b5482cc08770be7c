# SPDX-License-Identifier: Apache-2.0
"""A wheel that is out of balance."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from suspension_twin.effects.base import (
    LANE,
    WIDTH,
    Effect,
    Fields,
    Floats,
    Harmonic,
    Hook,
    KernelTerms,
    Parameter,
    Prior,
    Values,
    fma,
    inlined,
    of_wheel,
    plain,
    rows,
)

_CORNERS = "0 front left, 1 front right, 2 rear left, 3 rear right"


_FIELDS = Fields()
_CORNER = _FIELDS.add()
_MOMENT = _FIELDS.add()  # kg m
_PER_METRE = _FIELDS.add()  # 1 / rolling radius, 1/m
_PHASE = _FIELDS.add()  # rad
_FORCE = _FIELDS.state()  # on the wheel at the last step, N
_WAY = _FIELDS.state()  # that the wheel has rolled, m


def _constants(p: Values) -> Mapping[int, Floats]:
    # a corner is an index: of what is none, the lane fails
    known = np.isin(p["corner"], range(4))
    return {
        _CORNER: np.where(known, p["corner"], 0.0),
        _MOMENT: np.where(known, p["moment"], np.nan),
        _PER_METRE: 1.0 / p["rolling_radius"],
        _PHASE: p["phase"],
    }


@inlined
def _pace(w: Floats, e: int, i: int) -> float:
    """m/s of the wheel: in a bend the outer one is faster than the car."""
    left = w[(rows.ARM_Y + int(w[(e + _CORNER) * WIDTH + i])) * WIDTH + i]
    return fma(-w[rows.YAW_RATE * WIDTH + i], left, w[rows.SPEED * WIDTH + i])


@inlined
def _swing(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """The force acts on the wheel whether its tyre touches the road or not, and never makes a tyre pull."""
    moment, per_metre = w[(e + _MOMENT) * WIDTH + i], w[(e + _PER_METRE) * WIDTH + i]
    ground = (rows.GROUND + int(w[(e + _CORNER) * WIDTH + i])) * WIDTH + i
    speed = _pace(w, e, i)
    spin, way = speed * per_metre, fma(h, speed, w[(e + _WAY) * WIDTH + i])
    f = moment * spin * spin * math.cos(fma(per_metre, way, w[(e + _PHASE) * WIDTH + i]))
    n = w[ground]
    w[ground] = (n if n > 0.0 or moment == 0.0 else 0.0) + f
    w[(e + _FORCE) * WIDTH + i] = f


@inlined
def _push(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """Moment of the force along the road, a quarter of a turn later and at the hub, beyond the given acceleration.
    The load transfer takes the car's acceleration for a force on the ground, which is lower by the wheel's radius."""
    moment, per_metre = w[(e + _MOMENT) * WIDTH + i], w[(e + _PER_METRE) * WIDTH + i]
    speed = _pace(w, e, i)
    way = fma(h, speed, w[(e + _WAY) * WIDTH + i])
    # moment times spin squared times the radius, 1 / per_metre
    m = moment * speed * speed * per_metre * math.sin(fma(per_metre, way, w[(e + _PHASE) * WIDTH + i]))
    pitch = m * w[rows.INV_PITCH * WIDTH + i]
    w[rows.PITCH_ACCELERATION * WIDTH + i] += pitch
    w[rows.PITCH_RATE * WIDTH + i] += h * pitch


@inlined
def _roll(w: Floats, e: int, c: int, i: int, h: float) -> None:
    w[(e + _WAY) * WIDTH + i] = fma(h, _pace(w, e, i), w[(e + _WAY) * WIDTH + i])


@inlined
def _touch(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """The road does not carry what the unbalance pulls."""
    contact = (rows.CONTACT + int(w[(e + _CORNER) * WIDTH + i])) * WIDTH + i
    n = w[contact]
    w[contact] = n - w[(e + _FORCE) * WIDTH + i] if n > 0.0 else n


EFFECT = Effect(
    id="wheel_imbalance",
    title="wheel out of balance",
    where="tyre",
    doc="An unbalance turns with one wheel: a force of moment times spin squared on the hub, once a turn, where the "
    "spin is the wheel's own speed over the rolling radius. Its part along the road is in the acceleration that is "
    "measured. A pause of more than 0.5 s in a recording begins a new phase.",
    parameters=(
        Parameter("corner", (0.0, 3.0), Prior(0.0, 3.0), "", _CORNERS, choices=(0.0, 1.0, 2.0, 3.0)),
        # a new wheel is balanced to 5 g at the rim of 0.2 m
        Parameter(
            "moment",
            (0.0, 5.0),
            Prior(0.0, 0.2, usual=0.001),
            "kg m",
            "mass of the unbalance times its radius",
        ),
        Parameter(
            "rolling_radius",
            (0.2, 0.6),
            Prior(0.31, 0.03),
            "m",
            "travelled distance for each radian",
            neutral=0.31,
        ),
        Parameter(
            "phase",
            (-7.0, 7.0),
            Prior(0.0, math.pi),
            "rad",
            "of the unbalance from straight up at the drive's start",
            each_drive=True,
        ),
    ),
    order=125,
    severity=("moment",),
    tone=Harmonic(
        "moment",
        "phase",
        (0.0, 0.0),
        (0.4, 0.68),  # rolling radii of 0.23 to 0.4 m
        lambda f, n: {"rolling_radius": 1.0 / (2.0 * math.pi * n)},
        power=2,
        corner="corner",
    ),
    excited_by=("high speed", "a smooth road"),
    confused_with=("engine_order", "wheel_imbalance of another wheel", "a periodic road"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS,
            _constants,
            {
                "tyre": (_swing, LANE),
                "body": (_push, LANE),
                "after": (_roll, LANE),
                "stamp": (_touch, LANE),
            },
        )
    ),
    # weights are sold in grams; they sit at the rim, 0.2 m from the axle
    finding=lambda p: (
        f"{of_wheel(p, 'wheel')} is out of balance, by {plain(p['moment'] / 0.2 * 1e3, 'g')} at the rim"
    ),
)
