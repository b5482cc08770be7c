# SPDX-License-Identifier: Apache-2.0
"""Ways and roads that the tests of models share, here and of add-ons: fixtures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from suspension_twin.pose.types import Trajectory

__all__ = ["Ground", "drive", "ground", "rough"]


class Ground:
    """A road from a formula of x and y."""

    def __init__(self, formula: Callable[[Any, Any], Any]) -> None:
        self.heights = lambda x, y: np.asarray(formula(np.asarray(x), np.asarray(y)), dtype=float)


@pytest.fixture(scope="session")
def ground() -> type[Ground]:
    return Ground


@pytest.fixture(scope="session")
def rough() -> Ground:
    """Waves of 0.7 to 8 m, unlike under the left and the right wheel."""

    def height(x: Any, y: Any) -> Any:
        return (
            0.02 * np.sin(2 * np.pi * x / 8 + 0.4 * y)
            + 0.008 * np.sin(2 * np.pi * x / 2.1 - 0.9 * y)
            + 0.003 * np.sin(2 * np.pi * x / 0.7 + 2 * y)
        )

    return Ground(height)


@pytest.fixture(scope="session")
def drive() -> Callable[..., Trajectory]:
    """Maker of trajectories: constant speed and yaw rate from the origin, or braking."""

    def make(
        seconds: float = 4.0,
        rate: float = 100.0,
        speed: float = 8.0,
        yaw_rate: float = 0.0,
        ax: float = 0.0,
        t0: float = 1.7e9,
        jitter: float = 0.0,
        seed: int = 0,
    ) -> Trajectory:
        s = np.arange(round(seconds * rate) + 1) / rate
        s += jitter / rate * np.random.default_rng(seed).uniform(-0.5, 0.5, s.size)
        v = speed + ax * s
        yaw = yaw_rate * s
        if yaw_rate:
            x, y = speed / yaw_rate * np.sin(yaw), speed / yaw_rate * (1 - np.cos(yaw))
        else:
            x, y = speed * s + ax * s**2 / 2, 0 * s
        zero = np.zeros_like(s)
        return Trajectory(
            t=t0 + s,
            x=x,
            y=y,
            yaw=yaw,
            velocity=np.column_stack([v, zero]),
            yaw_rate=zero + yaw_rate,
            acceleration=np.column_stack([zero + ax, v * yaw_rate]),
            valid=np.ones(s.size, bool),
        )

    return make
