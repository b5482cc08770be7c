# SPDX-License-Identifier: Apache-2.0
"""Response of the twin to versions of a scanned road: its vertical acceleration on each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfiltfilt

from suspension_twin.addons.roads.recording import MOVING, Observation, simulated_channels
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.synthetic import path_along
from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.pose.types import Trajectory
from suspension_twin.road.road import Road
from suspension_twin.signals.filters import FilterSpec
from suspension_twin.vehicle.twin import Twin

__all__ = ["RoadResponse", "road_responses", "steady_path", "vertical_acceleration"]

_RATE = 200.0
#: s after the start in which the car settles.
_SETTLE = 1.0


@dataclass(frozen=True)
class RoadResponse:
    """Vertical acceleration on one version of a road.

    Parameters
    ----------
    name : str
        Of the version.
    rms, peak : float
        m/s².
    difference : float
        rms in m/s² of the difference from the written version.
    gap : float or None
        rms in m/s² of the residual to what a drive measured, None without one.
    """

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


def vertical_acceleration(road: Road, twin: Twin, path: Trajectory | Observation) -> Floats:
    """Filtered vertical acceleration (n,) m/s² at the sensor, on a path or over a prepared drive."""
    if isinstance(path, Observation):
        return simulated_channels(path, twin, road)["vertical_acceleration"]
    response = simulate_twin(twin, excitation(path, twin.vehicle, road))
    out: Floats = sosfiltfilt(FilterSpec().sections(_RATE), response.vertical_acceleration)
    return out[round(_SETTLE * _RATE) :]


def road_responses(
    roads: Mapping[str, Road], written: str, twin: Twin, path: Trajectory | Observation
) -> list[RoadResponse]:
    """The twin over versions of one road, compared with the version that is ``written``.

    Over a drive the rms is of the samples on the road and on the move.
    """
    signals = {name: vertical_acceleration(road, twin, path) for name, road in roads.items()}
    measured, mask = None, np.ones(signals[written].size, dtype=np.bool_)
    if isinstance(path, Observation):
        road, way = roads[written], path.trajectory
        u, v = road.xy_to_uv(way.x, way.y)
        end = road.length - max(float(path.twin.vehicle.wheel_positions[:, 0].max()), 0.0) - 0.5
        on = (u > 0.5) & (u < end) & (np.abs(v) < 0.5 * road.width) & (way.speed > MOVING)
        mask = np.interp(path.t, way.t, on.astype(np.float64)) > 0.99
        if mask.sum() < 2.0 * path.rate:
            raise InputError(path.name, "is on the road for less than 2 s")
        measured = path.measured["vertical_acceleration"]

    def rms(a: Floats) -> float:
        return float(np.sqrt(np.mean(a[mask] ** 2)))

    return [
        RoadResponse(
            name,
            rms(a),
            float(np.abs(a[mask]).max()),
            rms(a - signals[written]),
            None if measured is None else rms(measured - a),
        )
        for name, a in signals.items()
    ]
