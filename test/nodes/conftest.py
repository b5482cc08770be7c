# SPDX-License-Identifier: Apache-2.0
"""A ROS context, an executor and a bench to put nodes on, new for every test."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for nodes_bench

from nodes_bench import PATIENT, Bench

from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.nodes.process import ros_context
from suspension_twin.road import Road, grid_road, write_road
from suspension_twin.vehicle.twin import RoadFile, Twin, load_twin, save_twin


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A bench in a context of its own, whose nodes skip nothing, however slow the machine."""
    with ros_context(PATIENT) as context:
        made = Bench(context)
        try:
            yield made
        finally:
            made.close()


@pytest.fixture(scope="session")
def bumpy_road() -> Road:
    """120 m straight ahead with waves of 5 m and 1.1 m, 4 cm and 1 cm high at most."""
    u = np.arange(0.0, 130.0, 0.05)
    wave = 0.02 * np.sin(2 * np.pi * u / 5.0) + 0.005 * np.sin(2 * np.pi * u / 1.1)
    wave *= np.clip((u - 12.0) / 3.0, 0.0, 1.0)
    v = np.array([-3.0, 0.0, 3.0])
    return grid_road(np.repeat(wave[:, None], 3, axis=1), 0.05, v, name="bumpy")


@pytest.fixture(scope="session")
def twin(repository: Path) -> Twin:
    """The ready twin of the car paper's vehicle, without a road."""
    return load_twin(repository / "config" / "twins" / "ford_mondeo_mk4.yaml")


@pytest.fixture(scope="session")
def twin_path(tmp_path_factory: pytest.TempPathFactory, twin: Twin, bumpy_road: Road) -> Path:
    """A twin file with the bumpy road beside it."""
    folder = tmp_path_factory.mktemp("twin")
    write_road(bumpy_road, folder / "road.crg")
    on_road = twin.model_copy(update={"road": RoadFile(file=folder / "road.crg")})
    save_twin(on_road, folder / "twin.yaml")
    return folder / "twin.yaml"


@pytest.fixture(scope="session")
def drive(twin: Twin, bumpy_road: Road) -> Drive:
    """Standing for 2 s, then up to 8 m/s over the bumpy road: 14 s at 100 Hz, a few samples lost."""
    knots = [(0.0, 0.0), (2.0, 0.0), (6.0, 8.0), (13.0, 8.0), (14.0, 7.0)]
    return synthetic_drive(twin, bumpy_road, knots, seed=3, errors=SensorErrors(lost=0.002), name="bumpy")


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory, drive: Drive) -> Path:
    """The bumpy drive as a recording."""
    path = tmp_path_factory.mktemp("bags") / "bumpy"
    write_drive(drive, path)
    return path
