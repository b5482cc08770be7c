# SPDX-License-Identifier: Apache-2.0
"""Bring a recording of any known format in: one way for the command line and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from suspension_twin.drive.foreign_files import RecordedFiles
from suspension_twin.drive.importers import read_source
from suspension_twin.drive.importers.sensor_logger import is_database
from suspension_twin.drive.mapping import BagSpec, load_mapping, read_mapped, read_mapped_rig
from suspension_twin.drive.read import Topics, read_drive
from suspension_twin.drive.recording import is_recording
from suspension_twin.drive.rig import RigRecord
from suspension_twin.drive.streams import assemble, checked, merge
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.files import reading

__all__ = ["Imported", "import_drive", "import_rig"]


@dataclass(frozen=True, eq=False)
class Imported:
    """An imported drive, its format, and a line for every decision.

    Parameters
    ----------
    drive : Drive
        The recording in SI units.
    origin : str
        Title of the importer that recognised it, or ``bag``.
    notes : tuple of str
        One line for every decision: units, stamps, derived velocities.

    Examples
    --------
    >>> imported = import_drive(["bags/crg_road"])
    >>> imported.notes[0]
    'topics: /imu/data_raw, /fix, /vel'
    """

    drive: Drive
    origin: str
    notes: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.drive}\n  from: {self.origin}" + "".join(f"\n  {note}" for note in self.notes)

    __repr__ = __str__


def import_drive(
    paths: Sequence[str | Path], *, mapping: str | Path | None = None, topics: Topics | None = None
) -> Imported:
    """Import a recording of any known format as one drive.

    Parameters
    ----------
    paths : sequence of str or Path
        Files, folders or archives. Several are parts of one drive (the log of an IMU, that of a receiver);
        of a stream that more than one holds, the last one's is taken.
    mapping : str or Path, optional
        A mapping file that states the quantity of each column; it then decides alone (see ``config/import``).
    topics : Topics, optional
        Of a bag: the names of its topics.

    Returns
    -------
    Imported
        The drive, the format recognised, and a line for every decision.

    Raises
    ------
    InputError
        Naming the file: missing, of no known format, or without accelerometer or gyroscope.

    Examples
    --------
    >>> imported = import_drive(["bags/crg_road"])
    >>> imported.origin
    'bag'
    """
    if not paths:
        raise InputError("import", "no file given")
    if missing := [path for path in paths if not Path(path).exists()]:
        raise InputError(missing[0], "is not there")
    files = ", ".join(map(str, paths))
    with reading(files, "a recording"):
        spec = None if mapping is None else load_mapping(mapping)
        if spec is not None and spec.rig is not None:
            raise InputError(str(mapping), "rig", "maps a run of a rig: import it to a .csv file")
        if spec is not None and spec.bag is not None:
            return _mapped_bag(Path(paths[0]), spec.bag, spec.name)
        if spec is None and (bags := [p for p in paths if is_recording(p) and not _is_export(p)]):
            if len(paths) > 1:
                raise InputError(bags[0], "is a recording of its own: import it alone")
            return _bag(bags[0], topics or Topics())
        recordings = [RecordedFiles(path) for path in paths]
        if spec is None:
            streams = merge([read_source(recording) for recording in recordings])
        else:
            streams = read_mapped(spec, recordings, str(mapping))
        name = spec.name if spec is not None and spec.name else recordings[0].name
        unread = [r.label(file) for r in recordings for file in r.unread]
        drive, notes = assemble(streams, name, files, unread)
        return Imported(drive, streams.origin, tuple(notes))


def _is_export(path: str | Path) -> bool:
    """Whether a database is that of an app, not a bag."""
    return Path(path).is_file() and is_database(RecordedFiles(path))


def import_rig(paths: Sequence[str | Path], mapping: str | Path) -> RigRecord:
    """The run of a rig that a mapping file with a section ``rig`` makes of files; InputError names file and column."""
    spec = load_mapping(mapping)
    if spec.rig is None:
        raise InputError(str(mapping), "rig", "is missing: a .csv file is written of a run of a rig alone")
    with reading(", ".join(map(str, paths)), "a run of a rig"):
        return read_mapped_rig(spec, [RecordedFiles(path) for path in paths], str(mapping))


def _bag(path: str | Path, topics: Topics, lag: float = 0.0) -> Imported:
    drive = read_drive(path, topics=topics)
    notes = ["topics: " + ", ".join(filter(None, (topics.imu, topics.fix, topics.vel)))]
    if lag:
        drive = replace(drive, imu=replace(drive.imu, t=drive.imu.t - lag))
        notes.append(f"IMU time: {lag:g} s lag taken out")
    return Imported(checked(drive, None, notes), "bag", tuple(notes))


def _mapped_bag(path: Path, spec: BagSpec, name: str | None) -> Imported:
    if spec.file is not None and path.is_dir():
        if (path / spec.file).exists():
            path = path / spec.file
        elif not is_recording(path):
            raise InputError(path, spec.file, "is not there (the mapping asks for it)")
    topics = Topics(imu=spec.imu, fix=spec.fix, vel=spec.vel, heading=spec.heading)
    imported = _bag(path, topics, spec.lag)
    return replace(imported, drive=replace(imported.drive, name=name)) if name else imported
