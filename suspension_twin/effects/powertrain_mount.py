# SPDX-License-Identifier: Apache-2.0
"""The engine as a mass on soft mounts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from suspension_twin.effects.base import (
    LANE,
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
    fma,
    inlined,
    plain,
    rows,
)
from suspension_twin.models.hooks import Check

#: Damping ratio of hydraulic engine mounts.
DAMPING_RATIO = 0.08


_FIELDS = Fields()
_MASS = _FIELDS.add()  # kg
_STIFFNESS = _FIELDS.add()  # square of its angular frequency on the mounts, 1/s²
_DAMPING = _FIELDS.add()  # 2 zeta omega, 1/s
_X = _FIELDS.add()  # ahead of the sprung centre of gravity, m
_PLACE, _RATE = _FIELDS.state(), _FIELDS.state()  # against the body, m and m/s


def _constants(p: Values) -> Mapping[int, Floats]:
    omega = 2 * np.pi * p["frequency"]
    return {_MASS: p["mass"], _STIFFNESS: omega**2, _DAMPING: 2 * DAMPING_RATIO * omega, _X: p["x"]}


def _check(block: Floats, e: int, report: Check) -> None:
    give = block[rows.INV_MASS] + block[e + _X] ** 2 * block[rows.INV_PITCH]
    heavy = ~(block[e + _MASS] * give < 0.8)
    report(heavy, "effects.powertrain_mount", "the engine is too heavy for the sprung mass")


@inlined
def _absorb(w: Floats, e: int, c: int, i: int, h: float) -> None:
    """The engine as a mass on soft mounts, out of the sprung mass that it was rigidly part of.

    With M the rigid body's inertia, m the engine's mass at g = (1, 0, -x), e its displacement
    against the body and f = m (omega² e + 2 zeta omega e') its mounts' force on the body,
    ``(M - m g g^T) q'' = Q + g f``; by Sherman and Morrison the rigid answer q0'' only gains
    ``M^-1 g (f + m g.q0'') / (1 - m g^T M^-1 g)``.
    """
    mass, x = w[(e + _MASS) * WIDTH + i], w[(e + _X) * WIDTH + i]
    rate = w[(e + _RATE) * WIDTH + i]
    place = fma(h, rate, w[(e + _PLACE) * WIDTH + i])
    inv_m, inv_p = w[rows.INV_MASS * WIDTH + i], w[rows.INV_PITCH * WIDTH + i]
    give = fma(x * x, inv_p, inv_m)
    mount = fma(w[(e + _STIFFNESS) * WIDTH + i], place, w[(e + _DAMPING) * WIDTH + i] * rate)
    there = fma(-x, w[rows.PITCH_ACCELERATION * WIDTH + i], w[rows.HEAVE_ACCELERATION * WIDTH + i])
    f = mass * (mount + there) / (1.0 - mass * give)
    heave, pitch = f * inv_m, -(x * f) * inv_p
    w[rows.HEAVE_ACCELERATION * WIDTH + i] += heave
    w[rows.PITCH_ACCELERATION * WIDTH + i] += pitch
    w[rows.HEAVE_RATE * WIDTH + i] += h * heave
    w[rows.PITCH_RATE * WIDTH + i] += h * pitch
    w[(e + _PLACE) * WIDTH + i] = place
    w[(e + _RATE) * WIDTH + i] = fma(h, -mount - fma(give, f, there), rate)


def _finding(p: Given) -> str:
    mass, frequency = plain(p["mass"], "kg"), plain(p["frequency"], "Hz")
    return f"the engine moves on its mounts: {mass} at {frequency}"


EFFECT = Effect(
    id="powertrain_mount",
    title="engine on soft mounts",
    where="body",
    doc="A part of the sprung mass, the powertrain, moves in the vertical on mounts of its own and works as an "
    "absorber on the body. The whole mass stays as the file has it.",
    parameters=(
        Parameter("mass", (0.0, 600.0), Prior(180.0, 80.0), "kg", "of the powertrain"),
        Parameter(
            "frequency",
            (3.0, 30.0),
            Prior(10.0, 1.4, "factor"),
            "Hz",
            "on its mounts, the body held still",
            neutral=10.0,
        ),
        Parameter(
            "x",
            (-4.0, 4.0),
            Prior(1.2, 0.4),
            "m",
            "of its centre, ahead of the sprung centre of gravity",
            neutral=1.2,
        ),
    ),
    order=150,
    severity=("mass",),
    excited_by=("pitch and heave between 5 and 15 Hz",),
    confused_with=("body_bending", "mount_resonance", "unsprung_mass of the file"),
    hook=Hook(
        kernel=KernelTerms(_FIELDS, _constants, {"body": (_absorb, LANE)}, modes=(_STIFFNESS,), check=_check)
    ),
    finding=_finding,
)
