# SPDX-License-Identifier: Apache-2.0
"""The sensor is not where the file says."""

from __future__ import annotations

from suspension_twin.effects.base import Effect, Floats, Given, Hook, Parameter, Prior, Values, listed, more


def _vehicle(numbers: dict[str, Floats], p: Values) -> None:
    for i, name in enumerate(("x", "y", "z")):
        key = f"imu.position.{i}"
        numbers[key] = numbers[key] + p[name]


def _finding(p: Given) -> str:
    ways = (("x", "ahead", "behind"), ("y", "left", "right"), ("z", "above", "below"))
    largest = max(abs(p[axis]) for axis, *_ in ways)
    off = [more(p[axis], "m", *way) for axis, *way in ways if abs(p[axis]) >= max(0.01, 0.2 * largest)]
    return f"the sensor is not where its file says: {listed(off) if off else 'a few mm off'}"


EFFECT = Effect(
    id="sensor_offset",
    title="sensor elsewhere",
    where="sensor",
    doc="The sensor's place in base_link is off by this much: pitch and roll reach it through another arm.",
    parameters=(
        Parameter("x", (-4.0, 4.0), Prior(0.0, 0.5, usual=0.03), "m", "forward"),
        Parameter("y", (-1.5, 1.5), Prior(0.0, 0.3, usual=0.03), "m", "to the left"),
        Parameter("z", (-2.0, 2.0), Prior(0.0, 0.3, usual=0.03), "m", "up"),
    ),
    order=160,
    severity=("x", "y", "z"),
    excited_by=("pitch", "roll"),
    confused_with=("cog", "sprung_inertia.pitch"),
    hook=Hook(vehicle=_vehicle, models=("full_car", "msd")),
    finding=_finding,
)
