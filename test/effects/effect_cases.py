# SPDX-License-Identifier: Apache-2.0
"""A vehicle, ways and roads that the tests of the effects share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from suspension_twin.models.excitation import excitation
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.models.types import Response
from suspension_twin.pose.types import Trajectory
from suspension_twin.vehicle.twin import EffectSpec, Twin

Height = Callable[[Any, Any], Any]


class Ground:
    def __init__(self, formula: Height) -> None:
        self.heights = lambda x, y: np.asarray(formula(np.asarray(x), np.asarray(y)), dtype=float)


def rough(x: Any, y: Any) -> Any:
    """Waves of 0.4 to 8 m, unlike under the left and the right wheel."""
    return (
        0.02 * np.sin(2 * np.pi * x / 8 + 0.4 * y)
        + 0.008 * np.sin(2 * np.pi * x / 2.1 - 0.9 * y)
        + 0.003 * np.sin(2 * np.pi * x / 0.7 + 2 * y)
        + 0.001 * np.sin(2 * np.pi * x / 0.4)
    )


def way(
    seconds: float = 4.0, rate: float = 100.0, speed: float = 8.0, yaw_rate: float = 0.0, ax: float = 0.0
) -> Trajectory:
    s = np.arange(round(seconds * rate) + 1) / rate
    v, zero = speed + ax * s, np.zeros_like(s)
    if yaw_rate:
        x, y = speed / yaw_rate * np.sin(yaw_rate * s), speed / yaw_rate * (1 - np.cos(yaw_rate * s))
    else:
        x, y = speed * s + ax * s**2 / 2, zero
    return Trajectory(
        t=1.7e9 + s,
        x=x,
        y=y,
        yaw=yaw_rate * s,
        velocity=np.column_stack([v, zero]),
        yaw_rate=zero + yaw_rate,
        acceleration=np.column_stack([zero + ax, v * yaw_rate]),
        valid=np.ones(s.size, bool),
    )


def given(twin: Twin, **effects: dict[str, float]) -> Twin:
    """``twin`` with these effects."""
    specs = tuple(EffectSpec(id=name, parameters=values) for name, values in effects.items())
    return twin.model_copy(update={"effects": specs})


def respond(twin: Twin, road: Height = rough, trajectory: Trajectory | None = None) -> Response:
    return simulate_twin(twin, excitation(trajectory or way(), twin.vehicle, Ground(road)))
