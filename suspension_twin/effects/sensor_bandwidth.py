# SPDX-License-Identifier: Apache-2.0
"""A low-pass in the phone."""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.effects._signal import STATES, second_order
from suspension_twin.effects.base import (
    Bools,
    Effect,
    Floats,
    Hook,
    Parameter,
    Prior,
    SignalStage,
    Values,
    compiled,
    plain,
)


@compiled
def _signal(signals: Floats, t: Floats, fresh: Bools, values: Floats, state: Floats) -> None:
    for i in range(signals.shape[2]):
        if values[0, i] != 0.0:
            omega = 2.0 * math.pi * values[0, i]
            second_order(signals, t, fresh, 0, 6, i, omega, math.sqrt(0.5), 0.0, 1.0, state)


def _lag(p: Values) -> Floats:
    """(L,) s of group delay of a second-order Butterworth low-pass at 0 Hz."""
    omega = 2.0 * math.pi * p["cutoff"]
    return np.asarray(math.sqrt(2.0) / np.where(omega > 0.0, omega, np.inf))


EFFECT = Effect(
    id="sensor_bandwidth",
    title="low-pass in the sensor",
    where="sensor",
    doc="The sensor filters all its axes with a second-order Butterworth low-pass. 0 is no low-pass.",
    parameters=(Parameter("cutoff", (0.5, 500.0), Prior(15.0, 2.0, "factor"), "Hz", "its -3 dB frequency"),),
    order=270,
    severity=("cutoff",),
    excited_by=("wheel hop", "sharp edges", "anything quick"),
    confused_with=("time_offset", "tyre_envelope", "road_smoothing"),
    hook=Hook(
        signal=SignalStage(_signal, states=6 * STATES, order=40, lag=_lag),
        models=("full_car", "msd", "quarter_car"),
    ),
    finding=lambda p: f"the sensor loses what is faster than {plain(p['cutoff'], 'Hz')}",
)
