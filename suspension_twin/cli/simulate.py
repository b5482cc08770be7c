# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin simulate``: the twin over a recorded drive, without ROS."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Bag, Force, Outputs, TwinFile, output, print_table

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


def command(
    twin: TwinFile, bag: Bag, out: Out, off_road: OffRoad = Policy.ROAD, force: Force = False
) -> None:
    """The twin over a recorded drive, without ROS.

    Writes DIR/simulated, a recording of what the twin's topics carry for every IMU sample, and DIR/gap.json,
    how far that is from what was measured.
    """
    from suspension_twin.drive.read import read_drive
    from suspension_twin.drive.write import BagWriter
    from suspension_twin.gap.prepare import PrepareSettings
    from suspension_twin.gap.simulated import simulate_drive, write_simulated
    from suspension_twin.vehicle.twin import load_twin

    written = out / "simulated", out / "gap.json"
    outputs = Outputs(*written, force=force)
    BagWriter(written[0], overwrite=force)  # replaces nothing but a recording
    loaded, drive = load_twin(twin), read_drive(bag)
    outputs.announce()
    with outputs:
        result = simulate_drive(drive, loaded, settings=PrepareSettings(outside=off_road.value))
        write_simulated(result, out)
    console = output()
    for warning in result.prepared.warnings:
        console.print(f"{result.drive.name}: {warning}", style="yellow", markup=False)
    gap = result.gap
    rows = []
    for name, rms in gap.channels.items():
        unit = "rad/s" if name.endswith("rate") else "m/s²"
        rows.append((name.replace("_", " "), unit, f"{rms:.4f}", f"{result.prepared.noise_rms[name]:.4f}"))
    title = f"Gap over {gap.seconds:.1f} s of {result.drive.name}: measured minus simulated"
    print_table(console, title, ("channel", "unit", "rms", "noise"), rows, words=("channel", "unit"))
    console.print(f"Written to {written[0]} and {written[1]}")
