# SPDX-License-Identifier: Apache-2.0
"""Diagnoses of recorded cases whose effect nobody here knows, with the reasons in a page each.

    python benchmarks/withheld.py [--data DIR] [--only NAME ...] [--out DIR] [--json]

The cases come from an established multibody engine that shares nothing with this project (``withheld``
beside the measured data: ``../shared/withheld`` from the repository, or SUSPENSION_TWIN_WITHHELD). Each
folder holds a twin file, a road, drives, and in some a reference drive. The verdicts are written to
``benchmarks/results/withheld.json``, the pages to ``--out``; there are no labels here to compare with.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

from extras import unavailable
from options import parse_options

from suspension_twin.diagnosis.answer import write
from suspension_twin.diagnosis.request import DiagnosisRequest
from suspension_twin.diagnosis.run import diagnose
from suspension_twin.errors import SuspensionTwinError
from suspension_twin.report.diagnosis import diagnosis_page

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "withheld.json"
#: Effects that ``--smoke`` asks for.
SMOKE = ("time_offset",)


def cases(data: Path) -> list[Path]:
    """Folders with a twin file, by name."""
    return sorted(p.parent for p in data.glob("*/twin.yaml"))


def run(case: Path, out: Path, effects: tuple[str, ...]) -> dict[str, Any]:
    """Diagnose one case by ``effects``, none for the library, and return what is kept of it."""
    drives = sorted(str(p) for p in case.iterdir() if p.is_dir() and p.name.startswith("drive"))
    reference = sorted(str(p) for p in case.iterdir() if p.is_dir() and p.name.startswith("reference"))
    began = time.monotonic()
    twin = str(case / "twin.yaml")
    result = diagnose(DiagnosisRequest(twin, tuple(drives), tuple(reference), effects=effects))
    seconds = time.monotonic() - began
    write(result, out / case.name)
    diagnosis_page(result).write(out / case.name / "report.html")
    d = result.document
    kept = (
        "verdict",
        "message",
        "combination",
        "unexplained",
        "no_gap_probability",
        "unknown_probability",
        "gap",
        "recalibration",
        "background",
        "cannot_be_judged",
        "next_experiment",
    )
    return {
        "case": case.name,
        "reference": bool(reference),
        **{k: d[k] for k in kept},
        "signature": d.get("signature"),
        "causes": d["causes"][:5],
        "seconds": round(seconds, 1),
    }


def main() -> None:
    """Run all cases and print a table, or with ``--json`` the same figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("SUSPENSION_TWIN_WITHHELD", str(ROOT.parent / "shared" / "withheld"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("out/withheld"))
    parser.add_argument("--json", action="store_true")
    options = parse_options(parser)
    found = [c for c in cases(options.data) if not options.only or c.name in options.only]
    if not found:
        unavailable(f"{options.data}: no case with a twin.yaml; name the folder with --data")
    results = RESULTS
    effects: tuple[str, ...] = ()  # all
    if options.smoke:
        found, results, effects = found[:1], options.out / "withheld.json", SMOKE
    known = {r["case"]: r for r in json.loads(results.read_text())["cases"]} if results.is_file() else {}
    for case in found:
        try:
            known[case.name] = run(case, options.out, effects)
        except SuspensionTwinError as error:
            known[case.name] = {"case": case.name, "error": str(error)}
        row = known[case.name]
        if not options.json:
            text = row.get("message", row.get("error"))
            print(f"{case.name:18s} {row.get('verdict', 'error'):8s} {text}", flush=True)
        results.parent.mkdir(parents=True, exist_ok=True)
        table = {"cases": [known[k] for k in sorted(known)]}
        results.write_text(json.dumps(table, indent=2, ensure_ascii=False) + "\n")
    if options.json:
        print(json.dumps({"cases": [known[c.name] for c in found]}))


if __name__ == "__main__":
    main()
