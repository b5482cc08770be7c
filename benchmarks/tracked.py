# SPDX-License-Identifier: Apache-2.0
"""Selection of the tracked vehicle's damping, section 6 of the tracked paper: Table 1 and Fig. 13.

Variance of the pitch over 15 s for speeds of 5 to 55 km/h in steps of 5 and the seven dampings of
Table 1, 77 runs in one batch, and the damping with the least mean variance over a range of speeds.
Usage: ``python benchmarks/tracked.py [--json] [--out DIR] [--range LOW HIGH] [--convergence]``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.models.tracked import STEP, simulate_tracked, simulate_tracked_lanes
from suspension_twin.report import style
from suspension_twin.vehicle.tracked import TrackedVehicle, load_tracked

DAMPINGS = (0, 11272, 22545, 45090, 90180, 135270, 180360)  # N m s/rad, Table 1
SPEEDS = tuple(range(5, 56, 5))  # km/h
DURATION = 15.0  # s
FILE = Path(__file__).resolve().parents[1] / "config" / "tracked" / "pt91.yaml"


def variances(vehicle: TrackedVehicle) -> tuple[np.ndarray[Any, Any], dict[str, float]]:
    """Variance of the pitch in rad² (dampings, speeds), NaN for a run that diverged, and the times in s."""
    lanes = [(vehicle.with_dampers(c), v / 3.6) for c in DAMPINGS for v in SPEEDS]
    simulate_tracked(vehicle, 5.0, 0.1)  # compiles
    wall, processor = time.perf_counter(), time.process_time()
    runs = simulate_tracked_lanes([v for v, _ in lanes], [s for _, s in lanes], DURATION)
    times = {"wall_s": time.perf_counter() - wall, "processor_s": time.process_time() - processor}
    values = [np.nan if r.failed else float(r.pitch.var()) for r in runs]
    return np.reshape(values, (len(DAMPINGS), len(SPEEDS))), times


def draw(table: np.ndarray[Any, Any], path: Path) -> None:
    """The picture of Fig. 13; logarithmic, since the undamped curve lies ten times above the others."""
    with style.using():
        fig = style.figure(8.0, 4.6)
        ax = fig.subplots()
        for i, damping in enumerate(DAMPINGS):
            label = f"{i + 1}: {damping:,}".replace(",", " ")
            ax.plot(SPEEDS, 1e4 * table[i], marker="o", markersize=3, linewidth=2.4 if i == 3 else 1.2,
                    color=style.colour("ink") if i == 6 else None, label=label)  # fmt: skip
        ax.set_yscale("log")
        ticks = [2, 3, 5, 10, 20, 30, 50]
        ax.set_yticks(ticks, [str(v) for v in ticks])
        ax.minorticks_off()
        ax.set(xlabel="speed, km/h", ylabel="variance of the pitch, 10⁻⁴ rad²",
               title="Variance of the pitch over speed, by damping in N m s/rad")  # fmt: skip
        ax.legend(ncols=2)
        style.save(fig, path)


def convergence(vehicle: TrackedVehicle) -> list[dict[str, float]]:
    """Largest difference of marker A or B, mm at 13 km/h, from a chain and a step four times as fine."""
    fine = simulate_tracked(vehicle, 13 / 3.6, 6.0, fineness=8, step=STEP / 8).markers
    rows = []
    for fineness, step in ((1, STEP), (1, STEP / 4), (2, STEP / 2), (4, STEP / 4)):
        markers = simulate_tracked(vehicle, 13 / 3.6, 6.0, fineness=fineness, step=step).markers
        rows.append({"fineness": fineness, "step_s": step, "difference_mm": 1e3 * float(np.abs(markers - fine).max())})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description="Damping of the tracked vehicle over speed (Fig. 13).")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--out", type=Path, help="folder for the picture and the table")
    parser.add_argument("--range", type=float, nargs=2, default=(5.0, 55.0), metavar=("LOW", "HIGH"), help="km/h")
    parser.add_argument("--vehicle", type=Path, default=FILE)
    parser.add_argument("--convergence", action="store_true", help="also with finer chains and steps")
    arguments = parser.parse_args()
    low, high = arguments.range
    within = [low <= v <= high for v in SPEEDS]
    if not any(within):
        parser.error(f"--range: no speed of 5, 10 ... 55 km/h between {low:g} and {high:g}")
    vehicle = load_tracked(arguments.vehicle)
    table, times = variances(vehicle)
    mean, worst = table[:, within].mean(axis=1), table[:, within].max(axis=1)
    if np.isnan(mean).all():
        parser.exit(1, "every damping diverged within the range\n")
    best = int(np.nanargmin(mean))
    result: dict[str, Any] = {
        "speeds_kmh": SPEEDS,
        "dampings": DAMPINGS,
        "variance_rad2": [[None if np.isnan(v) else v for v in row] for row in table.tolist()],
        "range_kmh": [low, high],
        "recommended": {"curve": best + 1, "damping": DAMPINGS[best], "mean_variance_rad2": float(mean[best])},
        "paper": {"curve": 4, "damping": DAMPINGS[3]},
        **times,
    }
    if arguments.convergence:
        result["convergence"] = convergence(vehicle)
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        draw(table, arguments.out / "pitch_variance.png")
        (arguments.out / "pitch_variance.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    if arguments.json:
        print(json.dumps(result))
        return 0
    print("variance of the pitch, 1e-4 rad²; speed in km/h")
    print("damping  " + "".join(f"{v:7d}" for v in SPEEDS) + "   mean  worst (in range)")
    for c, row, m, w in zip(DAMPINGS, table, mean, worst, strict=True):
        print(f"{c:7d}  " + "".join(f"{1e4 * v:7.2f}" for v in row) + f"{1e4 * m:7.2f}{1e4 * w:7.2f}")
    print(f"from {low:g} to {high:g} km/h: curve {best + 1}, {DAMPINGS[best]} N m s/rad (the paper: curve 4 over all)")
    print(f"77 runs of 15 s: {times['wall_s']:.1f} s, {times['processor_s']:.1f} s of processor time")
    for row in result.get("convergence", []):
        print("fineness {fineness}, step {step_s:g} s: {difference_mm:.2f} mm".format(**row))
    return 0


if __name__ == "__main__":
    sys.exit(main())
