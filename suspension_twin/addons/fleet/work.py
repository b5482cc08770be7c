# SPDX-License-Identifier: Apache-2.0
"""One item of a fleet's work as a pure function: the single command's work, and its result as plain values.

A worker needs the names of the files and nothing else; its result is JSON, a few kB to a few 100 kB.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from suspension_twin import __version__
from suspension_twin.addons.fleet.manifest import Item
from suspension_twin.addons.fleet.storage import identity, is_url, outline, staged, transient
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import Json, explained, read_text, together
from suspension_twin.pose.local_map import LocalMap
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin

if TYPE_CHECKING:
    from suspension_twin.calibration.request import CurveEstimate

__all__ = ["VELOCITY", "Options", "Record", "Task", "moved_twin", "plan_task", "twin_and_road", "work"]

#: m/s at which a damper's force is followed over time: between the low and the high speeds of a strut, where workshops
#: compare dampers (the abscissae of Table 2 of the car paper have it).
VELOCITY = 0.25
#: m of road over which a residual is averaged for the map.
_PLACE = 5.0
_FORMAT = 1
#: Plain values by name: what JSON holds.
Record = Json


@dataclass(frozen=True)
class Options:
    """Options of the calibration or diagnosis of every item.

    Parameters
    ----------
    action : str
        ``calibrate`` or ``diagnose``.
    seed : int
        Seed of every random choice.
    preset : str
        Preset of a calibration.
    also : tuple of str
        Keys that a calibration searches as well.
    freeze : tuple of str
        Keys that a calibration leaves as they are.
    max_generations : int
        Limit to a calibration's search, 0 for the preset's.
    effects : tuple of str
        Ids to which a diagnosis is limited; empty for the whole library.

    Examples
    --------
    >>> Options("calibrate", also=("vehicle.tyre.vertical_stiffness",)).preset
    'fast'
    """

    action: Literal["calibrate", "diagnose"]
    seed: int = 0
    preset: str = "fast"
    also: tuple[str, ...] = ()
    freeze: tuple[str, ...] = ()
    max_generations: int = 0
    effects: tuple[str, ...] = ()


@dataclass(frozen=True)
class Task:
    """An item with the options, identified by ``key``: a hash of the contents of its files, the options and the
    version of this program. ``date`` is the manifest's or that of the first drive; ``bytes`` and ``seconds`` are of
    its drives."""

    key: str
    item: Item
    options: Options
    date: str
    bytes: int
    seconds: float


def plan_task(item: Item, options: Options) -> Task:
    """Identify an item's inputs; moves a few kB where they lie in object storage.

    Parameters
    ----------
    item : Item
        A row of the manifest.
    options : Options
        Of the calibration or diagnosis.

    Returns
    -------
    Task
        For :func:`work`.

    Raises
    ------
    InputError
        A file is missing, or the twin file cannot be used.

    Examples
    --------
    >>> item = Item("car", "", "bags/bump_15kmh/twin.yaml", ("bags/bump_15kmh",))
    >>> task = plan_task(item, Options("calibrate"))
    >>> task.date, task.seconds > 60.0
    ('2023-11-14', True)
    """
    with tempfile.TemporaryDirectory(prefix="suspension_twin_") as folder:
        twin, road = twin_and_road(item, Path(folder))
    references = item.references if options.action == "diagnose" else ()
    outlines = [outline(drive) for drive in item.drives]
    program = [] if twin.program is None else [str(twin.program)]
    files = [item.twin, *program, *([road] if road else []), *item.drives, *references]
    parts = {
        "format": _FORMAT,
        "version": __version__,
        "options": asdict(options),
        "counts": [len(item.drives), len(references)],
        "files": [[PurePosixPath(name).name, identity(name)] for name in files],
    }
    key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]
    date = item.date or next((o.date for o in outlines if o.date), "")
    seconds = float(sum(o.duration for o in outlines))
    return Task(key, item, options, date, sum(o.bytes for o in outlines), seconds)


def twin_and_road(item: Item, folder: Path) -> tuple[Twin, str]:
    """The twin of an item, and path or URL of its road; empty where neither names one."""
    local = staged(item.twin, folder)
    twin = load_twin(local)
    if twin.program is not None and is_url(item.twin):
        raise InputError(item.twin, "model", f"{twin.model} runs a program: such a twin must be a file here")
    if item.road:
        return twin, item.road
    if twin.road is None:
        return twin, ""
    if not is_url(item.twin):
        return twin, str(twin.road.file)
    beside = os.path.relpath(twin.road.file, local.resolve().parent)
    if beside.startswith(".."):
        raise InputError(
            item.twin, "road.file", "must lie beside or below a twin file in object storage; or give a road"
        )
    return twin, f"{item.twin.rpartition('/')[0]}/{Path(beside).as_posix()}"


def work(task: Task) -> Record:
    """Do one task: a calibration or a diagnosis, as the single command does it.

    Parameters
    ----------
    task : Task
        From :func:`plan_task`.

    Returns
    -------
    dict
        Plain values: ``status`` "done", or "failed" with the error line of the single command;
        ``files`` are texts by name.

    Raises
    ------
    OSError
        A failure that may pass by itself, such as a store out of reach: worth another trial.

    Examples
    --------
    >>> task = plan_task(Item("a", "", "bags/bump_15kmh/twin.yaml", ("bags/README.md",)), Options("calibrate"))
    >>> work(task)["message"]
    "bags/README.md: not a recording (MCAP, sqlite3 or ROS 1 bag); bring other formats in with 'suspension-twin import'"
    """
    began = time.monotonic()
    record: Record = {
        "key": task.key,
        "version": __version__,
        "action": task.options.action,
        "status": "done",
    }
    with tempfile.TemporaryDirectory(prefix="suspension_twin_") as name:
        inputs = _Inputs(task.item, Path(name), {})
        try:
            record |= (
                _calibrated(task, inputs) if task.options.action == "calibrate" else _diagnosed(task, inputs)
            )
        except Exception as error:
            if not isinstance(error, SuspensionTwinError) and transient(error):
                raise
            status, text = explained(error)
            for copy, original in sorted(inputs.copies.items(), key=lambda pair: -len(pair[0])):
                text = text.replace(copy, original)
            if text.startswith("twin: "):  # of a twin in memory, which knows of no file
                text = task.item.twin + text.removeprefix("twin")
            record |= {"status": "failed", "exit_status": status, "message": text}
    return record | {"seconds": round(time.monotonic() - began, 3), "peak_memory": _peak_memory()}


def _peak_memory() -> int | None:
    """Bytes that this process has held at most, where the system reports it."""
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@dataclass(frozen=True)
class _Inputs:
    """The files of an item where they can be read: their own places, or ``copies`` (with their names) in ``folder``."""

    item: Item
    folder: Path
    copies: dict[str, str]

    def here(self, name: str, part: str) -> str:
        """Path of a file, in a folder of its own where it is copied."""
        path = str(staged(name, self.folder / part))
        if path != name:
            self.copies[path] = name
        return path

    def twin(self) -> tuple[str, Record]:
        """Path of the twin file, on the item's road, and where road and program lie for the record."""
        twin, road = twin_and_road(self.item, self.folder / "twin")
        own = self.here(self.item.twin, "twin")
        if road and (self.item.road or is_url(road)):
            there = Path(self.here(road, "road"))
            own = str(moved_twin(twin, there, self.folder / "with_road" / Path(own).name))
            self.copies[own] = self.item.twin
        program = {} if twin.program is None else {"program": str(twin.program)}
        return own, {"road": "" if is_url(road) else road, **program}

    def drives(self, names: Sequence[str], part: str) -> tuple[str, ...]:
        """Paths of recordings."""
        return tuple(self.here(name, f"{part}{k}") for k, name in enumerate(names))

    def named_road(self, twin: Twin) -> Twin:
        """The twin with the name of a road in object storage, instead of a copy that is gone when this ends."""
        stored = [name for copy, name in self.copies.items() if Path(copy).parent == self.folder / "road"]
        if not stored:
            return twin
        return twin.model_copy(update={"road": RoadFile(file=Path(PurePosixPath(stored[0]).name))})


def moved_twin(twin: Twin, road: Path, path: Path) -> Path:
    """Write a twin that stands on another road; returns the file."""
    save_twin(twin.model_copy(update={"road": RoadFile(file=road.absolute())}), path)
    return path


def _calibrated(task: Task, inputs: _Inputs) -> Record:
    from suspension_twin.calibration.labels import parameter_unit
    from suspension_twin.calibration.output import write_result
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate

    (twin, places), options = inputs.twin(), task.options
    request = CalibrationRequest(
        twin=twin,
        bags=inputs.drives(task.item.drives, "drive"),
        preset=options.preset,
        seed=options.seed,
        also=options.also,
        freeze=options.freeze,
        max_generations=options.max_generations,
    )
    result = calibrate(request)
    result = replace(result, twin=inputs.named_road(result.twin))
    files = write_result(result, inputs.folder / "out" / "twin.yaml")
    fits = [
        (d.position, d.measured[d.channel] - d.after[d.channel], d.compared, d.rate) for d in result.drives
    ]
    gaps = {
        "gap_before": [d.gap_before.rms for d in result.drives],
        "gap_after": [d.gap_after.rms for d in result.drives],
        "noise": [d.gap_after.noise_rms for d in result.drives],
    }
    health = [row for c in result.curves if (row := _damper(c)) is not None]
    health += [
        _health(
            e.key, (e.value, e.low, e.high), parameter_unit(e.key), e.status in ("identified", "on bound")
        )
        for e in result.estimates
        if e.key.startswith("effects.") or ".tyre." in e.key
    ]
    parameters = [
        {"key": e.key, **_numbers(start=e.start, value=e.value, low=e.low, high=e.high), "status": e.status}
        for e in result.estimates
    ]
    return {
        **places,
        "message": result.message,
        "files": {path.name: read_text(path) for path in files},
        "warnings": list(result.warnings),
        "channel": result.drives[0].channel,
        **_numbers(**{name: float(np.sqrt(np.mean(np.square(values)))) for name, values in gaps.items()}),
        "parameters": parameters,
        "health": health,
        "places": _places(load_twin(twin), fits),
    }


def _damper(curve: CurveEstimate) -> Record | None:
    """Force of a damper at :data:`VELOCITY`; None for a spring, and where the drives did not excite it so far."""
    if ".damper_" not in curve.key or not curve.band.x[0] <= VELOCITY <= curve.band.x[-1]:
        return None
    force, low, high = (
        float(np.interp(VELOCITY, curve.band.x, c)) for c in (curve.force, curve.band.low, curve.band.high)
    )
    return _health(f"{curve.key}@{VELOCITY:g}", (force, low, high), "N", bool(curve.span[1] >= VELOCITY))


def _health(quantity: str, estimate: tuple[float, float, float], unit: str, identified: bool) -> Record:
    """A quantity that is followed over time: its value and the ends of its 90 % interval."""
    numbers = _numbers(**dict(zip(("value", "low", "high"), estimate, strict=True)))
    return {"quantity": quantity, **numbers, "unit": unit, "identified": identified}


def _diagnosed(task: Task, inputs: _Inputs) -> Record:
    from suspension_twin.diagnosis.answer import write
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.run import diagnose

    (twin, places), item = inputs.twin(), task.item
    drives, references = inputs.drives(item.drives, "drive"), inputs.drives(item.references, "reference")
    result = diagnose(DiagnosisRequest(twin, drives, references, task.options.seed, task.options.effects))
    out = inputs.folder / "out"
    with together():
        write(replace(result, twin=inputs.named_road(result.twin)), out)
    document = result.document
    fits = [
        (d.position, d.measured - d.simulated["before"], d.compared, d.rate)
        for d in result.drives
        if d.channel in ("", "vertical_acceleration")
    ]
    same = ("gap_before", "gap_after", "verdict", "probability", "shrink", "combination")
    return {
        **places,
        "message": result.message,
        "files": {path.name: read_text(path) for path in sorted(out.iterdir())},
        "warnings": list(document["warnings"]),
        "channel": document["gap"]["channel"],
        "noise": document["gap"]["noise_rms"],
        **{name: document[name] for name in same},
        "shrink_low": document["shrink_interval"][0],
        "shrink_high": document["shrink_interval"][1],
        "causes": [
            {name: c[name] for name in ("effect", "probability", "parameters")}
            for c in document["causes"][:5]
        ],
        "places": _places(load_twin(twin), fits),
    }


def _places(twin: Twin, fits: Iterable[tuple[Floats, Floats, NDArray[np.bool_], float]]) -> list[Record]:
    """Residual by piece of road, on WGS 84: rms over ``seconds`` of driving there."""
    rows = [np.stack([at, r**2, seen, np.full(at.size, 1.0 / rate)]) for at, r, seen, rate in fits]
    table = np.concatenate(rows, axis=1) if rows else np.zeros((4, 0))
    at, square, _, length = table[:, np.isfinite(table).all(axis=0) & (table[2] > 0.0)]
    if twin.road is None or twin.datum is None or not at.size:
        return []
    bins, index = np.unique(np.floor(at / _PLACE).astype(np.int64), return_inverse=True)
    rms = np.sqrt(np.bincount(index, square) / np.bincount(index))
    seconds = np.bincount(index, length)
    along = (bins + 0.5) * _PLACE
    x, y = load_road(twin.road.file).uv_to_xy(along, np.zeros(along.size))
    latitude, longitude, _ = LocalMap(twin.datum).to_geodetic(np.column_stack([x, y, np.zeros(x.size)])).T
    return [
        {
            "along": float(a),
            "latitude": round(float(p), 8),
            "longitude": round(float(q), 8),
            **_numbers(rms=float(r)),
            "seconds": round(float(s), 3),
        }
        for a, p, q, r, s in zip(along, latitude, longitude, rms, seconds, strict=True)
        if math.isfinite(p) and math.isfinite(q)
    ]


def _numbers(**values: float) -> dict[str, float | None]:
    """Numbers with seven digits; None for one that is not finite."""
    return {name: float(f"{value:.7g}") if math.isfinite(value) else None for name, value in values.items()}
