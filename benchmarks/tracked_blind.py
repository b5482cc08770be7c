# SPDX-License-Identifier: Apache-2.0
"""A blind check of the tracked vehicle's diagnosis, like the cars': faults in a specimen of another model.

Each case is a specimen of ``tracked_reality`` with parameters of its own (drawn by the seed), reference runs
from before and runs with one fault, filmed by a camera's tool. The diagnosis sees the CSVs and the twin
file, nothing else. Development and reporting seeds are apart: thresholds were set on the former alone. ``--keep``
writes what came out to ``benchmarks/results/tracked_blind.json``, with the commit that it belongs to.
Usage: ``python benchmarks/tracked_blind.py [--seeds development|reporting] [--kinds ...] [--json] [--cases N]
[--keep]``.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from blind.ask import commit
from tracked_reality import Faults, photogrammetry, simulate
from tracked_runs import write_run

from suspension_twin.diagnosis.tracked import diagnose_tracked_files
from suspension_twin.vehicle.tracked import load_tracked

FILE = Path(__file__).resolve().parents[1] / "config" / "tracked" / "pt91.yaml"
RESULTS = Path(__file__).resolve().parent / "results" / "tracked_blind.json"
KINDS = ("none", "track_tension", "track_wear", "station_damper", "station_bar", "payload", "sensor_scale",
         "sensor_tilt", "time_offset")  # fmt: skip
SEEDS = {"development": (100, 101), "reporting": (900, 901, 902)}
SPEEDS = {8: 7.4, 13: 5.0}


def case(kind: str, seed: int, folder: Path) -> dict[str, Any]:
    """Write the runs of one case to ``folder`` and return its truth."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    own = {
        "track.stiffness": float(np.exp(rng.uniform(np.log(1.5e7), np.log(4e7)))),
        "track.bending_stiffness": float(np.exp(rng.uniform(np.log(3e2), np.log(4e3)))),
        "track.damping": float(np.exp(rng.uniform(np.log(5e3), np.log(3e4)))),
        "track.bending_damping": float(np.exp(rng.uniform(np.log(1e2), np.log(2e3)))),
        "idler.setting": float(rng.uniform(-5575, -5558)),
        "mass": float(rng.uniform(41500, 43500)),
        "arm.stiffness": float(1.27e5 * rng.uniform(0.95, 1.05)),
    }
    vehicle = load_tracked(FILE).with_changes(own)
    broken, faults, camera, truth = vehicle, Faults(), {}, {}
    if kind == "track_tension":
        truth = {"tighter": float(rng.choice([-1, 1]) * rng.uniform(8, 15))}
        setting = float(np.clip(own["idler.setting"] - truth["tighter"], -5590, -5550))
        truth["tighter"] = own["idler.setting"] - setting
        broken = vehicle.with_changes({"idler.setting": setting})
    elif kind == "track_wear":
        truth = {"stiffness": float(rng.uniform(0.3, 0.6))}
        worn = ("track.stiffness", "track.bending_stiffness")
        broken = vehicle.with_changes({k: own[k] * truth["stiffness"] for k in worn})
    elif kind == "station_damper":
        truth = {"station": float(rng.choice([1, 2, 6])), "share": float(rng.uniform(0.0, 0.2))}
        damper = [1.0] * 6
        damper[int(truth["station"]) - 1] = truth["share"]
        faults = Faults(damper=tuple(damper))
    elif kind == "station_bar":
        truth = {"station": float(rng.choice([1, 2, 5, 6])), "sag": float(rng.uniform(0.06, 0.14))}
        sag = [0.0] * 6
        sag[int(truth["station"]) - 1] = truth["sag"]
        faults = Faults(sag=tuple(sag))
    elif kind == "payload":
        truth = {"mass": float(rng.uniform(2500, 5000)), "x": float(rng.uniform(-1.0, 1.0))}
        faults = Faults(payload=truth["mass"], payload_x=vehicle.cog[0] + truth["x"])
    elif kind == "sensor_scale":
        truth = {"gain": float(rng.choice([0.9, 1.12]))}
        camera = {"scale": truth["gain"]}
    elif kind == "sensor_tilt":
        truth = {"roll": float(rng.choice([-1, 1]) * rng.uniform(0.005, 0.015))}
        camera = {"tilt": truth["roll"]}
    elif kind == "time_offset":
        truth = {"seconds": float(rng.choice([-1, 1]) * rng.uniform(0.08, 0.16))}
        camera = {"late": truth["seconds"]}
    for state, specimen, fault, repeats in (("before", vehicle, Faults(), 2), ("after", broken, faults, 2)):
        (folder / state).mkdir()
        for kmh, seconds in SPEEDS.items():
            for repeat in range(repeats):
                speed = kmh / 3.6 * (1 + rng.normal(0, 0.006))
                motion = simulate(specimen, speed, seconds, fault)
                extra = dict(camera) if state == "after" else {}
                extra["late"] = extra.get("late", 0.0) + rng.normal(0, 0.008)
                table = photogrammetry(motion, int(rng.integers(1 << 30)), rate=50.0, **extra)
                write_run(folder / state / f"{kmh:02d}kmh_{repeat + 1}.csv", table)
    return truth


def judge(task: tuple[str, int, Path | None]) -> dict[str, Any]:
    """Make one case, or take it from where it was kept, and diagnose it."""
    kind, seed, kept = task
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) if kept is None else kept / f"{kind}_{seed}"
        if (folder / "truth.json").is_file():
            truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        else:
            folder.mkdir(parents=True, exist_ok=True)
            truth = case(kind, seed, folder)
            (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
        began = time.perf_counter()
        runs, reference = (sorted(str(p) for p in (folder / s).glob("*.csv")) for s in ("after", "before"))
        document = diagnose_tracked_files(str(FILE), runs, reference, seed=seed).document
    top = document["causes"][0]
    named = document["combination"]
    right = not named if kind == "none" else named == [kind]
    return {
        "kind": kind, "seed": seed, "truth": truth, "verdict": document["verdict"], "named": named, "right": right,
        "top": top["effect"], "probability": top["probability"], "parameters": top["parameters"],
        "shrink": top["shrink"], "tied": top["indistinguishable_from"], "message": document["message"],
        "evidence": {c["effect"]: [c["log_evidence"], c["shrink"]] for c in document["causes"]},
        "seconds": round(time.perf_counter() - began, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="Blind check of the tracked vehicle's diagnosis.")
    parser.add_argument("--seeds", choices=tuple(SEEDS), default="development")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--cases", type=int, default=10, help="at most so many seeds")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--folder", type=Path, help="where the cases are kept, and taken from if they are there")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="write what came out to benchmarks/results")
    arguments = parser.parse_args()
    seeds = SEEDS[arguments.seeds][: arguments.cases]
    tasks = [(kind, seed, arguments.folder) for seed in seeds for kind in arguments.kinds]
    rows, belongs = [], commit()
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        for row in pool.imap(judge, tasks):
            rows.append(row)
            if not arguments.json:
                mark = "right" if row["right"] else "WRONG"
                print(f"{mark} {row['kind']:15} {row['seed']} {row['truth']} -> {row['message']}; "
                      f"{row['top']} {row['probability']:.2f} {row['parameters']} tied {row['tied']}", flush=True)
    by: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        by[row["kind"]].append(row)
    kinds = {
        k: {
            "cases": len(own), "right": sum(r["right"] for r in own),
            "another_named": sum(bool(r["named"]) and not r["right"] for r in own),
            "no_gap": sum(r["verdict"] == "no_gap" for r in own),
            "unknown": sum(r["verdict"] == "unknown" for r in own),
        }
        for k, own in by.items()
    }  # fmt: skip
    result = {"commit": belongs, "seeds": SEEDS[arguments.seeds][: arguments.cases], "cases": len(rows),
              "right": sum(r["right"] for r in rows), "kinds": kinds, "rows": rows}  # fmt: skip
    if arguments.keep:
        known = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
        text = json.dumps({**known, arguments.seeds: result}, indent=1)
        RESULTS.write_text(text + "\n", encoding="utf-8")
    if arguments.json:
        print(json.dumps(result))
        return
    names = ("cases", "right", "another_named", "no_gap", "unknown")
    print(f"{'':15}" + "".join(f"{n.replace('_', ' '):>15}" for n in names))
    for kind, counts in kinds.items():
        print(f"{kind:15}" + "".join(f"{counts[n]:15d}" for n in names))
    print(f"{result['right']} of {result['cases']} right, of {belongs}")


if __name__ == "__main__":
    main()
