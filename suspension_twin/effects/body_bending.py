# SPDX-License-Identifier: Apache-2.0
"""A structural mode of the body where the sensor sits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from suspension_twin.effects.base import (
    LANE,
    WIDTH,
    Effect,
    Fields,
    Floats,
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
from suspension_twin.models.full_car import BAD_ACCELERATION

_FIELDS = Fields()
_STIFFNESS = _FIELDS.add()  # square of the mode's angular frequency, 1/s²
_DAMPING = _FIELDS.add()  # 2 zeta omega, 1/s
_GAIN = _FIELDS.add()  # share of the body's acceleration that drives it
_PLACE, _RATE, _ACCELERATION = (
    _FIELDS.state(),
    _FIELDS.state(),
    _FIELDS.state(),
)  # of the sensor against the body


def _constants(p: Values) -> Mapping[int, Floats]:
    omega = 2 * np.pi * p["frequency"]
    return {_STIFFNESS: omega**2, _DAMPING: 2 * p["damping_ratio"] * omega, _GAIN: p["gain"]}


@inlined
def _bend(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """The mode is driven by the body's heave; its reaction on the body is neglected."""
    rate = w[(e + _RATE) * WIDTH + i]
    place = fma(h, rate, w[(e + _PLACE) * WIDTH + i])
    push = w[(e + _GAIN) * WIDTH + i] * w[rows.HEAVE_ACCELERATION * WIDTH + i]
    push = fma(w[(e + _DAMPING) * WIDTH + i], rate, push)
    acceleration = -fma(w[(e + _STIFFNESS) * WIDTH + i], place, push)
    w[(e + _PLACE) * WIDTH + i], w[(e + _RATE) * WIDTH + i] = place, fma(h, acceleration, rate)
    w[(e + _ACCELERATION) * WIDTH + i] = acceleration


@inlined
def _read(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """The sensor reads the mode's acceleration too, in specific force z and vertical acceleration."""
    more = w[(e + _ACCELERATION) * WIDTH + i]
    w[rows.FAILED * WIDTH + i] = w[rows.FAILED * WIDTH + i] if abs(more) < BAD_ACCELERATION else 1.0
    w[(rows.SIGNAL + 2) * WIDTH + i] += more
    w[(rows.SIGNAL + 6) * WIDTH + i] += more


EFFECT = Effect(
    id="body_bending",
    title="body bending",
    where="body",
    doc="The first bending mode of the body, driven by the forces of the struts: the sensor rides on it and "
    "feels its acceleration on top of the rigid body's.",
    parameters=(
        Parameter(
            "gain", (-3.0, 3.0), Prior(0.0, 0.5), "", "share of the body's acceleration that drives the mode"
        ),
        Parameter("frequency", (5.0, 45.0), Prior(22.0, 1.4, "factor"), "Hz", "of the mode", neutral=22.0),
        Parameter("damping_ratio", (0.005, 0.3), Prior(0.03, 2.0, "factor"), "", "of the mode", neutral=0.03),
    ),
    order=140,
    severity=("gain",),
    excited_by=("wheel hop", "sharp edges", "rough road at speed"),
    confused_with=("mount_resonance", "powertrain_mount"),
    hook=Hook(
        kernel=KernelTerms(
            _FIELDS, _constants, {"after": (_bend, LANE), "stamp": (_read, LANE)}, modes=(_STIFFNESS,)
        )
    ),
    finding=lambda p: f"the body bends under the sensor, at {plain(p['frequency'], 'Hz')}",
)
