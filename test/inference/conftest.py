# SPDX-License-Identifier: Apache-2.0
"""A car, a road with bumps and a drive over it whose truth is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.drive.types import Drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.road import Road, add_bump, bump_road, circular
from suspension_twin.vehicle.twin import Datum, Twin, load_twin

KNOTS = [(0.0, 0.0), (3.0, 0.0), (6.0, 5.0), (14.0, 6.0), (16.0, 0.0), (19.5, 0.0)]


@pytest.fixture(scope="session")
def twin(repository: Path) -> Twin:
    loaded = load_twin(repository / "config" / "twins" / "ford_mondeo_mk4.yaml")
    return loaded.model_copy(update={"road": None, "datum": Datum(latitude=47.4, longitude=19.3)})


@pytest.fixture(scope="session")
def bumps() -> Road:
    road = bump_road(
        circular(0.9, 0.04), at=[22.0, 40.0], length=80.0, width=6.0, step=0.02, x=3.0, y=-4.0, heading=0.5
    )
    return add_bump(road, circular(0.9, 0.03), 31.0, v_low=0.0)


@pytest.fixture(scope="session")
def drive(twin: Twin, bumps: Road) -> Drive:
    return synthetic_drive(twin, bumps, KNOTS, seed=1, errors=SensorErrors(), name="bumps")
