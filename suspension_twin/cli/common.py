# SPDX-License-Identifier: Apache-2.0
"""What several subcommands share: their common arguments, and where the bundled files are."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import suspension_twin
from suspension_twin.errors import InputError

__all__ = ["Bag", "Bags", "Seed", "TwinFile", "bundled", "print_diagnosis", "stage_bar"]

TwinFile = Annotated[
    Path, typer.Option("--twin", help="The twin file.", metavar="TWIN.YAML", show_default=False)
]
Bag = Annotated[
    Path,
    typer.Argument(
        help="A recorded drive: a rosbag2 folder or a bare file.", metavar="BAG", show_default=False
    ),
]
Bags = Annotated[
    list[Path],
    typer.Argument(help="Recorded drives: rosbag2 folders or bare files.", metavar="BAG", show_default=False),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of every random choice.", min=0)]


def bundled(*parts: str) -> Path:
    """The path of a file or folder that comes with the program, such as ``bundled("config", "twins")``.

    From a source tree it lies there; otherwise where the installation put it: ``share/suspension_twin`` under the
    environment (pip) or under the package's own prefix (colcon). Raises :class:`InputError` if it is nowhere.
    """
    package = Path(suspension_twin.__file__).resolve().parent
    # colcon installs the code to <prefix>/lib/pythonX.Y/site-packages and the rest to <prefix>/share.
    prefixes = [Path(sys.prefix), *package.parents[3:5]]
    roots = [package.parent, *(p / "share" / "suspension_twin" for p in prefixes)]
    for root in roots:
        if (root / "package.xml").is_file() and (found := root.joinpath(*parts)).exists():
            return found
    raise InputError(
        "/".join(parts), f"is missing from the installation, looked in {', '.join(map(str, roots))}"
    )


def stage_bar() -> Progress:
    """A bar with the stage of the work on it, on standard error, gone when it is over; nothing where no one looks."""
    errors = Console(stderr=True)
    columns = TextColumn("{task.description:<44}"), BarColumn(), TimeElapsedColumn()
    return Progress(*columns, console=errors, disable=not errors.is_terminal, transient=True)


def print_diagnosis(document: Mapping[str, Any], out: Path) -> None:
    """What ``diagnosis.json`` holds in a few lines: warnings, verdict, the first causes, and the folder ``out``."""
    from suspension_twin.diagnosis.output import values_of

    console = Console(highlight=False, soft_wrap=True)
    for warning in document["warnings"]:
        console.print(f"[yellow]{warning}[/]")
    console.print(f"[bold]{document['verdict']}[/]: {document['message']}")
    table = Table()
    for name in ("cause", "probability", "shrink", "interval", "parameters"):
        table.add_column(name)
    for cause in document["causes"][:5]:
        low, high = cause["shrink_interval"]
        table.add_row(
            cause["effect"],
            f"{cause['probability']:.3f}",
            f"{cause['shrink']:.2f}",
            f"{low:.2f} to {high:.2f}",
            values_of(cause),
        )
    console.print(table)
    console.print(
        f"no gap {document['no_gap_probability']:.3f}, unknown {document['unknown_probability']:.3f}. "
        f"{document['next_experiment']}"
    )
    console.print(f"Written to {out}")
