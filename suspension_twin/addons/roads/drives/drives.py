# SPDX-License-Identifier: Apache-2.0
"""From recorded drives to a road file with its uncertainty beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.addons.roads.drives.estimate import STEP, Estimate, Settings, estimate_road, lanes_road
from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.files import write_text
from suspension_twin.inference.observation import Observation, ObserveSettings, observe
from suspension_twin.road.build import Centreline, flat_road
from suspension_twin.road.crg import record_path, write_road
from suspension_twin.road.road import Road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["Part", "road_from_drives", "surface_of", "with_datum", "write_estimate"]

#: Channels are compared up to the wheel hop and beyond; the default low-pass takes half of that away.
_FILTER = FilterSpec(order=4, cutoff=30.0)


@dataclass(frozen=True, eq=False)
class Part:
    """A recorded drive, or what lies ``start`` to ``end`` s after its first sample."""

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


def road_from_drives(
    parts: Sequence[Part | Drive],
    twin: Twin,
    settings: Settings | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Estimate:
    """Estimate the road under both wheel paths from drives with a calibrated vehicle.

    Parameters
    ----------
    parts : sequence of Part or Drive
        One drive or more over the same road in the same direction; the more and the more different their
        speeds, the better.
    twin : Twin
        The calibrated twin.
    settings : Settings, optional
        Iterations, draws and the seed.
    progress : callable, optional
        Called with a text and the share of the work that is done.

    Returns
    -------
    Estimate
        Heights with draws of their errors; :func:`write_estimate` writes it.

    Raises
    ------
    InputError
        A twin without four wheels, or a drive that does not fit the others, naming it.

    Examples
    --------
    >>> from suspension_twin.drive.read import read_drive
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> part = Part(read_drive("bags/bump_15kmh"), 8.0, 20.0)
    >>> found = road_from_drives([part], load_twin("bags/bump_15kmh/twin.yaml"), Settings(2, 2))
    >>> bool(found.heights.max() > 0.02)
    True
    """
    if "front" not in twin.axles:
        raise InputError(
            "twin", "model", f"a road is estimated with the axles of a car, {twin.model} has none"
        )
    pieces = [part if isinstance(part, Part) else Part(part) for part in parts]
    if not pieces:
        raise InputError("drives", "none is given")
    twin = with_datum(twin, pieces[0].drive)
    ground = flat_road()
    known: dict[int, Observation] = {}
    prepared = []
    for piece in pieces:
        whole = known.get(id(piece.drive))
        if whole is None:
            progress(f"reading {piece.drive.name}", 0.0)
            whole = observe(piece.drive, twin, ground, ObserveSettings(filter=_FILTER))
            known[id(piece.drive)] = whole
        if piece.whole:
            prepared.append(replace(whole, name=piece.name))
        else:
            begin = float(whole.t[0])
            end = begin + piece.end if math.isfinite(piece.end) else float(whole.t[-1]) + 1.0
            prepared.append(replace(whole.part(begin + piece.start, end), name=piece.name))
    return estimate_road(prepared, twin, settings, progress)


def with_datum(twin: Twin, drive: Drive) -> Twin:
    """A twin file without a datum counts from the first fix of the first drive."""
    if twin.datum is not None:
        return twin
    good = np.flatnonzero((drive.fix.status >= 0) & np.isfinite(drive.fix.latitude))
    if not good.size:
        raise InputError(drive.name, "fix", "has no usable GNSS fix: without a position there is no road")
    i = int(good[0])
    place = {"latitude": float(drive.fix.latitude[i]), "longitude": float(drive.fix.longitude[i])}
    return twin.with_changes({"datum": {**place, "altitude": 0.0}})


def surface_of(found: Estimate, name: str = "road from drives") -> Road:
    """The road as far as it was driven over; NaN between, where no drive was on the move."""
    covered = np.flatnonzero(found.covered)
    if covered.size < 2:
        raise InputError("drives", "none of them was on the move on this road")
    part = slice(int(covered[0]), int(covered[-1]) + 1)
    line = Centreline(found.line.x[part], found.line.y[part], STEP)
    whole = found.heights if found.surface is None else found.surface
    heights: Floats = np.where(found.covered, whole, np.nan)[..., part][..., : line.x.size]
    return lanes_road(line, heights, found.track, name, found.across if found.surface is not None else None)


def write_estimate(found: Estimate, twin: Twin, path: Path) -> dict[str, Any]:
    """Write the road to ``path`` and what is known of it to the record beside it; return the record.

    Parameters
    ----------
    found : Estimate
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
    >>> found = road_from_drives([Part(read_drive("bags/bump_15kmh"), 8.0, 20.0)], twin, Settings(2, 2))
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
    record: dict[str, Any] = {
        "origin": "drives",
        "vehicle": getattr(twin.vehicle, "name", ""),
        "datum": {"latitude": datum.latitude, "longitude": datum.longitude, "altitude": datum.altitude},
        "track": found.track,
        "drives": [
            {
                "name": p.name,
                "speed": p.speed,
                "shift": {
                    "rms": float(np.sqrt(np.mean((p.base + s @ p.knots) ** 2))),
                    "prior_sigma": p.shift_sigma,
                },
            }
            for p, s in zip(found.passes, found.shifts, strict=True)
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
