# SPDX-License-Identifier: Apache-2.0
"""One item of a fleet's work as a pure function: what the single command does, and its result as plain values.

A worker needs the names of the files and nothing else; what it returns is JSON, a few kB to a few 100 kB.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from suspension_twin import __version__
from suspension_twin.addons.fleet.manifest import Item, is_url
from suspension_twin.addons.fleet.storage import identity, outline, staged, transient
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError, SuspensionTwinError
from suspension_twin.files import explained, together
from suspension_twin.road import load_road
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin

__all__ = ["VELOCITY", "Options", "Task", "plan_task", "twin_and_road", "work"]

#: m/s at which a damper's force is followed over time: between the low and the high speeds of a strut, where workshops
#: compare dampers (the abscissae of Table 2 of the car paper have it).
VELOCITY = 0.25
#: m of road over which a residual is averaged for the map.
_PLACE = 5.0
_FORMAT = 1
Record = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """What is done with every item.

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
        What is to be done.

    Returns
    -------
    Task
        What :func:`work` takes.

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
    return Task(
        key, item, options, date, sum(o.bytes for o in outlines), float(sum(o.duration for o in outlines))
    )


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
        What :func:`plan_task` returned.

    Returns
    -------
    dict
        Plain values: ``status`` "done", or "failed" with the line that the single command would have said;
        ``files`` are texts by name.

    Raises
    ------
    OSError
        What may pass by itself, such as a store out of reach: worth another trial.

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
        folder = Path(name)
        copies: dict[str, str] = {}
        try:
            record |= _done(task, folder, copies)
        except Exception as error:
            if not isinstance(error, SuspensionTwinError) and transient(error):
                raise
            status, text = explained(error)
            for copy, original in sorted(copies.items(), key=lambda pair: -len(pair[0])):
                text = text.replace(copy, original)
            if text.startswith("twin: "):  # said of a twin in memory, which knows of no file
                text = task.item.twin + text.removeprefix("twin")
            record |= {"status": "failed", "exit_status": status, "message": text}
    record["seconds"] = round(time.monotonic() - began, 3)
    record["peak_memory"] = _peak_memory()
    return record


def _peak_memory() -> int | None:
    """Bytes that this process has held at most, where the system says it."""
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _done(task: Task, folder: Path, copies: dict[str, str]) -> Record:
    item = task.item

    def here(name: str, part: str) -> str:
        path = str(staged(name, folder / part))
        if path != name:
            copies[path] = name
        return path

    twin, road = twin_and_road(item, folder / "twin")
    own = here(item.twin, "twin")
    record: Record = {"road": "" if is_url(road) else road}
    if twin.program is not None:
        record["program"] = str(twin.program)
    if road and (item.road or is_url(road)):
        moved = twin.model_copy(update={"road": RoadFile(file=Path(here(road, "road")).absolute())})
        own = str(folder / "with_road" / Path(own).name)
        copies[own] = item.twin
        save_twin(moved, own)
    drives = tuple(here(d, f"drive{k}") for k, d in enumerate(item.drives))
    if task.options.action == "calibrate":
        return record | _calibrated(task.options, own, drives, folder, road)
    references = tuple(here(d, f"reference{k}") for k, d in enumerate(item.references))
    return record | _diagnosed(task.options, own, drives, references, folder, road)


def _calibrated(options: Options, twin: str, drives: Sequence[str], folder: Path, road: str) -> Record:
    from suspension_twin.calibration.labels import parameter_unit
    from suspension_twin.calibration.output import write_result
    from suspension_twin.calibration.request import CalibrationRequest
    from suspension_twin.calibration.run import calibrate

    request = CalibrationRequest(
        twin=twin,
        bags=tuple(drives),
        preset=options.preset,
        seed=options.seed,
        also=options.also,
        freeze=options.freeze,
        max_generations=options.max_generations,
    )
    result = calibrate(request)
    result = replace(result, twin=_named_road(result.twin, road))
    files = write_result(result, folder / "out" / "twin.yaml")
    first = result.drives[0]
    fits = [
        (d.position, d.measured[d.channel] - d.after[d.channel], d.compared, d.rate) for d in result.drives
    ]
    health = [row for c in result.curves if (row := _damper(c)) is not None]
    health += [
        _health(e.key, e.value, e.low, e.high, parameter_unit(e.key), e.status in ("identified", "on bound"))
        for e in result.estimates
        if e.key.startswith("effects.") or ".tyre." in e.key
    ]
    return {
        "message": result.message,
        "files": {path.name: path.read_text(encoding="utf-8") for path in files},
        "warnings": list(result.warnings),
        "channel": first.channel,
        "gap_before": _number(_together([d.gap_before.rms for d in result.drives])),
        "gap_after": _number(_together([d.gap_after.rms for d in result.drives])),
        "noise": _number(_together([d.gap_after.noise_rms for d in result.drives])),
        "parameters": [
            {
                "key": e.key,
                "start": _number(e.start),
                "value": _number(e.value),
                "low": _number(e.low),
                "high": _number(e.high),
                "status": e.status,
            }
            for e in result.estimates
        ],
        "health": health,
        "places": _places(load_twin(twin), fits),
    }


def _named_road(twin: Twin, road: str) -> Twin:
    """The twin with the name of a road in object storage, instead of a copy that is gone when this ends."""
    if not is_url(road):
        return twin
    return twin.model_copy(update={"road": RoadFile(file=Path(PurePosixPath(road).name))})


def _damper(curve: Any) -> Record | None:
    """Force of a damper at :data:`VELOCITY`; None for a spring, and where the drives did not excite it so far."""
    if ".damper_" not in curve.key or not curve.grid[0] <= VELOCITY <= curve.grid[-1]:
        return None
    value, low, high = (
        float(np.interp(VELOCITY, curve.grid, c)) for c in (curve.force, curve.low, curve.high)
    )
    return _health(f"{curve.key}@{VELOCITY:g}", value, low, high, "N", bool(curve.span[1] >= VELOCITY))


def _health(quantity: str, value: float, low: float, high: float, unit: str, identified: bool) -> Record:
    return {
        "quantity": quantity,
        "value": _number(value),
        "low": _number(low),
        "high": _number(high),
        "unit": unit,
        "identified": identified,
    }


def _diagnosed(
    options: Options,
    twin: str,
    drives: Sequence[str],
    references: Sequence[str],
    folder: Path,
    road: str,
) -> Record:
    from suspension_twin.diagnosis.answer import write
    from suspension_twin.diagnosis.request import DiagnosisRequest
    from suspension_twin.diagnosis.run import diagnose

    request = DiagnosisRequest(twin, tuple(drives), tuple(references), options.seed, options.effects)
    result = diagnose(request)
    out = folder / "out"
    with together():
        write(replace(result, twin=_named_road(result.twin, road)), out)
    document = result.document
    fits = [
        (d.position, d.measured - d.simulated["before"], d.compared, d.rate)
        for d in result.drives
        if _vertical(d.channel)
    ]
    return {
        "message": result.message,
        "files": {path.name: path.read_text(encoding="utf-8") for path in sorted(out.iterdir())},
        "warnings": list(document["warnings"]),
        "channel": document["gap"]["channel"],
        "gap_before": document["gap_before"],
        "gap_after": document["gap_after"],
        "noise": document["gap"]["noise_rms"],
        "verdict": document["verdict"],
        "probability": document["probability"],
        "shrink": document["shrink"],
        "shrink_low": document["shrink_interval"][0],
        "shrink_high": document["shrink_interval"][1],
        "combination": document["combination"],
        "causes": [
            {"effect": c["effect"], "probability": c["probability"], "parameters": c["parameters"]}
            for c in document["causes"][:5]
        ],
        "places": _places(load_twin(twin), fits),
    }


def _vertical(channel: str) -> bool:
    return channel in ("", "vertical_acceleration")


def _places(twin: Twin, fits: Sequence[tuple[Floats, Floats, Any, float]]) -> list[Record]:
    """Residual by stretch of road, on WGS 84: rms over ``seconds`` of driving there."""
    if twin.road is None or twin.datum is None or not fits:
        return []
    from suspension_twin.pose.local_map import LocalMap

    at = np.concatenate([position for position, *_ in fits])
    square = np.concatenate([residual**2 for _, residual, *_ in fits])
    seen = np.concatenate([np.asarray(compared, dtype=np.bool_) for _, _, compared, _ in fits])
    length = np.concatenate([np.full(position.size, 1.0 / rate) for position, *_, rate in fits])
    seen &= np.isfinite(at) & np.isfinite(square)
    if not seen.any():
        return []
    number = np.floor(at[seen] / _PLACE).astype(np.int64)
    bins, index = np.unique(number, return_inverse=True)
    count = np.bincount(index)
    rms = np.sqrt(np.bincount(index, square[seen]) / count)
    seconds = np.bincount(index, length[seen])
    along = (bins + 0.5) * _PLACE
    x, y = load_road(twin.road.file).uv_to_xy(along, np.zeros(along.size))
    latitude, longitude, _ = LocalMap(twin.datum).to_geodetic(np.column_stack([x, y, np.zeros(x.size)])).T
    rows = zip(along, latitude, longitude, rms, seconds, strict=True)
    return [
        {
            "along": float(a),
            "latitude": round(float(p), 8),
            "longitude": round(float(q), 8),
            "rms": _number(float(r)),
            "seconds": round(float(s), 3),
        }
        for a, p, q, r, s in rows
        if math.isfinite(p) and math.isfinite(q)
    ]


def _together(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _number(value: float) -> float | None:
    return float(f"{value:.7g}") if math.isfinite(value) else None
