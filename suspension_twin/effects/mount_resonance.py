# SPDX-License-Identifier: Apache-2.0
"""Resonance of the sensor's mount: a phone on a springy arm."""

from __future__ import annotations

import math

from suspension_twin.effects._signal import STATES, second_order
from suspension_twin.effects.base import (
    Bools,
    Effect,
    Floats,
    Hook,
    Parameter,
    Prior,
    SignalStage,
    compiled,
    plain,
)


@compiled
def _signal(signals: Floats, t: Floats, fresh: Bools, values: Floats, state: Floats) -> None:
    for i in range(signals.shape[2]):
        if values[0, i] != 0.0:
            omega, zeta = 2.0 * math.pi * values[1, i], values[2, i]
            second_order(signals, t, fresh, 2, 1, i, omega, zeta, 2.0 * zeta * omega, values[0, i], state)


EFFECT = Effect(
    id="mount_resonance",
    title="resonance of the sensor's holder",
    where="sensor",
    doc="The sensor hangs on a mass-spring-damper that is shaken at its foot; the vertical specific force that "
    "it reads is amplified near the resonance. Gain 1 is a sensor that rides on the holder wholly.",
    parameters=(
        Parameter("gain", (0.0, 1.5), Prior(1.0, 0.2), "", "share of the holder's motion in what is read"),
        Parameter("frequency", (4.0, 60.0), Prior(18.0, 1.6, "factor"), "Hz", "of the holder", neutral=18.0),
        Parameter(
            "damping_ratio", (0.005, 0.7), Prior(0.05, 2.0, "factor"), "", "of the holder", neutral=0.05
        ),
    ),
    order=240,
    severity=("gain",),
    excited_by=("everything near its frequency", "a tap on the holder"),
    confused_with=("body_bending", "sensor_bandwidth", "powertrain_mount"),
    hook=Hook(
        signal=SignalStage(_signal, states=STATES, order=10), models=("full_car", "msd", "quarter_car")
    ),
    finding=lambda p: f"the sensor's holder rings at {plain(p['frequency'], 'Hz')}",
)
