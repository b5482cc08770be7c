# SPDX-License-Identifier: Apache-2.0
"""A tone of the engine in the body."""

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
    plain,
    rows,
)

_FIELDS = Fields()
_SIZE = _FIELDS.add()  # N
_OMEGA = _FIELDS.add()  # at standstill, rad/s
_PER_METRE = _FIELDS.add()  # rad/m
_FLOOR = _FIELDS.add()  # rad/s
_PHASE = _FIELDS.add()  # rad
_ANGLE = _FIELDS.state()  # since the start, rad


def _constants(p: Values) -> Mapping[int, Floats]:
    turn = 2.0 * np.pi
    return {
        _SIZE: p["force"],
        _OMEGA: turn * p["frequency"],
        _PER_METRE: turn * p["per_metre"],
        _FLOOR: turn * p["floor"],
        _PHASE: p["phase"],
    }


@inlined
def _hum(w: Floats, e: int, c: int, i: int, h: float) -> None:
    omega = fma(w[(e + _PER_METRE) * WIDTH + i], w[rows.SPEED * WIDTH + i], w[(e + _OMEGA) * WIDTH + i])
    omega = max(omega, w[(e + _FLOOR) * WIDTH + i])
    angle = fma(h, omega, w[(e + _ANGLE) * WIDTH + i])
    w[(e + _ANGLE) * WIDTH + i] = angle
    f = w[(e + _SIZE) * WIDTH + i] * math.sin(angle + w[(e + _PHASE) * WIDTH + i])
    heave = f * w[rows.INV_MASS * WIDTH + i]
    pitch = -(w[rows.ARM_X * WIDTH + i] * f) * w[rows.INV_PITCH * WIDTH + i]
    w[rows.HEAVE_ACCELERATION * WIDTH + i] += heave
    w[rows.PITCH_ACCELERATION * WIDTH + i] += pitch
    w[rows.HEAVE_RATE * WIDTH + i] += h * heave
    w[rows.PITCH_RATE * WIDTH + i] += h * pitch


EFFECT = Effect(
    id="engine_order",
    title="tone of the engine",
    where="body",
    doc="A harmonic force on the body above the front axle, whose frequency is one part that is fixed and one that is "
    "proportional to the speed, but not below that of the idling engine: max(floor, frequency + per_metre v). A fan, "
    "an order of the engine in one gear, or both. A pause of more than 0.5 s in a recording begins a new phase.",
    parameters=(
        Parameter(
            "force",
            (0.0, 6000.0),
            Prior(0.0, 300.0, usual=5.0),
            "N",
            "amplitude, in the vertical above the front axle",
        ),
        Parameter(
            "frequency",
            (0.0, 50.0),
            Prior(10.0, 8.0),
            "Hz",
            "at standstill, and at any speed of a fixed tone",
        ),
        Parameter(
            "per_metre",
            (0.0, 4.0),
            Prior(0.5, 0.5),
            "1/m",
            "by which the frequency rises with the speed in m/s",
        ),
        Parameter("floor", (0.0, 50.0), Prior(0.0, 8.0), "Hz", "least frequency: the engine idles"),
        Parameter("phase", (-7.0, 7.0), Prior(0.0, math.pi), "rad", "at the drive's start", each_drive=True),
    ),
    order=145,
    severity=("force",),
    tone=Harmonic(
        "force",
        "phase",
        (0.0, 22.0),
        (0.0, 2.4),
        lambda f, n: {"frequency": f, "per_metre": n},
        with_floor=lambda f, n: {"frequency": 0.0, "per_metre": n, "floor": f},
    ),
    excited_by=("the engine itself", "a smooth road", "standing still"),
    confused_with=("wheel_imbalance", "mount_resonance", "powertrain_mount"),
    hook=Hook(kernel=KernelTerms(_FIELDS, _constants, {"body": (_hum, LANE)})),
    finding=lambda p: f"the engine shakes the body with {plain(p['force'], 'N')}",
)
