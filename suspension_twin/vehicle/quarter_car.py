# SPDX-License-Identifier: Apache-2.0
"""The file of a quarter car: one corner of a vehicle on a test rig."""

from __future__ import annotations

from typing import Literal

from suspension_twin.schema import Strict
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import (
    Damper,
    Imu,
    Mass,
    Radius,
    Spring,
    Suspension,
    Twin,
    TyreStiffness,
    WheelMass,
)

__all__ = ["QuarterCar", "QuarterCarTwin"]


class QuarterTyre(Strict):
    vertical_stiffness: TyreStiffness
    radius: Radius | None = None


class QuarterCar(Strict):
    """One corner: the masses above and below its spring in kg, and its characteristics, forces at the wheel."""

    name: str = "corner"
    sprung_mass: Mass
    unsprung_mass: WheelMass
    tyre: QuarterTyre
    spring: Spring
    damper_push: Damper
    damper_pull: Damper

    @property
    def axles(self) -> dict[str, Suspension]:
        """The corner itself."""
        return {"": Suspension(self, slice(0, 1), STANDARD_GRAVITY * self.sprung_mass)}


class QuarterCarTwin(Twin):
    """The twin of a corner on a rig. ``imu`` is the accelerometer on the sprung mass; its place has no effect."""

    model: Literal["quarter_car"]
    vehicle: QuarterCar
    imu: Imu = Imu()

    @property
    def joint_names(self) -> tuple[str, ...]:
        return ("suspension",)

    @property
    def axles(self) -> dict[str, Suspension]:
        return self.vehicle.axles
