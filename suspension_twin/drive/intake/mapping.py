# SPDX-License-Identifier: Apache-2.0
"""The mapping file: which column of which file is what, in which unit, axes and time base.

The files in ``config/import`` are worked examples of it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from suspension_twin.drive.intake.clocks import TIME_UNITS, iso_to_posix
from suspension_twin.errors import InputError
from suspension_twin.files import parse_yaml, read_yaml, reading
from suspension_twin.schema import Strict, checked
from suspension_twin.units import STANDARD_GRAVITY

__all__ = [
    "ANGLE_UNITS",
    "FORCE_UNITS",
    "RATE_UNITS",
    "SPEED_UNITS",
    "BagSpec",
    "FileSpec",
    "FixSpec",
    "HeadingSpec",
    "ImuSpec",
    "Mapping",
    "ReceivedSpec",
    "TimeSpec",
    "VectorSpec",
    "VelocitySpec",
    "load_mapping",
    "parse_mapping",
]

FORCE_UNITS: Final = {
    "m/s2": 1.0,
    "m/s^2": 1.0,
    "m/s²": 1.0,
    "g": STANDARD_GRAVITY,
    "mg": STANDARD_GRAVITY * 1e-3,
    "milli-g": STANDARD_GRAVITY * 1e-3,
}
RATE_UNITS: Final = {"rad/s": 1.0, "deg/s": math.radians(1), "°/s": math.radians(1), "dps": math.radians(1)}
SPEED_UNITS: Final = {"m/s": 1.0, "km/h": 1 / 3.6, "kn": 1852 / 3600, "mph": 0.44704}
#: In degrees, in which places and bearings are kept.
ANGLE_UNITS: Final = {"deg": 1.0, "°": 1.0, "rad": math.degrees(1)}

Column = str | int


def _one_of(units: dict[str, float]) -> AfterValidator:
    def check(value: str) -> str:
        if value not in units:
            raise ValueError(f"must be one of {', '.join(units)}, is {value!r}")
        return value

    return AfterValidator(check)


Number = Annotated[float, Field(allow_inf_nan=False)]


class FileSpec(Strict):
    """A file and how it is laid out. None: recognised; without ``file``, as in the section around it."""

    file: str | None = None
    header: bool | int | None = None  # True, False, or rows to skip before the one of names
    delimiter: str | None = None
    decimal: Literal[".", ","] | None = None
    comment: str = "#"

    def within(self, outer: FileSpec | None) -> FileSpec:
        """This one, or the section around it with what is said here."""
        if self.file is not None or outer is None:
            return self
        said = {key: getattr(self, key) for key in FileSpec.model_fields if key in self.model_fields_set}
        return FileSpec(**{key: getattr(outer, key) for key in FileSpec.model_fields} | said)


class ClockSpec(FileSpec):
    """Two clocks read side by side: times of a recorder's own clock and the POSIX times they were."""

    column: Column = 0
    unit: Annotated[str, _one_of(TIME_UNITS)] = "s"
    posix: TimeSpec


class TimeSpec(FileSpec):
    """Stamps. ``base`` says what they count from:

    ``posix`` since 1970 (UTC); ``gps`` since 1980 (GPS time); ``gps_week`` two columns, week and
    second; ``text`` dates and times in words or ISO 8601; ``start`` since the moment ``start`` names; ``rtklib_tag``
    the first and last sample stand at the first and last time of RTKLIB's ``tag`` file; ``clock`` a
    clock of its own, tied to POSIX time by ``tie``.

    ``lag`` s: what is stamped t happened at t - lag. ``drift_ppm``: the clock runs fast by so many
    millionths, counted from the first sample. Neither is guessed: give what you know.
    """

    column: Column = 0
    columns: tuple[Column, Column] | None = None
    unit: Annotated[str, _one_of(TIME_UNITS)] = "s"
    base: Literal["posix", "gps", "gps_week", "text", "start", "rtklib_tag", "clock"] = "posix"
    start: str | None = None
    tag: str | None = None
    tie: ClockSpec | None = None
    lag: Number = 0.0
    drift_ppm: Number = 0.0

    @model_validator(mode="after")
    def _check(self) -> TimeSpec:
        for base, key in (("rtklib_tag", "tag"), ("clock", "tie"), ("gps_week", "columns")):
            if (self.base == base) != (getattr(self, key) is not None):
                raise ValueError(f"base {base} and key {key} belong together")
        if self.start is not None:
            if self.base != "start":
                raise ValueError("key start belongs to base start")
            try:
                iso_to_posix(self.start)
            except ValueError:
                raise ValueError(
                    f"start: {self.start!r} is no date and time like 2024-05-01T12:00:00Z"
                ) from None
        if abs(self.drift_ppm) > 10_000:
            raise ValueError(f"drift_ppm: {self.drift_ppm:g} is no clock's drift")
        return self


Axis = Literal["x", "y", "z", "-x", "-y", "-z", "+x", "+y", "+z"]


class VectorSpec(FileSpec):
    """Three columns. ``axes``: what of the file's x, y, z becomes x, y and z (``[-y, x, z]``); or
    ``rpy`` (rad) or ``rpy_deg``: z-y-x angles of the sensor in the axes to write."""

    columns: tuple[Column, Column, Column]
    unit: str
    axes: tuple[Axis, Axis, Axis] = ("x", "y", "z")
    rpy: tuple[Number, Number, Number] | None = None
    rpy_deg: tuple[Number, Number, Number] | None = None
    time: TimeSpec | None = None

    @model_validator(mode="after")
    def _check(self) -> VectorSpec:
        if sorted(axis[-1] for axis in self.axes) != ["x", "y", "z"]:
            raise ValueError(f"axes: must name x, y and z once each, are {list(self.axes)}")
        if self.rpy is not None and self.rpy_deg is not None:
            raise ValueError("give rpy or rpy_deg, not both")
        return self


class _ForceSpec(VectorSpec):
    unit: Annotated[str, _one_of(FORCE_UNITS)]


class _RateSpec(VectorSpec):
    unit: Annotated[str, _one_of(RATE_UNITS)]


class ImuSpec(FileSpec):
    """Accelerometer (gravity included) and gyroscope; ``time`` of both, unless one has its own."""

    frame: str = "imu_link"
    time: TimeSpec | None = None
    specific_force: _ForceSpec
    angular_rate: _RateSpec

    @model_validator(mode="after")
    def _check(self) -> ImuSpec:
        if self.time is None and (self.specific_force.time is None or self.angular_rate.time is None):
            raise ValueError("time: is missing")
        return self


class ReceivedSpec(FileSpec):
    """Something a receiver gave: columns of a table, or whatever the importer of this name finds."""

    importer: str | None = None
    lag: Number = 0.0
    time: TimeSpec | None = None

    def columns_or_importer(self, *needed: str) -> None:
        if self.importer is not None:
            return
        for key in ("time", *needed):
            if getattr(self, key) is None:
                raise ValueError(f"{key}: is missing (or name an importer)")


class FixSpec(ReceivedSpec):
    """Positions: ``unit`` of the angles; ``sigma`` columns east, north, up in m; ``status`` as in
    sensor_msgs/NavSatStatus."""

    latitude: Column | None = None
    longitude: Column | None = None
    altitude: Column | None = None
    unit: Annotated[str, _one_of(ANGLE_UNITS)] = "deg"
    sigma: tuple[Column, Column, Column] | None = None
    status: Column | None = None
    frame: str = "gps_link"

    @model_validator(mode="after")
    def _check(self) -> FixSpec:
        self.columns_or_importer("latitude", "longitude")
        return self


class VelocitySpec(ReceivedSpec):
    """Velocities: columns ``east``, ``north``, ``up``, or ``speed`` and ``bearing`` (from north,
    clockwise), or ``derive: true`` from the positions."""

    derive: bool = False
    east: Column | None = None
    north: Column | None = None
    up: Column | None = None
    speed: Column | None = None
    bearing: Column | None = None
    unit: Annotated[str, _one_of(SPEED_UNITS)] = "m/s"
    bearing_unit: Annotated[str, _one_of(ANGLE_UNITS)] = "deg"

    @model_validator(mode="after")
    def _check(self) -> VelocitySpec:
        if self.derive:
            return self
        if self.speed is not None or self.bearing is not None:
            self.columns_or_importer("speed", "bearing")
        else:
            self.columns_or_importer("east", "north")
        return self


class HeadingSpec(ReceivedSpec):
    """Heading of the vehicle: ``convention`` ``enu`` (from east, counter-clockwise) or ``compass``."""

    column: Column | None = None
    unit: Annotated[str, _one_of(ANGLE_UNITS)] = "rad"
    convention: Literal["enu", "compass"] = "enu"

    @model_validator(mode="after")
    def _check(self) -> HeadingSpec:
        self.columns_or_importer("column")
        return self


class BagSpec(Strict):
    """A recording: which of its topics is which."""

    file: str | None = None
    imu: str = "/imu/data_raw"
    fix: str = "/fix"
    vel: str = "/vel"
    heading: str = "/heading"
    lag: Number = 0.0  # of the IMU's stamps against the others, s


class Mapping(Strict):
    """One recording: ``imu`` (and ``fix``, ``vel``, ``heading``) from tables, or ``bag``."""

    name: str | None = None
    imu: ImuSpec | None = None
    fix: FixSpec | None = None
    vel: VelocitySpec | None = None
    heading: HeadingSpec | None = None
    bag: BagSpec | None = None

    @model_validator(mode="after")
    def _check(self) -> Mapping:
        if (self.imu is None) == (self.bag is None):
            raise ValueError("name either imu (with fix and vel) or bag")
        if self.bag is not None and (self.fix or self.vel or self.heading):
            raise ValueError("bag: fix, vel and heading are topics of the bag")
        return self


ClockSpec.model_rebuild()
TimeSpec.model_rebuild()


def load_mapping(path: str | Path) -> Mapping:
    """Read and check a mapping file; InputError names the file and the key."""
    with reading(path, "a mapping file"):
        return _checked(read_yaml(path), path)


def parse_mapping(text: str, source: str | Path = "mapping") -> Mapping:
    """Check the text of a mapping file; InputError names ``source`` and the key."""
    return _checked(parse_yaml(text, source), source)


def _checked(data: Any, source: str | Path) -> Mapping:
    if not isinstance(data, dict):
        raise InputError(source, "not a mapping file: keys imu, fix, vel or bag are expected")
    return checked(Mapping, data, source, "a mapping file")
