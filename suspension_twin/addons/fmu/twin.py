# SPDX-License-Identifier: Apache-2.0
"""The twin file of the model ``fmu``: a vehicle whose equations are in an FMU made by another program."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from suspension_twin.arrays import Floats
from suspension_twin.schema import Strict, within
from suspension_twin.vehicle.twin import (
    Coordinate,
    FourWheeledTwin,
    Length,
    Radius,
    Suspension,
    Twin,
    wheels_at,
)

__all__ = ["Fmu", "FmuParameter", "FmuTwin", "FmuVehicle"]

Point = tuple[Coordinate, Coordinate, Coordinate]


class FmuParameter(Strict):
    """One parameter of the FMU: its ``value``, and the bounds ``low`` and ``high`` that a calibration searches between.

    ``variable`` is its name in the FMU where that is not its key. A parameter without bounds is set and not searched.
    """

    value: float
    low: float | None = None
    high: float | None = None
    variable: str | None = None

    @model_validator(mode="after")
    def _check(self) -> FmuParameter:
        if (self.low is None) != (self.high is None):
            raise ValueError("needs both low and high, or none of them")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low must be below high, they are {self.low:g} and {self.high:g}")
        return self


class Fmu(Strict):
    """The file, how its variables are called, and how it is stepped.

    ``step`` s is the longest communication step; ``settle`` s are simulated before every start, for an FMU that does
    not start in static equilibrium. ``inputs`` and ``outputs`` name its variable for each connector that it calls
    otherwise than :mod:`suspension_twin.models.connectors`; an empty name leaves a connector open.
    """

    file: Path
    step: Annotated[float, within(1e-5, 0.05, "s", "is it in ms?")] = 1e-3
    settle: Annotated[float, within(0.0, 60.0, "s", "is it in ms?")] = 0.0
    inputs: dict[str, str] = Field(default_factory=dict)
    outputs: dict[str, str] = Field(default_factory=dict)
    parameters: dict[str, FmuParameter] = Field(default_factory=dict)

    @field_validator("parameters")
    @classmethod
    def _named(cls, value: dict[str, FmuParameter]) -> dict[str, FmuParameter]:
        for name in value:
            if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
                raise ValueError(
                    f"{name}: a key has letters, digits and underscores; give its name as variable"
                )
        return value


class FmuTyre(Strict):
    radius: Radius


class FmuVehicle(Strict):
    """Where the wheels are, and the points that heave and planar accelerations are of.

    ``cog`` m is the centre of gravity of the whole vehicle, ``sprung_cog`` that of the body, whose height ``heave``
    counts (``cog`` by default). ``static_deflection`` m, front and rear, is ``deflection`` at standstill.
    """

    name: str = "vehicle"
    wheelbase: Length
    front_track: Length
    rear_track: Length
    cog: Point
    sprung_cog: Point | None = None
    tyre: FmuTyre
    static_deflection: tuple[float, float] = (0.0, 0.0)

    @property
    def wheel_positions(self) -> Floats:
        """(4, 2) x and y of the wheel centres in ``base_link``, corners in the usual order."""
        return wheels_at(self.wheelbase, self.front_track, self.rear_track)

    @property
    def axles(self) -> dict[str, Suspension]:
        """None: the springs are in the FMU."""
        return {}


class FmuTwin(FourWheeledTwin):
    """The twin of a vehicle that an FMU simulates."""

    model: Literal["fmu"]
    fmu: Fmu
    vehicle: FmuVehicle

    @property
    def standing(self) -> tuple[float, ...]:
        return self.vehicle.static_deflection

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        return {
            f"fmu.parameters.{name}.value": (p.low, p.high)
            for name, p in self.fmu.parameters.items()
            if p.low is not None and p.high is not None
        }

    @property
    def program(self) -> Path:
        return self.fmu.file

    def with_paths(self, change: Callable[[Path], Path]) -> Twin:
        moved = super().with_paths(change)
        return moved.model_copy(update={"fmu": self.fmu.model_copy(update={"file": change(self.fmu.file)})})
