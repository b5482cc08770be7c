# SPDX-License-Identifier: Apache-2.0
"""One calibration by four ways, for ``calibration.py``: both presets, SciPy's differential evolution, pymoo's GA."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from calibration_cases import PASS, bump, within_table_2, write_case
from calibration_judge import judged_by, same_question, traced
from plain_car import PlainCar

from suspension_twin.arrays import Floats
from suspension_twin.calibration.request import Progress
from suspension_twin.calibration.run import calibrate
from suspension_twin.calibration.searches import costs_of
from suspension_twin.calibration.setup import set_up
from suspension_twin.inference.problem import Problem
from suspension_twin.inference.synthetic import SensorErrors
from suspension_twin.models.parameters import twin_value
from suspension_twin.vehicle.twin import Twin, load_twin


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


def peers(folder: Path, seconds: float, seed: int) -> dict[str, Any]:
    """Cost reached on one pass within Table 2's bounds, by four ways; a trace row is (evaluations, seconds, cost)."""
    truth, start = within_table_2(seed)
    case = write_case(folder / "peers", truth, start, bump(seed), {"pass": PASS}, seed, SensorErrors())
    asked = same_question(case, "paper", seed)
    setup = set_up(asked, lambda note: None, lambda: False)
    problem = setup.problem
    quiet = np.zeros(len(problem.nuisances))
    found: dict[str, Any] = {}
    began, paper_trace = time.perf_counter(), []

    def look(p: Progress) -> None:
        if p.stage in ("search", "refine"):
            paper_trace.append([p.evaluations, time.perf_counter() - began, p.best_cost])

    paper = calibrate(asked, look)
    found["paper"] = _summed(paper_trace, paper.evaluations, paper.seconds)
    fast, trace = traced(same_question(case, "fast", seed), judged_by(asked))
    found["fast"] = _summed([[n, t, c] for n, c, t in trace], fast.evaluations, fast.seconds)

    def batch(values: np.ndarray) -> np.ndarray:
        return costs_of(problem, setup.objective, values, quiet, synchronise=True)

    found["scipy differential_evolution, this batch"] = _scipy(
        batch, problem.space.lower, problem.space.upper, seconds
    )
    found["pymoo GA, solve_ivp"] = _pymoo(problem, setup.twin, seconds)
    known = load_twin(case.truth)
    least = judged_by(asked)(np.array([float(twin_value(known, key)) for key in problem.space.keys]))
    for row in found.values():
        row["cost_over_truths"] = row["cost"] / least
        row["evaluations_per_second"] = row["evaluations"] / row["seconds"]
        row["seconds_to_paper_cost"] = next((t for _, t, c in row["trace"] if c <= paper.cost), None)
    return found


def _summed(trace: list[list[float]], evaluations: int, seconds: float) -> dict[str, Any]:
    cost = min(row[2] for row in trace)
    return {"evaluations": evaluations, "seconds": seconds, "cost": cost, "trace": trace}


def draw(found: dict[str, Any], path: Path) -> None:
    """Cost against evaluations and against seconds, all four ways."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for name, row in found.items():
        trace = np.array(row["trace"], dtype=float)
        best = np.minimum.accumulate(trace[:, 2])
        for axis, column, end in ((axes[0], 0, row["evaluations"]), (axes[1], 1, row["seconds"])):
            axis.step([*trace[:, column], end], [*best, best[-1]], where="post", label=name)
    for axis, text in zip(axes, ("evaluations", "seconds"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel=text)
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("cost, eq. (1) [m/s²]")
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=130)


def _scipy(batch: Callable[[Floats], Floats], lower: Floats, upper: Floats, seconds: float) -> dict[str, Any]:
    from scipy.optimize import Bounds, differential_evolution

    counted = Counted(seconds)

    def cost(x: Floats) -> Any:
        values = batch(x.reshape(len(lower), -1))
        counted.note(values)
        return values

    def look(x: Floats, convergence: object) -> None:
        if counted.over:
            raise StopIteration

    differential_evolution(
        cost,
        Bounds(lower, upper),
        seed=1,
        vectorized=True,
        updating="deferred",
        polish=False,
        popsize=4,
        maxiter=10_842 // (4 * len(lower)),
        callback=look,
    )
    return _told(counted)


def _pymoo(problem: Problem, twin: Twin, seconds: float) -> dict[str, Any]:
    from pymoo.algorithms.soo.nonconvex.ga import GA
    from pymoo.core.problem import ElementwiseProblem
    from pymoo.optimize import minimize
    from pymoo.termination.max_time import TimeBasedTermination

    counted = Counted(seconds)
    part, rows = problem.data.parts[0], problem.data.rows[0]
    car = PlainCar(twin, part.road_excitation)
    wanted = part.measured["vertical_acceleration"][rows]

    class Plain(ElementwiseProblem):  # type: ignore[misc]
        def _evaluate(self, x: np.ndarray, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
            candidate = problem.space.applied(twin, np.asarray(x))
            signal = part.apply(car.simulate(candidate.vehicle))[rows]
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
