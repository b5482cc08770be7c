# SPDX-License-Identifier: Apache-2.0
"""The file of a quarter car: one corner of a vehicle on a test rig."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import model_validator

from suspension_twin.schema import Strict, within
from suspension_twin.units import STANDARD_GRAVITY
from suspension_twin.vehicle.twin import (
    Damper,
    Imu,
    Radius,
    Spring,
    Suspension,
    Twin,
    TyreDamping,
)

__all__ = ["QuarterCar", "QuarterCarTwin"]


#: Hz of the body on its spring: half that of a soft limousine, and twice that of a rig for teaching.
_SLOWEST, _FASTEST = 0.3, 20.0
# from a rig for teaching, with plates of a kilogram on springs of 1 N/mm, to a lorry's corner
BenchMass = Annotated[float, within(0.05, 20_000.0, "kg", "is it in t?")]
BenchStiffness = Annotated[float, within(50.0, 1.0e7, "N/m", "is it in N/mm?")]


class QuarterTyre(Strict):
    vertical_stiffness: BenchStiffness
    radius: Radius | None = None
    damping: TyreDamping | None = None


class QuarterCar(Strict):
    """One corner: the masses above and below its spring in kg, and its characteristics, forces at the wheel."""

    name: str = "corner"
    sprung_mass: BenchMass
    unsprung_mass: BenchMass
    tyre: QuarterTyre
    spring: Spring
    damper_push: Damper
    damper_pull: Damper

    @model_validator(mode="after")
    def _check(self) -> QuarterCar:
        compression, force = self.spring.points
        bounce = math.sqrt(force[-1] / compression[-1] / self.sprung_mass) / (2.0 * math.pi)
        if not _SLOWEST <= bounce <= _FASTEST:
            raise ValueError(
                f"sprung_mass: {self.sprung_mass:g} kg would bounce on this spring at {bounce:.2g} Hz, which must lie "
                f"between {_SLOWEST:g} and {_FASTEST:g} Hz (is it in t?)"
            )
        return self

    @property
    def axles(self) -> dict[str, Suspension]:
        """The corner itself."""
        return {"": Suspension(self, slice(0, 1), STANDARD_GRAVITY * self.sprung_mass)}


class QuarterCarTwin(Twin):
    """The twin of a corner on a rig. ``imu`` is the accelerometer on the sprung mass; its place has no effect, and its
    ``latency`` s is that of all responses behind the road and the actuator's force. ``excitation``: a run drives the
    tyre by its ``road``, or the suspension by the measured motion of its ``wheel``, and nothing below is simulated."""

    model: Literal["quarter_car"]
    excitation: Literal["road", "wheel"] = "road"
    vehicle: QuarterCar
    imu: Imu = Imu()

    @property
    def joint_names(self) -> tuple[str, ...]:
        return ("suspension",)

    @property
    def acted_on(self) -> tuple[str, ...]:
        return (self.model, "msd") if self.on_wheel else (self.model,)

    @property
    def axles(self) -> dict[str, Suspension]:
        return self.vehicle.axles
