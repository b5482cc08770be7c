# SPDX-License-Identifier: Apache-2.0
"""Vehicles, ways and roads that the tests of the models share."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for ways
from ways import Ground, drive, ground, rough

from suspension_twin.vehicle.twin import Twin, load_twin

__all__ = ["drive", "ground", "rough"]

TWINS = Path(__file__).resolve().parents[2] / "config" / "twins"


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
def flat() -> Ground:
    return Ground(lambda x, y: 0.0 * x)
