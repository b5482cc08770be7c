# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin simulate``: the twin over a recorded drive or run of a rig, without ROS."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from suspension_twin.cli.common import Bag, Force, Outputs, TwinFile, output, print_table

if TYPE_CHECKING:
    from suspension_twin.inference.runs import SimulatedRun
    from suspension_twin.inference.simulated import SimulatedDrive

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
    """The twin over a recorded drive or run of a rig, without ROS.

    Writes DIR/gap.json, how far the twin is from what was measured, and of a drive DIR/simulated, a recording of what
    the twin's topics carry for every IMU sample, of a run of a rig DIR/simulated.csv.
    """
    from suspension_twin.drive.write import BagWriter
    from suspension_twin.inference.gap import channel_unit
    from suspension_twin.models.registry import model_of
    from suspension_twin.vehicle.twin import load_twin

    loaded = load_twin(twin)
    on_rig = model_of(loaded).recordings == "rig"
    written = out / ("simulated.csv" if on_rig else "simulated"), out / "gap.json"
    outputs = Outputs(*written, force=force)
    if not on_rig:
        BagWriter(written[0], overwrite=force)  # replaces nothing but a recording
    result: SimulatedDrive | SimulatedRun
    with outputs:
        if on_rig:
            from suspension_twin.drive.rig import read_rig
            from suspension_twin.inference.runs import simulate_rig

            record = read_rig(bag)
            outputs.announce()
            result = simulate_rig(record, loaded)
        else:
            from suspension_twin.drive.read import read_drive
            from suspension_twin.inference.observation import ObserveSettings
            from suspension_twin.inference.simulated import simulate_drive

            drive = read_drive(bag)
            outputs.announce()
            result = simulate_drive(drive, loaded, settings=ObserveSettings(outside=off_road.value))
        result.write(out)
    console = output()
    for warning in result.warnings:
        console.print(f"{result.name}: {warning}", style="yellow")
    gap = result.gap
    rows = [
        (name.replace("_", " "), channel_unit(name), f"{rms:.4g}", f"{result.noise_rms[name]:.4g}")
        for name, rms in gap.channels.items()
    ]
    title = f"Gap over {gap.seconds:.1f} s of {result.name}: measured minus simulated"
    print_table(console, title, ("channel", "unit", "rms", "noise"), rows, words=("channel", "unit"))
    console.print(f"Written to {written[0]} and {written[1]}")
