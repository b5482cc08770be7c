# SPDX-License-Identifier: Apache-2.0
"""``suspension-twin import``: a phone's or logger's recording becomes a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from suspension_twin.drive.importing import Imported, import_drive
from suspension_twin.drive.read import Topics
from suspension_twin.drive.summary import summarise
from suspension_twin.drive.write import BagWriter, write_drive

__all__ = ["command"]

_DEFAULT = Topics()


def command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Files, a folder or a zip of one recording: Sensor Logger, phyphox, MATLAB Mobile, RTKLIB .pos, "
            "comma2k19, or a bag (MCAP, sqlite3, ROS 1). Several are parts of one drive.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="BAG", help="The bag to write: a folder, or a file if it ends in .mcap."
        ),
    ],
    mapping: Annotated[
        Path | None,
        typer.Option(
            "--mapping",
            metavar="MAP.YAML",
            help="What the columns of any other file are (see config/import).",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the bag if there is one.")] = False,
    imu_topic: Annotated[str, typer.Option(help="Of a bag: the topic of the IMU.")] = _DEFAULT.imu,
    fix_topic: Annotated[str, typer.Option(help="Of a bag: the topic of the positions.")] = _DEFAULT.fix,
    vel_topic: Annotated[str, typer.Option(help="Of a bag: the topic of the velocities.")] = _DEFAULT.vel,
    heading_topic: Annotated[
        str, typer.Option(help="Of a bag: the topic of the heading.")
    ] = _DEFAULT.heading,
) -> None:
    """A phone's or logger's recording into a bag.

    Says what it recognised: source, rate, units, gravity's axis, gaps, path and top speed. Axes stay those of the
    sensor: how it is mounted belongs into the twin file (imu.rpy).
    """
    BagWriter(out, overwrite=overwrite)  # a target that cannot be written is said before the work
    topics = Topics(imu=imu_topic, fix=fix_topic, vel=vel_topic, heading=heading_topic)
    imported = import_drive(files, mapping=mapping, topics=topics)
    for line in _report(imported):
        print(line)
    write_drive(imported.drive, out, overwrite=overwrite)
    print(f"written: {out}")


def _report(imported: Imported) -> list[str]:
    """What was recognised, a line each."""
    drive = imported.drive
    return [
        f"{drive.name}: {imported.origin}",
        *(f"  {line}" for line in summarise(drive).lines()),
        *(f"  {line}" for line in imported.notes),
        *(f"  warning: {line}" for line in drive.warnings),
    ]
