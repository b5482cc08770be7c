# SPDX-License-Identifier: Apache-2.0
"""The range of the sensor."""

from __future__ import annotations

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
        limit = values[0, i]
        if limit != 0.0:
            for k in range(t.size):
                for axis in range(3):
                    signals[k, axis, i] = min(max(signals[k, axis, i], -limit), limit)


EFFECT = Effect(
    id="sensor_clipping",
    title="sensor clips",
    where="sensor",
    doc="Specific force beyond the range reads as the range, on each of the sensor's own axes. 0 is no limit.",
    parameters=(Parameter("range", (9.9, 400.0), Prior(15.0, 1.5, "factor"), "m/s²", "largest reading"),),
    order=280,
    severity=("range",),
    excited_by=("peaks: bumps and potholes at speed",),
    confused_with=("bump_stop", "sensor_bandwidth"),
    hook=Hook(
        signal=SignalStage(_signal, order=50, own_axes=True), models=("full_car", "msd", "quarter_car")
    ),
    finding=lambda p: f"the sensor clips at {plain(p['range'], 'm/s²')}",
)
