# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin salvage``: a cut-off, damaged or index-less recording, made readable."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.cli.common import Force, Outputs, output
from suspension_twin.drive.recording import read_recording
from suspension_twin.drive.write import BagWriter, write_contents

__all__ = ["command"]


def command(
    bag: Annotated[
        Path,
        typer.Argument(
            metavar="BAG",
            help="A rosbag2 folder, with or without metadata.yaml, or an .mcap, .db3 or ROS 1 .bag file.",
        ),
    ],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="BAG", help="The bag to write: a folder, or a file if it ends in .mcap."
        ),
    ],
    force: Force = False,
) -> None:
    """A cut-off, damaged or index-less recording into a whole one, with all of its topics.

    Prints what each topic still holds and what was lost. The recording itself is not changed.
    """
    console = output()
    outputs = Outputs(out, force=force)
    BagWriter(out, overwrite=force)  # replaces nothing but a recording
    contents = read_recording(bag)
    outputs.announce()
    with outputs:
        write_contents(contents, out, overwrite=force)
    for name, topic in contents.topics.items():
        seconds = 1e-9 * (topic.stamps[-1] - topic.stamps[0]) if topic.stamps else 0.0
        console.print(f"{name}: {len(topic.data)} messages over {seconds:.1f} s", markup=False)
    for text in contents.warnings:
        console.print(f"warning: {text}", markup=False)
