# SPDX-License-Identifier: Apache-2.0
"""Vehicles, roads and drives with a known truth for ``calibration.py``: seeded, made on the spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from suspension_twin.calibration.presets import TABLE_2, with_table_2
from suspension_twin.drive.types import Drive
from suspension_twin.drive.write import write_drive
from suspension_twin.inference.synthetic import SensorErrors, synthetic_drive
from suspension_twin.road import Road, bump_road, circular, write_road
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.vehicle.twin import Datum, RoadFile, Twin, load_twin, save_twin

ROOT = Path(__file__).resolve().parents[1]
Knots = Sequence[tuple[float, float]]

#: 15 km/h over the bump for ten seconds, as the car paper drove it.
PASS: Knots = [(0.0, 4.17), (10.0, 4.17)]
#: Two drives of 50 s with standstills, slow and faster.
SLOW: Knots = [(0, 0), (3, 0), (8, 5), (40, 6), (46, 0), (50, 0)]
BRISK: Knots = [(0, 0), (3, 0), (8, 8), (25, 9), (40, 14), (47, 0), (50, 0)]
UNSEEN: Knots = [(0, 0), (3, 0), (9, 7), (25, 11), (34, 11), (41, 0), (45, 0)]


def mondeo() -> Twin:
    """The car paper's vehicle with the contract's preset curves."""
    twin = load_twin(ROOT / "config" / "twins" / "ford_mondeo_mk4.yaml")
    return twin.model_copy(update={"road": None, "datum": Datum(latitude=47.4025, longitude=19.284)})


def within_table_2(seed: int) -> tuple[Twin, Twin]:
    """(truth, start): every point anywhere in the middle 80 % of its bounds, and the middle of all."""
    rng = np.random.default_rng(seed)
    base = with_table_2(mondeo())
    truth: dict[str, object] = {}
    start: dict[str, object] = {}
    for key, (_, bounds) in TABLE_2.items():
        low, high = np.array(bounds).T
        truth[f"{key}.force"] = tuple((low + (0.1 + 0.8 * rng.random(len(low))) * (high - low)).tolist())
        start[f"{key}.force"] = tuple((0.5 * (low + high)).tolist())
    return base.with_changes(truth), base.with_changes(start)


def thirty_per_cent_off(seed: int) -> tuple[Twin, Twin]:
    """(truth, start): a plausible car, and a preset whose every characteristic is 30 % above or below it."""
    rng = np.random.default_rng(seed)
    base = mondeo()
    truth: dict[str, object] = {}
    start: dict[str, object] = {}
    for key in TABLE_2:
        _, axle, part = key.split(".")
        x, force = getattr(getattr(base.vehicle, axle), part).points
        slopes = np.diff(np.concatenate([[0.0], force])) / np.diff(np.concatenate([[0.0], x]))
        own = np.exp(0.25 * rng.standard_normal() + 0.12 * rng.standard_normal(slopes.size))
        points = np.cumsum(slopes * own * np.diff(np.concatenate([[0.0], x])))
        truth[f"{key}.force"] = tuple(points.tolist())
        start[f"{key}.force"] = tuple((points * (1.3 if rng.random() < 0.5 else 0.7)).tolist())
    return base.with_changes(truth), base.with_changes(start)


def bump(seed: int) -> Road:
    """A bump across a smooth road, where a pass of ten seconds meets it in the middle."""
    del seed
    return bump_road(
        circular(0.9, 0.05), at=22.0, length=60.0, width=6.0, step=0.02, x=-20.0, y=3.0, heading=0.4
    )


def rough(seed: int) -> Road:
    """ISO 8608 class C, left and right tracks partly coherent."""
    return iso8608_road("C", 480.0, seed=seed, x=5.0, y=-10.0, heading=0.8)


@dataclass(frozen=True)
class Case:
    """Files of one case: the twin to start from, the truth, and the drives."""

    twin: Path
    truth: Path
    drives: dict[str, Path]


def write_case(
    folder: Path,
    truth: Twin,
    start: Twin,
    road: Road,
    knots: dict[str, Knots],
    seed: int,
    errors: SensorErrors,
) -> Case:
    """Simulate the drives of the truth and write all that a calibration reads."""
    folder.mkdir(parents=True, exist_ok=True)
    write_road(road, folder / "road.crg")
    named = RoadFile(file=(folder / "road.crg").resolve())
    paths = {}
    for i, (name, speed) in enumerate(knots.items()):
        drive: Drive = synthetic_drive(truth, road, speed, seed=1000 * seed + i, errors=errors, name=name)
        write_drive(drive, folder / name, overwrite=True)
        paths[name] = folder / name
    for name, twin in (("twin", start), ("truth", truth)):
        save_twin(twin.model_copy(update={"road": named}), folder / f"{name}.yaml")
    return Case(folder / "twin.yaml", folder / "truth.yaml", paths)
