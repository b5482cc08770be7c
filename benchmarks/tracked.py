# SPDX-License-Identifier: Apache-2.0
"""Section 6 of the tracked paper: Table 1 and Fig. 13, its cost, and what the answer depends on.

The selection itself is ``suspension-twin damping``. Here: the time of its 77 runs, ``--convergence`` with
time step, contact points and elements of a link, and ``--obstacles``, since Fig. 4 gives no dimensions:
which trapezoids come as near to the maxima of section 5, and what each of them recommends.
Usage: ``python benchmarks/tracked.py [--json] [--out DIR] [--range LOW HIGH] [--convergence] [--obstacles]``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from options import parse_options

from suspension_twin.calibration.damping import DAMPINGS, PAPER_CURVE, SPEEDS, select_damping
from suspension_twin.models.tracked import simulate_tracked, simulate_tracked_lanes
from suspension_twin.report import style
from suspension_twin.report.markers import damping_picture
from suspension_twin.vehicle.tracked import TrackedVehicle, load_tracked

FILE = Path(__file__).resolve().parents[1] / "config" / "tracked" / "pt91.yaml"
#: (elements of a link, contact points of an element, step in s), the finest first.
GRID = (
    (1, 16, 2.5e-5),
    (1, 1, 4e-4),
    (1, 4, 8e-4),
    (1, 4, 4e-4),
    (1, 4, 2e-4),
    (1, 8, 1e-4),
    (2, 4, 1e-4),
    (4, 4, 1e-4),
)
SECTION_5 = (0.6, 0.8, 6.0)  # m/s of A, m/s of B, m/s² at 13 km/h


def convergence(vehicle: TrackedVehicle) -> list[dict[str, Any]]:
    """Largest difference of a marker from the finest, over 6 s and 15 s, and the variance of the pitch.

    ``kick``: the same as the default with the standing hull given 1 micrometre a second: what grows of that is
    the vehicle's own sensitivity, which no refinement takes away.
    """
    rows: list[dict[str, Any]] = []
    for damping, kmh in itertools.product((45090.0, 0.0), (13.0, 30.0)):
        lane, speed = vehicle.with_dampers(damping), kmh / 3.6
        fine = None
        for elements, contacts, step in GRID:
            run = simulate_tracked(lane, speed, 15.0, fineness=elements, contacts=contacts, step=step)
            fine = run if fine is None else fine
            away = 1e3 * np.abs(run.markers - fine.markers)
            rows.append(
                {
                    "damping": damping,
                    "kmh": kmh,
                    "elements": elements,
                    "contacts": contacts,
                    "step_s": step,
                    "mm_over_6_s": float(away[:600].max()),
                    "mm_over_15_s": float(away.max()),
                    "variance_rad2": float(run.pitch.var()),
                }
            )
        usual = simulate_tracked(lane, speed, 15.0)
        kicks = [simulate_tracked(lane, speed, 15.0, kick=(k, 0.0)) for k in (1e-6, -1e-6, 2e-6, -2e-6)]
        away = np.max([1e3 * np.abs(k.markers - usual.markers).max(axis=1) for k in kicks], axis=0)
        rows.append(
            {
                "damping": damping,
                "kmh": kmh,
                "kick": "kicks of 1 to 2 micrometres/s",
                "mm_over_6_s": float(away[:600].max()),
                "mm_over_15_s": float(away.max()),
                "variance_rad2": float(np.mean([k.pitch.var() for k in kicks])),
                "variance_spread": float(np.std([k.pitch.var() for k in kicks])),
            }
        )
    return rows


def obstacles(vehicle: TrackedVehicle, low: float, high: float, shown: int = 6) -> list[dict[str, Any]]:
    """The trapezoids of a grid nearest to section 5's maxima, and what is recommended on each."""
    heights, ramps = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5), (0.3, 0.6, 0.9, 1.2, 1.6, 2.0, 2.5, 3.0, 4.0)
    tops = (0.0, 0.3, 0.6, 1.0, 1.5, 2.0, 3.0, 5.0)
    grid = [g for g in itertools.product(heights, ramps, tops) if g[0] < g[1]]
    keys = ("obstacle.height", "obstacle.ramp", "obstacle.top")
    vehicles = [vehicle.with_changes(dict(zip(keys, g, strict=True))) for g in grid]
    runs = simulate_tracked_lanes(vehicles, [13 / 3.6] * len(grid), 6.0)
    rows = []
    for g, v, r in zip(grid, vehicles, runs, strict=True):
        most = (*np.abs(r.marker_velocity[:, :2]).max(axis=0), np.abs(r.marker_acceleration[:, :2]).max())
        away = float(np.sum((np.log(np.array(most) / SECTION_5) * [1, 1, 0.7]) ** 2))
        rows.append((away, g, [round(float(p), 2) for p in most], v))
    out = []
    for away, g, peaks, v in sorted(rows, key=lambda r: r[0])[:shown]:
        chosen = select_damping(v, low, high)
        out.append(
            {
                "height": g[0],
                "ramp": g[1],
                "top": g[2],
                "peaks": peaks,
                "away": round(away, 4),
                "curve": chosen.best + 1,
                "near": [i + 1 for i in chosen.near],
                "paper_over_least_mean": float(chosen.mean[PAPER_CURVE - 1] / chosen.mean[chosen.best]),
            }
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description="Damping of the tracked vehicle over speed (Fig. 13).")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--out", type=Path, help="folder for the picture and the table")
    parser.add_argument(
        "--range", type=float, nargs=2, default=(5.0, 55.0), metavar=("LOW", "HIGH"), help="km/h"
    )
    parser.add_argument("--vehicle", type=Path, default=FILE)
    parser.add_argument(
        "--convergence", action="store_true", help="also with other elements, contacts and steps"
    )
    parser.add_argument("--obstacles", action="store_true", help="also on other obstacles")
    arguments = parse_options(parser)
    vehicle = load_tracked(arguments.vehicle)
    simulate_tracked(vehicle, 5.0, 0.1)  # compiles
    wall, processor = time.perf_counter(), time.process_time()
    chosen = select_damping(vehicle, *arguments.range)
    result: dict[str, Any] = {
        "wall_s": time.perf_counter() - wall,
        "processor_s": time.process_time() - processor,
        "speeds_kmh": SPEEDS,
        "dampings": DAMPINGS,
        "variance_rad2": [[None if np.isnan(v) else v for v in row] for row in chosen.table.tolist()],
        "mean_rad2": chosen.mean.tolist(),
        "worst_over_least": chosen.regret.tolist(),
        "range_kmh": arguments.range,
        "recommended": chosen.best + 1,
        "within_a_tenth": [i + 1 for i in chosen.near],
        "paper": PAPER_CURVE,
    }
    if arguments.convergence:
        result["convergence"] = convergence(vehicle)
    if arguments.obstacles:
        result["obstacles"] = obstacles(vehicle, *arguments.range)
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        style.save(damping_picture(SPEEDS, DAMPINGS, chosen.table), arguments.out / "pitch_variance.png")
        (arguments.out / "pitch_variance.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    if arguments.json:
        print(json.dumps(result))
        return
    print("variance of the pitch, 1e-4 rad²; speed in km/h")
    print("damping  " + "".join(f"{v:7.0f}" for v in SPEEDS) + "   mean  worst/least")
    for c, row, m, w in zip(DAMPINGS, chosen.table, chosen.mean, chosen.regret, strict=True):
        print(f"{c:7.0f}  " + "".join(f"{1e4 * v:7.2f}" for v in row) + f"{1e4 * m:7.2f}{w:7.2f}")
    low, high = arguments.range
    print(
        f"from {low:g} to {high:g} km/h: curve {chosen.best + 1}; within a tenth: {[i + 1 for i in chosen.near]}; "
        f"the paper, over all: curve {PAPER_CURVE}"
    )
    print(f"77 runs of 15 s: {result['wall_s']:.1f} s, {result['processor_s']:.1f} s of processor time")
    for row in result.get("convergence", []):
        what = (
            row.get("kick")
            or f"{row['elements']} elements, {row['contacts']:2d} contacts, {row['step_s']:g} s"
        )
        spread = f" +- {1e4 * row['variance_spread']:.3f}" if "variance_spread" in row else ""
        print(
            f"{row['damping']:6.0f} at {row['kmh']:2.0f} km/h, {what:32}: {row['mm_over_6_s']:8.3f} mm over 6 s, "
            f"{row['mm_over_15_s']:8.3f} mm over 15 s, variance {1e4 * row['variance_rad2']:.3f}"
            f"{spread}"
        )
    for row in result.get("obstacles", []):
        print(
            "obstacle {height} m high, ramps {ramp} m, top {top} m: maxima {peaks}, curve {curve}, within a tenth "
            "{near}, curve 4 over the least {paper_over_least_mean:.2f}".format(**row)
        )


if __name__ == "__main__":
    main()
