# SPDX-License-Identifier: Apache-2.0
"""The population searches: the car paper's GA with its pattern search, and CMA-ES."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.evolution import CmaSearch
from suspension_twin.calibration.genetic import GeneticSearch
from suspension_twin.calibration.pattern import PatternSearch
from suspension_twin.calibration.recorder import Outcome, Recorder
from suspension_twin.identification.problem import Interrupted

__all__ = ["run_evolution", "run_genetic"]


def run_genetic(recorder: Recorder) -> Outcome:
    """GA, then pattern search, both in unit coordinates."""
    problem, preset = recorder.setup.problem, recorder.setup.preset
    quiet = np.zeros(len(problem.nuisances))

    def costs(points: Floats) -> Floats:
        recorder.evaluations += len(points)
        return problem.costs(problem.space.from_unit(points.T), quiet, preset.synchronise)

    settings = preset.genetic
    if recorder.request.max_generations:
        settings = replace(settings, generations=recorder.request.max_generations)
    budget = settings.population + settings.generations * (settings.population - settings.elite)
    expected = float(budget + preset.pattern.evaluations)
    stopped, best = False, (problem.space.to_unit(problem.space.nominal), np.inf)
    try:
        if not recorder.waits_for("pattern"):
            ga = GeneticSearch(len(problem.space), settings, recorder.request.seed)
            if state := recorder.resume("genetic"):
                ga.restore(state.arrays, state.plain)
                best = ga.best_point
            while not ga.finished:
                recorder.check()
                ga.tell(costs(ga.ask()))
                best = ga.best_point
                recorder.report(False, ga.best[-1], ga.mean[-1], expected)
                recorder.save("genetic", *ga.state())
        if state := recorder.resume("pattern"):
            search = PatternSearch.restore(state.arrays, state.plain, preset.pattern)
        else:
            search = PatternSearch(*best, preset.pattern)
        while not search.finished:
            best = search.x, search.cost
            recorder.check()
            search.tell(costs(search.ask()))
            recorder.report(True, search.cost, search.cost, expected)
            recorder.save("pattern", *search.state())
        best = search.x, search.cost
    except Interrupted:
        stopped = True
    return _outcome(recorder, problem.space.from_unit(best[0]), best[1], stopped)


def run_evolution(recorder: Recorder) -> Outcome:
    """CMA-ES in slope coordinates for objectives that are no sum of squares."""
    problem = recorder.setup.problem
    quiet = np.zeros(len(problem.nuisances))
    generations = recorder.request.max_generations or 300
    cma = CmaSearch(problem.space.z0, 0.3, recorder.request.seed, population=24, generations=generations)
    stopped = False
    try:
        if state := recorder.resume("evolution"):
            cma.restore(state.arrays, state.plain)
        while not cma.finished:
            recorder.check()
            points = cma.ask()
            recorder.evaluations += len(points)
            cma.tell(problem.costs(problem.space.from_slopes(points.T), quiet, synchronise=True))
            recorder.report(False, cma.best_cost, cma.mean_cost, 24.0 * generations)
            recorder.save("evolution", *cma.state())
    except Interrupted:
        stopped = True
    return _outcome(recorder, problem.space.from_slopes(cma.best_x), cma.best_cost, stopped)


def _outcome(recorder: Recorder, values: Floats, cost: float, stopped: bool) -> Outcome:
    """The outcome at ``values``, with the clock offsets that synchronise them."""
    problem = recorder.setup.problem
    nuisance = np.zeros(len(problem.nuisances))
    if not stopped:
        try:
            signals, _ = problem.simulate(values[:, None])
            nuisance = problem.synchronised(signals, nuisance[:, None])[:, 0]
        except Interrupted:
            stopped = True
    return Outcome(values, nuisance, cost, problem, np.zeros(nuisance.size), stopped=stopped)
