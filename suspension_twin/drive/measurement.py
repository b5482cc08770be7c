# SPDX-License-Identifier: Apache-2.0
"""Measurement files of test benches and loggers, in a process with limits: ASAM MDF (``.mf4``, ``.mdf``) by asammdf,
the extra ``mdf``, and TDMS (``.tdms``) by npTDMS, the extra ``tdms``.

Each channel has stamps of its own, in s from the start of the measurement; here those of one section of a mapping
become the columns of one table. Channels of TDMS that are no waveforms have none: they are columns of a table by rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from typing import Final, Protocol

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.foreign_files import DataTable
from suspension_twin.drive.unpack import Budget, within_limits
from suspension_twin.errors import InputError

__all__ = ["MeasuredTable", "Measurement", "open_measurement"]


class Signal(Protocol):
    """Values of a channel at its stamps in s, as asammdf gives them."""

    timestamps: Floats
    samples: Floats


class _Mdf(Protocol):
    """The part of ``asammdf.MDF`` that is used."""

    start_time: datetime
    channels_db: Mapping[str, object]

    def get(self, name: str) -> Signal: ...


class _Waveform(Protocol):
    """The part of ``nptdms.TdmsChannel`` that is used."""

    name: str
    group_name: str
    properties: Mapping[str, object]

    def read_data(self) -> Floats: ...


def _opened(data: bytes) -> _Mdf:
    measurement: _Mdf = import_module("asammdf").MDF(BytesIO(data))
    return measurement


def _outline(data: bytes) -> tuple[float, list[str]]:
    measurement = _opened(data)
    return measurement.start_time.timestamp(), list(measurement.channels_db)


def _channels(data: bytes, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
    signals = map(_opened(data).get, names)
    return [(np.asarray(s.timestamps, np.float64), np.asarray(s.samples, np.float64)) for s in signals]


def _waveforms(data: bytes) -> tuple[float, dict[str, _Waveform]]:
    """The earliest start of a waveform in POSIX s, 0 where none has one, and channels by ``group/channel``."""
    groups = import_module("nptdms").TdmsFile.open(BytesIO(data)).groups()
    channels = {f"{c.group_name}/{c.name}": c for group in groups for c in group.channels()}
    starts = [_start(c) for c in channels.values() if "wf_start_time" in c.properties]
    return min(starts, default=0.0), channels


def _start(channel: _Waveform) -> float:
    return np.datetime64(channel.properties["wf_start_time"], "ns").astype(np.int64) * 1e-9  # type: ignore[call-overload, no-any-return]


def _tdms_outline(data: bytes) -> tuple[float, list[str]]:
    start, channels = _waveforms(data)
    return start, list(channels)


def _tdms_channels(data: bytes, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
    start, channels = _waveforms(data)
    found = []
    for channel in map(channels.__getitem__, names):
        values, own = np.asarray(channel.read_data(), np.float64), channel.properties
        t = np.empty(0)
        if "wf_increment" in own:
            after = _start(channel) - start if "wf_start_time" in own else 0.0
            offset, step = (float(str(own.get(f"wf_{key}", 0.0))) for key in ("start_offset", "increment"))
            t = after + offset + step * np.arange(values.size)
        found.append((t, values))
    return found


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
    b"MDF     ": _Format("an MDF file", "asammdf", "mdf", _outline, _channels),
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
