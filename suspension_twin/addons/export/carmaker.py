# SPDX-License-Identifier: Apache-2.0
"""CarMaker: springs and dampers as look-up tables in the lines of its vehicle file.

Written alone, to be pasted, or into a copy of a vehicle file, whose own lines for them are replaced: what the car
paper's calibration did after every candidate.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from suspension_twin.addons.export.registry import ExportSettings, Target
from suspension_twin.errors import InputError, printable
from suspension_twin.files import read_bytes, write_text
from suspension_twin.models.parameters import layout
from suspension_twin.vehicle.twin import Twin

__all__ = ["TARGET"]

#: Key of the vehicle file for each part of an axle.
_PARTS: Final = (("Spring", "spring"), ("Damp_Push", "damper_push"), ("Damp_Pull", "damper_pull"))
_AXLES: Final = (("SuspF", "front"), ("SuspR", "rear"))
_LARGEST: Final = 16 << 20  # bytes of a vehicle file


def _tables(twin: Twin) -> dict[str, list[str]]:
    """Lines by the key of their table: a factor of 1, then a row for the origin and each point."""
    if set(twin.axles) != {"front", "rear"}:
        raise InputError(
            "twin", "model", f"{twin.model} has no front and rear axle with springs for CarMaker"
        )
    tables = {}
    for prefix, axle in _AXLES:
        for word, name in _PARTS:
            key, points = f"{prefix}.{word}", zip(*getattr(twin.axles[axle].part, name).points, strict=True)
            rows = [f"\t{x:.9g} {force:.9g}" for x, force in ((0.0, 0.0), *points)]
            tables[key] = [f"{key}.Amplify = 1.0", f"{key}:", *rows]
    return tables


def _replaced(text: str, tables: dict[str, list[str]], source: Path) -> str:
    """The vehicle file with these tables in the places of its own."""
    remaining = dict(tables)

    def table(own: re.Match[str]) -> str:
        return "".join(f"{line}\n" for line in remaining.pop(own[1], ()))

    # a value on the line, or a table: the lines below that begin with white space
    keys = "|".join(map(re.escape, tables))
    text = re.sub(
        rf"^({keys})(?:\.Amplify)?[ \t]*(?:=.*|:.*(?:\n[ \t].*)*)\n?", table, text, flags=re.MULTILINE
    )
    for key in remaining:
        raise InputError(source, f"is no vehicle file of CarMaker with a line {key}")
    return text


def _write(twin: Twin, path: Path, settings: ExportSettings) -> Sequence[str]:
    tables = _tables(twin)
    if settings.into is None:
        head = [
            f"# {printable(twin.vehicle.name)}: springs and dampers of a twin, m, m/s and N, at the wheel",
            "",
        ]
        text = "\n".join([*head, *(line for lines in tables.values() for line in lines), ""])
    else:
        known = read_bytes(settings.into, _LARGEST)
        try:
            given = known.decode("utf-8")
        except UnicodeDecodeError:
            given = known.decode("latin-1")
        text = _replaced(given.replace("\r\n", "\n"), tables, settings.into)
    write_text(path, text)
    notes = [
        "Forces are those at the wheel, which is right for a kinematics with a ratio of 1 between wheel and strut. A "
        "spring's compression counts from its free length, which CarMaker has as Spring.l0."
    ]
    others = ", ".join(layout(twin).hooks)
    return [*notes, f"Not in the tables: {others}"] if others else notes


TARGET = Target("look-up tables for a vehicle file of CarMaker", (), _write, ("into",))
