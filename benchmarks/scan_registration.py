# SPDX-License-Identifier: Apache-2.0
"""Clouds in coordinates of their own, fitted to a drive: how far off the place is.

    python benchmarks/scan_registration.py [--seeds 1..8] [--json]

For each seed a car and a road of ``blind/``, driven by the equations of ``blind/newton.py``, which share nothing with
the package's models, and recorded with the noise of a phone and an RTK receiver. The first 90 m of the road are scanned
by the mobile scanner of ``scanners.py`` (cars, a person, grass, a kerb), turned and moved at random. The twin is the
uncalibrated one of the case. Errors (rms) are those of the ground along the drive, to the left and ahead, and of the
turn.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from blind import newton, phone  # noqa: E402
from blind.folder import road_file, twin_file  # noqa: E402
from blind.plan import Spec  # noqa: E402
from blind.world import drive_plan, make_world  # noqa: E402
from options import parse_options  # noqa: E402
from road_scan import make_site  # noqa: E402
from scanners import mobile  # noqa: E402

from suspension_twin.addons.roads.scan.clouds import Cloud, Georeference  # noqa: E402
from suspension_twin.addons.roads.scan.registration import register  # noqa: E402
from suspension_twin.drive.read import read_drive  # noqa: E402
from suspension_twin.drive.write import write_drive  # noqa: E402
from suspension_twin.errors import InputError  # noqa: E402
from suspension_twin.inference.observation import ObserveSettings, observe  # noqa: E402
from suspension_twin.road.build import flat_road  # noqa: E402
from suspension_twin.vehicle.twin import parse_twin  # noqa: E402

LENGTH = 90.0


def case(seed: int) -> dict[str, Any]:
    """One cloud on one drive."""
    world, rng = make_world(seed), np.random.default_rng([seed, 77])
    plan = drive_plan(np.random.default_rng([seed, 1]), 4.0, 9.0, 1, seed, 0.0)
    spec = Spec("registration", "null", (), 0.0, seed, "newton", reference=False)
    twin = parse_twin({**twin_file(world, spec), "road": None})
    with tempfile.TemporaryDirectory() as name:
        write_drive(phone.record(world, plan, newton.run(world, plan, {}), {}, "drive"), Path(name) / "drive")
        drive = observe(read_drive(Path(name) / "drive"), twin, flat_road(), ObserveSettings())
    road = road_file(world, world.survey)
    cloud = mobile(make_site("world", road, LENGTH, seed).ground, seed).points
    cloud = cloud[(cloud[:, 0] > 0.0) & (cloud[:, 0] < min(LENGTH, road.length) - 0.02)]
    u, inner = cloud[:, 0], np.clip(cloud[:, 1], -0.5 * road.width + 0.01, 0.5 * road.width - 0.01)
    x, y = road.uv_to_xy(u, inner)
    ahead = road.uv_to_xy(u + 0.01, inner)
    heading = np.arctan2(ahead[1] - y, ahead[0] - x)
    beside = cloud[:, 1] - inner
    true = np.column_stack([x - np.sin(heading) * beside, y + np.cos(heading) * beside])
    turn, move = rng.uniform(-math.pi, math.pi), rng.uniform(-300.0, 300.0, 2)
    c, s = math.cos(turn), math.sin(turn)
    own = np.column_stack([true @ np.array([[c, -s], [s, c]]).T + move, cloud[:, 2] + 30.0])
    began = time.monotonic()
    row: dict[str, Any] = {"seed": seed, "points": len(own)}
    try:
        found = register(
            [(Cloud(Path("own.las"), len(own), None, lambda: iter([own])), Georeference())], drive, twin
        )
    except InputError as error:
        return {**row, "refused": str(error)}
    near = np.abs(cloud[:, 1]) < 1.0
    off = Georeference(turn=found.turn, move=found.move).to_map(own[near])[:, :2] - true[near]
    cos, sin = np.cos(heading[near]), np.sin(heading[near])
    return {
        **row,
        "seconds": time.monotonic() - began,
        "compared_s": found.seconds,
        "correlation": found.correlation,
        "next_best": found.next_best,
        "turn_deg": abs(math.degrees(math.remainder(found.turn + turn, 2.0 * math.pi))),
        "ahead_m": float(np.sqrt(np.mean((cos * off[:, 0] + sin * off[:, 1]) ** 2))),
        "left_m": float(np.sqrt(np.mean((cos * off[:, 1] - sin * off[:, 0]) ** 2))),
    }


def main() -> None:
    """All seeds, as a table or with ``--json``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="1..8")
    parser.add_argument("--json", action="store_true")
    asked = parse_options(parser, seeds="1")
    first, _, last = asked.seeds.partition("..")
    rows = [case(seed) for seed in range(int(first), int(last or first) + 1)]
    if asked.json:
        print(json.dumps(rows, indent=1))
        return
    names = {
        "seed": "seed",
        "compared_s": "s compared",
        "correlation": "corr.",
        "next_best": "next",
        "turn_deg": "turn, deg",
        "ahead_m": "ahead, m",
        "left_m": "left, m",
        "seconds": "took, s",
    }
    table = Table(*names.values())
    for row in rows:
        table.add_row(*(f"{row[n]:.3g}" if n in row else "" for n in names))
    Console().print(table)
    for row in rows:
        if "refused" in row:
            print(f"seed {row['seed']}: {row['refused']}")


if __name__ == "__main__":
    main()
