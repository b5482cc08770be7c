# SPDX-License-Identifier: Apache-2.0
"""What ``full_car`` and ``msd`` have in common: the numbers of a car, what is measured of it, how it is simulated."""

from __future__ import annotations

from suspension_twin.models.registry import Model, deferred
from suspension_twin.vehicle.corners import AXLES
from suspension_twin.vehicle.twin import Twin

__all__ = ["CHANNELS", "CURVES", "car_model"]

#: What an IMU in a car measures, in base_link axes; vertical acceleration without gravity.
CHANNELS = (
    "vertical_acceleration",
    "roll_rate",
    "pitch_rate",
    "longitudinal_acceleration",
    "lateral_acceleration",
    "yaw_rate",
)
_SCALARS = (
    "vehicle.mass",
    "vehicle.wheelbase",
    "vehicle.front_track",
    "vehicle.rear_track",
    "vehicle.cog.0",
    "vehicle.cog.1",
    "vehicle.cog.2",
    "vehicle.sprung_inertia.roll",
    "vehicle.sprung_inertia.pitch",
    "vehicle.tyre.radius",
    "vehicle.tyre.vertical_stiffness",
    "vehicle.front.unsprung_mass",
    "vehicle.rear.unsprung_mass",
    "imu.position.0",
    "imu.position.1",
    "imu.position.2",
    "imu.latency",
)
#: The road heights were looked up for these: a candidate cannot differ in them.
_FIXED = ("vehicle.wheelbase", "vehicle.front_track", "vehicle.rear_track")
#: Axle, part and abscissa of every characteristic.
CURVES = tuple(
    (axle, part, abscissa)
    for axle in AXLES
    for part, abscissa in (
        ("spring", "compression"),
        ("damper_push", "velocity"),
        ("damper_pull", "velocity"),
    )
)


def numbers(twin: Twin) -> tuple[str, ...]:
    """Keys of the numbers of a car: scalars, then the points of its characteristics."""
    names = list(_SCALARS)
    for axle, part, abscissa in CURVES:
        curve = getattr(getattr(twin.vehicle, axle), part)
        for quantity in (abscissa, "force"):
            names += [f"vehicle.{axle}.{part}.{quantity}.{j}" for j in range(len(curve.force))]
    return tuple(names)


def car_model(name: str, title: str) -> Model:
    """The entry of a car's model in the registry."""
    return Model(
        name=name,
        title=title,
        recordings="drive",
        channels=CHANNELS,
        numbers=numbers,
        lanes=deferred("simulate", "car_lanes"),
        fixed=_FIXED,
        respond=deferred("simulate", "car_response"),
        live=deferred("live", "LiveTwin"),
        one_lane=deferred("one_lane", "one_lane"),
    )
