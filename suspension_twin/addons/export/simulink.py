# SPDX-License-Identifier: Apache-2.0
"""Simulink: a struct ``twin`` for the workspace of MATLAB, as a script (.m) or as a MAT-file (.mat).

Beside the keys of the twin file each axle has its look-up tables as blocks want them: ``spring_table`` and
``damper_table`` with ``breakpoints`` and ``values``, through the origin, the damper's over positive (push) and
negative (pull) velocity.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.io import savemat

from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.arrays import Floats
from suspension_twin.errors import printable
from suspension_twin.files import replacing, write_text
from suspension_twin.vehicle.twin import Suspension, Twin

__all__ = ["TARGET"]

#: A value of the workspace: a struct, a row of numbers, a number or a text.
Struct: TypeAlias = dict[str, "Struct"] | Floats | float | str
_NUMBERS_A_LINE = 6  # of the .m file, which is then narrower than 120 columns


def _tables(axle: Suspension) -> dict[str, dict[str, list[float]]]:
    """Look-up tables of an axle."""
    (x, f), (push, more), (pull, less) = (
        getattr(axle.part, name).points for name in ("spring", "damper_push", "damper_pull")
    )
    return {
        "spring_table": {"breakpoints": [0.0, *x], "values": [0.0, *f]},
        "damper_table": {
            "breakpoints": [*-pull[::-1], 0.0, *push],
            "values": [*-less[::-1], 0.0, *more],
        },
    }


def _struct(value: object) -> Struct:
    """A value of the twin file as MATLAB has it."""
    if isinstance(value, Mapping):
        return {str(key): _struct(item) for key, item in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        # such as the stations of a track: a row for each quantity
        return {str(key): _struct([item[key] for item in value]) for key in value[0]}
    if isinstance(value, list):
        return np.array(value, dtype=np.float64)
    return value if isinstance(value, str) else float(str(value))


def _workspace(twin: Twin) -> Struct:
    data = twin.model_dump(mode="json", exclude_none=True, exclude={"road"})
    effects = data.pop("effects")
    if effects:
        data["effects"] = {effect["id"]: effect["parameters"] for effect in effects}
    for name, axle in twin.axles.items():
        own = data["vehicle"][name] if name else data["vehicle"]
        own.update(_tables(axle), static_compression=axle.static_compression)
    return _struct(data)


def _lines(name: str, value: Struct) -> Iterator[str]:
    """Assignments that make a struct."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _lines(f"{name}.{key}", item)
    elif isinstance(value, str):
        text = printable(value).replace("'", "''")
        yield f"{name} = '{text}';"
    elif isinstance(value, np.ndarray):
        numbers = [_number(x) for x in value.tolist()]
        rows = [numbers[i : i + _NUMBERS_A_LINE] for i in range(0, len(numbers), _NUMBERS_A_LINE)]
        listed = ", ...\n    ".join(", ".join(row) for row in rows)
        yield f"{name} = [{listed}];"
    else:
        yield f"{name} = {_number(value)};"


def _number(value: float) -> str:
    return repr(value) if math.isfinite(value) else "NaN"


def _write(twin: Twin, path: Path, settings: ExportSettings) -> Sequence[str]:
    workspace = _workspace(twin)
    if path.suffix.lower() == ".mat":
        with replacing(path) as temporary:
            savemat(temporary, {"twin": workspace}, appendmat=False, long_field_names=True)
        return ()
    notes = []
    if not re.fullmatch(r"[A-Za-z]\w*", path.stem):
        notes.append(f"MATLAB runs a script by its name, and {path.stem} is none that it takes")
    lines = [
        f"% {printable(twin.vehicle.name)}: springs, dampers and masses of a twin. SI units, forces at the wheel.",
        "% Compressions count from the free length of the spring; a damper's push is positive.",
        *_lines("twin", workspace),
    ]
    write_text(path, "\n".join(lines) + "\n")
    return notes


TARGET = Target("a struct for MATLAB and Simulink, .m or .mat", (".m", ".mat"), _write)
