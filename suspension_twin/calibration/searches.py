# SPDX-License-Identifier: Apache-2.0
"""The population searches: the car paper's GA with its pattern search, and CMA-ES."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.evolution import CmaSearch
from suspension_twin.calibration.genetic import GeneticSearch
from suspension_twin.calibration.pattern import PatternSearch
from suspension_twin.calibration.recorder import Outcome, Recorder
from suspension_twin.inference.problem import Interrupted

__all__ = ["run_evolution", "run_genetic"]

#: CMA-ES: first step in slope coordinates (a logarithm), population, and generations at most.
_STEP, _POPULATION, _GENERATIONS = 0.3, 24, 300


def _advance(
    recorder: Recorder,
    stage: str,
    search: GeneticSearch | PatternSearch | CmaSearch,
    costs: Callable[[Floats], Floats],
    expected: float,
) -> bool:
    """Run a search to its end, resumed if there is a state of it; False if it was interrupted."""
    try:
        if state := recorder.resume(stage):
            search.restore(state.arrays, state.plain)
        while not search.finished:
            recorder.check()
            points = search.ask()
            recorder.evaluations += len(points)
            search.tell(costs(points))
            recorder.report(stage == "pattern", search.best_point[1], search.mean_cost, expected)
            recorder.save(stage, *search.state())
    except Interrupted:
        return False
    return True


def run_genetic(recorder: Recorder) -> Outcome:
    """GA, then pattern search, both in unit coordinates."""
    problem, preset = recorder.setup.problem, recorder.setup.preset
    space, quiet = problem.space, np.zeros(len(problem.nuisances))

    def costs(points: Floats) -> Floats:
        return problem.costs(space.from_unit(points.T), quiet, preset.synchronise)

    settings = preset.genetic
    if recorder.request.max_generations:
        settings = replace(settings, generations=recorder.request.max_generations)
    budget = settings.population + settings.generations * (settings.population - settings.elite)
    expected = float(budget + preset.pattern.evaluations)
    best, done = (space.to_unit(space.nominal), np.inf), True
    if not recorder.waits_for("pattern"):
        genetic = GeneticSearch(len(space), settings, recorder.request.seed)
        done = _advance(recorder, "genetic", genetic, costs, expected)
        best = genetic.best_point if genetic.best else best
    if done:
        pattern = PatternSearch(*best, preset.pattern)
        done = _advance(recorder, "pattern", pattern, costs, expected)
        best = pattern.best_point
    return _outcome(recorder, space.from_unit(best[0]), best[1], done)


def run_evolution(recorder: Recorder) -> Outcome:
    """CMA-ES in slope coordinates for objectives that are no sum of squares."""
    problem = recorder.setup.problem
    space, quiet = problem.space, np.zeros(len(problem.nuisances))

    def costs(points: Floats) -> Floats:
        return problem.costs(space.from_slopes(points.T), quiet, synchronise=True)

    generations = recorder.request.max_generations or _GENERATIONS
    search = CmaSearch(space.z0, _STEP, recorder.request.seed, _POPULATION, generations)
    done = _advance(recorder, "evolution", search, costs, float(_POPULATION * generations))
    x, cost = search.best_point
    return _outcome(recorder, space.from_slopes(x), cost, done)


def _outcome(recorder: Recorder, values: Floats, cost: float, done: bool) -> Outcome:
    """The outcome at ``values``, with the clock offsets that align them in time."""
    problem = recorder.setup.problem
    nuisance = np.zeros(len(problem.nuisances))
    if done:
        try:
            signals, _ = problem.simulate(values[:, None])
            nuisance = problem.synchronised(signals, nuisance[:, None])[:, 0]
        except Interrupted:
            done = False
    return Outcome(values, nuisance, cost, problem, np.zeros(nuisance.size), stopped=not done)
