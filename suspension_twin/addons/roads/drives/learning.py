# SPDX-License-Identifier: Apache-2.0
"""What a running twin learns of its road: passes that were just driven to a road and a twin that stands on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suspension_twin.addons.roads.drives.drives import Part, road_from_drives, write_estimate
from suspension_twin.addons.roads.drives.estimate import Settings
from suspension_twin.drive.types import Drive
from suspension_twin.files import together
from suspension_twin.vehicle.twin import Datum, RoadFile, load_twin, save_twin

__all__ = ["Lesson", "learn_road", "twin_path"]

#: A draw costs as much as the estimate itself.
_SETTINGS = Settings(iterations=4, samples=6, strict=False)


@dataclass(frozen=True)
class Lesson:
    """What a road is learnt from.

    Parameters
    ----------
    twin : str
        The twin file.
    out : str
        The OpenCRG file to write; its record and the twin on it have its name with ``.json`` and ``.yaml``.
    passes : tuple of (Drive, float, float)
        Of each pass the drive that it lies in, and its start and end in s (as the drive's stamps).
    datum : tuple of float, optional
        Latitude and longitude in degrees and altitude in m that the poses count from, where the twin file says none.
    """

    twin: str
    out: str
    passes: tuple[tuple[Drive, float, float], ...]
    datum: tuple[float, float, float] | None = None


def twin_path(out: Path) -> Path:
    """The twin file beside a road that is learnt."""
    return out.with_suffix(".yaml")


def learn_road(
    lesson: Lesson, progress: Callable[[str, float], None] = lambda text, share: None
) -> dict[str, Any]:
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
        twin = twin.with_changes(
            {"datum": Datum(latitude=latitude, longitude=longitude, altitude=altitude).model_dump()}
        )
    parts = []
    for number, (drive, start, end) in enumerate(lesson.passes, 1):
        first = float(drive.imu.t[0])
        parts.append(Part(drive, start - first, end - first, f"pass {number}"))
    found = road_from_drives(parts, twin, _SETTINGS, progress)
    out = Path(lesson.out)
    with together():
        record = write_estimate(found, twin, out)
        on_it = twin.model_copy(update={"road": RoadFile(file=out.absolute())})
        save_twin(on_it, twin_path(out), "# On a road that was learnt while driving, see road.file.\n")
    length = float(found.covered.sum() * found.line.step)
    return {
        "twin": str(twin_path(out).absolute()),
        "passes": len(found.passes),
        "length": length,
        "warnings": list(record["warnings"]),
    }
