# SPDX-License-Identifier: Apache-2.0
"""The sensor is not upright."""

from __future__ import annotations

import math

import numpy as np

from suspension_twin.effects.base import (
    Bools,
    Effect,
    Floats,
    Given,
    Hook,
    MarkerExcitation,
    Parameter,
    Prior,
    SignalStage,
    Values,
    Variant,
    compiled,
    listed,
    plain,
)

_angle = ((-3.2, 3.2), Prior(0.0, 0.1), "rad")


@compiled
def _turn(roll: float, pitch: float, yaw: float) -> Floats:
    """Rows of the matrix from base_link axes to the sensor's."""
    cr, sr, cp, sp, cy, sy = (
        math.cos(roll),
        math.sin(roll),
        math.cos(pitch),
        math.sin(pitch),
        math.cos(yaw),
        math.sin(yaw),
    )
    return np.array(
        [
            [cy * cp, sy * cp, -sp],
            [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr],
            [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr],
        ]
    )


@compiled
def _signal(signals: Floats, t: Floats, fresh: Bools, values: Floats, state: Floats) -> None:
    for i in range(signals.shape[2]):
        if values[0, i] != 0.0 or values[1, i] != 0.0 or values[2, i] != 0.0:
            turn = _turn(values[0, i], values[1, i], values[2, i])
            for k in range(t.size):
                for first in (0, 3):
                    a, b, c = signals[k, first, i], signals[k, first + 1, i], signals[k, first + 2, i]
                    for axis in range(3):
                        signals[k, first + axis, i] = (
                            turn[axis, 0] * a + turn[axis, 1] * b + turn[axis, 2] * c
                        )
                    if first == 0:
                        signals[k, 6, i] += signals[k, 2, i] - c


#: A camera's horizon is levelled by eye.
_CAMERA = (Parameter("pitch", (-0.1, 0.1), Prior(0.0, 0.02), "rad", "about y, nose down"),)


def _reading(signals: Floats, run: MarkerExcitation, p: Values) -> None:
    """Part of the travel is taken for height, of the speed for vertical velocity: markers (n, 9, L)."""
    leak = np.sin(p["pitch"])
    signals[:, 0:3] += (leak * (run.speed * run.t)[:, None])[:, None]
    signals[:, 3:6] += leak * run.speed


def _finding(p: Given) -> str:
    known = {axis: p[axis] for axis in ("roll", "pitch", "yaw") if axis in p}
    largest = max(abs(v) for v in known.values())
    parts = [f"{plain(v, 'rad')} in {axis}" for axis, v in known.items() if abs(v) >= 0.2 * largest]
    return f"the sensor is turned against its file: {listed(parts)}"


EFFECT = Effect(
    id="sensor_tilt",
    title="sensor tilted",
    where="sensor",
    doc="The sensor is turned against the mounting in the file (z-y-x Euler angles): gravity and the planar "
    "accelerations leak into the other axes.",
    parameters=(
        Parameter("roll", *_angle, "about x, left side up"),
        Parameter("pitch", *_angle, "about y, nose down"),
        Parameter("yaw", *_angle, "about z, counter-clockwise"),
    ),
    order=250,
    severity=("roll", "pitch", "yaw"),
    excited_by=("braking", "cornering", "standing still"),
    confused_with=("accelerometer bias", "sensor_scale"),
    hook=Hook(
        signal=SignalStage(_signal, order=20),
        models=("full_car", "msd"),
        upright=True,
        turned=lambda p: (p.get("roll", 0.0), p.get("pitch", 0.0), p.get("yaw", 0.0)),
    ),
    variants={"tracked": Variant(_CAMERA, Hook(reading=_reading))},
    finding=_finding,
)
