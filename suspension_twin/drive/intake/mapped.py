# SPDX-License-Identifier: Apache-2.0
"""Streams from any table or array, read as a mapping file says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from suspension_twin.arrays import Floats
from suspension_twin.drive.importers import load_importer, read_source
from suspension_twin.drive.intake.arrays import MAGIC as ARRAY_MAGIC
from suspension_twin.drive.intake.arrays import read_array
from suspension_twin.drive.intake.clocks import (
    GPS_EPOCH,
    TIME_UNITS,
    gps_to_posix,
    iso_to_posix,
    rtklib_tag,
    text_to_posix,
    week_to_posix,
)
from suspension_twin.drive.intake.mapping import (
    ANGLE_UNITS,
    FORCE_UNITS,
    RATE_UNITS,
    SPEED_UNITS,
    FileSpec,
    FixSpec,
    HeadingSpec,
    Mapping,
    ReceivedSpec,
    TimeSpec,
    VectorSpec,
    VelocitySpec,
)
from suspension_twin.drive.intake.source import Source
from suspension_twin.drive.intake.streams import Series, Streams
from suspension_twin.drive.intake.table import Table, read_table
from suspension_twin.drive.intake.velocity import velocities_from_course
from suspension_twin.drive.types import FixData, HeadingData, VelocityData
from suspension_twin.errors import InputError

__all__ = ["read_mapped"]


class _Files:
    """The files given, and tables parsed from them once each."""

    def __init__(self, sources: Sequence[Source], streams: Streams) -> None:
        self.sources = sources
        self.streams = streams
        self.tables: dict[tuple[object, ...], Table] = {}

    def content(self, name: str | None) -> tuple[bytes, str]:
        """Bytes and label of a file: among those given, or beside one of them."""
        if name is None:
            first = self.sources[0]
            if len(first.names) != 1:
                raise InputError(first.path, "the mapping names no file to read in it")
            name = first.names[0]
        for source in self.sources:
            found = source.find(name)
            if found is not None:
                return source.read(found), source.label(found)
        for source in self.sources:
            beside = source.path.parent / name
            if source.path.is_file() and beside.is_file():
                return Source(beside).read(beside.name), str(beside)
        raise InputError(self.sources[0].path, name, "is not there (the mapping asks for it)")

    def table(self, spec: FileSpec, outer: FileSpec | None) -> Table:
        """The table of a section."""
        chosen = spec.within(outer)
        key = (chosen.file, chosen.header, chosen.delimiter, chosen.decimal, chosen.comment)
        if key not in self.tables:
            data, label = self.content(chosen.file)
            if data.startswith(ARRAY_MAGIC):
                self.tables[key] = Table(label, [], values=read_array(data, label))
            else:
                table = read_table(
                    data,
                    label,
                    header=chosen.header,
                    delimiter=chosen.delimiter,
                    decimal=chosen.decimal,
                    comment=chosen.comment,
                )
                self.streams.warnings += table.warnings
                self.tables[key] = table
        return self.tables[key]


def read_mapped(mapping: Mapping, sources: Sequence[Source], label: str) -> Streams:
    """Streams of the files that the mapping names, found among ``sources`` or beside them.

    ``label`` is the mapping's own name. Raises InputError naming file and column.
    """
    assert mapping.imu is not None
    streams = Streams(origin=f"mapping {Path(label).name}", force_unit="m/s²", frame=mapping.imu.frame)
    files = _Files(sources, streams)
    imu = mapping.imu
    streams.force = _vector(files, imu.specific_force, imu, imu.time, FORCE_UNITS)
    streams.rate = _vector(files, imu.angular_rate, imu, imu.time, RATE_UNITS)
    streams.notes.append(
        f"units: accelerometer {imu.specific_force.unit}, gyroscope {imu.angular_rate.unit} (from the mapping)"
    )
    for time in (imu.time, imu.specific_force.time, imu.angular_rate.time):
        if time is not None and (time.lag or time.drift_ppm):
            streams.notes.append(f"IMU time: {time.lag:g} s lag and {time.drift_ppm:g} ppm drift taken out")
    if mapping.fix is not None:
        _fix(files, mapping.fix)
    if mapping.vel is not None:
        _velocity(files, mapping.vel)
    if mapping.heading is not None:
        _heading(files, mapping.heading)
    return streams


def _vector(
    files: _Files, spec: VectorSpec, outer: FileSpec, time: TimeSpec | None, units: dict[str, float]
) -> Series:
    table = files.table(spec, outer)
    values = np.stack([table.numbers(column) for column in spec.columns], axis=1) * units[spec.unit]
    turned = np.empty_like(values)
    for i, axis in enumerate(spec.axes):
        turned[:, i] = values[:, "xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)
    angles = spec.rpy if spec.rpy_deg is None else tuple(np.radians(spec.rpy_deg))
    if angles is not None:
        good = np.isfinite(turned).all(axis=1)
        turned[good] = Rotation.from_euler("xyz", angles).apply(turned[good])
    chosen = spec.time or time
    assert chosen is not None
    t = _time(files, chosen, spec if spec.file is not None else outer)
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
        return text_to_posix(table.text(spec.column))
    if spec.base == "gps_week":
        assert spec.columns is not None
        week, seconds = (table.numbers(column) for column in spec.columns)
        return week_to_posix(week, seconds * TIME_UNITS[spec.unit])
    t = table.numbers(spec.column) * TIME_UNITS[spec.unit]
    finite = t[np.isfinite(t)]
    if not finite.size:
        raise InputError(table.label, f"column {spec.column}", "holds no times")
    if spec.base == "gps":
        return gps_to_posix(t + GPS_EPOCH)
    if spec.base == "start" and spec.start is not None:
        return t + iso_to_posix(spec.start)
    if spec.base == "rtklib_tag":
        assert spec.tag is not None
        first, last = rtklib_tag(*files.content(spec.tag))
        if finite[-1] <= finite[0]:
            raise InputError(table.label, f"column {spec.column}", "times do not rise")
        return gps_to_posix(first + (t - finite[0]) * (last - first) / (finite[-1] - finite[0]))
    if spec.base == "clock":
        assert spec.tie is not None
        own = files.table(spec.tie, outer).numbers(spec.tie.column) * TIME_UNITS[spec.tie.unit]
        posix = _time(files, spec.tie.posix, spec.tie)
        if own.size != posix.size:
            raise InputError(table.label, f"tie: {own.size} times of the clock for {posix.size} POSIX times")
        return np.asarray(t + np.nanmedian(posix - own))
    return t


def _imported(files: _Files, spec: ReceivedSpec) -> Streams:
    """What the importer of this name finds in the file."""
    assert spec.importer is not None
    importer = load_importer(spec.importer)
    name = spec.file
    for source in files.sources:
        found = source.find(name) if name else None
        if found is not None and source.path.is_dir():
            return read_source(Source(source.path / found), importer)
        if found is not None or name is None:
            return read_source(source, importer)
    beside = files.sources[0].path.parent / str(name)
    if beside.is_file():
        return read_source(Source(beside), importer)
    raise InputError(files.sources[0].path, str(name), "is not there (the mapping asks for it)")


def _received_time(files: _Files, spec: ReceivedSpec) -> Floats:
    assert spec.time is not None
    return _time(files, spec.time, spec) - spec.lag


def _fix(files: _Files, spec: FixSpec) -> None:
    if spec.importer is not None:
        found = _imported(files, spec)
        fix = found.fix
        if fix is None:
            raise InputError(spec.file or files.sources[0].path, "holds no positions")
        files.streams.notes += found.notes
        files.streams.warnings += found.warnings
        files.streams.fix = replace(fix, t=fix.t - spec.lag, frame=spec.frame)
        return
    table = files.table(spec, None)
    assert spec.latitude is not None and spec.longitude is not None
    t = _received_time(files, spec)
    scale = ANGLE_UNITS[spec.unit]
    nothing = np.full(t.size, np.nan)
    altitude = nothing if spec.altitude is None else table.numbers(spec.altitude)
    sigma = np.stack([nothing] * 3 if spec.sigma is None else [table.numbers(c) for c in spec.sigma], axis=1)
    status = np.zeros(t.size) if spec.status is None else np.nan_to_num(table.numbers(spec.status), nan=-1.0)
    latitude, longitude = table.numbers(spec.latitude) * scale, table.numbers(spec.longitude) * scale
    if not t.size == latitude.size == longitude.size:
        raise InputError(table.label, f"{latitude.size} positions for {t.size} stamps")
    files.streams.fix = FixData(t, latitude, longitude, altitude, status.astype(np.int8), sigma, spec.frame)


def _velocity(files: _Files, spec: VelocitySpec) -> None:
    if spec.derive:
        return
    if spec.importer is not None:
        found = _imported(files, spec).velocity
        if found is None:
            raise InputError(
                spec.file or files.sources[0].path, "holds no velocities: give derive: true instead"
            )
        files.streams.velocity = replace(found, t=found.t - spec.lag)
        return
    table = files.table(spec, None)
    t, scale = _received_time(files, spec), SPEED_UNITS[spec.unit]
    if spec.speed is not None and spec.bearing is not None:
        degrees = table.numbers(spec.bearing) * ANGLE_UNITS[spec.bearing_unit]
        files.streams.velocity = velocities_from_course(t, table.numbers(spec.speed) * scale, degrees)
        files.streams.notes.append("velocity: from speed and bearing")
        return
    assert spec.east is not None and spec.north is not None
    up = np.zeros(t.size) if spec.up is None else table.numbers(spec.up)
    enu = np.stack([table.numbers(spec.east), table.numbers(spec.north), up], axis=1) * scale
    files.streams.velocity = VelocityData(t, enu)


def _heading(files: _Files, spec: HeadingSpec) -> None:
    if spec.importer is not None:
        files.streams.heading = _imported(files, spec).heading
        return
    assert spec.column is not None
    yaw = np.radians(files.table(spec, None).numbers(spec.column) * ANGLE_UNITS[spec.unit])
    if spec.convention == "compass":
        yaw = np.pi / 2 - yaw
    t = _received_time(files, spec)
    files.streams.heading = HeadingData(t, np.asarray((yaw + np.pi) % (2 * np.pi) - np.pi))
