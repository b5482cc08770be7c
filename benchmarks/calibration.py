# SPDX-License-Identifier: Apache-2.0
"""How well and how fast a twin is calibrated, beside what one would use instead; all with known truth.

Usage: ``python benchmarks/calibration.py [--json] [--only SECTION ...] [--vehicles N] [--peer-seconds S]``

- ``evaluations``: the cost that ``paper`` ends with, and after how many evaluations ``fast`` is there;
- ``accuracy``: residual on a drive not seen, recovered forces and coverage of the 90 % intervals;
- ``speed``: wall time of the command line, everything included;
- ``peers``: one problem solved by pymoo's stock GA over ``solve_ivp``, by scipy's differential
  evolution on this project's batch, and by both presets.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
)  # fmt: skip
from plain_car import PlainCar
from rich.console import Console
from rich.table import Table

from suspension_twin.calibration.request import CalibrationRequest, CalibrationResult
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.setup import set_up
from suspension_twin.calibration.space import curve_keys, twin_value
from suspension_twin.drive.read import read_drive
from suspension_twin.gap.prepare import prepare
from suspension_twin.gap.synthetic import SensorErrors
from suspension_twin.models.simulate import simulate_twin
from suspension_twin.vehicle.twin import Twin, load_twin

SECTIONS = ("evaluations", "accuracy", "speed", "peers")
ONE_CHANNEL = (("vertical_acceleration", 1.0),)


def same_question(case: Case, preset: str, seed: int) -> CalibrationResult:
    """One drive, the paper's 24 points and eq. (1): what both presets can be asked alike."""
    asked = {} if preset == "paper" else {
        "objective": "euclidean", "channels": ONE_CHANNEL, "free": curve_keys(load_twin(case.twin)),
    }  # fmt: skip
    return calibrate(
        CalibrationRequest(
            twin=str(case.twin),
            bags=tuple(str(p) for p in case.drives.values()),
            preset=preset,
            seed=seed,
            **asked,
        )
    )


def evaluations(folder: Path, vehicles: int) -> list[dict[str, Any]]:
    """``paper`` and ``fast`` on the same pass over a bump, vehicle by vehicle."""
    rows = []
    for seed in range(vehicles):
        truth, start = within_table_2(seed)
        case = write_case(
            folder / f"pass{seed}", truth, start, bump(seed), {"pass": PASS}, seed, SensorErrors()
        )
        paper = same_question(case, "paper", seed)
        fast = same_question(case, "fast", seed)
        there = fast.history[fast.history[:, 1] <= paper.cost]
        rows.append(
            {
                "vehicle": seed,
                "paper_cost": paper.cost,
                "paper_evaluations": paper.evaluations,
                "fast_cost": fast.cost,
                "fast_evaluations": fast.evaluations,
                "fast_reached_at": float(there[0, 0]) if len(there) else None,
                "share": float(there[0, 0]) / paper.evaluations if len(there) else None,
            }
        )
    return rows


def accuracy(folder: Path, vehicles: int) -> dict[str, Any]:
    """``fast`` from a preset 30 % off on two drives, checked on a third and against the truth."""
    ratios, errors, excited_hits, all_hits, spans = [], [], [], [], []
    for seed in range(vehicles):
        truth, start = thirty_per_cent_off(seed)
        knots = {"slow": SLOW, "brisk": BRISK, "unseen": UNSEEN}
        case = write_case(folder / f"off{seed}", truth, start, rough(seed), knots, seed, SensorErrors())
        used = tuple(str(case.drives[name]) for name in ("slow", "brisk"))
        result = calibrate(CalibrationRequest(twin=str(case.twin), bags=used, seed=seed))
        known = load_twin(case.truth)
        ratios.append(
            gap_on(case.drives["unseen"], result.twin, known) / gap_on(case.drives["unseen"], known, known)
        )
        for e in result.estimates:
            true = float(twin_value(known, e.key))
            hit = e.low <= true <= e.high
            all_hits.append(hit)
            if e.excited and ".force." in e.key:
                errors.append(abs(e.value / true - 1))
                excited_hits.append(hit)
        spans += [force_error_along(result, known, curve) for curve in range(len(result.curves))]
    return {
        "vehicles": vehicles,
        "residual_ratio_unseen_worst": float(np.max(ratios)),
        "residual_ratio_unseen_median": float(np.median(ratios)),
        "force_error_median_at_points": float(np.median(errors)),
        "force_error_median_along_excited_range": float(np.median(spans)),
        "points_excited": len(excited_hits),
        "coverage_excited_points": float(np.mean(excited_hits)),
        "points_all": len(all_hits),
        "coverage_all_parameters": float(np.mean(all_hits)),
    }


def gap_on(bag: Path, twin: Twin, placed: Twin) -> float:
    """Gap in m/s² of a twin on a drive, on the road of ``placed``."""
    there = prepare(read_drive(bag), twin.model_copy(update={"road": placed.road}))
    return there.gap(there.condition(simulate_twin(twin, there.excitation))).rms


def force_error_along(result: CalibrationResult, truth: Twin, index: int) -> float:
    """Median relative error of a curve's force over the range that was excited."""
    curve = result.curves[index]
    _, axle, part = curve.key.split(".")
    x, force = getattr(getattr(truth.vehicle, axle), part).points
    low, high = curve.span
    inside = (curve.grid >= max(low, 1e-3)) & (curve.grid <= high)
    true = np.interp(curve.grid[inside], np.concatenate([[0.0], x]), np.concatenate([[0.0], force]))
    return float(np.median(np.abs(curve.force[inside] / true - 1)))


def speed(folder: Path, repeats: int = 3) -> dict[str, float]:
    """Wall time of whole commands, start of Python included; the best of a few, after one to compile."""
    truth, start = within_table_2(1)
    one = write_case(folder / "speed_pass", truth, start, bump(1), {"pass": PASS}, 1, SensorErrors())
    truth, start = thirty_per_cent_off(1)
    two = write_case(
        folder / "speed_two", truth, start, rough(1), {"slow": SLOW, "brisk": BRISK}, 1, SensorErrors()
    )
    return {
        "paper_10_s_pass_s": timed(one, "paper", folder / "p.yaml", repeats),
        "fast_two_drives_of_100_s_in_all_s": timed(two, "fast", folder / "f.yaml", repeats),
    }


def timed(case: Case, preset: str, out: Path, repeats: int) -> float:
    command = [
        sys.executable, "-m", "suspension_twin", "calibrate", "--twin", str(case.twin), "--preset", preset,
        "--out", str(out), *map(str, case.drives.values()),
    ]  # fmt: skip
    walls = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        walls.append(time.perf_counter() - start)
    return min(walls[1:])


class Counted:
    """Remembers the best cost against evaluations and seconds, and ends a search out of time."""

    def __init__(self, seconds: float) -> None:
        self.limit, self.began = seconds, time.perf_counter()
        self.evaluations, self.best = 0, np.inf
        self.trace: list[tuple[int, float, float]] = []

    def note(self, costs: np.ndarray) -> None:
        self.evaluations += costs.size
        if costs.size and costs.min() < self.best:
            self.best = float(costs.min())
            self.trace.append((self.evaluations, time.perf_counter() - self.began, self.best))

    @property
    def over(self) -> bool:
        return time.perf_counter() - self.began > self.limit


def peers(folder: Path, seconds: float) -> dict[str, Any]:
    """Cost reached on one pass within Table 2's bounds, by four ways."""
    truth, start = within_table_2(1)
    case = write_case(folder / "peers", truth, start, bump(1), {"pass": PASS}, 1, SensorErrors())
    request = CalibrationRequest(twin=str(case.twin), bags=(str(case.drives["pass"]),), preset="paper")
    setup = set_up(request, lambda note: None, lambda: False)
    problem = setup.problem
    quiet = np.zeros(len(problem.nuisances))
    found: dict[str, Any] = {}
    for preset in ("paper", "fast"):
        result = same_question(case, preset, 1)
        found[preset] = {"evaluations": result.evaluations, "seconds": result.seconds, "cost": result.cost}

    def batch(values: np.ndarray) -> np.ndarray:
        return problem.costs(values, quiet, synchronise=True)

    found["scipy differential_evolution, this batch"] = _scipy(
        batch, problem.space.lower, problem.space.upper, seconds
    )
    found["pymoo GA, solve_ivp"] = _pymoo(problem, setup.twin, seconds)
    return found


def _scipy(
    batch: Callable[[np.ndarray], np.ndarray], lower: Any, upper: Any, seconds: float
) -> dict[str, Any]:
    from scipy.optimize import differential_evolution

    counted = Counted(seconds)

    def cost(x: np.ndarray) -> np.ndarray:
        values = batch(x.reshape(len(lower), -1))
        counted.note(values)
        return values

    differential_evolution(
        cost, list(zip(lower, upper, strict=True)), seed=1, vectorized=True, updating="deferred", polish=False,
        popsize=4, maxiter=10_842 // (4 * len(lower)), callback=lambda *a: counted.over,
    )  # fmt: skip
    return _told(counted)


def _pymoo(problem: Any, twin: Twin, seconds: float) -> dict[str, Any]:
    from pymoo.algorithms.soo.nonconvex.ga import GA
    from pymoo.core.problem import ElementwiseProblem
    from pymoo.optimize import minimize
    from pymoo.termination.max_time import TimeBasedTermination

    counted = Counted(seconds)
    part, rows = problem.parts[0], problem.rows[0]
    car = PlainCar(twin, part.excitation)
    wanted = part.measured["vertical_acceleration"][rows]

    class Plain(ElementwiseProblem):  # type: ignore[misc]
        def _evaluate(self, x: np.ndarray, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
            candidate = problem.space.applied(twin, np.asarray(x))
            signal = part.conditioner.apply(car.simulate(candidate.vehicle))[rows]
            out["F"] = float(np.sqrt(np.sum((signal - wanted) ** 2)))
            counted.note(np.array([out["F"]]))

    space = problem.space
    asked = Plain(n_var=len(space), n_obj=1, xl=space.lower, xu=space.upper)
    minimize(asked, GA(pop_size=20), TimeBasedTermination(seconds), seed=1)
    return _told(counted)


def _told(counted: Counted) -> dict[str, Any]:
    return {
        "evaluations": counted.evaluations,
        "seconds": time.perf_counter() - counted.began,
        "cost": counted.best,
        "trace": [list(row) for row in counted.trace],
    }


def show(console: Console, results: dict[str, Any]) -> None:
    for section, found in results.items():
        rows = found if isinstance(found, list) else None
        table = Table(title=section, title_justify="left", title_style="bold")
        if rows:
            for name in rows[0]:
                table.add_column(name.replace("_", " "), justify="right")
            for row in rows:
                table.add_row(*(_cell(v) for v in row.values()))
        elif all(isinstance(v, dict) for v in found.values()):
            table.add_column("by")
            for name in ("evaluations", "seconds", "cost"):
                table.add_column(name, justify="right")
            for name, row in found.items():
                table.add_row(name, *(_cell(row[c]) for c in ("evaluations", "seconds", "cost")))
        else:
            table.add_column("figure")
            table.add_column("value", justify="right")
            for name, value in found.items():
                table.add_row(name.replace("_", " "), _cell(value))
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
    parser.add_argument("--peer-seconds", type=float, default=60.0, help="time each peer is given")
    given = parser.parse_args()
    console = Console(stderr=given.json, highlight=False)
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        for section in given.only:
            console.print(f"[dim]{section} ...[/]")
            if section == "evaluations":
                results[section] = evaluations(here, given.vehicles)
            elif section == "accuracy":
                results[section] = accuracy(here, given.vehicles)
            elif section == "speed":
                results[section] = speed(here)
            else:
                results[section] = peers(here, given.peer_seconds)
    if given.json:
        print(json.dumps(results))
    else:
        show(console, results)


if __name__ == "__main__":
    main()
