# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin simulate``: the twin over a recorded drive or run of a rig, without ROS."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Bag, Force, Outputs, TwinFile, output, print_table

__all__ = ["command"]


class Policy(str, Enum):
    """Heights where a drive leaves the road."""

    ROAD = "road"
    HOLD = "hold"
    ZERO = "zero"
    ERROR = "error"


def command(
    twin: TwinFile,
    bag: Bag,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="Folder for the result.", metavar="DIR", file_okay=False, show_default=False
        ),
    ],
    off_road: Annotated[
        Policy,
        typer.Option(
            "--off-road",
            help="Heights where the drive leaves the road: as its file says, of its border, 0 m, or an error.",
        ),
    ] = Policy.ROAD,
    force: Force = False,
) -> None:
    """The twin over a recorded drive or run of a rig, without ROS.

    Writes DIR/gap.json, the rms of measured minus simulated by channel. Of a drive it writes DIR/simulated, a
    recording of the twin's topics with a message for every IMU sample, of a run of a rig DIR/simulated.csv.
    """
    from suspension_twin.api import read_recording, simulate
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
    with outputs:
        recording = read_recording(bag, loaded)
        outputs.announce()
        result = simulate(recording, loaded, outside=off_road.value)
        result.write(out)
    console = output()
    for warning in result.warnings:
        console.print(f"{result.name}: {warning}", style="yellow")
    correlation = result.correlation
    rows = [
        (
            name.replace("_", " "),
            channel_unit(name),
            f"{rms:.4g}",
            f"{result.noise_rms[name]:.4g}",
            f"{correlation[name]:.2f}",
        )
        for name, rms in result.gap.channels.items()
    ]
    title = f"Gap over {result.gap.seconds:.1f} s of {result.name}: rms of measured minus simulated"
    columns = ("channel", "unit", "rms", "noise", "correlation")
    print_table(console, title, columns, rows, words=("channel", "unit"))
    console.print(f"Written to {written[0]} and {written[1]}")
