# SPDX-License-Identifier: Apache-2.0
"""How well and how fast a twin is calibrated, beside what one would use instead; all with known truth.

Usage: ``python benchmarks/calibration.py [--json] [--only SECTION ...] [--vehicles N] [--seeds development]``

- ``evaluations``: the cost that ``paper`` ends with, and after how many evaluations ``fast`` is there;
- ``accuracy``: residual on a drive not seen, recovered forces and coverage of the 90 % intervals;
- ``speed``: wall and processor time of the command line, everything included;
- ``peers``: one problem solved by pymoo's stock GA over ``solve_ivp``, by scipy's differential
  evolution on this project's batch, and by both presets; with ``--picture FILE`` drawn.

Vehicles are seeded. What is developed on (``--seeds development``, from 0 on) is not what is reported
(the default, from 6000 on).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from calibration_cases import (
    BRISK,
    PASS,
    SLOW,
    UNSEEN,
    Case,
    bump,
    rough,
    thirty_per_cent_off,
    within_table_2,
    write_case,
)
from calibration_judge import judged_by, same_question, traced
from calibration_peers import draw, peers
from options import parse_options
from rich.console import Console
from rich.table import Table

from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.drive.read import read_drive
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import observe
from suspension_twin.inference.synthetic import SensorErrors
from suspension_twin.models.parameters import twin_value
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.report.characteristics import force
from suspension_twin.vehicle.twin import Twin, load_twin

SECTIONS = ("evaluations", "accuracy", "speed", "peers")
FIRST_SEED = {"development": 0, "reporting": 6000}


def evaluations(folder: Path, seeds: Sequence[int]) -> dict[str, Any]:
    """``paper`` and ``fast`` on the same pass over a bump, vehicle by vehicle.

    Both are judged by one yardstick: eq. (1) of the vertical acceleration, no bias, gain or tilt, each candidate
    aligned in time as well as it can be. That ``paper`` interpolates its signals in time and ``fast`` moves the pose
    counts for neither.
    """
    rows = []
    for seed in seeds:
        truth, start = within_table_2(seed)
        case = write_case(
            folder / f"pass{seed}", truth, start, bump(seed), {"pass": PASS}, seed, SensorErrors()
        )
        asked = same_question(case, "paper", seed)
        paper = calibrate(asked)
        judge = judged_by(asked)
        ends = judge(np.array([e.value for e in paper.estimates]))
        true = judge(np.array([float(twin_value(load_twin(case.truth), e.key)) for e in paper.estimates]))
        fast, trace = traced(same_question(case, "fast", seed), judge)
        there = [row for row in trace if row[1] <= ends]
        rows.append(
            {
                "vehicle": seed,
                "truths_cost": true,
                "paper_cost": ends,
                "paper_own_cost": paper.cost,
                "paper_evaluations": paper.evaluations,
                "fast_cost": min(row[1] for row in trace),
                "fast_evaluations": fast.evaluations,
                "fast_reached_at": there[0][0] if there else None,
                "share": there[0][0] / paper.evaluations if there else None,
            }
        )
    shares = [row["share"] for row in rows if row["share"] is not None]
    return {
        "within_a_tenth": sum(s <= 0.1 for s in shares),
        "vehicles": len(rows),
        "worst_share": max(shares) if len(shares) == len(rows) else None,
        "by_vehicle": rows,
    }


def accuracy(folder: Path, seeds: Sequence[int]) -> dict[str, Any]:
    """``fast`` from a preset 30 % off on two drives, checked on a third and against the truth."""
    rows: list[dict[str, Any]] = []
    errors: list[float] = []
    # A true spring has corners that the points found, lines between them, cannot have.
    hits: dict[str, list[bool]] = {"dampers": [], "springs": [], "other parameters": []}
    for seed in seeds:
        truth, start = thirty_per_cent_off(seed)
        knots = {"slow": SLOW, "brisk": BRISK, "unseen": UNSEEN}
        case = write_case(folder / f"off{seed}", truth, start, rough(seed), knots, seed, SensorErrors())
        used = tuple(str(case.drives[name]) for name in ("slow", "brisk"))
        result = calibrate(CalibrationRequest(twin=str(case.twin), bags=used, seed=seed))
        known = load_twin(case.truth)
        own_errors, own_hits = [], []
        for e in result.estimates:
            true = true_value(known, result.twin, e.key)
            hit = bool(e.low <= true <= e.high)
            point = ".force." in e.key
            hits["other parameters" if not point else "springs" if ".spring." in e.key else "dampers"].append(
                hit
            )
            if e.status == "identified" and point:
                own_errors.append(abs(e.value / true - 1))
                own_hits.append(hit)
        errors += own_errors
        left, least = (gap_on(case.drives["unseen"], twin, known) for twin in (result.twin, known))
        rows.append(
            {
                "vehicle": seed,
                "residual_ratio_unseen": left / least,
                "force_error_points": float(np.median(own_errors)),
                "force_error_excited_range": float(
                    np.median([force_error_along(result, known, k) for k in range(len(result.curves))])
                ),
                "identified_points": len(own_hits),
                "covered": sum(own_hits),
                "evaluations": result.evaluations,
            }
        )
    every = [h for kind in hits.values() for h in kind]
    return {
        "vehicles": len(rows),
        "residual_ratio_unseen_worst": max(r["residual_ratio_unseen"] for r in rows),
        "residual_ratio_unseen_median": float(np.median([r["residual_ratio_unseen"] for r in rows])),
        "force_error_median_at_identified_points": float(np.median(errors)),
        "force_error_median_worst_vehicle": max(r["force_error_points"] for r in rows),
        "force_error_median_along_excited_range": float(
            np.median([r["force_error_excited_range"] for r in rows])
        ),
        **{f"{kind.replace(' ', '_')}": len(found) for kind, found in hits.items()},
        **{
            f"coverage_{kind.replace(' ', '_')}": float(np.mean(found))
            for kind, found in hits.items()
            if found
        },
        "coverage_everything": float(np.mean(every)),
        "by_vehicle": rows,
    }


def gap_on(bag: Path, twin: Twin, placed: Twin) -> float:
    """Gap in m/s² of a twin on a drive, on the road of ``placed``."""
    there = observe(read_drive(bag), twin.model_copy(update={"road": placed.road}))
    return there.gap(there.condition(simulate_twin(twin, there.road_excitation))).rms


def true_value(truth: Twin, found: Twin, key: str) -> float:
    """The true value of a parameter found; of a force, that at the deflection or velocity of the point found, which
    need not be a point of the truth's table. Compressions are counted from the standing car: no signal shows a shift
    of the spring along its travel."""
    if ".force." not in key:
        try:
            return float(twin_value(truth, key) or 0.0)
        except InputError:  # a part that the file leaves out: the vehicle does not have it
            return 0.0
    _, axle, part, _, number = key.split(".")
    curve, refined = (getattr(getattr(twin.vehicle, axle), part).points for twin in (truth, found))
    at = refined[0][[int(number)]]
    if part == "spring":
        at = at + truth.axles[axle].static_compression - found.axles[axle].static_compression
    return float(force(curve, at)[0])


def force_error_along(result: CalibrationResult, truth: Twin, index: int) -> float:
    """Median relative error of a curve's force over the range that was excited."""
    curve = result.curves[index]
    _, axle, part = curve.key.split(".")
    points = getattr(getattr(truth.vehicle, axle), part).points
    low, high = curve.span
    grid = curve.band.x
    inside = (grid >= max(low, 1e-3)) & (grid <= high)
    true = force(points, grid[inside])
    return float(np.median(np.abs(curve.force[inside] / true - 1)))


def speed(folder: Path, repeats: int = 5) -> dict[str, Any]:
    """Whole commands, start of Python included; the best of a few, after one to compile."""
    truth, start = within_table_2(1)
    one = write_case(folder / "speed_pass", truth, start, bump(1), {"pass": PASS}, 1, SensorErrors())
    truth, start = thirty_per_cent_off(1)
    two = write_case(
        folder / "speed_two", truth, start, rough(1), {"slow": SLOW, "brisk": BRISK}, 1, SensorErrors()
    )
    found: dict[str, Any] = {
        name: timed(case, preset, folder / f"{preset}.yaml", repeats, page)
        for name, case, preset, page in (
            ("paper, one pass of 10 s", one, "paper", None),
            ("paper, one pass of 10 s, with the page", one, "paper", folder / "page_p"),
            ("fast, two drives of 100 s in all", two, "fast", None),
            ("fast, two drives of 100 s in all, with the page", two, "fast", folder / "page_f"),
        )
    }
    return found


def timed(case: Case, preset: str, out: Path, repeats: int, page: Path | None) -> dict[str, float]:
    """Wall and processor seconds of a whole command, the least of ``repeats`` each, and how busy the machine was."""
    command = [
        sys.executable,
        "-m",
        "suspension_twin",
        "calibrate",
        "--twin",
        str(case.twin),
        "--preset",
        preset,
        "--out",
        str(out),
        *map(str, case.drives.values()),
        *(("--report", str(page)) if page else ()),
    ]
    walls, busy = [], []
    for _ in range(repeats + 1):
        start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        walls.append(time.perf_counter() - start)
        busy.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return {
        "wall_s": min(walls[1:]),
        "wall_median_s": float(np.median(walls[1:])),
        "processor_s": min(busy[1:]),
        "load_average": os.getloadavg()[0],
    }


def show(console: Console, results: dict[str, Any]) -> None:
    for section in SECTIONS:
        found = results.get(section)
        if not found:
            continue
        rows = found.get("by_vehicle")
        if rows:
            _print(console, section, list(rows[0]), [list(r.values()) for r in rows])
            found = {k: v for k, v in found.items() if k != "by_vehicle"}
        if all(isinstance(v, dict) for v in found.values()):
            names = [k for k in next(iter(found.values())) if k != "trace"]
            _print(console, section, ["by", *names], [[k, *(v[c] for c in names)] for k, v in found.items()])
        else:
            _print(console, section, ["figure", "value"], [list(pair) for pair in found.items()])


def _print(console: Console, title: str, columns: list[str], rows: list[list[Any]]) -> None:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for name in columns:
        side: Literal["left", "right"] = "left" if name == columns[0] else "right"
        table.add_column(name.replace("_", " "), justify=side, overflow="fold")
    for row in rows:
        table.add_row(*(_cell(v) for v in row))
    console.print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "never"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--seeds", choices=FIRST_SEED, default="reporting")
    parser.add_argument("--peer-seconds", type=float, default=60.0, help="time each peer is given")
    parser.add_argument("--picture", type=Path, help="where to draw the peers (.png, .svg)")
    given = parse_options(parser, vehicles=1, peer_seconds=1.0, only=["evaluations", "accuracy", "peers"])
    console = Console(stderr=given.json, highlight=False)
    seeds = range(FIRST_SEED[given.seeds], FIRST_SEED[given.seeds] + given.vehicles)
    results: dict[str, Any] = {"seeds": list(seeds)}
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        for section in given.only:
            console.print(f"[dim]{section} ...[/]")
            if section == "evaluations":
                results[section] = evaluations(here, seeds)
            elif section == "accuracy":
                results[section] = accuracy(here, seeds)
            elif section == "speed":
                results[section] = speed(here)
            else:
                results[section] = peers(here, given.peer_seconds, seeds[0])
    if given.picture and "peers" in results:
        draw(results["peers"], given.picture)
    if given.json:
        print(json.dumps(results))
    else:
        show(console, results)


if __name__ == "__main__":
    main()
