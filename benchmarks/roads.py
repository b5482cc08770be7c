# SPDX-License-Identifier: Apache-2.0
"""How fast roads are evaluated, beside the OpenCRG library's own evaluation in the same run.

Every figure is of one core, in processor time, which what else runs on the machine disturbs least.
Both sides get the same positions, and the largest difference of their heights is printed.
Usage: ``python benchmarks/roads.py [--json] [--positions N]``.
"""

from __future__ import annotations

import argparse
import json
import logging
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycrg
from options import parse_options
from rich.console import Console
from rich.table import Table

from suspension_twin.road import Road, curved_road, load_road, write_road
from suspension_twin.road.mesh import road_mesh
from suspension_twin.road.roughness import iso8608_road
from suspension_twin.road.smoothing import find_spikes, smooth

REPEATS = 9
_FIRST_CALL = """
import sys, time
start = time.process_time()
from suspension_twin.road import load_road
imported = time.process_time()
road = load_road(sys.argv[1])
loaded = time.process_time()
road.heights(0.0, 0.0)
print(imported - start, loaded - imported, time.process_time() - loaded)
"""


def roads() -> Iterator[tuple[str, Road]]:
    """A straight road, a winding one, and a long winding one."""
    straight = iso8608_road("C", 200, seed=1, x=10, y=20, heading=0.7)
    yield "straight, 200 m at 5 cm", straight
    yield "winding, 200 m at 5 cm", curved_road(straight, 0.03 * np.sin(straight.u[1:] / 15))
    long = iso8608_road("C", 5000, width=4, v_step=1.0, seed=1)
    yield "winding, 5 km at 5 cm", curved_road(long, 0.02 * np.sin(long.u[1:] / 60))


def positions(road: Road, count: int, order: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Places on the road: wheels on a drive along it, or one here and one there."""
    rng = np.random.default_rng(0)
    u = np.linspace(road.u_first, road.u_last, count)
    v = 0.6 * np.sin(u / 7) + np.tile([0.75, -0.75], count // 2 + 1)[:count]
    if order == "random":
        u, v = rng.uniform(road.u_first, road.u_last, count), rng.uniform(road.v[0], road.v[-1], count)
    x, y = road.uv_to_xy(u, v)
    return x, y


def seconds(work: Callable[[], object], repeats: int = REPEATS) -> tuple[float, float]:
    """Median and least processor time of a piece of work."""
    work()
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return statistics.median(times), min(times)


def evaluation(count: int, folder: Path) -> list[dict[str, Any]]:
    """Wheel positions a second, ours and the library's, alternating so that both meet the same machine."""
    rows = []
    for name, road in roads():
        path = folder / "road.crg"
        write_road(road, path)
        road = load_road(path)
        with pycrg.DataSet.open(path) as data, data.create_contact_point() as point:
            for order in ("drive", "random"):
                x, y = positions(road, count, order)
                point.set_history(100)
                ours, ours_best = seconds(partial(road.heights, x, y))
                # The library searches the whole line for every random place: fewer of them are enough.
                few = count if order == "drive" or road.straight else count // 20
                theirs, theirs_best = seconds(partial(point.xy_to_z_many, x[:few], y[:few]), 3)
                difference = float(
                    np.abs(road.heights(x[:few], y[:few]) - point.xy_to_z_many(x[:few], y[:few])).max()
                )
                rows.append(
                    {
                        "road": name,
                        "order": order,
                        "positions_per_s": count / ours,
                        "positions_per_s_best": count / ours_best,
                        "pycrg_positions_per_s": few / theirs,
                        "pycrg_positions_per_s_best": few / theirs_best,
                        "ratio": (count / ours) / (few / theirs),
                        "largest_difference_m": difference,
                    }
                )
    return rows


def live() -> list[dict[str, Any]]:
    """Time of one call for the four wheels, as a live twin makes it."""
    rows = []
    calls = 2000
    for name, road in roads():
        x, y = (
            np.ascontiguousarray(c) for c in road.uv_to_xy([52.8, 52.8, 50.0, 50.0], [0.8, -0.8, 0.8, -0.8])
        )

        def drive(road: Road = road, x: Any = x, y: Any = y) -> None:
            for _ in range(calls):
                road.heights(x, y)

        median, best = seconds(drive)
        rows.append({"road": name, "us": 1e6 * median / calls, "us_best": 1e6 * best / calls})
    return rows


def other(folder: Path) -> dict[str, float]:
    """Start-up and the slower work, seconds."""
    _, road = next(roads())
    path = folder / "road.crg"
    write_road(road, path)
    command = [sys.executable, "-c", _FIRST_CALL, str(path)]
    first = []
    for _ in range(3):
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        first.append([float(word) for word in done.stdout.split()])
    imported, loaded, called = (statistics.median(column) for column in zip(*first, strict=True))
    return {
        "import_s": imported,
        "load_200_m_s": loaded,
        "first_heights_call_s": called,
        "iso8608_200_m_s": seconds(partial(iso8608_road, "C", 200), 3)[0],
        "smooth_200_m_s": seconds(lambda: smooth(road, 0.2, 0.3), 3)[0],
        "find_spikes_200_m_s": seconds(lambda: find_spikes(road), 3)[0],
        "mesh_200_m_s": seconds(lambda: road_mesh(road), 3)[0],
    }


def show(result: dict[str, Any]) -> None:
    """The figures as tables."""
    console = Console()
    table = Table(title="Heights at map positions, millions a second on one core (median)")
    for column in ("road", "order", "suspension_twin", "pycrg", "ratio", "largest difference"):
        table.add_column(column, justify="left" if column in ("road", "order") else "right")
    for row in result["evaluation"]:
        table.add_row(
            row["road"],
            row["order"],
            f"{row['positions_per_s'] / 1e6:.1f}",
            f"{row['pycrg_positions_per_s'] / 1e6:.2f}",
            f"{row['ratio']:.1f}",
            f"{row['largest_difference_m']:.1e} m",
        )
    console.print(table)
    table = Table(title="One call for four wheels, µs")
    for column in ("road", "median", "best"):
        table.add_column(column, justify="left" if column == "road" else "right")
    for row in result["live"]:
        table.add_row(row["road"], f"{row['us']:.1f}", f"{row['us_best']:.1f}")
    console.print(table)
    table = Table(title="Other work, s", show_header=False)
    for name, value in result["other"].items():
        table.add_row(name.removesuffix("_s").replace("_", " "), f"{value:.3f}")
    console.print(table)


def main() -> None:
    """Run everything and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--positions", type=int, default=400_000)
    arguments = parse_options(parser, positions=2_000)
    logging.getLogger("pycrg").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        result = {
            "positions": arguments.positions,
            "evaluation": evaluation(arguments.positions, Path(folder)),
            "live": live(),
            "other": other(Path(folder)),
        }
    if arguments.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)


if __name__ == "__main__":
    main()
