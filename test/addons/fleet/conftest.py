# SPDX-License-Identifier: Apache-2.0
"""A fleet of two vehicles with drives of six seconds over one bump."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import pytest

from suspension_twin.addons.fleet import engine
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.road import bump_road, circular, write_road
from suspension_twin.vehicle.twin import RoadFile, Twin, save_twin


@pytest.fixture(scope="session")
def fleet_folder(tmp_path_factory: pytest.TempPathFactory, mondeo: Twin) -> Path:
    """``twin.yaml``, ``road.crg``, the drives ``one`` and ``two``, two days apart, and ``notes.txt``, which is none."""
    folder = tmp_path_factory.mktemp("fleet")
    road = bump_road(circular(0.9, 0.05), at=14.0, length=45.0, step=0.02, x=-20.0, y=3.0, heading=0.4)
    write_road(road, folder / "road.crg")
    save_twin(mondeo.model_copy(update={"road": RoadFile(file=folder / "road.crg")}), folder / "twin.yaml")
    for days, name in enumerate(("one", "two")):
        errors = SensorErrors(start=1_700_000_000.0 + 2 * 86_400.0 * days)
        drive = synthetic_drive(mondeo, road, [(0.0, 4.2), (6.0, 4.2)], seed=days, errors=errors, name=name)
        write_drive(drive, folder / name)
    (folder / "notes.txt").write_text("no drive")
    return folder


@pytest.fixture
def manifest(fleet_folder: Path) -> Path:
    path = fleet_folder / "fleet.csv"
    path.write_text(
        "vehicle,date,twin,drives\n"
        "car_a,,twin.yaml,one\n"
        "car_a,2023-11-17,twin.yaml,two\n"
        "car_b,,twin.yaml,notes.txt\n"
        "car_b,2024-01-01,twin.yaml,missing\n"
    )
    return path


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers as threads, so that numba's code is loaded once."""
    real = engine.connected

    @contextmanager
    def inside(scheduler: str = "", workers: int = 0, memory: float = 0.0):  # type: ignore[no-untyped-def]
        with real(scheduler, 1, memory, inside=True) as cluster:
            yield cluster

    monkeypatch.setattr(engine, "connected", inside)
