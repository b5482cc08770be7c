# SPDX-License-Identifier: Apache-2.0
"""Cases on disk: a twin file, a road and drives of a car that has what the twin lacks."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import synthetic_drive
from suspension_twin.road import half_sine, write_road
from suspension_twin.road.build import add_bump
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import EffectSpec, RoadFile, Twin, save_twin

sys.path.insert(0, str(Path(__file__).parent))  # for one_channel

KNOTS = ((0.0, 0.0), (0.5, 0.0), (3.0, 7.0), (11.0, 8.0))

Make = Callable[..., tuple[Path, list[str], list[str]]]


@pytest.fixture(scope="session")
def car(mondeo: Twin) -> Twin:
    return mondeo


@pytest.fixture(scope="session")
def make(tmp_path_factory: pytest.TempPathFactory, car: Twin) -> Make:
    """``make(effect, parameters, reference, seed, car, always)``: twin file, bags, reference bags; ``always`` is what
    the car has on all of them that the twin lacks. What is asked for again is not made again: nobody writes into it."""
    made: dict[str, tuple[Path, list[str], list[str]]] = {}

    def build(
        effect: str = "",
        parameters: dict[str, float] | None = None,
        reference: bool = False,
        seed: int = 3,
        car: Twin = car,
        always: tuple[EffectSpec, ...] = (),
    ) -> tuple[Path, list[str], list[str]]:
        asked = repr((effect, parameters, reference, seed, car, always))
        if asked in made:
            return made[asked]
        folder = tmp_path_factory.mktemp(effect or "none")
        road = iso8608_road("B", 130, seed=seed, v_step=0.4)
        road = add_bump(road, half_sine(0.9, 0.05), 50.0)
        road = add_bump(road, half_sine(0.6, 0.04), 75.0, v_low=0.1)
        write_road(road, folder / "road.crg")
        twin = car.model_copy(update={"road": RoadFile(file=folder / "road.crg")})
        save_twin(twin, folder / "twin.yaml")
        stiffer = car.with_changes({"vehicle.front.damper_push.force": [230.0, 480.0, 700.0, 810.0]})
        stiffer = stiffer.model_copy(update={"effects": always})
        specs = (EffectSpec(id=effect, parameters=parameters or {}),) if effect else ()
        truth = stiffer.model_copy(update={"effects": (*always, *specs)})
        bags = []
        for i, factor in enumerate((1.0, 0.7)):
            knots = tuple((t, v * factor) for t, v in KNOTS)
            drive = synthetic_drive(truth, road, knots, seed=10 * seed + i, name=f"drive_{i}")
            write_drive(drive, folder / f"drive_{i}")
            bags.append(str(folder / f"drive_{i}"))
        before = []
        if reference:
            drive = synthetic_drive(stiffer, road, KNOTS, seed=10 * seed + 7, name="before")
            write_drive(drive, folder / "before")
            before.append(str(folder / "before"))
        made[asked] = folder / "twin.yaml", bags, before
        return made[asked]

    return build
