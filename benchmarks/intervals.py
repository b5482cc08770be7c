# SPDX-License-Identifier: Apache-2.0
"""Whether the intervals of a calibration hold the true characteristics of cars that other code simulates.

    python benchmarks/intervals.py [--cars N] [--first SEED] [--reality NAME ...] [--exact-road] [--apart] [--json]

Cars without a fault by the realities of ``blind/``, which share nothing with the package's models, on their usual road
and over a single hump. A twin file with preset characteristics is calibrated as documented. Of every characteristic
this prints which share of the excited range the 90 % interval holds the truth on, and by how much the curve is off, as
the rms over the range. Springs are compared from where they bear the twin's load: their travel at rest shows in no
signal. Forces count for the mass of the twin file, which is up to a per cent off.

``--apart`` calibrates on each of the two drives of the usual road alone, and prints the difference of the points found
over the deviation that the intervals state of it, as the rms: 1 where they are right from drive to drive.

``--exact-road`` takes the heights of the road file without the survey's noise of 0.3 mm. Seeds that a method was made
on are below 71 000 000.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from blind import phone
from blind.folder import RUN, road_file, twin_file
from blind.plan import Spec
from blind.world import (
    DAMPER_N,
    DAMPER_REACH,
    FILE_DU,
    FILE_DV,
    SPRING_N,
    SPRING_REACH,
    Scene,
    World,
    make_world,
)
from numpy.typing import NDArray
from options import parse_options
from rich.console import Console
from rich.table import Table

from suspension_twin.api import calibrate
from suspension_twin.calibration.request import CurveEstimate
from suspension_twin.calibration.uncertainty import HALF_WIDTH
from suspension_twin.drive.write import write_drive
from suspension_twin.road import write_road
from suspension_twin.vehicle.twin import load_twin, parse_twin, save_twin

Floats = NDArray[np.float64]
#: The drives that are calibrated on, by scene: a single hump is driven over once.
DRIVES: dict[Scene, tuple[str, ...]] = {"usual": ("drive_fast", "drive_slow"), "bump": ("drive_slow",)}
COMPRESSIONS = np.linspace(0.0, SPRING_REACH, SPRING_N + 1)  # m
VELOCITIES = np.linspace(0.0, DAMPER_REACH, DAMPER_N + 1)  # m/s


def write_car(folder: Path, reality: str, world: World, scene: Scene, exact: bool) -> None:
    """Twin file, road and drives of a sound car."""
    folder.mkdir(parents=True)
    for name in DRIVES[scene]:
        plan = world.plans[name]
        write_drive(phone.record(world, plan, RUN[reality](world, plan, {}), {}, name), folder / name)
    heights = world.surface.surveyed(FILE_DU, FILE_DV, 0.0, 0.0, 0) if exact else world.survey
    write_road(road_file(world, heights), folder / "road.crg", comment="Surveyed road")
    spec = Spec(folder.name, "null", (), 0.0, world.seed, reality, reference=False)
    save_twin(parse_twin(twin_file(world, spec)), folder / "twin.yaml")


def compared(curve: CurveEstimate, world: World, scale: float) -> tuple[Floats, Floats, Floats, Floats]:
    """(n,) low and high end of the interval, the found and the true force over the excited range; ``scale`` the twin's
    mass over the true one."""
    _, axle, part = curve.key.split(".")
    strut = getattr(world.car, axle)
    x, low, high, force = curve.band.x, curve.band.low, curve.band.high, curve.force
    if part == "spring":
        assert curve.from_rest is not None
        load = float(np.interp(curve.static, x, force))
        travel, low, high = curve.from_rest.x, curve.from_rest.low, curve.from_rest.high
        at_rest = float(np.interp(load, scale * strut.spring, COMPRESSIONS))
        true = scale * np.interp(at_rest + travel, COMPRESSIONS, strut.spring)
        return low, high, np.interp(curve.static + travel, x, force), np.asarray(true)
    table = strut.push if part == "damper_push" else strut.pull
    inside = (x > 0.0) & (x <= curve.span[1])
    true = scale * np.interp(x[inside], VELOCITIES, table)
    return low[inside], high[inside], force[inside], np.asarray(true)


def rows_of(reality: str, seed: int, scene: Scene, exact: bool) -> Iterator[dict[str, Any]]:
    """A row for each characteristic of a car."""
    world = make_world(seed, False, scene)
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case"
        write_car(case, reality, world, scene, exact)
        twin = load_twin(case / "twin.yaml")
        found = calibrate(twin, [str(case / name) for name in DRIVES[scene]])
    scale = float(twin.vehicle.mass) / world.car.mass
    for curve in found.curves:
        if curve.key.endswith("spring") and curve.from_rest is None:
            continue
        low, high, force, true = compared(curve, world, scale)
        yield {
            "reality": reality,
            "seed": seed,
            "scene": scene,
            "key": curve.key,
            "covered": float(np.mean((low <= true) & (true <= high))),
            "error": float(np.sqrt(np.mean((force - true) ** 2) / np.mean(true**2))),
            "half_width": float(np.mean(0.5 * (high - low)) / np.sqrt(np.mean(true**2))),
        }


def apart(reality: str, seed: int, exact: bool) -> Iterator[dict[str, Any]]:
    """A row for each point of a characteristic: what two drives found of it differs by so many stated deviations."""
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case"
        write_car(case, reality, make_world(seed), "usual", exact)
        twin = load_twin(case / "twin.yaml")
        found = [calibrate(twin, [str(case / name)]) for name in DRIVES["usual"]]
    for one, other in zip(*(result.estimates for result in found), strict=True):
        sigma = float(np.hypot(one.high - one.low, other.high - other.low)) / (2.0 * HALF_WIDTH)
        if ".force." in one.key and one.key == other.key and 0.0 < sigma < np.inf:
            yield {"reality": reality, "seed": seed, "key": one.key, "z": (one.value - other.value) / sigma}


def show_apart(rows: list[dict[str, Any]], console: Console) -> None:
    """The table of ``--apart``."""
    table = Table(
        title="Points found on either drive of a sound car: difference over its stated deviation, rms"
    )
    for title in ("reality", "characteristic", "points", "rms"):
        table.add_column(title)
    for reality in sorted({row["reality"] for row in rows}):
        for part in ("spring", "damper_push", "damper_pull"):
            own = [r["z"] for r in rows if r["reality"] == reality and f".{part}." in r["key"]]
            rms = f"{np.sqrt(np.mean(np.square(own))):.2f}" if own else ""
            table.add_row(reality, part.replace("_", " "), str(len(own)), rms)
    console.print(table)


def main() -> None:
    """Parse the command line and print the table, or JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cars", type=int, default=5, help="of each reality and scene")
    parser.add_argument("--first", type=int, default=71_000_000, help="seed of the first car")
    parser.add_argument("--reality", nargs="+", choices=sorted(RUN), default=["newton", "multibody"])
    parser.add_argument("--exact-road", action="store_true", help="road heights without a survey's noise")
    parser.add_argument("--apart", action="store_true", help="on each of two drives alone")
    parser.add_argument("--json", action="store_true")
    given = parse_options(parser, cars=1, reality=["newton"])
    if given.apart:
        seeds = range(given.first, given.first + given.cars)
        rows = [row for r in given.reality for seed in seeds for row in apart(r, seed, given.exact_road)]
        show_apart(rows, Console(stderr=given.json))
        if given.json:
            print(json.dumps({"rows": rows}))
        return
    scenes: tuple[Scene, ...] = ("bump",) if given.smoke else ("usual", "bump")
    rows = [
        row
        for scene in scenes
        for reality in given.reality
        for seed in range(given.first, given.first + given.cars)
        for row in rows_of(reality, seed, scene, given.exact_road)
    ]
    table = Table(title="Share of the excited range on which the 90 % interval holds the truth")
    for title in ("drives", "characteristic", "curves", "covered", "half of the interval", "error"):
        table.add_column(title)
    for scene in scenes:
        for part in ("spring", "damper_push", "damper_pull"):
            own = [r for r in rows if r["scene"] == scene and r["key"].endswith(part)]
            if own:
                mean = {
                    k: 100.0 * float(np.mean([r[k] for r in own])) for k in ("covered", "half_width", "error")
                }
                table.add_row(
                    "usual road" if scene == "usual" else "a single hump",
                    part.replace("_", " "),
                    str(len(own)),
                    *(f"{mean[k]:.0f} %" for k in ("covered", "half_width", "error")),
                )
    Console(stderr=given.json).print(table)
    if given.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
