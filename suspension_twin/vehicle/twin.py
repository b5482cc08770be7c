# SPDX-License-Identifier: Apache-2.0
"""The twin file: one vehicle, its sensors, its road and the effects added to its model.

``load_twin`` and ``save_twin`` are the only ways in and out. Whatever is wrong with a file is
one :class:`~suspension_twin.errors.InputError` that names the file and the key.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal, Protocol

import numpy as np
import yaml
from pydantic import Field, field_validator, model_validator

from suspension_twin.arrays import Floats
from suspension_twin.display import axes_or_new, bulleted
from suspension_twin.errors import InputError, nearest, shown
from suspension_twin.files import parse_yaml, read_yaml, reader, reading, write_text
from suspension_twin.registry import Registry, missing_addons
from suspension_twin.schema import Strict, checked, problems, within
from suspension_twin.units import STANDARD_GRAVITY as G
from suspension_twin.vehicle.corners import CORNERS, Joint

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "SCHEMAS",
    "Axle",
    "CarTwin",
    "Coordinate",
    "Damper",
    "Datum",
    "EffectSpec",
    "FourWheeledTwin",
    "Imu",
    "Length",
    "Mass",
    "Place",
    "Radius",
    "RoadFile",
    "Spring",
    "Suspension",
    "Twin",
    "Tyre",
    "TyreStiffness",
    "Vehicle",
    "WheelMass",
    "load_twin",
    "parse_twin",
    "save_twin",
    "twin_of_text",
    "value_at",
    "wheels_at",
    "with_value",
]


_KIND = "a twin file"

Length = Annotated[float, within(0.3, 12.0, "m", "is it in mm?")]
Coordinate = Annotated[float, within(-20.0, 20.0, "m", "is it in mm?")]
Angle = Annotated[float, within(-2 * math.pi, 2 * math.pi, "rad", "is it in degrees?")]
Mass = Annotated[float, within(50.0, 100_000.0, "kg", "is it in t?")]
WheelMass = Annotated[float, within(2.0, 2_000.0, "kg")]
Inertia = Annotated[float, within(10.0, 1.0e6, "kg m²")]
Radius = Annotated[float, within(0.1, 1.5, "m", "is it in mm?")]
Latency = Annotated[float, within(-2.0, 2.0, "s", "is it in ms?")]
TyreStiffness = Annotated[float, within(1.0e4, 1.0e7, "N/m", "is it in N/mm?")]
TyreDamping = Annotated[float, within(0.0, 5000.0, "N s/m")]
ContactLength = Annotated[float, within(0.0, 2.0, "m", "is it in mm?")]
PartStiffness = Annotated[float, within(0.0, 5.0e6, "N/m", "is it in N/mm?")]
Friction = Annotated[float, within(0.0, 1500.0, "N")]
LinkShare = Annotated[float, within(-3.0, 3.0, "", "is it in per cent?")]
Recession = Annotated[float, within(-1.0, 1.0, "", "is it in mm/m?")]
RollCenter = Annotated[float, within(-1.0, 1.0, "m", "is it in mm?")]


class _Characteristic(Strict):
    """Piecewise linear through (0, 0) and its points, going on with its last slope.

    A subclass has two fields, the abscissae and the forces.
    """

    largest: ClassVar[float]

    @model_validator(mode="after")
    def _check(self) -> _Characteristic:
        name, x, force = next(iter(type(self).model_fields)), *self._points
        if not 1 <= len(x) <= 32:
            raise ValueError(f"{name}: needs 1 to 32 points, has {len(x)}")
        if len(force) != len(x):
            raise ValueError(f"force: has {len(force)} points for {len(x)} of {name}")
        for key, values in ((name, x), ("force", force)):
            if not all(math.isfinite(v) for v in values):
                raise ValueError(f"{key}: must be finite numbers, are {list(values)}")
        if x[0] <= 0 or any(b <= a for a, b in zip(x, x[1:], strict=False)):
            raise ValueError(f"{name}: must rise from above 0, is {list(x)}")
        if force[0] < 0 or any(b < a for a, b in zip(force, force[1:], strict=False)):
            raise ValueError(f"force: must not be negative or fall, is {list(force)}")
        if x[-1] > self.largest:
            raise ValueError(f"{name}: {x[-1]:g} is beyond {self.largest:g}: wrong unit?")
        if force[-1] > 2.0e6:
            raise ValueError(f"force: {force[-1]:g} N is beyond 2e6 N: wrong unit?")
        return self

    @property
    def _points(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        x, force = (getattr(self, name) for name in type(self).model_fields)
        return x, force

    @property
    def points(self) -> tuple[Floats, Floats]:
        """Abscissae in m or m/s and forces in N, both (k,)."""
        x, force = self._points
        return np.array(x), np.array(force)


class Spring(_Characteristic):
    """Force at the wheel in N over the compression in m, counted from the free length."""

    largest = 3.0

    compression: tuple[float, ...]
    force: tuple[float, ...]

    @model_validator(mode="after")
    def _carries(self) -> Spring:
        if self.force[-1] <= 0:
            raise ValueError("force: a spring without force cannot carry the vehicle")
        return self


class Damper(_Characteristic):
    """Force at the wheel in N over the speed in m/s, one direction, both counted positive."""

    largest = 20.0

    velocity: tuple[float, ...]
    force: tuple[float, ...]


class Linkage(Strict):
    """Geometry of the links of an axle, as far as it acts on the ride.

    ``braking`` and ``driving``: share of the axle's load transfer that the links carry past the spring while the car
    slows down and speeds up. At the front they are the anti-dive and the anti-lift, at the rear the anti-lift and the
    anti-squat, as fractions of 1 (Gillespie, "Fundamentals of Vehicle Dynamics", 1992, chapter 7). ``recession`` m
    that a wheel moves back for each m that it rises. ``roll_center`` m, the height of the roll centre.
    """

    braking: LinkShare = 0.0
    driving: LinkShare = 0.0
    recession: Recession = 0.0
    roll_center: RollCenter = 0.0


class Axle(Strict):
    """One axle: everything for one wheel, forces at the wheel.

    What follows the characteristics is optional; a part that is not there does nothing. ``anti_roll_bar`` N/m at each
    wheel per difference of the compressions; ``friction`` N of each strut; ``top_mount`` N/m of the elastic mount in
    series with each damper.
    """

    unsprung_mass: WheelMass
    spring: Spring
    damper_push: Damper
    damper_pull: Damper
    anti_roll_bar: PartStiffness | None = None
    friction: Friction | None = None
    top_mount: PartStiffness | None = None
    linkage: Linkage | None = None


class SpringAndDampers(Protocol):
    """Characteristics of one wheel's suspension: an axle's, or a corner's."""

    spring: Spring
    damper_push: Damper
    damper_pull: Damper


@dataclass(frozen=True)
class Suspension:
    """Springs and dampers of one characteristic: those of an axle, or of a single corner.

    ``columns`` are its wheels among the deflections of a response; ``load`` N is carried by each of its springs at
    standstill.
    """

    part: SpringAndDampers
    columns: slice
    load: float

    @property
    def static_compression(self) -> float:
        """m of each spring at standstill, left and right alike."""
        x, f = (np.concatenate([[0.0], points]) for points in self.part.spring.points)
        if self.load <= f[-1]:
            return float(np.interp(self.load, f, x))
        return float(x[-1] + (self.load - f[-1]) * (x[-1] - x[-2]) / (f[-1] - f[-2]))


class Tyre(Strict):
    """The tyres, all alike. ``damping`` N s/m, ``contact_length`` m of the contact patch and ``rolling_radius`` m, with
    which they roll over an edge, are optional."""

    radius: Radius
    vertical_stiffness: TyreStiffness
    damping: TyreDamping | None = None
    contact_length: ContactLength | None = None
    rolling_radius: ContactLength | None = None


class SprungInertia(Strict):
    """Moments of inertia of the sprung mass about its own centre of gravity, kg m²."""

    roll: Inertia
    pitch: Inertia


class Vehicle(Strict):
    """Masses and geometry, ``mass`` and ``cog`` of the whole vehicle with all on board."""

    name: str = "vehicle"
    mass: Mass
    wheelbase: Length
    front_track: Length
    rear_track: Length
    cog: tuple[Coordinate, Coordinate, Coordinate]
    sprung_inertia: SprungInertia
    tyre: Tyre
    front: Axle
    rear: Axle

    @model_validator(mode="after")
    def _check(self) -> Vehicle:
        if not 0 < self.cog[0] < self.wheelbase:
            raise ValueError(
                f"cog: x must lie between the axles (0 to {self.wheelbase:g} m), is {self.cog[0]:g}"
            )
        if abs(self.cog[1]) >= min(self.front_track, self.rear_track) / 2:
            raise ValueError(f"cog: y must lie between the wheels, is {self.cog[1]:g}")
        if not 0 < self.cog[2] < 5:
            raise ValueError(f"cog: z must lie above the ground, is {self.cog[2]:g}")
        unsprung = 2 * (self.front.unsprung_mass + self.rear.unsprung_mass)
        if unsprung >= 0.6 * self.mass:
            raise ValueError(f"mass: {self.mass:g} kg leaves no sprung mass above {unsprung:g} kg of wheels")
        return self

    @property
    def axles(self) -> dict[str, Suspension]:
        """Front and rear; an axle's load follows from the centre of gravity, less its own wheels."""
        share = self.cog[0] / self.wheelbase
        parts = (("front", self.front, slice(0, 2), share), ("rear", self.rear, slice(2, 4), 1.0 - share))
        return {
            name: Suspension(part, wheels, G * (self.mass * part_of / 2.0 - part.unsprung_mass))
            for name, part, wheels, part_of in parts
        }

    @property
    def wheel_positions(self) -> Floats:
        """(4, 2) x and y of the wheel centres in ``base_link``, corners in the usual order."""
        return wheels_at(self.wheelbase, self.front_track, self.rear_track)


def wheels_at(wheelbase: float, front_track: float, rear_track: float) -> Floats:
    """(4, 2) m x and y of the wheel centres of a car in ``base_link``, corners in the usual order."""
    f, r, b = front_track / 2, rear_track / 2, wheelbase
    return np.array([[b, f], [b, -f], [0.0, r], [0.0, -r]])


class Place(Strict):
    """Where a sensor sits in ``base_link``: ``position`` m, ``rpy`` rad (z-y-x Euler angles)."""

    frame: str = "imu_link"
    position: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    rpy: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)


class Imu(Place):
    """The IMU's place and its ``latency`` s: a sample stamped t was taken at t - latency on the clock of the
    receiver. It sums up the offset between the two clocks and the delay of the sensor's own low-pass."""

    latency: Latency = 0.0


class Datum(Strict):
    """Origin of ``map`` on WGS 84, degrees and m."""

    latitude: Annotated[float, within(-90, 90, "degrees")]
    longitude: Annotated[float, within(-180, 180, "degrees")]
    altitude: Annotated[float, within(-1000, 20_000, "m")] = 0.0


class RoadFile(Strict):
    file: Path


class EffectSpec(Strict):
    """One effect added to the model: its id and the parameters that differ from neutral."""

    id: str
    parameters: dict[str, float] = Field(default_factory=dict)

    @field_validator("parameters")
    @classmethod
    def _all_finite(cls, value: dict[str, float]) -> dict[str, float]:
        if wrong := next((key for key, number in value.items() if not math.isfinite(number)), None):
            raise ValueError(f"{wrong}: must be a finite number")
        return value


class Twin(Strict):
    """One digital twin as its file describes it, whatever its model. Immutable: use :meth:`with_changes`.

    The subclass of a model states the type of ``vehicle``.

    Attributes
    ----------
    model : str
        Name of the model in :data:`suspension_twin.models.registry.MODELS`.
    effects : tuple of EffectSpec
        Effects added to the model.
    vehicle : object
        Masses, geometry, characteristics; SI units.
    imu : Place
        Position (m) and mounting (rad) of the IMU in ``base_link``.
    gps : Place
        Position of the antenna.
    datum : Datum, optional
        Origin of ``map`` on WGS 84.
    road : RoadFile, optional
        The OpenCRG file.
    uncertainty : dict, optional
        Standard deviations of values by their dotted keys: a number, or one for each point of a characteristic
        (``vehicle.front.spring.force``). A value that is replaced loses its own.

    Examples
    --------
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> heavier = twin.with_changes({"vehicle.mass": 1800.0})
    >>> twin.vehicle.mass, heavier.vehicle.mass
    (1725.0, 1800.0)
    """

    model: str
    effects: tuple[EffectSpec, ...] = ()
    vehicle: Any
    imu: Imu
    gps: Place = Place(frame="gps_link")
    datum: Datum | None = None
    road: RoadFile | None = None
    uncertainty: dict[str, float | tuple[float, ...]] | None = None

    @model_validator(mode="after")
    def _uncertain_of_what_is_there(self) -> Twin:
        for key, sigma in (self.uncertainty or {}).items():
            try:
                value = value_at(self, key)
            except InputError as error:
                raise ValueError(f"uncertainty: {key}: no such key in the twin file") from error
            count, known = (len(v) if isinstance(v, Sequence) else 0 for v in (value, sigma))
            if isinstance(value, str) or not (count or isinstance(value, (int, float))):
                raise ValueError(f"uncertainty: {key} is not a number or a list of numbers")
            if count != known:
                raise ValueError(f"uncertainty: {key}: needs {count or 'one'}, has {known or 'one'}")
            if not all(
                math.isfinite(one) and one >= 0.0 for one in (sigma if isinstance(sigma, tuple) else (sigma,))
            ):
                raise ValueError(f"uncertainty: {key}: must not be negative or infinite, is {sigma}")
        return self

    def deviation(self, key: str) -> float:
        """The standard deviation that the file states of the number at a dotted key, 0 where it states none."""
        known = self.uncertainty or {}
        whole, _, index = key.rpartition(".")
        sigma = known.get(key, known.get(whole) if index.isdecimal() else None)
        if isinstance(sigma, tuple):
            return sigma[int(index)]
        return 0.0 if sigma is None else sigma

    @field_validator("effects")
    @classmethod
    def _once(cls, value: tuple[EffectSpec, ...]) -> tuple[EffectSpec, ...]:
        ids = [e.id for e in value]
        if twice := next((name for name in ids if ids.count(name) > 1), None):
            raise ValueError(f"{twice} is listed more than once")
        return value

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in joint_states, in the order of a response's deflections."""
        return ()

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Where the wheels hang, in the order of ``joint_names``; empty for a vehicle without a place on a road."""
        return ()

    @property
    def axles(self) -> dict[str, Suspension]:
        """Springs and dampers with characteristics, by the word that their keys have after ``vehicle``, if any."""
        return {}

    @property
    def acted_on(self) -> tuple[str, ...]:
        """Models that an effect has to act on, to act on this twin."""
        return (self.model,)

    @property
    def on_wheel(self) -> bool:
        """Whether the measured motion of wheels drives what is above them, in the place of a road."""
        return getattr(self, "excitation", None) == "wheel"

    @property
    def cog_height(self) -> float:
        """Height in m of the centre of gravity above the ground."""
        return 0.0

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds that the file itself gives to numbers of it, by their keys: the default range of a calibration."""
        return {}

    @property
    def program(self) -> Path | None:
        """The file with machine code that simulating this twin runs, if it is not of this package."""
        return None

    def __str__(self) -> str:
        def at(place: Place) -> str:
            return f"({', '.join(f'{v:g}' for v in place.position)}) m"

        effects = ", ".join(e.id for e in self.effects) or "none"
        lines = [
            f"IMU at {at(self.imu)}, GPS antenna at {at(self.gps)} in base_link",
            f"effects: {effects}; road: {'none' if self.road is None else self.road.file}",
        ]
        return bulleted(f"Twin {self.vehicle.name} ({self.model})", lines)

    __repr__ = __str__

    def plot(self, ax: Sequence[Axes] | None = None) -> Sequence[Axes]:
        """Draw the characteristics: forces at the wheel in N of the springs over m, of the dampers over m/s.

        Two axes are drawn on, ``ax`` or those of a new figure, and returned. Pulled (extended) dampers count
        negative. Raises InputError for a model without characteristics.
        """
        if not self.axles:
            raise InputError(self.vehicle.name, "model", f"{self.model} has no characteristics to draw")
        if ax is None:
            from matplotlib import pyplot

            ax = pyplot.subplots(1, 2, figsize=(9.0, 3.5), layout="constrained")[1]
        for one, title, unit in zip(
            ax, ("springs", "dampers"), ("compression [m]", "velocity [m/s]"), strict=True
        ):
            axes_or_new(one, unit, "force at the wheel [N]", title)
        for name, suspension in self.axles.items():
            x, force = suspension.part.spring.points
            ax[0].plot([0.0, *x], [0.0, *force], label=name or "corner")
            push, pull = (getattr(suspension.part, f"damper_{way}").points for way in ("push", "pull"))
            lines = [[*-end[::-1], 0.0, *begin] for end, begin in zip(pull, push, strict=True)]
            ax[1].plot(*lines, label=name or "corner")
        ax[0].legend(loc="upper left")
        return ax

    def with_paths(self, change: Callable[[Path], Path]) -> Twin:
        """A copy in which ``change`` is applied to every path of a file."""
        if self.road is None:
            return self.model_copy()
        return self.model_copy(update={"road": RoadFile(file=change(self.road.file))})

    def with_changes(self, changes: Mapping[str, object]) -> Twin:
        """A checked copy with dotted keys replaced: ``{"vehicle.mass": 1700.0}``.

        Points of a characteristic are addressed by index: ``vehicle.front.spring.force.2``.
        Raises InputError that names the key.
        """
        data: object = self.model_dump(mode="python")
        for key, value in changes.items():
            data = with_value(data, key, value)
        if self.uncertainty and "uncertainty" not in changes:
            kept = {
                key: sigma
                for key, sigma in self.uncertainty.items()
                if not any(
                    f"{changed}.".startswith(f"{key}.") or f"{key}.".startswith(f"{changed}.")
                    for changed in changes
                )
            }
            data = with_value(data, "uncertainty", kept or None)
        return parse_twin(data, source="twin")


def value_at(node: object, key: str, source: str = "twin") -> object:
    """The value at a dotted key of a twin, of a part of one, or of nested plain values.

    Points of a characteristic by number: ``vehicle.front.spring.force.2``. Raises InputError that names ``source``,
    the key and the nearest known one.
    """
    for part in key.split("."):
        node = _child(node, part, key, source)
    return node


def with_value(node: object, key: str, value: object, source: str = "twin") -> object:
    """A copy of nested plain values with another value at a dotted key; errors as of :func:`value_at`."""

    def changed(node: object, parts: list[str]) -> object:
        part, *rest = parts
        old = _child(node, part, key, source)
        new = changed(old, rest) if rest else value
        if isinstance(node, Mapping):
            return {**node, part: new}
        assert isinstance(node, Sequence)
        return [new if str(i) == part else item for i, item in enumerate(node)]

    return changed(node, key.split("."))


def _child(node: object, part: str, key: str, source: str) -> object:
    """The value of one part of a key."""
    kind = type(node)
    known: Collection[str] = _fields(kind)  # type: ignore[arg-type]  # a class can be hashed
    if part in known:
        return getattr(node, part)
    if isinstance(node, Mapping):
        known = [str(name) for name in node]
        if part in known:
            return node[part]
    elif kind in (tuple, list):
        assert isinstance(node, Sequence)
        if part.isdecimal() and part == str(int(part)) and int(part) < len(node):
            return node[int(part)]
        known = [str(i) for i in range(len(node))]
    near = nearest(part, known) or (f" ({', '.join(known)})" if known else "")
    raise InputError(source, key, f"no such key in the twin file{near}")


@cache
def _fields(kind: type[Any]) -> Collection[str]:
    """Names of the values of a part of a file, none of another type."""
    return kind.model_fields if issubclass(kind, Strict) else ()


class FourWheeledTwin(Twin):
    """The twin of a vehicle with a wheel at each of four corners, of which each rides on its own suspension."""

    @property
    def standing(self) -> tuple[float, ...]:
        """Deflection in m of the suspensions at standstill, front and rear."""
        raise NotImplementedError

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(f"{corner}_suspension" for corner in CORNERS)

    @property
    def joints(self) -> tuple[Joint, ...]:
        up, none, radius = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), self.vehicle.tyre.radius
        standing = [rest for rest in self.standing for _ in range(2)]
        places = self.vehicle.wheel_positions.tolist()
        return tuple(
            Joint(name, "prismatic", (x, y, radius - rest), up, none, rest, radius, 0.2)
            for name, (x, y), rest in zip(self.joint_names, places, standing, strict=True)
        )

    @property
    def cog_height(self) -> float:
        return float(self.vehicle.cog[2])


class CarTwin(FourWheeledTwin):
    """The twin of a car: models ``full_car`` and ``msd``. ``excitation: wheel``: the measured motion of its four hubs
    drives an ``msd``, whose wheels have no mass and are where they are put."""

    model: Literal["full_car", "msd"] = "full_car"
    excitation: Literal["wheel"] | None = None
    vehicle: Vehicle

    @model_validator(mode="after")
    def _check_excitation(self) -> CarTwin:
        if self.on_wheel and self.model != "msd":
            raise ValueError("excitation: the measured motion of wheels drives the model msd alone")
        return self

    @property
    def acted_on(self) -> tuple[str, ...]:
        return (self.model, "quarter_car") if self.on_wheel else (self.model,)

    @property
    def standing(self) -> tuple[float, ...]:
        return tuple(axle.static_compression for axle in self.axles.values())

    @property
    def axles(self) -> dict[str, Suspension]:
        return self.vehicle.axles


#: By model the class of its twin file; that of a plugin is ``TWIN`` of the module that holds its ``MODEL``.
SCHEMAS: Final = Registry[type[Twin]](
    "models",
    {
        "full_car": f"{__name__}:CarTwin",
        "msd": f"{__name__}:CarTwin",
        "tracked": f"{__package__}.tracked:TrackedTwin",
        "quarter_car": f"{__package__}.quarter_car:QuarterCarTwin",
    },
    attribute="TWIN",
    kind=type,
)


def parse_twin(data: object, source: str | Path = "twin") -> Twin:
    """Check the data of a twin file.

    Parameters
    ----------
    data : mapping
        The contents of the file.
    source : str or Path
        Name of the file for the messages of errors.

    Returns
    -------
    Twin
        The twin.

    Raises
    ------
    InputError
        Naming source and key.

    Examples
    --------
    >>> from suspension_twin.errors import InputError
    >>> try:
    ...     parse_twin({"vehicle": {}, "imu": {"position": [0, 0, 1]}}, source="mine.yaml")
    ... except InputError as error:
    ...     str(error).startswith("mine.yaml")
    True
    """
    if not isinstance(data, dict):
        raise InputError(source, "not a twin file: a mapping with 'vehicle' and 'imu' is expected")
    model = str(data.get("model", "full_car"))
    if model in SCHEMAS:
        return checked(SCHEMAS[model], data, source, _KIND)
    wrong = f"model: must be one of {', '.join(SCHEMAS)}, is {shown(model)}{nearest(model, SCHEMAS)}"
    # what else is wrong is not known of the file of an add-on's model
    rest = [] if missing_addons() else problems(CarTwin, {**data, "model": "full_car"}, _KIND)
    raise InputError(source, "; ".join([wrong + missing_addons(), *rest]))


@reader("a twin file")
def load_twin(path: str | Path) -> Twin:
    """Read and check a twin file.

    Parameters
    ----------
    path : str or Path
        The YAML file.

    Returns
    -------
    Twin
        With ``road.file`` and the paths of other files as absolute paths.

    Raises
    ------
    InputError
        Naming the file and the key: an unknown or missing key, a value out of its physical range, a
        characteristic that does not rise.

    Examples
    --------
    >>> load_twin("bags/bump_15kmh/twin.yaml").model
    'full_car'
    """
    path = Path(path)
    return _in_folder(parse_twin(read_yaml(path), source=path), path.parent)


def twin_of_text(text: str, path: Path) -> Twin:
    """The twin that :func:`load_twin` would read from ``path`` if the file had this ``text``."""
    with reading(path, "a twin file"):
        return _in_folder(parse_twin(parse_yaml(text, path), source=path), path.parent)


def _in_folder(twin: Twin, folder: Path) -> Twin:
    return twin.with_paths(lambda file: file if file.is_absolute() else (folder / file).resolve())


def save_twin(twin: Twin, path: str | Path, heading: str = "") -> None:
    """Write a twin file that :func:`load_twin` reads back equal.

    Parameters
    ----------
    twin : Twin
        The twin.
    path : str or Path
        The YAML file; the paths of the road and of other files are kept relative to it if they can be.
    heading : str
        Comment lines to put before it.

    Raises
    ------
    InputError
        The file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_twin(twin, f"{folder}/twin.yaml")
    ...     load_twin(f"{folder}/twin.yaml") == twin
    True
    """
    path = Path(path)
    folder, anchor = path.parent.resolve(), path.absolute().anchor

    def near(file: Path) -> Path:
        if file.is_absolute() and file.anchor == anchor:  # Windows: on the same drive
            file = Path(os.path.relpath(file, folder))
        return Path(file.as_posix())

    data = twin.with_paths(near).model_dump(mode="json", exclude_none=True)
    write_text(path, heading + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100))
