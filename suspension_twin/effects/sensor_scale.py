# SPDX-License-Identifier: Apache-2.0
"""The gain of the sensor."""

from __future__ import annotations

from suspension_twin.effects.base import (
    Bools,
    Effect,
    Floats,
    Hook,
    MarkerExcitation,
    Parameter,
    Prior,
    SignalStage,
    Values,
    Variant,
    compiled,
    more,
)


@compiled
def _signal(signals: Floats, t: Floats, fresh: Bools, values: Floats, state: Floats) -> None:
    for i in range(signals.shape[2]):
        if values[0, i] != 0.0:
            for k in range(t.size):
                for axis in range(3):
                    more = values[0, i] * signals[k, axis, i]
                    signals[k, axis, i] += more
                    if axis == 2:
                        signals[k, 6, i] += more


def _reading(signals: Floats, run: MarkerExcitation, p: Values) -> None:
    signals *= 1.0 + p["scale"]


#: Another length than that the scale of a camera was set by.
_CAMERA = (Parameter("scale", (-0.5, 1.0), Prior(0.0, 0.08), "", "gain less one"),)


EFFECT = Effect(
    id="sensor_scale",
    title="gain of the accelerometer",
    where="sensor",
    doc="The accelerometer reads (1 + scale) times the specific force on all axes, gravity included.",
    parameters=(Parameter("scale", (-0.6, 1.0), Prior(0.0, 0.05, usual=0.01), "", "gain less one"),),
    order=260,
    severity=("scale",),
    excited_by=("gravity: standing still", "every acceleration"),
    confused_with=("road_scale", "accelerometer bias"),
    hook=Hook(
        signal=SignalStage(_signal, order=30),
        models=("full_car", "msd", "quarter_car"),
        gained=lambda p: 1.0 + p.get("scale", 0.0),
    ),
    variants={"tracked": Variant(_CAMERA, Hook(reading=_reading))},
    finding=lambda p: f"the sensor reads {more(p['scale'], '', 'too much', 'too little')}",
)
