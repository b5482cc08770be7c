# SPDX-License-Identifier: Apache-2.0
"""Sections 4 and 5 of the tracked paper to the end: 40 x 30 on 4 km/h, validation at 8 and 13 km/h, Figs 7 to 12.

Once with the paper's search and objective (15), preset ``tracked_paper``, and once with the preset ``fast`` on the
same five parameters and runs: all nine channels, each run's clock and speed free. The runs are those of
``tracked_runs.py``; the specimen's true parameters are printed beside what was found, and nothing but this table
reads them. Usage: ``python benchmarks/tracked_paper.py [--json] [--out DIR] [--seed N] [--generations N] [--runs N]``.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from options import parse_options
from tracked_agreement import compare, simulate_runs

from suspension_twin.calibration.request import CalibrationRequest
from suspension_twin.calibration.run import calibrate
from suspension_twin.inference.marker_runs import read_run
from suspension_twin.report.markers import marker_pictures
from suspension_twin.vehicle.tracked import BOUNDS, load_tracked

ROOT = Path(__file__).resolve().parents[1] / "config" / "tracked"
#: The tracked paper's result, eqs (16) to (20).
PUBLISHED: Final = dict(zip(BOUNDS, (2.676e7, 6.257e3, 1.0e4, 7.74e3, -5563.0), strict=True))
#: Its correlations of A and B on the validation run at 13 km/h, section 5.
PUBLISHED_CORRELATION: Final = (0.94, 0.87)
PRESETS: Final = ("tracked_paper", "fast")


def main() -> None:
    parser = argparse.ArgumentParser(description="The preset tracked_paper to the end.")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path, help="folder for Figs 7 to 12")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--generations", type=int, default=0, help="0: as many as the preset says")
    parser.add_argument(
        "--runs", type=int, metavar="N", help="calibrate on the first N; all at 4 km/h by default"
    )
    arguments = parse_options(parser, generations=1, runs=1)
    vehicle = load_tracked(ROOT / "pt91.yaml")
    files = sorted((ROOT / "runs").glob("*.csv"))
    runs = [read_run(p, vehicle) for p in files]
    slow = tuple(str(p) for p, r in zip(files, runs, strict=True) if r.speed < 1.5)[: arguments.runs]
    others = [r for r in runs if r.speed >= 1.5]
    truth = yaml.safe_load((ROOT / "runs" / "truth.yaml").read_text(encoding="utf-8"))
    results: dict[str, Any] = {
        "truth": truth,
        "published": PUBLISHED,
        "published_correlation": PUBLISHED_CORRELATION,
    }
    vehicles = {
        "published parameters": vehicle.with_changes(PUBLISHED),
        "true parameters": vehicle.with_changes(truth),
    }
    for preset in PRESETS:
        began, cpu = time.perf_counter(), time.process_time()
        request = CalibrationRequest(
            str(ROOT / "pt91.yaml"),
            slow,
            preset=preset,
            seed=arguments.seed,
            free=tuple(f"vehicle.{key}" for key in BOUNDS),
            max_generations=arguments.generations,
        )
        found = calibrate(request)
        vehicles[preset] = found.twin.vehicle
        results[preset] = {
            "values": {e.key.removeprefix("vehicle."): e.value for e in found.estimates},
            "intervals": {e.key.removeprefix("vehicle."): [e.low, e.high] for e in found.estimates},
            "evaluations": found.evaluations,
            "cost": found.cost,
            "wall_s": time.perf_counter() - began,
            "processor_s": time.process_time() - cpu,
        }
    rows = []
    for name, candidate in vehicles.items():
        told = simulate_runs([candidate], runs)[0]
        assert told is not None
        for kmh in (4, 8, 13):
            worth = [compare(r, t) for r, t in zip(runs, told, strict=True) if round(r.speed * 3.6) == kmh]
            rows.append(
                {
                    "parameters": name,
                    "kmh": kmh,
                    "correlation": np.mean([w.correlation for w in worth], axis=0).round(4).tolist(),
                    "residual": np.mean([w.residual for w in worth], axis=0).round(4).tolist(),
                    "gain": np.mean([w.gain for w in worth], axis=0).round(4).tolist(),
                    "motion": float(np.mean([w.motion.mean() for w in worth]).round(4)),
                }
            )
    results["rows"] = rows
    spread = [
        compare(a, replace(b, t=a.t))
        for a in others
        for b in others
        if a is not b and a.speed == b.speed and a.t.size == b.t.size
    ]
    results["repeats"] = {
        "correlation": np.mean([w.correlation for w in spread], axis=0).round(4).tolist(),
        "motion": float(np.mean([w.motion.mean() for w in spread]).round(4)),
    }
    if arguments.out:
        fast = [r for r in runs if round(r.speed * 3.6) == 13][:1]
        lines = {n: simulate_runs([vehicles[n]], fast)[0][0] for n in PRESETS}  # type: ignore[index]
        marker_pictures(fast[0], lines, arguments.out)
        (arguments.out / "tracked_paper.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    if arguments.json:
        print(json.dumps(results))
        return
    print(f"{'':22}" + "".join(f"{k.split('.')[1]:>20}" for k in BOUNDS))
    for name, values in (
        ("the paper's", PUBLISHED),
        ("the specimen's", truth),
        *((o, results[o]["values"]) for o in PRESETS),
    ):
        print(f"{name:22}" + "".join(f"{values[k]:20.4g}" for k in BOUNDS))
    names = ("rho A", "rho B", "left A", "left B", "gain A", "gain B", "motion")
    print(f"\n{'parameters':22}{'km/h':>5}" + "".join(f"{n:>9}" for n in names))
    for r in rows:
        numbers = (*r["correlation"], *r["residual"], *r["gain"], r["motion"])
        print(f"{r['parameters']:22}{r['kmh']:5d}" + "".join(f"{v:9.4f}" for v in numbers))
    print(
        f"repeats among themselves at 8 and 13 km/h: rho {results['repeats']['correlation']}, "
        f"motion {results['repeats']['motion']}; the paper at 13 km/h: rho {PUBLISHED_CORRELATION}"
    )
    for o in PRESETS:
        print(
            f"{o}: {results[o]['evaluations']} candidates, {results[o]['processor_s']:.0f} s of processor time"
        )


if __name__ == "__main__":
    main()
