# SPDX-License-Identifier: Apache-2.0
"""What several subcommands share: their common arguments, and where the bundled files are."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

import suspension_twin
from suspension_twin.errors import InputError

__all__ = ["Bag", "Bags", "Seed", "TwinFile", "bundled"]

TwinFile = Annotated[Path, typer.Option("--twin", help="The twin file.", metavar="TWIN.YAML", show_default=False)]
Bag = Annotated[
    Path, typer.Argument(help="A recorded drive: a rosbag2 folder or a bare file.", metavar="BAG", show_default=False)
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
    raise InputError("/".join(parts), f"is missing from the installation, looked in {', '.join(map(str, roots))}")
