# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin import``: a phone's or logger's recording becomes a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.padding import Padding

from suspension_twin.cli.common import Force, Outputs, output
from suspension_twin.drive.checks import summarise
from suspension_twin.drive.importing import import_drive, import_rig
from suspension_twin.drive.read import Topics
from suspension_twin.drive.rig import write_rig
from suspension_twin.drive.write import BagWriter, write_drive
from suspension_twin.signals.offline import turns_said

__all__ = ["command"]


def command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE",
            help="Files, a folder or a zip of one recording: Sensor Logger, phyphox, MATLAB Mobile, RTKLIB .pos, "
            "comma2k19, VBO, CSV of AndroSensor, SensorLog, Physics Toolbox, RaceChrono, or a bag (MCAP, sqlite3, "
            "ROS 1). Several are parts of one drive.",
        ),
    ],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="BAG",
            help="The bag to write: a folder, or a file if it ends in .mcap; of a run of a rig a .csv file.",
        ),
    ],
    mapping: Annotated[
        Path | None,
        typer.Option(
            "--mapping",
            metavar="MAP.YAML",
            help="A mapping file that names the columns of any other file, and their units (see config/import).",
        ),
    ] = None,
    imu_topic: Annotated[
        str, typer.Option(help="Of a bag: the topic of the IMU.", metavar="TOPIC")
    ] = Topics.imu,
    fix_topic: Annotated[
        str, typer.Option(help="Of a bag: the topic of the positions.", metavar="TOPIC")
    ] = Topics.fix,
    vel_topic: Annotated[
        str, typer.Option(help="Of a bag: the topic of the velocities.", metavar="TOPIC")
    ] = Topics.vel,
    heading_topic: Annotated[
        str, typer.Option(help="Of a bag: the topic of the heading.", metavar="TOPIC")
    ] = Topics.heading,
    force: Force = False,
) -> None:
    """A phone's or logger's recording into a bag.

    Prints source, rate (Hz), units, gravity's axis, gaps (s), path (km) and top speed (m/s). Axes stay those of the
    sensor: its mounting belongs into the twin file (imu.rpy).
    """
    console = output()
    outputs = Outputs(out, force=force)
    if mapping is not None and out.suffix == ".csv":
        with outputs:
            record = import_rig(files, mapping)
            write_rig(record, out, f"{record.name}, by {mapping.name}")
            outputs.announce()
            rate = (record.t.size - 1) / (record.t[-1] - record.t[0])
            console.print(
                f"{record.name}: {record.t[-1]:.1f} s at {rate:.4g} Hz, {', '.join(record.columns)}",
                *(f"  warning: {text}" for text in record.warnings),
                sep="\n",
            )
        console.print(f"Written to {out}")
        return
    BagWriter(out, overwrite=force)  # replaces nothing but a recording
    topics = Topics(imu=imu_topic, fix=fix_topic, vel=vel_topic, heading=heading_topic)
    with outputs:
        imported = import_drive(files, mapping=mapping, topics=topics)
        write_drive(imported.drive, out, overwrite=force)  # before a pipe that closes ends the printing
        outputs.announce()
        console.print(f"{imported.drive.name}: {imported.origin}")
        warnings = (f"warning: {text}" for text in (*imported.drive.warnings, *turns_said(imported.drive)))
        for line in (*summarise(imported.drive).lines(), *imported.notes, *warnings):
            console.print(Padding(line, (0, 0, 0, 2), expand=False))
    console.print(f"Written to {out}")
