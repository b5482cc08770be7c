# SPDX-License-Identifier: Apache-2.0
"""The population searches: the car paper's GA with its pattern search, and CMA-ES; costs of candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.evolution import CmaSearch
from suspension_twin.calibration.genetic import GeneticSearch
from suspension_twin.calibration.pattern import PatternSearch
from suspension_twin.calibration.recorder import Recorder, SearchOutcome
from suspension_twin.inference.objectives import Objective
from suspension_twin.inference.problem import Interrupted, Problem

__all__ = ["BATCH", "costs_of", "run_evolution", "run_genetic", "synchronised"]

#: Candidates that are simulated together: the population of CMA-ES, and random starts.
BATCH = 24
#: CMA-ES: first step in slope coordinates (a logarithm), and generations at most.
_STEP, _GENERATIONS = 0.3, 300
_SAVE_EVERY = 5  # generations of a search whose costs are few numbers
_SYNC_STEP, _SYNC_LIMIT = 1e-3, 0.1  # s, of a clock offset


def costs_of(
    problem: Problem, objective: Objective, values: Floats, nuisance: Floats, synchronise: bool = False
) -> Floats:
    """(L,) costs of candidates (d, L), in the units of the twin file, at fixed nuisance parameters (q,); infinite where
    one cannot be simulated.

    ``synchronise``: the clock offset of each drive is first fitted for each candidate, as the car paper aligns signals.
    """
    costs = np.empty(values.shape[1])
    for cut in problem.batches(values.shape[1]):
        signals, failed = problem.signals_of(values[:, cut], np.zeros((0, values[:, cut].shape[1])))
        held = np.repeat(nuisance[:, None], failed.size, axis=1)
        if synchronise:
            held = synchronised(problem, objective, signals, held)
        found = objective.costs(problem.likelihood.compared(signals, held))
        costs[cut] = np.where(failed | ~np.isfinite(found), np.inf, found)
    return costs


def synchronised(
    problem: Problem, objective: Objective, signals: Sequence[Floats], nuisance: Floats
) -> Floats:
    """``nuisance`` (q, L) with every lane's clock offsets at their least squares values: two Gauss-Newton steps, each
    within a tenth of a second."""
    nuisance, data, nuisances = nuisance.copy(), problem.data, problem.nuisances
    weights = np.array([max(t.weight for t in objective.terms if t.channel == c) for c in data.channels])
    for row, numbers in nuisances.clocks:
        for _ in range(2):
            ahead = nuisance.copy()
            ahead[row] += _SYNC_STEP
            top, bottom = np.zeros(nuisance.shape[1]), np.zeros(nuisance.shape[1])
            for k in numbers:
                part, rows = data.parts[k], data.rows[k]
                here, there = (nuisances.apply(k, signals[k], rows, n) for n in (nuisance, ahead))
                wanted = np.stack([part.measured[c][rows] for c in data.channels], axis=1)
                slope = weights[None, :, None] * (there - here) / _SYNC_STEP
                off = weights[None, :, None] * (wanted[:, :, None] - here)
                top += np.einsum("rcl,rcl->l", slope, off, optimize=False)
                bottom += np.einsum("rcl,rcl->l", slope, slope, optimize=False)
            step = np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), 0.0)
            nuisance[row] += np.clip(step, -_SYNC_LIMIT, _SYNC_LIMIT)
    return nuisance


def _advance(
    recorder: Recorder,
    refine: bool,
    search: GeneticSearch | PatternSearch | CmaSearch,
    values: Callable[[Floats], Floats],
    costs: Callable[[Floats], Floats],
    expected: float,
) -> bool:
    """Run a search over points, whose ``values`` (d, n) cost ``costs`` (n,), to its end; False if interrupted."""
    try:
        while not search.finished:
            recorder.check()
            points = search.ask()
            search.tell(recorder.known(len(points), partial(lambda at: costs(values(at.T)), points)))
            point, cost = search.best_point
            recorder.report(refine, values(point), cost, search.mean_cost, expected)
            recorder.save(_SAVE_EVERY)
    except Interrupted:
        return False
    return True


def run_genetic(recorder: Recorder) -> SearchOutcome:
    """GA, then pattern search, both in unit coordinates."""
    setup = recorder.setup
    problem, preset = setup.problem, setup.preset
    space, quiet = problem.space, np.zeros(len(problem.nuisances))

    def costs(values: Floats) -> Floats:
        return costs_of(problem, setup.objective, values, quiet, preset.synchronise)

    settings = preset.genetic
    if recorder.request.max_generations:
        settings = replace(settings, generations=recorder.request.max_generations)
    budget = settings.population + settings.generations * (settings.population - settings.elite)
    expected = float(budget + preset.pattern.evaluations)
    genetic = GeneticSearch(len(space), settings, recorder.request.seed)
    done = _advance(recorder, False, genetic, space.from_unit, costs, expected)
    best = genetic.best_point if genetic.best else (space.to_unit(space.nominal), np.inf)
    if done:
        pattern = PatternSearch(*best, preset.pattern)
        done = _advance(recorder, True, pattern, space.from_unit, costs, expected)
        best = pattern.best_point
    return _outcome(recorder, space.from_unit(best[0]), best[1], done)


def run_evolution(recorder: Recorder) -> SearchOutcome:
    """CMA-ES in slope coordinates for objectives that are no sum of squares."""
    problem = recorder.setup.problem
    space, quiet = problem.space, np.zeros(len(problem.nuisances))

    def costs(values: Floats) -> Floats:
        return costs_of(problem, recorder.setup.objective, values, quiet, synchronise=True)

    generations = recorder.request.max_generations or _GENERATIONS
    search = CmaSearch(space.z0, _STEP, recorder.request.seed, BATCH, generations)
    done = _advance(recorder, False, search, space.from_slopes, costs, float(BATCH * generations))
    x, cost = search.best_point
    return _outcome(recorder, space.from_slopes(x), cost, done)


def _outcome(recorder: Recorder, values: Floats, cost: float, done: bool) -> SearchOutcome:
    """The outcome at ``values``, with the clock offsets that align them in time."""
    problem = recorder.setup.problem
    nuisance = np.zeros(len(problem.nuisances))
    if done:
        try:
            signals, _ = problem.signals_of(values[:, None], np.zeros((0, 1)))
            nuisance = synchronised(problem, recorder.setup.objective, signals, nuisance[:, None])[:, 0]
        except Interrupted:
            done = False
    return SearchOutcome(values, nuisance, cost, problem, np.zeros(nuisance.size), stopped=not done)
