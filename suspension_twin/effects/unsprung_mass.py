# SPDX-License-Identifier: Apache-2.0
"""Wheels with a mass on elastic tyres, for the game-engine model that has neither."""

from __future__ import annotations

from suspension_twin.effects.base import CornerChange, Effect, Hook, Parameter, Prior, Values, plain


def _corners(change: CornerChange, p: Values) -> None:
    change.wheel_mass[:] += p["mass"]


EFFECT = Effect(
    id="unsprung_mass",
    title="unsprung masses",
    where="tyre",
    doc="Each spring and damper of the model stands on a wheel of this mass, and the wheel on the vehicle's tyre "
    "stiffness, instead of on the road itself.",
    parameters=(Parameter("mass", (0.0, 300.0), Prior(40.0, 20.0), "kg", "of one wheel with hub and brake"),),
    order=130,
    severity=("mass",),
    excited_by=("sharp edges", "wheel hop, 8 to 16 Hz"),
    confused_with=("damper points at high velocity", "road_smoothing", "tyre_envelope"),
    hook=Hook(corners=_corners, models=("msd",)),
    finding=lambda p: f"the wheels have a mass that the file leaves out: {plain(p['mass'], 'kg')} each",
)
