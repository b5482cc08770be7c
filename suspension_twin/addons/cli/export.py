# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin export``: a twin in the files of other simulators."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, output

__all__ = ["command"]


class Fmi(str, Enum):
    """Versions of the interface of an FMU."""

    TWO = "2.0"
    THREE = "3.0"


def command(
    twin: Annotated[Path, typer.Argument(help="The twin file.", metavar="TWIN.YAML", show_default=False)],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            help="What the file is for: fmu, carmaker, simulink, unity, csv, or the exporter of a plugin.",
            metavar="TARGET",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="The file to write.", metavar="FILE", show_default=False)
    ],
    into: Annotated[
        Path | None,
        typer.Option(
            "--into",
            help="carmaker: copy this vehicle file, with its springs and dampers replaced.",
            metavar="VEHICLE",
            show_default=False,
        ),
    ] = None,
    fmi: Annotated[Fmi, typer.Option("--fmi", help="fmu: the version of the interface.")] = Fmi.TWO,
    force: Force = False,
) -> None:
    """A twin in the files of other simulators: docs/export.md.

    What of the twin a target cannot hold is said.
    """
    from suspension_twin.addons.export.registry import TARGETS, ExportSettings, export_twin
    from suspension_twin.vehicle.twin import load_twin

    TARGETS.named(to, "--to")
    outputs = Outputs(out, force=force)
    loaded = load_twin(twin)
    outputs.announce()
    with outputs:
        notes = export_twin(loaded, to, out, ExportSettings(into, fmi.value))
    console = output()
    for note in notes:
        console.print(note, style="yellow")
    console.print(f"Written to {out}: {loaded.vehicle.name} ({loaded.model})")
