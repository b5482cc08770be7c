# SPDX-License-Identifier: Apache-2.0
"""Measurement files of test benches and loggers, ASAM MDF (``.mf4``, ``.mdf``), read by asammdf, the extra ``mdf``.

Each channel has stamps of its own, in s from the start of the measurement; here those of one section of a mapping
become the columns of one table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from importlib import import_module
from io import BytesIO
from typing import Final, Protocol

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.drive.foreign_files import DataTable
from suspension_twin.errors import InputError
from suspension_twin.files import reading

__all__ = ["MDF_MAGIC", "MeasuredTable", "Measurement", "open_mdf"]

MDF_MAGIC: Final = b"MDF     "


class Signal(Protocol):
    """Values of a channel at its stamps in s, as asammdf gives them."""

    timestamps: Floats
    samples: Floats


class Measurement(Protocol):
    """The part of ``asammdf.MDF`` that is used."""

    start_time: datetime
    channels_db: Mapping[str, object]

    def get(self, name: str) -> Signal:
        """One channel."""
        ...


def open_mdf(data: bytes, label: str) -> Measurement:
    """A measurement from the bytes of its file; InputError where asammdf is missing or cannot read it."""
    try:
        module = import_module("asammdf")
    except ImportError:
        raise InputError(label, 'an MDF file needs asammdf: pip install "suspension-twin[mdf]"') from None
    with reading(label, "an MDF file"):
        measurement: Measurement = module.MDF(BytesIO(data))
        return measurement


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
        assert self.measurement is not None
        if key == 0:
            return self.stamps + self.measurement.start_time.timestamp()
        if isinstance(key, int) or key not in self.measurement.channels_db:
            known = ", ".join(list(self.measurement.channels_db)[:40])
            raise InputError(self.label, f"channel {key}", f"is not there; the channels are {known}")
        with reading(self.label, "an MDF file"):
            signal = self.measurement.get(key)
            values = np.asarray(signal.samples, dtype=np.float64)
        if not self.stamps.size:
            self.stamps = np.asarray(signal.timestamps, dtype=np.float64)
        if not values.size:
            return np.full(self.stamps.size, np.nan)
        return np.interp(self.stamps, signal.timestamps, values, left=np.nan, right=np.nan)
