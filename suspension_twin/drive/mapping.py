# SPDX-License-Identifier: Apache-2.0
"""Mapping files: which columns of a foreign log are which quantity, in which units and on which clock.

The files in ``config/import`` are worked examples of it.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Mapping as MappingOf, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from suspension_twin.arrays import Floats
from suspension_twin.drive.clocks import (
    GPS_EPOCH,
    TIME_UNITS,
    gps_to_posix,
    iso_to_posix,
    rtklib_tag,
    text_to_posix,
    week_to_posix,
)
from suspension_twin.drive.foreign_files import DataTable, RecordedFiles, read_table
from suspension_twin.drive.importers import IMPORTERS, read_source
from suspension_twin.drive.mat import MAT_MAGIC, mat_table
from suspension_twin.drive.measurement import MeasuredTable, open_measurement
from suspension_twin.drive.rig import QUANTITIES, RigRecord, checked_rig, rig_unit, upright
from suspension_twin.drive.stamps import began_again, moment, unwrapped
from suspension_twin.drive.streams import Series, Streams
from suspension_twin.drive.types import FixData, HeadingData, VelocityData
from suspension_twin.errors import InputError, shown
from suspension_twin.files import read_yaml, reader
from suspension_twin.schema import Strict, checked
from suspension_twin.units import STANDARD_GRAVITY

__all__ = ["BagSpec", "Mapping", "load_mapping", "read_mapped", "read_mapped_rig"]

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
#: A logger's clock and the tag of its file run alike: to s by which the first and last bytes of one are late, and to a
#: share that is ten times the error of a quartz (tolerances, by hand).
_LATE, _DRIFT = 1.0, 1e-3

Column = str | int


def _one_of(units: MappingOf[str, float]) -> AfterValidator:
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
        """The layout of this section; without a file of its own that of the section around it, but for keys given."""
        base = self if self.file is not None or outer is None else outer
        given = {key: getattr(self, key) for key in FileSpec.model_fields if key in self.model_fields_set}
        return FileSpec(**{key: getattr(base, key) for key in FileSpec.model_fields} | given)


class LaggedSpec(FileSpec):
    """Data whose stamps come ``lag`` s late: a sample stamped t was taken at t - lag."""

    lag: Number = 0.0


class ClockSpec(FileSpec):
    """Two clocks read side by side: times of a recorder's own clock and the POSIX times they were."""

    column: Column = 0
    unit: Annotated[str, _one_of(TIME_UNITS)] = "s"
    posix: TimeSpec


class TimeSpec(LaggedSpec):
    """Stamps. ``base`` is the moment that they count from:

    ``posix`` since 1970 (UTC); ``gps`` since 1980 (GPS time); ``gps_week`` two columns, week and
    second; ``text`` dates and times in words or ISO 8601, or times of the day that ``start`` names;
    ``start`` since the moment ``start`` names; ``rtklib_tag`` the first and last sample stand at the
    first and last time of RTKLIB's ``tag`` file; ``clock`` a clock of its own, tied to POSIX time by ``tie``.

    ``drift_ppm``: the clock runs fast by so many millionths, counted from the first sample. Neither it nor ``lag`` is
    guessed: give known values.
    """

    column: Column = 0
    columns: tuple[Column, Column] | None = None
    unit: Annotated[str, _one_of(TIME_UNITS)] = "s"
    base: Literal["posix", "gps", "gps_week", "text", "start", "rtklib_tag", "clock"] = "posix"
    start: str | None = None
    tag: str | None = None
    tie: ClockSpec | None = None
    drift_ppm: Number = 0.0

    @model_validator(mode="after")
    def _check(self) -> TimeSpec:
        for base, key in (("rtklib_tag", "tag"), ("clock", "tie"), ("gps_week", "columns")):
            if (self.base == base) != (getattr(self, key) is not None):
                raise ValueError(f"base {base} and key {key} belong together")
        if self.start is not None:
            if self.base not in ("start", "text"):
                raise ValueError("key start belongs to base start or text")
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
    """Three columns. ``axes``: which of the file's x, y, z becomes x, y and z (``[-y, x, z]``); or
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


class ReceivedSpec(LaggedSpec):
    """Data of a receiver: columns of a table, or whatever the importer of this name finds."""

    importer: str | None = None
    time: TimeSpec | None = None

    @property
    def needed(self) -> tuple[str, ...]:
        """Keys that must be given without an importer."""
        return ("time",)

    @model_validator(mode="after")
    def _complete(self) -> ReceivedSpec:
        missing = next((key for key in self.needed if getattr(self, key) is None), None)
        if self.importer is None and missing is not None:
            raise ValueError(f"{missing}: is missing (or name an importer)")
        return self


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

    @property
    def needed(self) -> tuple[str, ...]:
        return ("time", "latitude", "longitude")


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

    @property
    def needed(self) -> tuple[str, ...]:
        if self.derive:
            return ()
        by_course = self.speed is not None or self.bearing is not None
        return ("time", *(("speed", "bearing") if by_course else ("east", "north")))


class HeadingSpec(ReceivedSpec):
    """Heading of the vehicle: ``convention`` ``enu`` (from east, counter-clockwise) or ``compass``."""

    column: Column | None = None
    unit: Annotated[str, _one_of(ANGLE_UNITS)] = "rad"
    convention: Literal["enu", "compass"] = "enu"

    @property
    def needed(self) -> tuple[str, ...]:
        return ("time", "column")


class BagSpec(Strict):
    """A recording: which of its topics is which."""

    file: str | None = None
    imu: str = "/imu/data_raw"
    fix: str = "/fix"
    vel: str = "/vel"
    heading: str = "/heading"
    lag: Number = 0.0  # of the IMU's stamps against the others, s


class SpinSpec(Strict):
    """The column of a sensor's rate of turn about the axle of its wheel."""

    column: Column
    unit: Annotated[str, _one_of(RATE_UNITS)]


class RigColumnSpec(FileSpec):
    """One quantity of a run of a rig: a ``column`` in a ``unit``, with the ``sign`` that makes upwards, compression and
    a force that pushes the body up positive; ``time`` where it has stamps of its own. Of an accelerometer that turns
    with its wheel, two columns across the axle, x and y where the axle is z, and the ``spin`` about z."""

    column: Column | tuple[Column, Column]
    unit: str
    sign: Literal[1, -1] = 1
    time: TimeSpec | None = None
    spin: SpinSpec | None = None

    @property
    def read(self) -> tuple[Column, ...]:
        """The columns that are read."""
        own = self.column if isinstance(self.column, tuple) else (self.column,)
        return own if self.spin is None else (*own, self.spin.column)

    @model_validator(mode="after")
    def _check(self) -> RigColumnSpec:
        if isinstance(self.column, tuple) != (self.spin is not None):
            raise ValueError("two columns and spin belong together")
        return self


def _listed(value: object) -> object:
    return value if isinstance(value, list) else [value]


class RigSpec(FileSpec):
    """A run of a rig: its ``time``, and columns by quantity; those of several files are joined. Of several columns of
    one quantity, both hubs of an axle, the mean is taken."""

    time: TimeSpec
    columns: dict[str, Annotated[list[RigColumnSpec], BeforeValidator(_listed), Field(min_length=1)]]

    @property
    def all_columns(self) -> list[tuple[str, RigColumnSpec]]:
        """Every column with its quantity."""
        return [(name, spec) for name, specs in self.columns.items() for spec in specs]

    @model_validator(mode="after")
    def _check(self) -> RigSpec:
        for name, spec in self.all_columns:
            known = [q for q in QUANTITIES if q != "time"]
            if name not in known:
                raise ValueError(f"columns: {name} is none of {', '.join(known)}")
            units = QUANTITIES[name][0]
            if rig_unit(spec.unit) not in units:
                raise ValueError(f"columns: {name}: unit must be one of {', '.join(units)}, is {spec.unit!r}")
        return self


class Mapping(Strict):
    """One recording: ``imu`` (and ``fix``, ``vel``, ``heading``) from tables, or ``bag``, or a run of a ``rig``."""

    name: str | None = None
    imu: ImuSpec | None = None
    fix: FixSpec | None = None
    vel: VelocitySpec | None = None
    heading: HeadingSpec | None = None
    bag: BagSpec | None = None
    rig: RigSpec | None = None

    @model_validator(mode="after")
    def _check(self) -> Mapping:
        if sum(part is not None for part in (self.imu, self.bag, self.rig)) != 1:
            raise ValueError("name either imu (with fix and vel), bag or rig")
        if self.imu is None and (self.fix or self.vel or self.heading):
            fault = (
                "bag: fix, vel and heading are topics of the bag"
                if self.bag
                else "rig: has no fix, vel or heading"
            )
            raise ValueError(fault)
        return self


ClockSpec.model_rebuild()
TimeSpec.model_rebuild()


@reader("a mapping file")
def load_mapping(path: str | Path) -> Mapping:
    """Read and check a mapping file; InputError names the file and the key."""
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(path, "not a mapping file: keys imu, fix, vel or bag are expected")
    return checked(Mapping, data, path, "a mapping file")


# Reading by a mapping


def read_mapped(mapping: Mapping, recordings: Sequence[RecordedFiles], label: str) -> Streams:
    """Streams of the files that the mapping names, found among ``recordings`` or beside them.

    ``label`` is the mapping's own name. Raises InputError naming file and column.
    """
    imu = mapping.imu
    assert imu is not None
    streams = Streams(origin=f"mapping {Path(label).name}")
    files = _Files(recordings, streams)
    streams.force = replace(
        _vector(files, imu.specific_force, imu, FORCE_UNITS), unit="m/s²", frame=imu.frame
    )
    streams.rate = _vector(files, imu.angular_rate, imu, RATE_UNITS)
    streams.notes.append(
        f"units: accelerometer {imu.specific_force.unit}, gyroscope {imu.angular_rate.unit} (from the mapping)"
    )
    for time in (imu.time, imu.specific_force.time, imu.angular_rate.time):
        if time is not None and (time.lag or time.drift_ppm):
            streams.notes.append(f"IMU time: {time.lag:g} s lag and {time.drift_ppm:g} ppm drift taken out")
    if mapping.fix is not None:
        streams.fix = _fix(files, mapping.fix)
    if mapping.vel is not None and not mapping.vel.derive:
        _velocity(files, mapping.vel)
    if mapping.heading is not None:
        streams.heading = _heading(files, mapping.heading)
    return streams


def read_mapped_rig(mapping: Mapping, recordings: Sequence[RecordedFiles], label: str) -> RigRecord:
    """A run of a rig of the files that a mapping names: every quantity at the stamps of ``time`` that all reach,
    along a cubic spline between its own. Raises InputError naming file and column."""
    spec = mapping.rig
    assert spec is not None
    streams = Streams(origin=f"mapping {Path(label).name}")
    files = _Files(recordings, streams)
    # before their time: that of a measurement's channels is the first one's
    read = [[files.table(one, spec).numbers(c) for c in one.read] for _, one in spec.all_columns]
    t = _time(files, spec.time, spec)
    series: list[tuple[str, Floats, Floats]] = []
    for (name, one), values in zip(spec.all_columns, read, strict=True):
        table = files.table(one, spec)
        own = one if one.file is not None else spec
        stamps = t if one.time is None else _time(files, one.time, own)
        unit = one.sign * QUANTITIES[name][0][rig_unit(one.unit)]
        if {stamps.size} != {own.size for own in values}:
            raise InputError(
                table.label, name, f"{values[0].size} rows for {stamps.size} stamps: give it a time"
            )
        good = np.isfinite([stamps, *values]).all(axis=0)
        stamps, (first, *more) = stamps[good], [own[good] for own in values]
        if good.sum() < 4 or (np.diff(stamps) <= 0).any():
            raise InputError(table.label, name, "needs rising stamps and numbers in four rows or more")
        if one.spin is not None:
            first = upright(table.label, stamps, first + 1j * more[0], more[1] * RATE_UNITS[one.spin.unit])
        series.append((name, stamps, first * unit / len(spec.columns[name])))
    begin = max([t[0], *(s[0] for _, s, _ in series)])
    end = min([t[-1], *(s[-1] for _, s, _ in series)])
    kept = t[(t >= begin) & (t <= end)]
    columns = {name: np.zeros(kept.size) for name in spec.columns}
    for name, s, part in series:
        columns[name] += CubicSpline(s, part)(kept)
    name = mapping.name or recordings[0].name
    return checked_rig(label, name, {"time": kept - kept[0], **columns}, tuple(streams.warnings))


class _Files:
    """The recordings given, and tables parsed from their files once each."""

    def __init__(self, recordings: Sequence[RecordedFiles], streams: Streams) -> None:
        self.recordings, self.streams = recordings, streams
        self.tables: dict[FileSpec, DataTable] = {}
        self.measured: dict[int, DataTable] = {}

    def located(self, name: str) -> tuple[RecordedFiles, str]:
        """Recording and name of a file: among those given, or beside one of them."""
        for recording in self.recordings:
            if found := recording.find(name):
                return recording, found
            if alike := fnmatch.filter(recording.names, name):
                return recording, alike[0]
        for recording in self.recordings:
            beside = recording.path.parent / name
            if beside.is_file():
                return RecordedFiles(beside), beside.name
        raise InputError(self.recordings[0].path, name, "is not there (the mapping asks for it)")

    def content(self, name: str | None) -> tuple[bytes, str]:
        """Bytes and label of a file."""
        first = self.recordings[0]
        if name is None and len(first.names) != 1:
            raise InputError(first.path, "the mapping names no file to read in it")
        recording, found = (first, first.names[0]) if name is None else self.located(name)
        return recording.read(found), recording.label(found)

    def table(self, spec: FileSpec, outer: FileSpec | None = None) -> DataTable:
        """The table of a section."""
        chosen = spec.within(outer)
        # Channels of a measurement have stamps of their own: a table for each section.
        section = id(spec if outer is None or spec.file is not None else outer)
        if section in self.measured:
            return self.measured[section]
        if chosen not in self.tables:
            data, label = self.content(chosen.file)
            if (measurement := open_measurement(data, label)) is not None:
                self.measured[section] = MeasuredTable(label, [], measurement=measurement)
                return self.measured[section]
            if data.startswith(MAT_MAGIC):
                self.tables[chosen] = mat_table(data, label)
                return self.tables[chosen]
            table = read_table(data, label, **chosen.model_dump(exclude={"file"}))
            self.streams.warnings += table.warnings
            self.tables[chosen] = table
        return self.tables[chosen]

    def imported(self, spec: ReceivedSpec) -> Streams:
        """The streams that the importer of this name finds in the file."""
        assert spec.importer is not None
        recording = self.recordings[0]
        if spec.file is not None:
            recording, found = self.located(spec.file)
            if recording.path.is_dir():
                recording = RecordedFiles(recording.path / found)
        return read_source(recording, IMPORTERS.named(spec.importer, "importer"))


def _vector(files: _Files, spec: VectorSpec, imu: ImuSpec, units: MappingOf[str, float]) -> Series:
    table = files.table(spec, imu)
    values = table.vector(spec.columns) * units[spec.unit]
    signs = [-1.0 if axis[0] == "-" else 1.0 for axis in spec.axes]
    turned = values[:, ["xyz".index(axis[-1]) for axis in spec.axes]] * signs
    angles = spec.rpy if spec.rpy_deg is None else tuple(np.radians(spec.rpy_deg))
    if angles is not None:
        good = np.isfinite(turned).all(axis=1)
        turned[good] = Rotation.from_euler("xyz", angles).apply(turned[good])
    time = spec.time or imu.time
    assert time is not None
    t = _time(files, time, spec if spec.file is not None else imu)
    if t.size != values.shape[0]:
        raise InputError(table.label, f"{values.shape[0]} rows for {t.size} stamps")
    return Series(t, turned)


def _time(files: _Files, spec: TimeSpec, outer: FileSpec | None) -> Floats:
    """POSIX times, lag and drift taken out."""
    t = _posix(files, spec, outer)
    finite = t[np.isfinite(t)]
    if spec.drift_ppm and finite.size:
        t = finite[0] + (t - finite[0]) / (1 + spec.drift_ppm * 1e-6)
    return t - spec.lag


def _posix(files: _Files, spec: TimeSpec, outer: FileSpec | None) -> Floats:
    table = files.table(spec, outer)
    if spec.base == "text":
        texts = table.text(spec.column)
        t = text_to_posix(texts, math.nan if spec.start is None else iso_to_posix(spec.start))
        if not np.isfinite(t).any():
            fault = "is no date and time"
            if np.isfinite(text_to_posix(texts[:1], 0.0)).all():
                fault = "names no day: give it in the mapping as start: 2024-05-01"
            raise InputError(table.label, f"column {spec.column}", f"{shown(texts[0])} {fault}")
        return t
    if spec.columns is not None:  # GPS week and second
        week, seconds = (table.numbers(column) for column in spec.columns)
        return week_to_posix(week, seconds * TIME_UNITS[spec.unit])
    t = table.numbers(spec.column) * TIME_UNITS[spec.unit]
    finite = t[np.isfinite(t)]
    if not finite.size:
        raise InputError(table.label, f"column {spec.column}", "holds no times")
    if spec.tie is not None or spec.drift_ppm:  # which are of the counter as it goes on
        t = _going_on(files, t)
    if spec.base == "gps":
        return gps_to_posix(t + GPS_EPOCH)
    if spec.start is not None:
        return t + iso_to_posix(spec.start)
    if spec.tag is not None:
        first, last = rtklib_tag(*files.content(spec.tag))
        span = finite[-1] - finite[0]
        if span <= 0.0 or abs(last - first - span) > _LATE + _DRIFT * span:
            zero = moment(float(gps_to_posix(np.array(first - finite[0])))).removesuffix(" UTC")
            raise InputError(
                table.label,
                f"column {spec.column}",
                f"runs for {span:.1f} s and {spec.tag} for {last - first:.1f} s: is one cut off, or the unit wrong? "
                f"Copy both again, or go by this clock alone: base: start, start: {zero} instead of base and tag",
            )
        return gps_to_posix(first + (t - finite[0]) * (last - first) / span)
    if spec.tie is not None:
        own = files.table(spec.tie, outer).numbers(spec.tie.column) * TIME_UNITS[spec.tie.unit]
        own = _going_on(files, own)
        posix = _time(files, spec.tie.posix, spec.tie)
        if own.size != posix.size:
            raise InputError(table.label, f"tie: {own.size} times of the clock for {posix.size} POSIX times")
        return np.asarray(t + np.nanmedian(posix - own))
    return t


def _going_on(files: _Files, t: Floats) -> Floats:
    """Times (n,) s of a counter that may begin again."""
    good, t = np.isfinite(t), t.copy()
    t[good], span = unwrapped(t[good])
    if span:
        files.streams.warnings.append(began_again(span))
    return t


def _received_time(files: _Files, spec: ReceivedSpec) -> Floats:
    assert spec.time is not None
    return _time(files, spec.time, spec) - spec.lag


def _fix(files: _Files, spec: FixSpec) -> FixData:
    if spec.importer is not None:
        found = files.imported(spec)
        if found.fix is None:
            raise InputError(spec.file or files.recordings[0].path, "holds no positions")
        files.streams.notes += found.notes
        files.streams.warnings += found.warnings
        return replace(found.fix, t=found.fix.t - spec.lag, frame=spec.frame)
    assert spec.latitude is not None and spec.longitude is not None
    table, scale = files.table(spec), ANGLE_UNITS[spec.unit]
    latitude, longitude = (table.numbers(c) * scale for c in (spec.latitude, spec.longitude))
    t = _received_time(files, spec)
    nothing = np.full(t.size, np.nan)
    if t.size != latitude.size:
        raise InputError(table.label, f"{latitude.size} positions for {t.size} stamps")
    return FixData(
        t,
        latitude,
        longitude,
        altitude=nothing if spec.altitude is None else table.numbers(spec.altitude),
        status=(
            np.zeros(t.size, dtype=np.int8)
            if spec.status is None
            else np.nan_to_num(table.numbers(spec.status), nan=-1.0).astype(np.int8)
        ),
        sigma=np.stack([nothing] * 3, axis=1) if spec.sigma is None else table.vector(spec.sigma),
        frame=spec.frame,
    )


def _velocity(files: _Files, spec: VelocitySpec) -> None:
    if spec.importer is not None:
        found = files.imported(spec).velocity
        if found is None:
            fault = "holds no velocities: give derive: true instead"
            raise InputError(spec.file or files.recordings[0].path, fault)
        files.streams.velocity = replace(found, t=found.t - spec.lag)
        return
    table, scale = files.table(spec), SPEED_UNITS[spec.unit]
    if spec.speed is not None and spec.bearing is not None:
        speed, degrees = (
            table.numbers(spec.speed),
            table.numbers(spec.bearing) * ANGLE_UNITS[spec.bearing_unit],
        )
        files.streams.add_course(_received_time(files, spec), speed * scale, degrees)
        return
    assert spec.east is not None and spec.north is not None
    east, north = table.numbers(spec.east), table.numbers(spec.north)
    up = np.zeros(east.size) if spec.up is None else table.numbers(spec.up)
    files.streams.velocity = VelocityData(
        _received_time(files, spec), np.stack([east, north, up], axis=1) * scale
    )


def _heading(files: _Files, spec: HeadingSpec) -> HeadingData | None:
    if spec.importer is not None:
        return files.imported(spec).heading
    assert spec.column is not None
    yaw = np.radians(files.table(spec).numbers(spec.column) * ANGLE_UNITS[spec.unit])
    if spec.convention == "compass":
        yaw = np.pi / 2 - yaw
    t = _received_time(files, spec)
    return HeadingData(t, np.asarray((yaw + np.pi) % (2 * np.pi) - np.pi))
