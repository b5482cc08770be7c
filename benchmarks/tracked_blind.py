# SPDX-License-Identifier: Apache-2.0
"""A blind check of the tracked vehicle's diagnosis, like the cars': faults in a specimen of another model.

Each case is a specimen of ``tracked_reality`` with parameters of its own (drawn by the seed), reference runs
from before and runs with one fault as strong as 0.5, 1.5 or 5 floors (see ``tracked_cases``), filmed by a camera's
tool. The diagnosis sees the CSVs and the twin file, nothing else. Development and reporting seeds are apart:
thresholds were set on the former alone. ``--keep`` writes what came out to ``benchmarks/results/tracked_blind.json``,
with the commit that it belongs to.
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

from blind.ask import commit
from options import parse_options
from tracked_cases import FILE, KINDS, SEVERITIES, make_cases

from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose

RESULTS = Path(__file__).resolve().parent / "results" / "tracked_blind.json"
SEEDS = {"development": (110, 111), "reporting": (954,)}
#: In what parameter a fault's strength is.
STRENGTH = {
    "track_tension": "tighter",
    "track_wear": "stiffness",
    "station_damper": "change",
    "station_bar": "sag",
    "payload": "mass",
    "sensor_scale": "scale",
    "sensor_tilt": "pitch",
    "time_offset": "offset",
}
OUTCOMES = ("right", "in_set", "another", "unknown", "said_unseen", "no_gap")


def outcome(truth: dict[str, Any], document: dict[str, Any]) -> str:
    """``right``; ``in_set``: one of those that cannot be told apart from what is named; ``said_unseen``: no gap, with
    a word that such a fault cannot be judged on these runs; else ``another``, ``unknown`` or ``no_gap``."""
    kind, named = truth["kind"], document["combination"]
    if kind == "none":
        return (
            "right"
            if document["verdict"] in ("no_gap", "recalibration")
            else ("another" if named else "unknown")
        )
    if named == [kind]:
        return "right"
    if named:
        tied = document["causes"][0]["indistinguishable_from"]
        return "in_set" if kind in tied and len(named) == 1 else "another"
    if document["verdict"] == "unknown":
        return "unknown"
    return "said_unseen" if kind in document["cannot_be_judged"] else "no_gap"


def judge(task: tuple[str, int, Path | None]) -> list[dict[str, Any]]:
    """Make the cases of one specimen, or take them from where they were kept, and diagnose them."""
    kind, seed, kept = task
    with tempfile.TemporaryDirectory() as name:
        folder = (Path(name) if kept is None else kept) / f"{kind}_{seed}"
        return [judge_one(truth, folder) for truth in make_cases(kind, seed, folder)]


def judge_one(truth: dict[str, Any], folder: Path) -> dict[str, Any]:
    began = time.perf_counter()
    after = folder / f"after_{truth['severity']:g}"
    runs, reference = (sorted(str(p) for p in f.glob("*.csv")) for f in (after, folder / "before"))
    document = diagnose(
        DiagnosisRequest(str(FILE), tuple(runs), tuple(reference), seed=truth["seed"])
    ).document
    top = document["causes"][0]
    own = next((c for c in document["causes"] if c["effect"] == truth["kind"]), top)
    return {
        **truth,
        "outcome": outcome(truth, document),
        "verdict": document["verdict"],
        "named": document["combination"],
        "top": top["effect"],
        "probability": top["probability"],
        "unknown": document["unknown_probability"],
        "parameters": top["parameters"],
        "own": own["parameters"],
        "shrink": top["shrink"],
        "tied": top["indistinguishable_from"],
        "message": document["message"],
        "cannot_be_judged": document["cannot_be_judged"],
        "evidence": {c["effect"]: [c["log_evidence"], c["shrink"]] for c in document["causes"]},
        "took_s": round(time.perf_counter() - began, 1),
    }


def counted(rows: list[dict[str, Any]], key: str) -> dict[str, dict[str, int]]:
    """Outcomes by what ``key`` says."""
    by: dict[str, dict[str, int]] = defaultdict(lambda: dict.fromkeys(("cases", *OUTCOMES), 0))
    for row in rows:
        by[str(row[key])]["cases"] += 1
        by[str(row[key])][row["outcome"]] += 1
    return dict(by)


def main() -> None:
    parser = argparse.ArgumentParser(description="Blind check of the tracked vehicle's diagnosis.")
    parser.add_argument("--seeds", choices=tuple(SEEDS), default="development")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--cases", type=int, default=10, help="at most so many seeds")
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--folder", type=Path, help="where the cases are kept, and taken from if they are there"
    )
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="write what came out to benchmarks/results")
    arguments = parse_options(parser, kinds=["none"], cases=1)
    seeds = SEEDS[arguments.seeds][: arguments.cases]
    tasks = [(kind, seed, arguments.folder) for seed in seeds for kind in arguments.kinds]
    rows: list[dict[str, Any]] = []
    belongs = commit()
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        for own in pool.imap(judge, tasks):
            rows += own
            if not arguments.json:
                for row in own:
                    print(
                        f"{row['outcome']:12}{row['kind']:15} {row['floors']:5.2f} floors -> {row['verdict']} "
                        f"{row['named']}; {row['top']} {row['probability']:.2f} {row['parameters']}",
                        flush=True,
                    )
    kinds = counted(rows, "kind")
    severities = counted([r for r in rows if r["kind"] != "none"], "severity")
    result = {
        "commit": belongs,
        "seeds": seeds,
        "severities": SEVERITIES,
        "cases": len(rows),
        "right": sum(r["outcome"] == "right" for r in rows),
        "kinds": kinds,
        "by_severity": severities,
        "rows": rows,
    }
    if arguments.keep:
        known = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
        text = json.dumps({**known, arguments.seeds: result}, indent=1)
        RESULTS.write_text(text + "\n", encoding="utf-8")
    if arguments.json:
        print(json.dumps(result))
        return
    names = ("cases", *OUTCOMES)
    print(f"{'':15}" + "".join(f"{n.replace('_', ' '):>13}" for n in names))
    for group in (kinds, severities):
        for kind, counts in group.items():
            print(f"{kind:15}" + "".join(f"{counts[n]:13d}" for n in names))
    print(f"{result['right']} of {result['cases']} right, of {belongs}")


if __name__ == "__main__":
    main()
