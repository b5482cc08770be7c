# SPDX-License-Identifier: Apache-2.0
"""From recorded drives to a road file with its uncertainty beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspension_twin.addons.roads.drives.estimate import (
    STEP,
    RoadEstimate,
    RoadEstimateSettings,
    WheelProfiles,
    estimate_road,
)
from suspension_twin.addons.roads.recording import Observation, prepare_drive, with_datum
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.files import Json, write_text
from suspension_twin.road.build import Centreline
from suspension_twin.road.crg import record_path, write_road
from suspension_twin.road.road import Road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["DrivenPart", "road_from_drives", "surface_of", "write_estimate"]

#: Channels are compared up to the wheel hop and beyond; the default low-pass takes half of that away.
_FILTER = FilterSpec(order=4, cutoff=30.0)


@dataclass(frozen=True, eq=False)
class DrivenPart:
    """A recorded drive, or its part from ``start`` to ``end`` s after its first sample."""

    drive: Drive
    start: float = 0.0
    end: float = math.inf
    label: str = ""

    @property
    def whole(self) -> bool:
        """Whether it is the whole drive."""
        return self.start <= 0.0 and not math.isfinite(self.end)

    @property
    def name(self) -> str:
        """``label``, or the drive's name with the part of it."""
        part = "" if self.whole else f"@{self.start:g}..{self.end:g}"
        return self.label or f"{self.drive.name}{part}"

    def of(self, prepared: Observation) -> Observation:
        """The part of the prepared drive."""
        if self.whole:
            return prepared
        begin = float(prepared.t[0])
        end = begin + self.end if math.isfinite(self.end) else float(prepared.t[-1]) + 1.0
        return prepared.part(begin + self.start, end)


def road_from_drives(
    parts: Sequence[DrivenPart | Drive],
    twin: Twin,
    settings: RoadEstimateSettings | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> RoadEstimate:
    """Estimate the road under both wheel paths from drives with a calibrated vehicle.

    Parameters
    ----------
    parts : sequence of DrivenPart or Drive
        One drive or more over the same road in the same direction; the more and the more different their
        speeds, the better.
    twin : Twin
        The calibrated twin.
    settings : RoadEstimateSettings, optional
        Iterations, draws and the seed.
    progress : callable, optional
        Called with a text and the share of the work that is done.

    Returns
    -------
    RoadEstimate
        Heights with draws of their errors; :func:`write_estimate` writes it.

    Raises
    ------
    InputError
        A twin without four wheels, or a drive that does not fit the others, naming it.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> part = DrivenPart(read_drive("bags/bump_15kmh"), 8.0, 20.0)
    >>> found = road_from_drives([part], load_twin("bags/bump_15kmh/twin.yaml"), RoadEstimateSettings(2, 2))
    >>> bool(found.profiles.heights.max() > 0.02)
    True
    """
    if "front" not in twin.axles:
        raise InputError(
            "twin", "model", f"a road is estimated with the axles of a car, {twin.model} has none"
        )
    pieces = [part if isinstance(part, DrivenPart) else DrivenPart(part) for part in parts]
    if not pieces:
        raise InputError("drives", "none is given")
    twin = with_datum(twin, pieces[0].drive)
    read: dict[Drive, Observation] = {}
    for drive in dict.fromkeys(piece.drive for piece in pieces):
        progress(f"reading {drive.name}", 0.0)
        read[drive] = prepare_drive(drive, twin, _FILTER)
    prepared = [replace(piece.of(read[piece.drive]), name=piece.name) for piece in pieces]
    return estimate_road(prepared, twin, settings, progress)


def surface_of(found: RoadEstimate, name: str = "road from drives") -> Road:
    """The road as far as it was driven over; NaN between, where no drive was on the move."""
    covered = np.flatnonzero(found.covered)
    if covered.size < 2:
        raise InputError("drives", "none of them was on the move on this road")
    part, whole = slice(int(covered[0]), int(covered[-1]) + 1), found.profiles
    line = Centreline(whole.line.x[part], whole.line.y[part], STEP)
    heights = np.where(found.covered, whole.heights, np.nan)[..., part][..., : line.x.size]
    return WheelProfiles(line, whole.track, heights, whole.across).road(name)


def write_estimate(found: RoadEstimate, twin: Twin, path: Path) -> Json:
    """Write the road to ``path`` and its uncertainty to the record beside it; return the record.

    Parameters
    ----------
    found : RoadEstimate
        From :func:`road_from_drives`.
    twin : Twin
        With which it was found.
    path : Path
        The OpenCRG file; the record has its name with ``.json``.

    Returns
    -------
    dict
        The record.

    Examples
    --------
    >>> import tempfile
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> twin = load_twin("bags/bump_15kmh/twin.yaml")
    >>> part = DrivenPart(read_drive("bags/bump_15kmh"), 8.0, 20.0)
    >>> found = road_from_drives([part], twin, RoadEstimateSettings(2, 2))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_estimate(found, twin, Path(folder) / "road.crg")["origin"]
    'drives'
    """
    road = surface_of(found, path.stem)
    first = int(np.flatnonzero(found.covered)[0])
    sigma = found.sigma()[:, first : first + road.u.size]
    every = round(1.0 / STEP)
    datum = found.passes[0].prepared.twin.datum
    assert datum is not None
    moved = [p.base + s @ p.knots for p, s in zip(found.passes, found.shifts, strict=True)]
    record: Json = {
        "origin": "drives",
        "vehicle": getattr(twin.vehicle, "name", ""),
        "datum": {"latitude": datum.latitude, "longitude": datum.longitude, "altitude": datum.altitude},
        "track": found.profiles.track,
        "drives": [
            {
                "name": p.name,
                "speed": p.speed,
                "shift": {"rms": float(np.sqrt(np.mean(m**2))), "prior_sigma": p.shift_sigma},
            }
            for p, m in zip(found.passes, moved, strict=True)
        ],
        "wavelengths": found.by_wavelength(),
        "per_metre": {
            "u": road.u[::every].tolist(),
            "left_sigma": sigma[0, ::every].tolist(),
            "right_sigma": sigma[1, ::every].tolist(),
            "band": "waves between 0.5 and 10 m",
        },
        "iterations": list(found.history),
        "warnings": list(found.warnings),
    }
    if found.vehicle is not None:
        record["joint"] = {
            "parameters": found.vehicle.as_list(),
            "amplitude_sigma": found.vehicle.amplitude,
            "not_separable": found.vehicle.not_separable(),
        }
    names = ", ".join(p.name for p in found.passes)
    write_road(road, path, comment=f"Estimated from drives by suspension_twin: {names}")
    write_text(record_path(path), json.dumps(record, indent=1) + "\n")
    return record
