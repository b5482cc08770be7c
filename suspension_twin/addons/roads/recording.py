# SPDX-License-Identifier: Apache-2.0
"""Recorded drives for the estimation of roads: prepared, simulated over a road, and the line that was driven.

Other modules of this add-on take from the inference package no more than priors, the search space and synthetic paths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import Observation, ObserveSettings, first_fix, observe
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import HeightField
from suspension_twin.pose.types import Trajectory
from suspension_twin.road.build import Centreline, flat_road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = [
    "MOVING",
    "Observation",
    "line_of",
    "prepare_drive",
    "simulated_channels",
    "smoothed_line",
    "with_datum",
]

#: A vehicle moves above this speed, m/s: below, errors of clocks and of the map blur what little the wheels meet.
MOVING = 1.0
#: A line has a point every so many m, smoothed over about so many.
_KNOT, _SMOOTH = 0.5, 1.5


def with_datum(twin: Twin, drive: Drive) -> Twin:
    """The twin with a datum: where its file has none, the first fix of the drive at altitude 0."""
    if twin.datum is not None:
        return twin
    return twin.with_changes({"datum": first_fix(drive).model_dump() | {"altitude": 0.0}})


def prepare_drive(drive: Drive, twin: Twin, low_pass: FilterSpec | None = None) -> Observation:
    """Pose and filtered channels of a drive on a level road. Raises InputError."""
    return observe(drive, twin, flat_road(), ObserveSettings(filter=low_pass or FilterSpec()))


def simulated_channels(
    drive: Observation,
    twin: Twin,
    ground: HeightField,
    max_step: float = 1e-3,
    trajectory: Trajectory | None = None,
) -> dict[str, Floats]:
    """Channels (m,) of the twin driven over some ground on the path of a drive, through the drive's filter.

    ``max_step`` is the longest step of the simulation in s; ``trajectory`` replaces the drive's own.
    """
    path = drive.trajectory if trajectory is None else trajectory
    driven = excitation(path, twin.vehicle, ground, max_step, twin.gps.position[2])
    return drive.condition(simulate_twin(twin, driven))


def line_of(paths: Sequence[Trajectory], step: float, margin: float) -> Centreline:
    """A line along the drives: the longest path on the move, ``margin`` m longer at both ends."""
    moving = [path.speed > MOVING for path in paths]
    lines = [(p.x[on], p.y[on]) for p, on in zip(paths, moving, strict=True) if on.sum() > 10]
    if not lines:
        raise InputError("drives", f"none of them moves faster than {MOVING:g} m/s")
    x, y = max(lines, key=lambda p: float(np.hypot(np.diff(p[0]), np.diff(p[1])).sum()))
    return smoothed_line(x, y, step, margin)


def smoothed_line(x: Floats, y: Floats, step: float, margin: float = 0.0) -> Centreline:
    """A line through points (n,) m, smoothed over about a metre and a half, ``margin`` m longer at both ends."""
    rough = Centreline(x, y, _KNOT)
    # Straight on at both ends, in the direction of the first and of the last metres.
    more = math.ceil((margin + 4.0 * _SMOOTH) / _KNOT)
    reach = min(round(3.0 / _KNOT), rough.x.size - 1)
    points = np.column_stack([rough.x, rough.y])
    steps = np.arange(1, more + 1)[:, None] * _KNOT
    first, last = ((points[i] - points[j]) for i, j in ((0, reach), (-1, -1 - reach)))
    before = points[0] + steps[::-1] * first / np.hypot(*first)
    after = points[-1] + steps * last / np.hypot(*last)
    # A path wavers where the drive is slow; a line that turns on the spot has no road to its sides.
    smooth = gaussian_filter1d(np.vstack([before, points, after]), _SMOOTH / _KNOT, axis=0, mode="nearest")
    extra = more - math.ceil(margin / _KNOT)
    smooth = smooth[extra : smooth.shape[0] - extra]
    at = np.arange(smooth.shape[0])
    fine = CubicSpline(at, smooth)(np.linspace(0.0, at[-1], 20 * (at.size - 1) + 1))
    return Centreline(fine[:, 0], fine[:, 1], step)
