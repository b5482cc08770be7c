# SPDX-License-Identifier: Apache-2.0
"""Marker runs as the tracked paper measured them, on a specimen of another model with withheld parameters.

The paper's measurement is not public. ``tracked_reality`` (97 rigid links, driven by the sprocket) drives
over the same obstacle three times at each of 4, 8 and 13 km/h; a camera's tool gives displacement,
velocity and acceleration of A, B and C. The parameters are in ``truth.yaml`` beside the files and nothing
that calibrates reads them. Usage: ``python benchmarks/tracked_runs.py [--out config/tracked/runs] [--kmh 4 13]``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import yaml
from options import parse_options
from tracked_reality import Faults, photogrammetry, simulate

from suspension_twin.vehicle.tracked import load_tracked

ROOT = Path(__file__).resolve().parents[1] / "config" / "tracked"
SPEEDS = {4: 14.5, 8: 7.4, 13: 5.0}  # km/h: s
QUANTITIES = ("displacement_mm", "velocity_m_s", "acceleration_m_s2")
HEADER = "time_s," + ",".join(f"{m}_{q}" for m in "ABC" for q in QUANTITIES)
#: The specimen: drawn by hand once, before any calibration was run on it.
TRUTH = {
    "track.stiffness": 1.6e7,
    "track.bending_stiffness": 1.5e3,
    "track.damping": 2.0e4,
    "track.bending_damping": 9.0e2,
    "idler.setting": -5571.0,
}


def write_run(path: Path, table: np.ndarray) -> None:
    """One CSV as the tool exports it."""
    formats = ["%.3f", *["%.2f", "%.4f", "%.3f"] * 3]
    np.savetxt(path, table, delimiter=",", header=HEADER, comments="", fmt=formats)


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the marker runs.")
    parser.add_argument("--out", type=Path, default=ROOT / "runs")
    parser.add_argument("--kmh", type=int, nargs="+", choices=list(SPEEDS), default=list(SPEEDS))
    options = parse_options(parser, kmh=[13])
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    vehicle = load_tracked(ROOT / "pt91.yaml").with_changes(TRUTH)
    for kmh in options.kmh:
        seconds = SPEEDS[kmh]
        for repeat in (1, 2, 3):
            rng = np.random.default_rng([kmh, repeat])
            speed = kmh / 3.6 * (1 + rng.normal(0, 0.008))
            motion = simulate(vehicle, speed, seconds, Faults())
            table = photogrammetry(motion, kmh * 10 + repeat, rate=50.0, late=rng.normal(0, 0.01))
            write_run(out / f"{kmh:02d}kmh_{repeat}.csv", table)
            print(f"{kmh} km/h, {repeat}: {table.shape[0]} rows", flush=True)
    about = (
        "# The specimen that the runs beside this file were made with; nothing that calibrates reads it.\n"
    )
    (out / "truth.yaml").write_text(about + yaml.safe_dump(TRUTH, sort_keys=False), encoding="utf-8")


if __name__ == "__main__":
    main()
