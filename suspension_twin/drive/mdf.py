# SPDX-License-Identifier: Apache-2.0
"""Measurement files of test benches and loggers, ASAM MDF (``.mf4``, ``.mdf``), read by asammdf, the extra ``mdf``,
in a process with limits.

Each channel has stamps of its own, in s from the start of the measurement; here those of one section of a mapping
become the columns of one table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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

__all__ = ["MDF_MAGIC", "MeasuredTable", "Measurement", "open_mdf"]

MDF_MAGIC: Final = b"MDF     "
_KIND: Final = {"kind": "an MDF file", "module": "asammdf"}


class Signal(Protocol):
    """Values of a channel at its stamps in s, as asammdf gives them."""

    timestamps: Floats
    samples: Floats


class _File(Protocol):
    """The part of ``asammdf.MDF`` that is used."""

    start_time: datetime
    channels_db: Mapping[str, object]

    def get(self, name: str) -> Signal: ...


def _opened(data: bytes) -> _File:
    measurement: _File = import_module("asammdf").MDF(BytesIO(data))
    return measurement


def _outline(data: bytes) -> tuple[float, list[str]]:
    measurement = _opened(data)
    return measurement.start_time.timestamp(), list(measurement.channels_db)


def _channels(data: bytes, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
    signals = map(_opened(data).get, names)
    return [(np.asarray(s.timestamps, np.float64), np.asarray(s.samples, np.float64)) for s in signals]


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement file: its bytes, its ``start`` in POSIX s and the names of its channels."""

    data: bytes
    label: str
    start: float
    names: Sequence[str]

    def channels(self, names: Sequence[str]) -> list[tuple[Floats, Floats]]:
        """Stamps in s from the start and values of some channels."""
        budget = Budget(self.label, len(self.data))
        return within_limits(_channels, self.data, names, budget=budget, **_KIND)


def open_mdf(data: bytes, label: str) -> Measurement:
    """A measurement from the bytes of its file; InputError where asammdf is missing or cannot read it."""
    if find_spec("asammdf") is None:
        raise InputError(label, 'an MDF file needs asammdf: pip install "suspension-twin[mdf]"')
    budget = Budget(label, len(data))
    return Measurement(data, label, *within_limits(_outline, data, budget=budget, **_KIND))


@dataclass
class MeasuredTable(DataTable):
    """Channels at the stamps of the one that is asked for first, linear between their own; column 0 is POSIX time."""

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
            self.stamps = found[0][0]
        columns = np.full((self.stamps.size, len(found)), np.nan)
        for column, (t, values) in zip(columns.T, found, strict=True):
            if t.size:
                column[:] = np.interp(self.stamps, t, values, left=np.nan, right=np.nan)
        return columns
