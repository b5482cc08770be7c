# SPDX-License-Identifier: Apache-2.0
"""Search by bounded Gauss-Newton (Levenberg-Marquardt), with restarts at the corners of the springs.

The cost has several local minima: one for each corner of a spring's characteristic that the static
compression can lie at, and no gradient leads from one to the other. So after the first descent
every corner near the static compression is tried as a start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.recorder import Recorder, SearchOutcome, SquaresFit
from suspension_twin.calibration.searches import BATCH, costs_of
from suspension_twin.calibration.setup import Setup
from suspension_twin.inference.gauss_newton import GaussNewton, GaussNewtonSettings, Quadratic
from suspension_twin.inference.noise import NEAR_FLOOR, Whitener
from suspension_twin.inference.nuisance import Nuisances
from suspension_twin.inference.observation import Observation
from suspension_twin.inference.posterior import travel
from suspension_twin.inference.problem import Interrupted, Problem
from suspension_twin.inference.spring_position import FARTHEST, standing_at

__all__ = ["FAINT", "LATENCY", "LIKELIHOOD", "in_floors", "moved", "run_squares"]

_EXPECTED = 700.0  # evaluations, for the time left
#: Weight of the prior beside an objective that was asked for by name.
FAINT = 1e-3
#: Residuals in floors (the median of the channels) up to which no other corner is tried.
_AT_FLOOR = 1.3
#: Offsets that are simulated from here on instead of interpolated: s and m.
_PLACE_CLOCK, _PLACE_MAP = 2e-3, 2e-2
#: Standard deviations of the random restarts of a search with a named objective.
_SHAKES = (2.0, 4.0, 4.0)
_NEAREST_CORNER = 0.003  # m
LATENCY = "imu.latency"


@dataclass(frozen=True)
class _Round:
    """One minimisation. ``faint``: the prior has the weight ``FAINT`` (it settles what the objective does not
    depend on), unless the objective is the likelihood; ``hop``: (spring, corner) to start at, or None."""

    stage: str
    number: int
    settings: GaussNewtonSettings
    faint: bool = True
    hop: tuple[int, int] | None = None


_DESCENT = GaussNewtonSettings(iterations=3, tolerance=1e-3)
_SEARCH = GaussNewtonSettings(iterations=4, tolerance=1e-2)
#: A likelihood's minimum is found where -2 log likelihood falls by less than a tenth.
LIKELIHOOD = GaussNewtonSettings(iterations=15, tolerance=0.0, absolute=0.1, patience=1)


@dataclass(frozen=True, eq=False)
class _Recorded:
    """The residuals of a problem for the solver, in what the recorder keeps."""

    problem: Problem
    recorder: Recorder

    def quadratic(self, x: Floats) -> Quadratic:
        """The quadratic model about ``x``."""
        return self.recorder.known(1 + self.problem.d, partial(self.problem.quadratic, x))

    def sums_of_squares(self, x: Floats) -> Floats:
        """(L,) sums of squared residuals."""
        return self.recorder.known(x.shape[1], partial(self.problem.sums_of_squares, x))


def moved(problem: Problem, nuisance: Floats) -> Problem:
    """The problem with clock and map offsets applied to the excitation instead of by interpolation.

    Fitted biases, gains and tilts are unchanged; further offsets are relative to these.
    """
    found = dict(zip(problem.nuisances.names, nuisance, strict=True))
    metres, late = found.get("map_position", 0.0), found.get("clock_offset", 0.0)
    data = problem.data
    parts = [on_taped_road(p, problem.nuisances, nuisance) for p in data.parts]
    parts = [p.moved(late + found.get(f"{p.name}.clock_offset", 0.0), metres) for p in parts]
    wander = (problem.nuisances.wander_of(number, nuisance) for number in range(len(parts)))
    parts = [p.displaced(t, ahead) if t.size else p for p, (t, ahead) in zip(parts, wander, strict=True)]
    return replace(problem, likelihood=replace(problem.likelihood, data=replace(data, parts=tuple(parts))))


def on_taped_road(part: Observation, nuisances: Nuisances, values: Floats) -> Observation:
    """A drive on the road with the errors of the tape among ``values`` (q,) put right."""
    errors = nuisances.tape_of(values)
    return part.on(nuisances.taped.changed(part.road, errors)) if nuisances.taped and errors.any() else part


def run_squares(recorder: Recorder) -> SearchOutcome:
    """Levenberg-Marquardt on the objective, then, unless one was asked for by name, on the likelihood.

    The likelihood is efficient where the residual is noise. A larger residual is model discrepancy, which
    the likelihood would take for coloured noise: then the least squares fit stands.
    """
    fit = _Fit(recorder)
    stopped = False
    try:
        fit.explore()
        for planned in fit.plan():
            if recorder.out_of_generations:
                break
            fit.round(planned)
        fit.cost = fit.costs_at(fit.x)
    except Interrupted:
        stopped = True
    values = fit.base.space.from_slopes(fit.x[: fit.d])
    nuisance = fit.x[fit.d :] + fit.placed
    squares = SquaresFit(fit.x, fit.likelihood, 1.0 if fit.balanced else FAINT)
    return SearchOutcome(values, nuisance, fit.cost, fit.problem, fit.placed, squares, stopped)


class _Fit:
    """The best coordinates ``x`` so far, and the offsets ``placed`` that are simulated, not interpolated."""

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self.base = self.problem = recorder.setup.problem
        self.d, q = len(self.base.space), len(self.base.nuisances)
        self.precision = self.base.prior.precision
        self.x = np.concatenate([self.base.space.z0, np.zeros(q)])
        self.placed = np.zeros(q)
        self.likelihood: Whitener | None = None
        self.cost = np.inf
        self.balanced = recorder.objective == "likelihood"
        self.springs = [
            c
            for c in self.base.space.curves
            if c.part == "spring" and min(c.rows) >= 0 and c.standing is None
        ]

    @property
    def values(self) -> Floats:
        """(d,) values of the fit, in the units of the twin file."""
        return self.base.space.from_slopes(self.x[: self.d])

    # -- the plan ------------------------------------------------------------------------------

    def plan(self) -> Iterator[_Round]:
        """The rounds; each is decided on when its turn comes."""
        yield _Round("squares", 0, _DESCENT, faint=False)
        yield _Round("squares", 1, _DESCENT)
        if not self.balanced:
            for number in range(len(_SHAKES)):
                yield _Round("shake", number, _SEARCH)
        corners = [(s, j) for s, c in enumerate(self.springs) for j in range(c.x.size - 1)]
        for number, corner in enumerate(corners):
            if self.balanced and self.floors() < _AT_FLOOR:
                break
            yield _Round("hop", 2 * number, replace(_SEARCH, iterations=2), faint=False, hop=corner)
            yield _Round("hop", 2 * number + 1, _SEARCH)
        yield _Round("squares", 2, self.recorder.setup.preset.squares)
        if self.balanced and self.floors() < NEAR_FLOOR:
            yield _Round("likelihood", 0, LIKELIHOOD)
            yield _Round("likelihood", 1, LIKELIHOOD)

    def explore(self) -> None:
        """Start from the best of two dozen stiffer, softer, harder and weaker versions of the preset."""
        space = self.base.space
        rng = np.random.default_rng(self.recorder.request.seed)
        starts = np.repeat(space.z0[:, None], BATCH, axis=1)
        for curve in space.curves:
            rows = [r for r in curve.rows if r >= 0]
            starts[rows] += 0.4 * rng.standard_normal(BATCH)
        if LATENCY in space.keys:  # no gradient leads over half a period of the fastest motion
            starts[space.keys.index(LATENCY)] += 2.0 * rng.standard_normal(BATCH)
        starts[:, 0] = space.z0
        objective = self.recorder.setup.objective
        values = space.from_slopes(starts)
        costs = self.recorder.known(BATCH, lambda: costs_of(self.base, objective, values, self.x[self.d :]))
        best = int(np.argmin(costs))
        if costs[best] < 0.8 * costs[0]:
            self.x[: self.d] = starts[:, best]
        self.cost = float(costs[best])
        finite = costs[np.isfinite(costs)]
        mean = float(finite.mean()) if finite.size else np.inf
        self.recorder.report(False, self.values, self.cost, mean, _EXPECTED)

    # -- one round -----------------------------------------------------------------------------

    def round(self, planned: _Round) -> None:
        """One minimisation from where the fit is, or from the corner to hop to; kept if it is better."""
        recorder = self.recorder
        start = self._start(planned)
        if start is None:
            return
        problem = self.problem
        if planned.stage == "likelihood":
            self.likelihood = self._whitener(start)
            problem = problem.weighed(self.likelihood)
        centre = np.concatenate([self.base.space.z0, -self.placed])
        precision = self._scale(planned, start) * self.precision
        solver = GaussNewton(
            _Recorded(problem, recorder), start, precision, centre, settings=planned.settings
        )
        while not solver.finished and not recorder.out_of_generations:
            recorder.check()
            solver.step()
            self._note(solver, planned)
        self._pending = solver.x if planned.stage == "hop" else None

    _pending: Floats | None = None

    def _start(self, planned: _Round) -> Floats | None:
        """Coordinates that a round starts from; None where it has nothing to do."""
        if planned.stage == "hop":
            if planned.hop is not None:
                return self._at_corner(*planned.hop)
            # the second half of a hop goes on from the first, if that was made at all
            return self._pending
        if planned.stage == "shake":
            return self._shaken(planned.number)
        self._place()
        return self.x

    def _shaken(self, number: int) -> Floats:
        """The best of two dozen draws around the fit, wide in directions of little information: local minima of
        the corners lie side by side there."""

        def drawn() -> Floats:
            at = self.problem.linearise(self.x)
            residual, jacobian = at.residual, at.jacobian
            scale = max(float(np.mean(residual**2)) / self.problem.measured.independent, 1e-30)
            information = jacobian.T @ jacobian / scale + self.precision
            unit = 1.0 / np.sqrt(np.diag(information))
            scaled = information * unit[:, None] * unit[None, :] + 1e-9 * np.eye(unit.size)
            root = unit[:, None] * np.linalg.cholesky(np.linalg.inv(scaled))
            rng = np.random.default_rng((self.recorder.request.seed, number))
            draws = rng.standard_normal((self.x.size, BATCH))
            starts = self.x[:, None] + _SHAKES[number] * np.einsum("ij,jn->in", root, draws, optimize=False)
            return np.asarray(starts[:, int(np.argmin(self.problem.sums_of_squares(starts)))])

        return self.recorder.known(1 + self.d + BATCH, drawn)

    def _note(self, solver: GaussNewton, planned: _Round) -> None:
        """Keep a better point, report, save."""
        recorder = self.recorder
        whitened = planned.stage == "likelihood"
        # The squares of the objective order candidates as its costs do; those of the likelihood do not.
        cost = self.costs_at(solver.x) if whitened else recorder.setup.objective.cost_of_squares(solver.fit)
        if cost < self.cost or (self.balanced and planned.stage not in ("hop", "shake")):
            self.x, self.cost = solver.x, cost
        recorder.report(whitened, self.values, self.cost, cost, _EXPECTED)
        recorder.save()

    def _whitener(self, x: Floats) -> Whitener:
        """The noise as the residual at ``x`` shows it."""
        measured = self.problem.measured

        def found() -> tuple[tuple[int, ...], Floats, Floats]:
            noise = Whitener.of_residual(measured, self.problem.readings(x))
            return noise.group, noise.filters, noise.sigma

        return Whitener.with_filters(measured, *self.recorder.known(1, found))

    def _at_corner(self, spring: int, corner: int) -> Floats | None:
        """The fit with one spring's curve bent so that the vehicle stands at one of its corners."""
        curve = self.springs[spring]
        rows = list(curve.rows)
        twin = self.base.space.applied(self.recorder.setup.twin, self.values)
        static = self.recorder.known(0, lambda: travel(twin, self.problem).static[curve.axle])
        if not _NEAREST_CORNER < abs(curve.x[corner] - static) < FARTHEST:
            return None
        moved = self.x.copy()
        moved[rows] = standing_at(curve.x, self.x[rows], static, corner)
        return moved

    def _scale(self, planned: _Round, start: Floats) -> float:
        """Weight of the prior beside the sum of squares: the variance of an independent residual."""
        if planned.stage == "likelihood":
            return 1.0

        def square() -> float:
            residual = self.recorder.setup.objective.residuals(self.problem.compared(start[:, None]))
            return float(np.mean(residual**2))

        variance = max(self.recorder.known(1, square) / self.problem.measured.independent, 1e-30)
        return variance * (FAINT if planned.faint and not self.balanced else 1.0)

    def _place(self) -> None:
        """Simulate the offsets found so far where they are too large to interpolate; not of controlled runs."""
        if not self.recorder.setup.on_road:
            return
        names = self.base.nuisances.names
        clock = np.array([n.endswith(".clock_offset") for n in names], dtype=bool)
        tape = np.array([n.startswith("tape.") for n in names], dtype=bool)
        offset = clock | tape | np.array([n == "map_position" or ".wander." in n for n in names], dtype=bool)
        small = np.where(clock, _PLACE_CLOCK, np.where(tape, 0.0, _PLACE_MAP))
        found = np.where(offset, self.x[self.d :], 0.0)
        if np.any(np.abs(found) > small):
            self.placed = self.placed + found
            self.x = self.x.copy()
            self.x[self.d :][offset] = 0.0
            self.problem = moved(self.base, self.placed)
        self.problem = self.problem.with_tape_response(self.x)

    # -- evaluation -------------------------------------------------------------------------------

    def costs_at(self, x: Floats) -> float:
        """The objective's cost at coordinates ``x``."""
        values, objective = self.base.space.from_slopes(x[: self.d, None]), self.recorder.setup.objective
        costs = self.recorder.known(1, lambda: costs_of(self.problem, objective, values, x[self.d :]))
        return float(costs[0])

    def floors(self) -> float:
        """Residual rms in units of the noise floor; the median of the channels."""
        setup = self.recorder.setup
        return self.recorder.known(1, lambda: in_floors(setup, self.problem, self.problem.readings(self.x)))


def in_floors(setup: Setup, problem: Problem, compared: Floats) -> float:
    """Residual rms of ``compared`` signals (M, C) in units of the noise floor; the median of the channels."""
    residual = np.sqrt(np.mean((compared - problem.measured.values) ** 2, axis=0))
    floors = [float(np.mean([d.noise_rms[c] for d in setup.drives])) for c in problem.channels]
    return float(np.median(residual / np.array(floors)))
