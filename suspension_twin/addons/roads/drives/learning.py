# SPDX-License-Identifier: Apache-2.0
"""The road of a drive that goes on: its passes, and from them a road file and a twin that stands on it."""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from suspension_twin.addons.roads.drives.drives import DrivenPart, road_from_drives, write_estimate
from suspension_twin.addons.roads.drives.estimate import RoadEstimateSettings
from suspension_twin.drive.types import Drive, FixData, HeadingData, ImuData, Samples, VelocityData
from suspension_twin.files import Json, open_file, parse_json, reader, replacing, together
from suspension_twin.vehicle.twin import Datum, RoadFile, load_twin, save_twin

__all__ = ["Laps", "Lesson", "Span", "learn_road", "read_lesson", "twin_path", "write_lesson"]

#: m of path between two points that are remembered.
_EVERY = 1.0
#: m of path after which a place near one of the path counts as come back to.
_AWAY = 50.0
#: m within which a place is the same, at least; a receiver's own uncertainty widens it so many times.
_SAME, _SIGMAS = 4.0, 2.0
_ALIKE = math.radians(45.0)  # between two directions that are the same
_MOVING = 1.0  # m/s
#: m after which a pass ends in any case: what is estimated from it is to come in time.
_LONGEST = 5000.0
#: m and s of motion below which there is nothing to learn from.
_SHORTEST, _BRIEFEST = 20.0, 8.0
#: A draw costs as much as the estimate itself.
_SETTINGS = RoadEstimateSettings(iterations=4, samples=6, strict=False)
_KINDS: Final[Mapping[str, Callable[..., Samples]]] = {
    "imu": ImuData,
    "fix": FixData,
    "velocity": VelocityData,
    "heading": HeadingData,
}


class Span(NamedTuple):
    """Times of a pass: ``start`` and ``end`` s, ``length`` m."""

    start: float
    end: float
    length: float


class Laps:
    """The passes of a path as it grows: one ends where the vehicle comes back to a place in it.

    Within a pass no place is driven over twice in the same direction, so that its path can be the line of a road.

    Examples
    --------
    >>> laps = Laps()
    >>> circle = [(t, 20.0 * math.cos(0.25 * t), 20.0 * math.sin(0.25 * t), 0.25 * t + math.pi / 2)
    ...           for t in np.arange(0.0, 30.0, 0.1)]
    >>> [round(span.length) for row in circle if (span := laps.push(*row, speed=5.0))]
    [123]
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin the next pass here."""
        self._points = array("d")  # x, y, yaw, m of path of each
        self._start = self._end = math.nan
        self._moved = 0.0
        self._last: tuple[float, float, float] | None = None
        self.length = 0.0

    @property
    def worth(self) -> bool:
        """Whether the present pass is long enough to learn from."""
        return self.length >= _SHORTEST and self._moved >= _BRIEFEST

    def push(self, t: float, x: float, y: float, yaw: float, speed: float, sigma: float = 0.0) -> Span | None:
        """Go on to ``x``, ``y`` m at ``t`` s, with the receiver's standard deviation ``sigma`` m; the pass that ends
        here, or None."""
        before, self._last = self._last, (t, x, y)
        if speed < _MOVING or before is None:
            return None
        if math.isnan(self._start):
            self._start = t
        self._end = t
        self._moved += t - before[0]
        self.length += math.hypot(x - before[1], y - before[2])
        if self._points and self.length - self._points[-1] < _EVERY:
            return None
        if self.length > _LONGEST or self._returned(x, y, yaw, max(_SAME, _SIGMAS * sigma)):
            return self.close()
        self._points.extend((x, y, yaw, self.length))
        return None

    def close(self) -> Span | None:
        """End the present pass; None where it is too short."""
        span = Span(self._start, self._end, self.length) if self.worth else None
        self.restart()
        return span

    def _returned(self, x: float, y: float, yaw: float, reach: float) -> bool:
        earlier = np.array(self._points).reshape(-1, 4)
        earlier = earlier[self.length - earlier[:, 3] > _AWAY]
        near = earlier[np.hypot(earlier[:, 0] - x, earlier[:, 1] - y) < reach]
        return bool((np.cos(near[:, 2] - yaw) > math.cos(_ALIKE)).any())


@dataclass(frozen=True)
class Lesson:
    """The drives from which a road is learnt.

    Parameters
    ----------
    twin : str
        The twin file.
    out : str
        The OpenCRG file to write; its record and the twin on it have its name with ``.json`` and ``.yaml``.
    drives : tuple of Drive
        The drives.
    passes : tuple of (int, float, float)
        Of each pass the number of its drive, and its start and end in s (as the drive's stamps).
    datum : tuple of float, optional
        Latitude and longitude in degrees and altitude in m that the poses count from, where the twin file says none.
    """

    twin: str
    out: str
    drives: tuple[Drive, ...]
    passes: tuple[tuple[int, float, float], ...]
    datum: tuple[float, float, float] | None = None


def write_lesson(lesson: Lesson, path: Path) -> None:
    """Write a lesson as arrays of NumPy in a file ``.npz``. Raises InputError, WorkError."""
    arrays: dict[str, NDArray[Any]] = {}
    for k, drive in enumerate(lesson.drives):
        for kind in _KINDS:
            values = vars(samples) if (samples := getattr(drive, kind)) is not None else {}
            arrays |= {f"{k}.{kind}.{n}": np.asarray(v) for n, v in values.items() if v is not None}
    text = {
        "twin": lesson.twin,
        "out": lesson.out,
        "datum": lesson.datum,
        "drives": [(drive.name, drive.warnings) for drive in lesson.drives],
        "passes": lesson.passes,
    }
    with replacing(path) as temporary:
        np.savez(temporary, lesson=np.array(json.dumps(text)), **arrays)  # type: ignore[arg-type]


@reader("a lesson")
def read_lesson(path: Path) -> Lesson:
    """Read a lesson that :func:`write_lesson` wrote."""
    return _lesson(path)


def _lesson(path: Path) -> Lesson:
    with open_file(path) as opened, np.load(opened, allow_pickle=False) as file:
        arrays = dict(file)
    text = parse_json(str(arrays["lesson"]), path)
    drives = []
    for k, (name, warnings) in enumerate(text["drives"]):
        parts: Json = {}
        for kind, make in _KINDS.items():
            start = f"{k}.{kind}."
            own = {n.removeprefix(start): a for n, a in arrays.items() if n.startswith(start)}
            parts[kind] = make(**{n: a if a.ndim else str(a) for n, a in own.items()}) if own else None
        drives.append(Drive(name, **parts, warnings=tuple(warnings)))
    datum = None if text["datum"] is None else tuple(text["datum"])
    return Lesson(text["twin"], text["out"], tuple(drives), tuple(map(tuple, text["passes"])), datum)


def twin_path(out: Path) -> Path:
    """The twin file beside a road that is learnt."""
    return out.with_suffix(".yaml")


def learn_road(lesson: Lesson, progress: Callable[[str, float], None] = lambda text, share: None) -> Json:
    """Estimate the road of some passes; write it, its record and a twin file that stands on it.

    Parameters
    ----------
    lesson : Lesson
        Twin, passes and where to write.
    progress : callable, optional
        Called with a text and the share of the work that is done.

    Returns
    -------
    dict
        ``twin`` the path of the twin file on the road, ``passes`` used, ``length`` of the road in m, ``warnings``.

    Raises
    ------
    InputError
        A twin without four wheels, or no pass that a road could be learnt from.
    WorkError
        The files cannot be written.
    """
    twin = load_twin(lesson.twin)
    if twin.datum is None and lesson.datum is not None:
        latitude, longitude, altitude = lesson.datum
        datum = Datum(latitude=latitude, longitude=longitude, altitude=altitude)
        twin = twin.with_changes({"datum": datum.model_dump()})
    parts = []
    for number, (which, start, end) in enumerate(lesson.passes, 1):
        drive = lesson.drives[which]
        first = float(drive.imu.t[0])
        parts.append(DrivenPart(drive, start - first, end - first, f"pass {number}"))
    found = road_from_drives(parts, twin, _SETTINGS, progress)
    out = Path(lesson.out)
    with together():
        record = write_estimate(found, twin, out)
        on_it = twin.model_copy(update={"road": RoadFile(file=out.absolute())})
        save_twin(on_it, twin_path(out), "# On a road that was learnt while driving, see road.file.\n")
    return {
        "twin": str(twin_path(out).absolute()),
        "passes": len(found.passes),
        "length": float(found.covered.sum() * found.profiles.line.step),
        "warnings": list(record["warnings"]),
    }
