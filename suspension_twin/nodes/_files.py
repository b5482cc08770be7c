# SPDX-License-Identifier: Apache-2.0
"""Parameters that several nodes share: the twin file and the low-pass."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import yaml

from suspension_twin.calibration.output import details_path
from suspension_twin.errors import InputError
from suspension_twin.nodes._parameters import Param, Values
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["FILTER", "TWIN", "Left", "filter_of", "left_by_calibration", "twin_of"]

_DEFAULT = FilterSpec()

TWIN = Param("twin", "", "Path of the twin file; the node starts afresh when it is set. Empty: none.")

#: The same in imu_ingest and suspension_model, or measured and simulated cannot be compared.
FILTER = (
    Param("filter.order", _DEFAULT.order, "Order of the Butterworth low-pass.", 1, 8),
    Param("filter.cutoff", _DEFAULT.cutoff, "Cut-off (-3 dB) of the low-pass in Hz.", 0.1, 800.0),
)


@lru_cache(maxsize=16)
def _load(path: str, _changed: int) -> Twin:
    return load_twin(path)


def twin_of(values: Values) -> Twin | None:
    """The twin of the parameter ``twin``, read again when the file has changed; None if not set.

    Raises InputError that names the file and the key.
    """
    path = values["twin"]
    if not path:
        return None
    try:
        changed = Path(path).stat().st_mtime_ns
    except OSError as error:
        raise InputError(path, error.strerror or "cannot be read") from None
    return _load(path, changed)


def filter_of(values: Values) -> FilterSpec:
    """The low-pass that the parameters describe."""
    return FilterSpec(values["filter.order"], values["filter.cutoff"])


class Left(NamedTuple):
    """What a calibration left on its worst drive: the gap's rms in m/s², and as a ``share`` of the motion's, which
    tells what to expect where the road is rougher. Both 0 where it is not known."""

    rms: float
    share: float


def left_by_calibration(twin_file: str) -> Left:
    """What the calibration of this twin file left, as the details beside it say; nothing where there are none.

    Raises InputError for details that cannot be read.
    """
    if not twin_file:
        return Left(0.0, 0.0)
    details = details_path(Path(twin_file))
    if not details.is_file():
        return Left(0.0, 0.0)
    try:
        drives = yaml.safe_load(details.read_text(encoding="utf-8"))["drives"]
        # Live nothing takes clock, gain and tilt out: the larger of the two is what will be seen.
        left = [max(d["gap_after"]["rms"], d["residual_with_nuisances_corrected"] or 0.0) for d in drives]
        share = [math.sqrt(1.0 - min(abs(d["correlation"] or 1.0), 1.0) ** 2) for d in drives]
    except (OSError, ValueError, RecursionError, yaml.YAMLError, KeyError, TypeError):
        raise InputError(details, "drives", "does not say what gap the calibration left") from None
    known = [gap for gap in left if math.isfinite(gap)]
    return Left(max(known, default=0.0), max(share, default=0.0))
