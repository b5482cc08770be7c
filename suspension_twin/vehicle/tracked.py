# SPDX-License-Identifier: Apache-2.0
"""The file of a tracked vehicle in its plane of symmetry, after the tracked paper.

The paper's axes (mm, x backwards, y up, from marker C) are kept for the values that it prints in them: the
markers and the setting x_kn of the idler. Everything else is in m, x forwards and z up from the
axis of the sprocket, at which marker C is taken to be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.files import read_yaml, reader
from suspension_twin.schema import Strict, checked, within
from suspension_twin.vehicle.corners import Joint
from suspension_twin.vehicle.twin import Imu, Twin, with_value

__all__ = [
    "BOUNDS",
    "Driver",
    "Obstacle",
    "Station",
    "Track",
    "TrackedTwin",
    "TrackedVehicle",
    "load_tracked",
    "parse_tracked",
]

#: Bounds (10) to (14) of the five parameters, in the order of (9): k_gl, k_g_phi, b_gl, b_g_phi, x_kn.
BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "track.stiffness": (1.0e5, 1.0e9),
    "track.bending_stiffness": (10.0, 1.0e5),
    "track.damping": (1.0, 1.0e6),
    "track.bending_damping": (1.0, 1.0e5),
    "idler.setting": (-5590.0, -5550.0),
}


def _bounded(key: str, unit: str) -> AfterValidator:
    return within(*BOUNDS[key], unit)


Length = Annotated[float, within(0.01, 12.0, "m", "is it in mm?")]
Position = Annotated[float, within(-12.0, 12.0, "m", "is it in mm?")]
PaperPlace = Annotated[float, within(-12_000.0, 12_000.0, "mm")]
Angle = Annotated[float, within(-1.2, 1.2, "rad", "is it in degrees?")]


class Markers(Strict):
    """Markers on the hull in the paper's axes, mm, front to rear."""

    A: tuple[PaperPlace, PaperPlace]
    B: tuple[PaperPlace, PaperPlace]
    C: tuple[PaperPlace, PaperPlace]

    @model_validator(mode="after")
    def _in_order(self) -> Markers:
        if not self.A[0] < self.B[0] < self.C[0]:
            raise ValueError(
                "must stand front to rear, A before B before C (rising x), "
                f"are {self.A[0]:g}, {self.B[0]:g}, {self.C[0]:g}"
            )
        return self


class Sprocket(Strict):
    position: tuple[Position, Position] = (0.0, 0.0)
    radius: Length


class Idler(Strict):
    """``setting`` is x_kn, eq. (14); ``taut_at`` is the setting at which the tension begins."""

    height: Position
    radius: Length
    setting: Annotated[float, _bounded("idler.setting", "mm")]
    taut_at: Annotated[float, within(-5700.0, -5450.0, "mm")]


class Track(Strict):
    """Stiffness and damping are those of the joint between two links, eqs (10) to (13)."""

    links: Annotated[int, Field(ge=20, le=400)]
    pitch: Annotated[float, within(0.05, 0.4, "m")]
    thickness: Annotated[float, within(0.0, 0.2, "m")]
    link_mass: Annotated[float, within(1.0, 200.0, "kg")]
    stiffness: Annotated[float, _bounded("track.stiffness", "N/m")]
    damping: Annotated[float, _bounded("track.damping", "N s/m")]
    bending_stiffness: Annotated[float, _bounded("track.bending_stiffness", "N m/rad")]
    bending_damping: Annotated[float, _bounded("track.bending_damping", "N m s/rad")]


class Wheel(Strict):
    """``mass`` has the outer half of the arm; ``rubber`` is N/m, its damping N s/m, per m of contact."""

    radius: Annotated[float, within(0.1, 1.0, "m")]
    mass: Annotated[float, within(10.0, 2000.0, "kg")]
    rubber: Annotated[float, within(1.0e6, 3.0e8, "N/m²")]
    rubber_damping: Annotated[float, within(0.0, 1.0e5, "N s/m²")]


class Arm(Strict):
    """Angles below the horizontal of the hull, the wheel behind its pivot.

    The pivots are placed so that the wheels are where ``stations`` says at ``standing_angle``.
    """

    length: Annotated[float, within(0.1, 1.0, "m")]
    standing_angle: Angle
    free_angle: Angle
    stiffness: Annotated[float, within(1.0e3, 2.0e6, "N m/rad")]
    jounce_stop: Angle
    rebound_stop: Angle
    stop_stiffness: Annotated[float, within(1.0e4, 5.0e6, "N m/rad")]

    @model_validator(mode="after")
    def _check(self) -> Arm:
        if not self.jounce_stop < self.free_angle <= self.rebound_stop:
            raise ValueError("free_angle: must lie between jounce_stop and rebound_stop")
        return self


class Station(Strict):
    """A road wheel: ``x`` of its axis on the standing vehicle; ``sag`` of its torsion bar in rad."""

    x: Position
    damping: Annotated[float, within(0.0, 1.0e6, "N m s/rad")] = 0.0
    sag: Annotated[float, within(-0.2, 0.3, "rad")] = 0.0


class Soil(Strict):
    stiffness: Annotated[float, within(1.0e6, 3.0e8, "N/m²")]
    damping: Annotated[float, within(0.0, 1.0e5, "N s/m²")]


class Obstacle(Strict):
    """A trapezoid across the way: ``ramp`` up, ``top``, ``ramp`` down, m."""

    height: Annotated[float, within(0.0, 2.0, "m", "is it in mm?")]
    ramp: Annotated[float, within(0.05, 50.0, "m")]
    top: Annotated[float, within(0.0, 50.0, "m")]

    @property
    def length(self) -> float:
        return 2 * self.ramp + self.top


class Driver(Strict):
    """The driver who holds the speed by that of the sprocket: ``gain`` on the error of the speed, ``reset`` 1/s on the
    distance that the vehicle is behind; ``droop`` m/s per N by which engine and gearbox give way to the pull of one
    track. All 0: a sprocket that turns evenly. Nobody publishes them; the defaults hold 13 km/h within 0.1 m over a
    0.4 m obstacle."""

    gain: Annotated[float, within(0.0, 20.0, "")] = 1.5
    reset: Annotated[float, within(0.0, 60.0, "1/s")] = 4.0
    droop: Annotated[float, within(0.0, 1.0e-4, "m/s per N")] = 2.0e-6


class TrackedVehicle(Strict):
    name: str = "tracked vehicle"
    mass: Annotated[float, within(1000.0, 100_000.0, "kg", "is it in t?")]
    cog: tuple[Position, Position]
    gyration: Annotated[float, within(0.3, 6.0, "m")]
    tread: Annotated[float, within(0.5, 6.0, "m", "is it in mm?")] = 2.79
    markers: Markers
    sprocket: Sprocket
    idler: Idler
    track: Track
    wheel: Wheel
    arm: Arm
    stations: Annotated[tuple[Station, ...], Field(min_length=2, max_length=12)]
    wheel_height: Position
    ground: Soil
    obstacle: Obstacle
    driver: Driver | None = None

    @model_validator(mode="after")
    def _check(self) -> TrackedVehicle:
        xs = [s.x for s in self.stations]
        if any(b >= a for a, b in zip(xs, xs[1:], strict=False)):
            raise ValueError(f"stations: x must fall from front to rear, is {xs}")
        if not self.sprocket.position[0] < xs[-1] < xs[0] < -self.idler.setting / 1000:
            raise ValueError("stations: must lie between sprocket and idler")
        if not xs[-1] < self.cog[0] < xs[0]:
            raise ValueError(f"cog: x must lie between the outer wheels, is {self.cog[0]:g}")
        if self.hull_mass <= 0.3 * self.mass / 2:
            raise ValueError(f"mass: {self.mass:g} kg leaves no hull above its wheels and tracks")
        if self.obstacle.height > self.approach_height:
            raise ValueError(
                f"obstacle.height: {self.obstacle.height:g} m cannot be passed, the idler's axis stands "
                f"{self.approach_height:.2f} m above the ground; make it lower"
            )
        if self.obstacle.height / self.obstacle.ramp > 1.0:
            raise ValueError(
                f"obstacle.ramp: {self.obstacle.ramp:g} m for {self.obstacle.height:g} m of height is steeper "
                "than 45 degrees, which the vehicle cannot climb; make it longer"
            )
        return self

    @property
    def hull_mass(self) -> float:
        """Half of the sprung mass without wheels and track, kg."""
        return self.mass / 2 - len(self.stations) * self.wheel.mass - self.track.links * self.track.link_mass

    @property
    def wheel_positions(self) -> Floats:
        """(4, 2) x and y in ``base_link`` of the outer road wheels, in the order of a car's."""
        ahead, side = self.stations[0].x - self.stations[-1].x, self.tread / 2
        return np.array([[ahead, side], [ahead, -side], [0.0, side], [0.0, -side]])

    @property
    def ground_height(self) -> float:
        """Ground under the standing vehicle from the sprocket's axis, m (below 0)."""
        return self.wheel_height - self.wheel.radius - self.track.thickness

    @property
    def approach_height(self) -> float:
        """Height of the idler's axis above the ground, m."""
        return self.idler.height - self.ground_height

    def with_changes(self, changes: Mapping[str, object]) -> TrackedVehicle:
        """A checked copy with dotted keys replaced: ``{"track.stiffness": 1e7, "stations.0.damping": 0}``."""
        data: object = self.model_dump(mode="json")
        for key, value in changes.items():
            data = with_value(data, key, value, "tracked vehicle")
        return parse_tracked(data)

    def with_dampers(self, damping: float) -> TrackedVehicle:
        """The vehicle with this damper at every station that has one, N m s/rad (Table 1)."""
        return self.with_changes(
            {f"stations.{i}.damping": damping for i, s in enumerate(self.stations) if s.damping > 0}
        )


class TrackedTwin(Twin):
    """The twin of a vehicle on tracks in its plane of symmetry.

    ``base_link`` is on the ground under the rearmost road wheels, as it is under a car's rear axle; the
    positions in ``vehicle`` count from the sprocket's axis, as in the tracked paper's drawing. ``imu`` may be left out
    where only markers are measured: it then sits at the centre of gravity's place.
    """

    model: Literal["tracked"] = "tracked"
    vehicle: TrackedVehicle
    imu: Imu = Imu(position=(2.1, 0.0, 1.1))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """One joint for each road wheel, front to rear, left side first."""
        count = len(self.vehicle.stations)
        return tuple(f"{side}_road_wheel_{i + 1}" for side in ("left", "right") for i in range(count))

    @property
    def joints(self) -> tuple[Joint, ...]:
        v = self.vehicle
        arm, height, first = v.arm, v.wheel_height - v.ground_height, v.stations[-1].x
        pivot = arm.length * math.cos(arm.standing_angle), arm.length * math.sin(arm.standing_angle)
        free = -arm.length * math.cos(arm.free_angle), 0.0, -arm.length * math.sin(arm.free_angle)
        places = [
            (s.x - first + pivot[0], y, height + pivot[1])
            for y in (v.tread / 2, -v.tread / 2)
            for s in v.stations
        ]
        standing = arm.free_angle - arm.standing_angle
        return tuple(
            Joint(name, "revolute", place, (0.0, 1.0, 0.0), free, standing, v.wheel.radius, 0.3)
            for name, place in zip(self.joint_names, places, strict=True)
        )

    @property
    def cog_height(self) -> float:
        return self.vehicle.cog[1] - self.vehicle.ground_height


def parse_tracked(data: object, source: str | Path = "tracked vehicle") -> TrackedVehicle:
    """Check the contents of a file, a vehicle alone or a twin file around it; InputError names source and key."""
    if not isinstance(data, dict):
        raise InputError(source, "not the file of a tracked vehicle: a mapping is expected")
    if data.get("model") == "tracked" and isinstance(data.get("vehicle"), dict):
        data = data["vehicle"]
    return checked(TrackedVehicle, data, source, "a tracked vehicle's file")


@reader("a file of a tracked vehicle")
def load_tracked(path: str | Path) -> TrackedVehicle:
    """Read and check a file such as ``config/tracked/pt91.yaml``; InputError names file and key."""
    return parse_tracked(read_yaml(path), path)
