# SPDX-License-Identifier: Apache-2.0
"""What the twin feels of a scanned road: its vertical acceleration on several versions of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfiltfilt

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import Observation
from suspension_twin.inference.synthetic import path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.types import Trajectory
from suspension_twin.road.road import Road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["Felt", "feel", "steady_path", "vertical_acceleration"]

_RATE = 200.0
#: s after the start in which the car settles.
_SETTLE = 1.0


@dataclass(frozen=True)
class Felt:
    """Vertical acceleration on one version of a road: ``rms`` and ``peak`` m/s², and ``difference``, the rms of the
    difference from the written version, m/s². ``gap`` m/s² rms to what a drive measured, None without one."""

    name: str
    rms: float
    peak: float
    difference: float
    gap: float | None = None


def steady_path(road: Road, twin: Twin, speed: float) -> Trajectory:
    """A drive along the middle of a road at ``speed`` m/s, as far as all wheels are on it."""
    wheels = twin.vehicle.wheel_positions
    begin = max(0.0, -float(wheels[:, 0].min())) + 0.1
    seconds = (road.length - begin - max(0.0, float(wheels[:, 0].max())) - 0.1) / speed
    if seconds < 2.0 * _SETTLE:
        raise InputError("road", f"is too short to be driven at {3.6 * speed:.0f} km/h: {road.length:.1f} m")
    t = np.arange(0.0, seconds, 1.0 / _RATE)
    return path_along(road, t, ((0.0, speed), (seconds, speed)), begin)


def vertical_acceleration(
    road: Road, twin: Twin, path: Trajectory | Observation, max_step: float = 1e-3
) -> Floats:
    """Filtered vertical acceleration (n,) m/s² at the sensor, on a path or over a prepared drive."""
    if isinstance(path, Observation):
        driven = excitation(path.trajectory, twin.vehicle, road, max_step, twin.gps.position[2])
        return path.condition(simulate_twin(twin, driven))["vertical_acceleration"]
    response = simulate_twin(twin, excitation(path, twin.vehicle, road, max_step))
    out: Floats = sosfiltfilt(FilterSpec().sections(_RATE), response.vertical_acceleration)
    return out[round(_SETTLE * _RATE) :]


def feel(roads: Mapping[str, Road], written: str, twin: Twin, path: Trajectory | Observation) -> list[Felt]:
    """The twin over versions of one road, the first row the version that is ``written``.

    Over a drive the rms is of where the drive is on the road and moves.
    """
    signals = {name: vertical_acceleration(road, twin, path) for name, road in roads.items()}
    mask = np.ones(signals[written].size, dtype=np.bool_)
    if isinstance(path, Observation):
        road = roads[written]
        u, v = road.xy_to_uv(path.trajectory.x, path.trajectory.y)
        base = float(max(path.twin.vehicle.wheel_positions[:, 0].max(), 0.0))
        on = (
            (u > 0.5)
            & (u < road.length - base - 0.5)
            & (np.abs(v) < 0.5 * road.width)
            & (path.trajectory.speed > 1.0)
        )
        mask = np.interp(path.t, path.trajectory.t, on.astype(np.float64)) > 0.99
        if mask.sum() < 2.0 * path.rate:
            raise InputError(path.name, "is on the road for less than 2 s")
    rows = []
    for name, a in signals.items():
        gap = None
        if isinstance(path, Observation):
            gap = _rms((path.measured["vertical_acceleration"] - a)[mask])
        rows.append(
            Felt(name, _rms(a[mask]), float(np.abs(a[mask]).max()), _rms((a - signals[written])[mask]), gap)
        )
    return rows


def _rms(a: Floats) -> float:
    return float(np.sqrt(np.mean(a**2)))
