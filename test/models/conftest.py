# SPDX-License-Identifier: Apache-2.0
"""Vehicles, ways and roads that the tests of the models share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.pose.types import Trajectory
from suspension_twin.vehicle.twin import Twin, load_twin

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))  # for other_car

TWINS = Path(__file__).resolve().parents[2] / "config" / "twins"


class Ground:
    """A road from a formula of x and y."""

    def __init__(self, formula: Callable[[Any, Any], Any]) -> None:
        self.heights = lambda x, y: np.asarray(formula(np.asarray(x), np.asarray(y)), dtype=float)


@pytest.fixture(scope="session")
def mondeo() -> Twin:
    return load_twin(TWINS / "ford_mondeo_mk4.yaml")


@pytest.fixture(scope="session")
def bmw() -> Twin:
    return load_twin(TWINS / "bmw_320i.yaml")


@pytest.fixture(scope="session")
def stiff(mondeo: Twin) -> Twin:
    """The stiffest dampers that Table 2 of the car paper allows: 100 kN s/m between the last points."""
    changes: dict[str, Any] = {}
    for axle in ("front", "rear"):
        changes[f"vehicle.{axle}.damper_push.force"] = (1000.0, 3000.0, 3000.0, 8000.0)
        changes[f"vehicle.{axle}.damper_pull.force"] = (2000.0, 3000.0, 3000.0, 6000.0)
        changes[f"vehicle.{axle}.spring.force"] = (500.0, 5000.0, 15000.0, 50000.0)
    return mondeo.with_changes(changes)


@pytest.fixture(scope="session")
def ground() -> type[Ground]:
    return Ground


@pytest.fixture(scope="session")
def flat() -> Ground:
    return Ground(lambda x, y: 0.0 * x)


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
            speed=v,
            lateral_speed=zero,
            yaw_rate=zero + yaw_rate,
            ax=zero + ax,
            ay=v * yaw_rate,
            valid=np.ones(s.size, bool),
        )

    return make
