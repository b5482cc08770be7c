# SPDX-License-Identifier: Apache-2.0
"""Which of the five parameters of the tracked paper its manoeuvre determines.

Standard deviations by Fisher information with several steps, in logarithms, on 4 km/h alone (what the
paper fits) and on all three speeds, for the camera's noise and for what the model misses of another
model's motion; with ``--profiles`` the likelihood of each parameter over its whole range.
Usage: ``python benchmarks/tracked_identify.py [--json] [--profiles] [--points N]``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from suspension_twin.calibration.tracked_identify import BOUNDS_ALONE, fisher, profile
from suspension_twin.calibration.tracked_paper import PUBLISHED, simulate_runs
from suspension_twin.gap.marker_runs import read_run
from suspension_twin.vehicle.tracked import BOUNDS, load_tracked

ROOT = Path(__file__).resolve().parents[1] / "config" / "tracked"
#: What repeats differ by, and what the model misses of the other model: m, m/s, m/s². The latter is no white noise:
#: a tenth of the samples count.
NOISES = {"camera": np.array([1e-3, 0.01, 0.17]), "model error": np.array([0.02, 0.1, 1.2]) * 10**0.5}


def main() -> None:
    parser = argparse.ArgumentParser(description="Identifiability of the five track parameters.")
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--profiles", action="store_true", help="also the likelihood over each whole range (minutes)"
    )
    parser.add_argument("--points", type=int, default=7)
    arguments = parser.parse_args()
    vehicle = load_tracked(ROOT / "pt91.yaml").with_changes(PUBLISHED)
    runs = [read_run(ROOT / "runs" / f"{kmh:02d}kmh_1.csv", vehicle) for kmh in (4, 8, 13)]
    sets = {"4 km/h": runs[:1], "4, 8 and 13 km/h": runs}
    result: dict[str, Any] = {"bounds_alone": BOUNDS_ALONE, "fisher": [], "profiles": []}
    for noise_name, noise in NOISES.items():
        for name, used in sets.items():
            for step, deviation in fisher(vehicle, used, noise).items():
                result["fisher"].append({"noise": noise_name, "runs": name, "step": step, **deviation})
    if arguments.profiles:
        told = simulate_runs([vehicle], runs)[0]
        assert told is not None
        for key in BOUNDS:
            p = profile(vehicle, told, NOISES["camera"], key, arguments.points)
            low, high = BOUNDS[key]
            log = key.startswith("track.")
            ends = [low * (high / low) ** u if log else low + u * (high - low) for u in (p.low, p.high)]
            result["profiles"].append(
                {
                    "key": key,
                    "places": p.places.tolist(),
                    "half_chi_square": p.cost.tolist(),
                    "interval": ends,
                }
            )
    if arguments.json:
        print(json.dumps(result))
        return
    print(f"standard deviation as a share of the range; the bounds alone: {BOUNDS_ALONE:.2f}")
    print(f"{'noise':12}{'runs':18}{'step':>7}" + "".join(f"{k.split('.')[1]:>19}" for k in BOUNDS))
    for row in result["fisher"]:
        print(
            f"{row['noise']:12}{row['runs']:18}{row['step']:7.3f}"
            + "".join(f"{row[k]:19.4f}" for k in BOUNDS)
        )
    for row in result["profiles"]:
        costs = " ".join(
            f"{p:.2f}: {c:.3g}" for p, c in zip(row["places"], row["half_chi_square"], strict=True)
        )
        print(
            f"{row['key']}: 90 % from {row['interval'][0]:.4g} to {row['interval'][1]:.4g}; half chi square {costs}"
        )


if __name__ == "__main__":
    main()
