# SPDX-License-Identifier: Apache-2.0
"""The functions that a program begins with, on paths or on objects; the command line calls the same ones below.

``import suspension_twin as st`` has them all: ``st.simulate``, ``st.calibrate``, ``st.diagnose``, ``st.import_drive``
and ``st.read_road``, beside ``st.read_drive`` and ``st.load_twin``. Each result prints in a few lines, draws itself
(``plot``) and gives arrays or a table of pandas (``to_frame``).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from suspension_twin.drive.importing import Imported
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.rig import RigRecord, read_rig
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.vehicle.twin import Twin, load_twin, save_twin

if TYPE_CHECKING:
    from suspension_twin.calibration.request import CalibrationResult, Progress as CalibrationProgress
    from suspension_twin.diagnosis.decision import Costs
    from suspension_twin.diagnosis.request import DiagnosisProgress, DiagnosisResult
    from suspension_twin.drive.read import Topics
    from suspension_twin.inference.gap import Comparison
    from suspension_twin.road import Outside, Road

__all__ = ["calibrate", "diagnose", "import_drive", "read_recording", "read_road", "simulate"]

File: TypeAlias = str | Path
Recording: TypeAlias = File | Drive | Imported


def read_road(path: File) -> Road:
    """Read a road from an OpenCRG file.

    Parameters
    ----------
    path : str or Path
        The file, such as ``road.crg``.

    Returns
    -------
    Road
        Heights on a grid along a reference line.

    Raises
    ------
    InputError
        Naming the file and what is wrong with it.

    Examples
    --------
    >>> import suspension_twin as st
    >>> round(st.read_road("bags/crg_road/road.crg").length)
    90
    """
    from suspension_twin.road import load_road

    return load_road(path)


def import_drive(
    files: File | Sequence[File], *, mapping: File | None = None, topics: Topics | None = None
) -> Imported:
    """Import the recording of a phone or a logger, whatever its format.

    Parameters
    ----------
    files : str, Path or a sequence of them
        A file, folder or archive; several are parts of one drive.
    mapping : str or Path, optional
        A mapping file that states what the columns are (see ``config/import``).
    topics : Topics, optional
        Of a bag: the names of its topics.

    Returns
    -------
    Imported
        The ``drive``, the format recognised, and a line for every decision.

    Raises
    ------
    InputError
        Naming the file: missing, of no known format, or without accelerometer or gyroscope.

    Examples
    --------
    >>> import suspension_twin as st
    >>> st.import_drive("bags/crg_road").origin
    'bag'
    """
    from suspension_twin.drive import importing

    given = [files] if isinstance(files, str | Path) else list(files)
    return importing.import_drive(given, mapping=mapping, topics=topics)


def read_recording(source: Recording | RigRecord, twin: Twin) -> Drive | RigRecord:
    """Read what a twin is compared with: a drive, or a run of a rig for a model that stands on one.

    Parameters
    ----------
    source : str, Path, Drive, Imported or RigRecord
        A path; a recording that has been read is returned as it is.
    twin : Twin
        The twin; its model says which of the two it takes.

    Returns
    -------
    Drive or RigRecord
        The recording.

    Raises
    ------
    InputError
        Naming the file, or that the recording is not of the kind that the model takes.

    Examples
    --------
    >>> import suspension_twin as st
    >>> read_recording("bags/crg_road", st.load_twin("bags/crg_road/twin.yaml")).name
    'crg_road'
    """
    from suspension_twin.models.registry import model_of

    kind = RigRecord if model_of(twin).recordings == "rig" else Drive
    if isinstance(source, str | Path):
        return read_rig(source) if kind is RigRecord else read_drive(source)
    found = source.drive if isinstance(source, Imported) else source
    if not isinstance(found, kind):
        raise InputError("drive", f"must be a path or a {kind.__name__}, is a {type(found).__name__}")
    return found


def simulate(
    drive: Recording | RigRecord,
    twin: File | Twin,
    *,
    road: File | Road | None = None,
    outside: Outside = "road",
) -> Comparison:
    """Simulate a twin over a recorded drive or run of a rig, and measure the gap between the two.

    Parameters
    ----------
    drive : str, Path, Drive, Imported or RigRecord
        The recording.
    twin : str, Path or Twin
        The twin.
    road : str, Path or Road, optional
        The road in place of the twin file's.
    outside : {"road", "hold", "zero", "error"}
        Heights where the drive leaves the road; ``road``: what the road's file says.

    Returns
    -------
    Comparison
        ``measured`` and ``simulated`` are the channels over the stamps ``t``, ``gap`` is their difference. Of a drive
        it is a :class:`~suspension_twin.inference.simulated.SimulatedDrive`, with the whole response of the model.

    Raises
    ------
    InputError
        Naming the file, or the drive and what it lacks.

    Examples
    --------
    >>> import suspension_twin as st
    >>> result = st.simulate("bags/crg_road", "bags/crg_road/twin.yaml")
    >>> difference = result.measured["vertical_acceleration"] - result.simulated["vertical_acceleration"]
    >>> difference.shape == result.t.shape
    True
    """
    from suspension_twin.inference.observation import ObserveSettings
    from suspension_twin.inference.runs import simulate_rig
    from suspension_twin.inference.simulated import simulate_drive

    twin = twin if isinstance(twin, Twin) else load_twin(twin)
    found = read_recording(drive, twin)
    if isinstance(found, RigRecord):
        return simulate_rig(found, twin)
    surface = read_road(road) if isinstance(road, str | Path) else road
    return simulate_drive(found, twin, surface, ObserveSettings(outside=outside))


def calibrate(
    twin: File | Twin,
    drives: Recording | Sequence[Recording],
    *,
    preset: str = "fast",
    seed: int = 0,
    free: Sequence[str] = (),
    also: Sequence[str] = (),
    freeze: Sequence[str] = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    max_generations: int = 0,
    on_progress: Callable[[CalibrationProgress], None] | None = None,
) -> CalibrationResult:
    """Find a twin's characteristics from recorded drives over a known road.

    Objects are written to a temporary folder first, since a calibration reads files. All choices there are:
    :class:`~suspension_twin.calibration.request.CalibrationRequest`.

    Parameters
    ----------
    twin : str, Path or Twin
        The twin to start from.
    drives : str, Path, Drive, Imported or a sequence of them
        The recorded drives; runs of a rig and of markers by their paths.
    preset : str
        ``fast``, ``paper`` or ``tracked_paper``.
    seed : int
        Seed of every random choice.
    free, also, freeze : sequence of str
        Keys to search in place of the preset's, to search as well, and to leave as they are.
    bounds : mapping of str to (float, float), optional
        Lower and upper bound by key, in the units of the twin file.
    max_generations : int
        End of the search; 0 for the preset's.
    on_progress : callable, optional
        Called with a :class:`~suspension_twin.calibration.request.Progress`.

    Returns
    -------
    CalibrationResult
        The calibrated ``twin``, the ``estimates`` with their intervals, and the gap of each drive before and after.

    Raises
    ------
    InputError
        What cannot be used: names file, drive or key.
    WorkError
        No candidate can be simulated.

    Examples
    --------
    >>> import suspension_twin as st
    >>> result = st.calibrate("bags/crg_road/twin.yaml", "bags/crg_road")  # doctest: +SKIP
    >>> result.drives[0].gap_after.rms < result.drives[0].gap_before.rms  # doctest: +SKIP
    True
    """
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate as run

    limits = tuple((key, low, high) for key, (low, high) in (bounds or {}).items())
    with _files(twin, drives) as (path, (bags,)):
        request = CalibrationRequest(
            twin=path,
            bags=bags,
            preset=preset,
            seed=seed,
            free=tuple(free),
            also=tuple(also),
            freeze=tuple(freeze),
            bounds=limits,
            max_generations=max_generations,
        )
        return run(request, on_progress)


def diagnose(
    twin: File | Twin,
    drives: Recording | Sequence[Recording],
    reference: Recording | Sequence[Recording] = (),
    *,
    seed: int = 0,
    effects: Sequence[str] = (),
    costs: Costs | None = None,
    on_progress: Callable[[DiagnosisProgress], None] | None = None,
) -> DiagnosisResult:
    """Find where twin and car disagree, why, and what closes the gap.

    Objects are written to a temporary folder first, since a diagnosis reads files.

    Parameters
    ----------
    twin : str, Path or Twin
        The calibrated twin.
    drives : str, Path, Drive, Imported or a sequence of them
        The drives that show the gap.
    reference : str, Path, Drive, Imported or a sequence of them
        Drives of the same vehicle from before the gap.
    seed : int
        Seed of every random choice.
    effects : sequence of str
        Ids of the effects to try; all of the library by default.
    costs : Costs, optional
        Costs of wrong and missing answers.
    on_progress : callable, optional
        Called with a :class:`~suspension_twin.diagnosis.request.DiagnosisProgress`.

    Returns
    -------
    DiagnosisResult
        ``verdict`` and ``probabilities``, the whole ``document`` of ``diagnosis.json``, and the ``twin`` with what
        was found.

    Raises
    ------
    InputError
        What cannot be used: names file, drive or key.
    WorkError
        A hypothesis cannot be simulated.

    Examples
    --------
    >>> import suspension_twin as st
    >>> st.diagnose("out/calibrated.yaml", "bags/bump_15kmh").verdict  # doctest: +SKIP
    'unknown'
    """
    from suspension_twin.diagnosis.decision import Costs
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.run import diagnose as run

    with _files(twin, drives, reference) as (path, (bags, references)):
        request = DiagnosisRequest(
            path, bags, references, seed=seed, effects=tuple(effects), costs=costs or Costs()
        )
        return run(request, on_progress)


@contextmanager
def _files(
    twin: File | Twin, *groups: Recording | Sequence[Recording]
) -> Iterator[tuple[str, list[tuple[str, ...]]]]:
    """Paths of a twin and of groups of recordings; what is an object lies in a temporary folder meanwhile."""
    with tempfile.TemporaryDirectory(prefix="suspension_twin_") as name:
        folder = Path(name)
        if isinstance(twin, Twin):
            save_twin(twin, folder / "twin.yaml")
            twin = folder / "twin.yaml"
        paths = [
            tuple(_path(recording, folder / f"{k}_{i}") for i, recording in enumerate(_several(group)))
            for k, group in enumerate(groups)
        ]
        yield str(twin), paths


def _several(group: Recording | Sequence[Recording]) -> Iterable[Recording]:
    return [group] if isinstance(group, str | Path | Drive | Imported) else group


def _path(recording: Recording, folder: Path) -> str:
    """Where a recording lies: its own path, or that of a bag written below ``folder``, named as the drive is."""
    if isinstance(recording, str | Path):
        return str(recording)
    drive = recording.drive if isinstance(recording, Imported) else recording
    if not isinstance(drive, Drive):
        raise InputError("drives", f"must be paths or drives, not a {type(drive).__name__}")
    path = folder / (Path(drive.name).name or "drive")
    write_drive(drive, path)
    return str(path)
