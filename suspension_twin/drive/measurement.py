# SPDX-License-Identifier: Apache-2.0
"""Measurement files of test benches and loggers, in a process with limits: ASAM MDF (``.mf4``, ``.mdf``) by asammdf,
the extra ``mdf``, and TDMS (``.tdms``) by npTDMS, the extra ``tdms``.

Each channel has stamps of its own, in s from the start of the measurement; here those of one section of a mapping
become the columns of one table. Channels of TDMS that are no waveforms have none: they are columns of a table by rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from typing import Any, Final

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.foreign_files import DataTable
from suspension_twin.drive.unpack import Budget, within_limits
from suspension_twin.errors import InputError

__all__ = ["MeasuredTable", "Measurement", "open_measurement"]


def _mdf(data: bytes) -> Any:
    return import_module("asammdf").MDF(BytesIO(data))


def _mdf_outline(data: bytes) -> tuple[float, list[str]]:
    measurement = _mdf(data)
    return measurement.start_time.timestamp(), list(measurement.channels_db)


def _mdf_channels(data: bytes, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
    signals = map(_mdf(data).get, names)
    return [(np.asarray(s.timestamps, np.float64), np.asarray(s.samples, np.float64)) for s in signals]


def _tdms(data: bytes) -> dict[str, Any]:
    groups = import_module("nptdms").TdmsFile.open(BytesIO(data)).groups()
    return {f"{c.group_name}/{c.name}": c for group in groups for c in group.channels()}


def _start(channel: Any) -> float:
    """POSIX s at which a waveform begins, NaN where that is not said."""
    start = channel.properties.get("wf_start_time")
    return np.nan if start is None else float(np.datetime64(start, "us").astype(np.int64)) * 1e-6


def _tdms_outline(data: bytes) -> tuple[float, list[str]]:
    channels = _tdms(data)
    starts = [start for start in map(_start, channels.values()) if start == start]
    return min(starts, default=0.0), list(channels)


def _tdms_channels(data: bytes, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
    channels, (earliest, _) = _tdms(data), _tdms_outline(data)
    return [
        (_stamps(channels[name], earliest), np.asarray(channels[name].read_data(), np.float64))
        for name in names
    ]


def _stamps(channel: Any, earliest: float) -> Floats:
    """Stamps (n,) of a waveform in s from the ``earliest`` one's start; none of any other channel."""
    own = channel.properties
    if "wf_increment" not in own:
        return np.empty(0)
    after = np.nan_to_num(_start(channel) - earliest) + float(own.get("wf_start_offset", 0.0))
    return np.asarray(after + float(own["wf_increment"]) * np.arange(len(channel)))


@dataclass(frozen=True)
class _Format:
    """How a file is called, the module and the package of its extra, and what is read of its bytes: start and names,
    and stamps and values of some channels."""

    kind: str
    module: str
    extra: str
    outline: Callable[[bytes], tuple[float, list[str]]]
    channels: Callable[[bytes, Sequence[str]], list[tuple[Floats, Floats]]]


_FORMATS: Final = {
    b"MDF     ": _Format("an MDF file", "asammdf", "mdf", _mdf_outline, _mdf_channels),
    b"TDSm": _Format("a TDMS file", "nptdms", "tdms", _tdms_outline, _tdms_channels),
}


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement file: its bytes, its ``start`` in POSIX s and the names of its channels."""

    data: bytes
    label: str
    format: _Format
    start: float
    names: Sequence[str]

    def channels(self, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
        """Stamps in s from the start, none where a channel has none, and values of some channels."""
        read, budget = self.format, Budget(self.label, len(self.data))
        return within_limits(
            read.channels, self.data, names, budget=budget, kind=read.kind, module=read.module
        )


def open_measurement(data: bytes, label: str) -> Measurement | None:
    """A measurement from the bytes of its file, None where they are no measurement's; InputError where its library is
    missing or cannot read it."""
    read = next((form for magic, form in _FORMATS.items() if data.startswith(magic)), None)
    if read is None:
        return None
    if find_spec(read.module) is None:
        library = {"nptdms": "npTDMS"}.get(read.module, read.module)
        raise InputError(label, f'{read.kind} needs {library}: pip install "suspension-twin[{read.extra}]"')
    budget = Budget(label, len(data))
    outline = within_limits(read.outline, data, budget=budget, kind=read.kind, module=read.module)
    return Measurement(data, label, read, *outline)


@dataclass
class MeasuredTable(DataTable):
    """Channels at the stamps of the one that is asked for first, linear between their own; column 0 is POSIX time.
    Where one of both has no stamps, row by row."""

    measurement: Measurement | None = None
    stamps: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def rows(self) -> int:
        """Number of stamps."""
        return int(self.stamps.size)

    def text(self, key: str | int) -> tuple[str, ...]:
        """A channel holds no text here."""
        raise InputError(self.label, f"channel {key}", "is read as numbers: take time: {} for its time")

    def numbers(self, key: str | int) -> Floats:
        """Values (rows,) of a channel, NaN beyond its stamps."""
        if key == 0:
            assert self.measurement is not None
            if np.isnan(self.stamps).any():
                raise InputError(
                    self.label, "time", "channels without stamps: name the one that is their time"
                )
            return self.stamps + self.measurement.start
        return self.vector([key])[:, 0]

    def vector(self, keys: Sequence[str | int]) -> Floats:
        """Channels side by side (rows, len(keys)), NaN beyond their stamps."""
        assert self.measurement is not None
        names = [str(key) for key in keys]
        for key, name in zip(keys, names, strict=True):
            if key != name or name not in self.measurement.names:
                known = ", ".join(self.measurement.names[:40])
                raise InputError(self.label, f"channel {key}", f"is not there; the channels are {known}")
        found = self.measurement.channels(names)
        if not self.stamps.size:
            t, values = found[0]
            self.stamps = t if t.size else np.full(values.size, np.nan)
        return np.stack([self._at(name, *one) for name, one in zip(names, found, strict=True)], axis=1)

    def _at(self, name: str, t: Floats, values: Floats) -> Floats:
        """Values (rows,) of a channel at the stamps of the table."""
        if t.size and not np.isnan(self.stamps).any():
            return np.interp(self.stamps, t, values, left=np.nan, right=np.nan)
        if values.size != self.rows:
            raise InputError(
                self.label, f"channel {name}", f"has {values.size} values and no stamps for {self.rows} rows"
            )
        return values
