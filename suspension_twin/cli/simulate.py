# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin simulate``: the twin over a recorded drive, without ROS."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from suspension_twin.cli.common import Bag, TwinFile

__all__ = ["command"]


class Policy(str, Enum):
    """What a drive gets that leaves the road."""

    ROAD = "road"
    HOLD = "hold"
    ZERO = "zero"
    ERROR = "error"


Out = Annotated[
    Path,
    typer.Option("--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False),
]
OffRoad = Annotated[
    Policy,
    typer.Option("--off-road", help="Heights where the drive leaves the road; road: what its file says."),
]


def command(twin: TwinFile, bag: Bag, out: Out, off_road: OffRoad = Policy.ROAD) -> None:
    """The twin over a recorded drive, without ROS.

    Writes DIR/simulated, a recording of what the twin's topics carry for every IMU sample, and DIR/gap.json,
    how far that is from what was measured.
    """
    from suspension_twin.drive.read import read_drive
    from suspension_twin.gap.prepare import PrepareSettings
    from suspension_twin.gap.simulated import simulate_drive, write_simulated
    from suspension_twin.vehicle.twin import load_twin

    loaded = load_twin(twin)
    result = simulate_drive(read_drive(bag), loaded, settings=PrepareSettings(outside=off_road.value))
    out.mkdir(parents=True, exist_ok=True)
    write_simulated(result, out)
    console = Console(highlight=False, soft_wrap=True)
    for warning in result.prepared.warnings:
        console.print(f"[yellow]{result.drive.name}: {warning}[/]")
    gap = result.gap
    table = Table(
        title=f"Gap over {gap.seconds:.1f} s of {result.drive.name}", title_justify="left", title_style="bold"
    )
    table.add_column("channel")
    for name in ("rms", "floor", "unit"):
        table.add_column(name, justify="right")
    for name, rms in gap.channels.items():
        unit = "rad/s" if name.endswith("rate") else "m/s²"
        table.add_row(name.replace("_", " "), f"{rms:.4f}", f"{result.prepared.noise_rms[name]:.4f}", unit)
    console.print(table)
    console.print(f"Written to {out / 'simulated'} and {out / 'gap.json'}")
