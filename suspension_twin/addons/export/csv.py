# SPDX-License-Identifier: Apache-2.0
"""CSV: every number of a twin, a row each, by the key that it has in the twin file."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.calibration.labels import parameter_unit
from suspension_twin.files import write_text
from suspension_twin.models.parameters import layout, pack
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGET"]


def _write(twin: Twin, path: Path, settings: ExportSettings) -> Sequence[str]:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("key", "value", "unit"))
    for key, value in zip(layout(twin).names, pack(twin).tolist(), strict=True):
        table.writerow((key, repr(value), parameter_unit(key)))
    write_text(path, text.getvalue())
    return ()


TARGET = Target("every number with its key and unit", (".csv",), _write)
