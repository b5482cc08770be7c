# SPDX-License-Identifier: Apache-2.0
"""How well one explanation of a tracked vehicle's gap fits: the numerics of ``diagnosis.tracked``.

Prediction of a run = model with the effect - model without + what is normal for this vehicle. Normal is the mean
of the reference runs at that speed, so that whatever the model gets wrong of a sound vehicle cancels; without
a reference it is the model itself. Each run's clock and true speed are nuisances with priors of their own: they
are found anew for every explanation, and what an explanation asks of them counts against it. Causes are weighed
against noise and doubt together: the model tells the change that a fault brings no better than it tells the motion of
the sound vehicle, and where it misses that by much it says little of which fault it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.calibration.tracked_paper import simulate_runs
from suspension_twin.diagnosis.tracked_own import (
    OWN_HIGH,
    OWN_LOW,
    OWN_SPREAD,
    driven,
    own_places,
    own_vehicle,
)
from suspension_twin.effects.tracked_effects import TRACKED_EFFECTS, apply_tracked, camera_of
from suspension_twin.errors import InputError, WorkError
from suspension_twin.gap.marker_runs import MarkerRun
from suspension_twin.identification.gauss_newton import bounded_step
from suspension_twin.vehicle.tracked import TrackedVehicle

__all__ = [
    "NOTHING",
    "Bench",
    "Fitted",
    "Hypothesis",
    "align",
    "calibrate_to",
    "evidence",
    "expect",
    "fit",
    "hypotheses_for",
    "make_bench",
    "moved",
    "signals",
    "together",
]

_CLOCK = np.array([0.015, 0.01])  # s and share: what a camera's start and a driver's speed are off by
_FARTHEST = 2.0  # of these: beyond that it is no matter of a start any more
_SAMPLES = 30.0  # samples of one run that hold one piece of what a prior tells: they are not independent
_INDEPENDENT = 2.0  # pieces of information that one second at one speed holds: what the model misses is slow
_FLOOR = np.repeat([0.8e-3, 0.01, 0.15], 3)  # m, m/s, m/s²: less noise than that no tool has
_UNEVEN = 0.01  # share of the motion by which two runs of one driver differ
_BLOCK = 0.5  # s of consecutive samples that are held out together
_FOLDS = 5
_DOUBT = 0.5  # error of a change that the model tells, over its error about the sound vehicle there and then
_AROUND = 0.5  # s over which that error is taken
_STEPS = 8
_LARGEST_STEP = 2.0  # spreads
_WORN = (0.25, 0.45, 0.7)  # what is left of a worn track's stiffness, to begin from


@dataclass(frozen=True)
class Hypothesis:
    """Effects with parameters: ``fixed`` ones and ``keys`` "effect.parameter" with bounds, start and spread."""

    effects: tuple[str, ...]
    fixed: tuple[tuple[str, float], ...]
    keys: tuple[str, ...]
    low: Floats
    high: Floats
    start: Floats
    spread: Floats

    def given(self, x: Floats) -> dict[str, dict[str, float]]:
        """Parameters by effect."""
        out: dict[str, dict[str, float]] = {e: {} for e in self.effects}
        for key, value in (*self.fixed, *zip(self.keys, x, strict=True)):
            effect, name = key.split(".")
            out[effect][name] = float(value)
        return out


NOTHING = Hypothesis((), (), (), *(np.zeros(0) for _ in range(4)))


@dataclass(frozen=True)
class Bench:
    """Runs of the gap beside what is normal: displacement, velocity and acceleration of A, B, C in m, m/s, m/s².

    Of each run ``plain``, the model's motion, ``usual`` (n, 9) and lateness and stretch of that against the model
    (``clocks``); ``sigma`` (9,) noise, ``scale`` (n, 9) of each run noise and doubt together. ``free``: what is the
    vehicle's own is fitted too, as there is no reference.
    """

    vehicle: TrackedVehicle
    runs: tuple[MarkerRun, ...]
    plain: tuple[MarkerRun, ...]
    usual: tuple[Floats, ...]
    clocks: tuple[Floats, ...]
    sigma: Floats
    scale: tuple[Floats, ...]
    free: bool


@dataclass(frozen=True)
class Fitted:
    """``x`` found, ``rest`` residual (n, 9) of each run in units of its noise. On held-out blocks: ``score`` mean
    square of what is left in units of noise and doubt, ``left`` the same of noise alone, ``levels`` (blocks,) that
    block by block; ``own`` (12,) see ``tracked_own``."""

    hypothesis: Hypothesis
    x: Floats
    own: Floats
    rest: tuple[Floats, ...]
    score: float
    left: float
    levels: Floats


def signals(run: MarkerRun) -> Floats:
    """(n, 9) displacement, velocity, acceleration of A, B, C."""
    return np.concatenate([run.markers, run.velocity, run.acceleration], axis=1)


def moved(seen: Floats, t: Floats, late: float, stretch: float) -> Floats:
    """(n, 9) what would have been seen with clock and speed right."""
    at = t + late + stretch * t
    return np.stack([np.interp(at, t, c) for c in seen.T], axis=1)


def _shifts(seen: Floats, t: Floats) -> Floats:
    """(2, n, 9) change of a run per second of lateness and per unit of stretch."""
    slope = -np.gradient(seen, t, axis=0)
    return np.stack([slope, slope * t[:, None]])


def align(measured: Floats, told: Floats, t: Floats, sigma: Floats) -> Floats:
    """(2,) lateness and stretch of a run against what is expected: least squares with priors, within bounds."""
    clock = np.zeros(2)
    for _ in range(
        4
    ):  # anew each time: a slope at no shift says little of signals at 6 Hz that are 20 ms late
        there = moved(told, t, *-clock)
        a = (_shifts(there, t) / sigma).reshape(2, -1).T * _CLOCK
        r = ((measured - there) / sigma).ravel()
        step = np.linalg.solve(a.T @ a + _SAMPLES * np.eye(2), a.T @ r - _SAMPLES * clock / _CLOCK)
        clock = np.clip(clock + _CLOCK * step, -_FARTHEST * _CLOCK, _FARTHEST * _CLOCK)
    return clock


def _around(squares: Floats, run: MarkerRun) -> Floats:
    """(n, 9) their mean over what is near in time."""
    window = np.ones(max(1, round(_AROUND * run.rate)))
    members = np.convolve(np.ones(run.t.size), window, "same")
    return np.stack([np.convolve(c, window, "same") / members for c in squares.T], axis=1)


def make_bench(
    vehicle: TrackedVehicle,
    runs: Sequence[MarkerRun],
    reference: Sequence[MarkerRun],
    free: bool | None = None,
) -> Bench:
    """What is normal at the speed of each run: references at that speed, else the model.

    Raises WorkError where the vehicle diverges.
    """
    vehicle = driven(vehicle)
    plain = simulate_runs([vehicle], runs)[0]
    if plain is None:
        raise WorkError("tracked: the twin as it stands diverges on these runs")
    usual: list[Floats] = []
    clocks, scatter, doubts = [], [], []
    # a real run's links lie where they lie: what that changes the model cannot tell
    other = simulate_runs([vehicle], runs, 0.5 * vehicle.track.pitch)[0]
    for j, (run, model) in enumerate(zip(runs, plain, strict=True)):
        own, clock = signals(model), np.zeros(2)
        same = [ref for ref in reference if abs(ref.speed - run.speed) <= 0.02 * run.speed]
        if same:
            repeats = [np.stack([np.interp(run.t, r.t, c) for c in signals(r).T], axis=1) for r in same]
            mean = np.mean(repeats, axis=0)
            for _ in range(2):  # each with its own clock set by what all have in common
                right = [moved(r, run.t, *align(r, mean, run.t, _FLOOR)) for r in repeats]
                mean = np.mean(right, axis=0)
            if len(same) > 1:
                factor = (len(same) + 1) / (len(same) - 1)
                scatter.append(factor * np.mean([(r - mean) ** 2 for r in right], axis=(0, 1)))
            clock = align(mean, own, run.t, 4 * _FLOOR)
            missed = (mean - moved(own, run.t, *-clock)) ** 2
            own = mean
            around = _around(missed, run)
        else:
            around = np.zeros_like(own)
        if other is not None:
            rough = _around((signals(other[j]) - signals(model)) ** 2, run)
            around = around + rough / _DOUBT**2
        usual.append(own)
        clocks.append(clock)
        doubts.append(_DOUBT * np.sqrt(around))
    sigma = np.maximum(np.sqrt(np.mean(scatter, axis=0)), _FLOOR) if scatter else 4 * _FLOOR
    motion = np.sqrt(np.mean([u.var(axis=0) for u in usual], axis=0))
    sigma = np.hypot(sigma, _UNEVEN * motion)
    seen = np.tile(np.all([r.seen for r in runs], axis=0), 3)
    sigma = np.where(seen, sigma, 1e6)
    fitted = not reference if free is None else free
    scale = tuple(np.hypot(sigma, d) for d in doubts)
    return Bench(vehicle, tuple(runs), tuple(plain), tuple(usual), tuple(clocks), sigma, scale, fitted)


def hypotheses_for(effect: str, vehicle: TrackedVehicle) -> list[Hypothesis]:
    """Every variant of one effect: one for each station that it can be about, or for each place to begin from."""
    found = TRACKED_EFFECTS[effect]
    free = [p for p in found.parameters if not p.choices]
    starts = {"station_damper.share": 0.5, "payload.mass": 500.0}
    keys = tuple(f"{effect}.{p.name}" for p in free)
    low, high = np.array([p.low for p in free]), np.array([p.high for p in free])
    start = np.array([starts.get(k, p.neutral) for k, p in zip(keys, free, strict=True)])
    spread = np.array([p.spread for p in free])
    if effect == "track_wear":
        # contacts come and go with a track's tension: from one start a fit ends in a valley on the way
        begun = [np.where([k == "track_wear.stiffness" for k in keys], worn, start) for worn in _WORN]
        return [Hypothesis((effect,), (), keys, low, high, b, spread) for b in begun]
    if not any(p.choices for p in found.parameters):
        return [Hypothesis((effect,), (), keys, low, high, start, spread)]
    places = [i for i, s in enumerate(vehicle.stations) if effect != "station_damper" or s.damping > 0]
    return [
        Hypothesis((effect,), ((f"{effect}.station", i + 1.0),), keys, low, high, start, spread)
        for i in places
    ]


def together(a: Fitted, b: Fitted) -> Hypothesis:
    """Both explanations at once, from where each of them ended."""
    one, two = a.hypothesis, b.hypothesis
    return Hypothesis(
        (*one.effects, *two.effects),
        (*one.fixed, *two.fixed),
        (*one.keys, *two.keys),
        np.concatenate([one.low, two.low]),
        np.concatenate([one.high, two.high]),
        np.concatenate([a.x, b.x]),
        np.concatenate([one.spread, two.spread]),
    )


def _predict(bench: Bench, hypothesis: Hypothesis, points: Sequence[Floats]) -> list[list[Floats] | None]:
    """Expected (n, 9) of each run at points (k + 12 if free,); None where the vehicle cannot be or diverges."""
    return expect(bench, [(hypothesis, point) for point in points])


def expect(bench: Bench, asked: Sequence[tuple[Hypothesis, Floats]]) -> list[list[Floats] | None]:
    """As :func:`_predict`, each point with a hypothesis of its own."""
    vehicles, at, givens = [], [], []
    for i, (hypothesis, point) in enumerate(asked):
        k = len(hypothesis.keys)
        given = hypothesis.given(np.clip(point[:k], hypothesis.low, hypothesis.high))
        try:
            vehicle = own_vehicle(bench.vehicle, point[k:]) if point.size > k else bench.vehicle
            vehicle = apply_tracked(vehicle, given)
        except InputError:  # no such vehicle: more taken off than there is, say
            continue
        vehicles.append(vehicle)
        at.append(i)
        givens.append(given)
    out: list[list[Floats] | None] = [None] * len(asked)
    for i, given, told in zip(at, givens, simulate_runs(vehicles, bench.runs), strict=True):
        if told is None:
            continue
        camera, predicted = camera_of(given), []
        for run, model, plain, usual, clock in zip(
            bench.runs, told, bench.plain, bench.usual, bench.clocks, strict=True
        ):
            full = usual + moved(signals(model) - signals(plain), run.t, *-clock)
            seen = camera.see(run.t, full[:, :3], full[:, 3:6], full[:, 6:], run.speed)
            predicted.append(np.concatenate(seen, axis=1))
        out[i] = predicted
    return out


@dataclass(frozen=True)
class _Linear:
    """Residual r (m,) with the clocks set, its change a (m, d + 2 runs) per unit of prior of the parameters and the
    clocks, ``x0`` (d + 2 runs,) where they stand in these units."""

    r: Floats
    a: Floats
    x0: Floats


def _linear(bench: Bench, hypothesis: Hypothesis, x: Floats, prior: Floats, centre: Floats) -> _Linear | None:
    size = 0.2 * prior  # contacts make anything nearer rough
    high = np.concatenate([hypothesis.high, OWN_HIGH])[: x.size]
    size = np.where(x + size > high, -size, size)
    points = [x, *(x + np.eye(x.size)[i] * size[i] for i in range(x.size))]
    told = _predict(bench, hypothesis, points)
    if told[0] is None:
        return None
    count = len(bench.runs)
    rows, columns, clocks = [], [], []
    for j, (run, scale) in enumerate(zip(bench.runs, bench.scale, strict=True)):
        clock = align(signals(run), told[0][j], run.t, scale)
        here = moved(told[0][j], run.t, *-clock)
        rows.append(((signals(run) - here) / scale).ravel())
        own = np.zeros((here.size, x.size + 2 * count))
        for i in range(x.size):
            other = told[1 + i]
            if other is not None:
                change = (moved(other[j], run.t, *-clock) - here) / scale
                own[:, i] = change.ravel() * prior[i] / size[i]
        shifts = (_shifts(here, run.t) / scale).reshape(2, -1).T
        own[:, x.size + 2 * j : x.size + 2 * j + 2] = shifts * _CLOCK
        columns.append(own)
        clocks.append(clock / _CLOCK)
    return _Linear(
        np.concatenate(rows), np.concatenate(columns), np.concatenate([(x - centre) / prior, *clocks])
    )


def _solve(a: Floats, r: Floats, x0: Floats) -> Floats:
    """Step with priors."""
    return np.asarray(np.linalg.solve(a.T @ a + _SAMPLES * np.eye(a.shape[1]), a.T @ r - _SAMPLES * x0))


def _step(linear: _Linear, weight: Floats, low: Floats, high: Floats) -> Floats:
    """(d,) step of the parameters, in units of their priors of weight (d + 2 runs,), between ``low`` and ``high`` (d,)
    and no further than the linearisation is good for. A clock at its bound stays there, which takes nothing off a
    parameter: it is set anew at the next place anyway."""
    size, clocks = low.size, linear.x0[low.size :]
    free = np.abs(clocks) < _FARTHEST - 1e-9
    down = np.concatenate([np.maximum(low, -_LARGEST_STEP), free * (-_FARTHEST - clocks)])
    up = np.concatenate([np.minimum(high, _LARGEST_STEP), free * (_FARTHEST - clocks)])
    gradient = weight * linear.x0 - linear.a.T @ linear.r
    hessian = linear.a.T @ linear.a + np.diag(weight)
    return bounded_step(hessian, gradient[:, None], np.minimum(down, 0.0), np.maximum(up, 0.0))[:size, 0]


def fit(bench: Bench, hypothesis: Hypothesis) -> Fitted | None:
    """The best parameters, by Gauss-Newton with halved steps; None where it cannot be simulated."""
    k = len(hypothesis.keys)
    own = own_places(bench.vehicle)
    count = k + own.size if bench.free else k
    centre = np.concatenate([hypothesis.start, own])[:count]
    prior = np.concatenate([hypothesis.spread, OWN_SPREAD])[:count]
    low = np.concatenate([hypothesis.low, OWN_LOW])[:count]
    high = np.concatenate([hypothesis.high, OWN_HIGH])[:count]
    x = centre.copy()
    # an effect's own prior is wide: what a fault is like is not known beforehand
    weight = np.full(x.size + 2 * len(bench.runs), _SAMPLES)
    weight[:k] *= 0.01
    best: tuple[float, Floats, _Linear] | None = None
    for _ in range(_STEPS):
        linear = _linear(bench, hypothesis, x, prior, centre)
        if linear is None:
            break
        cost = float(linear.r @ linear.r + weight @ linear.x0**2)
        if best is not None and cost > best[0] * (1 + 1e-6):
            x = 0.5 * (x + best[1])
            if np.abs((x - best[1]) / prior).max(initial=0.0) < 1e-3:
                break
            continue
        gained = np.inf if best is None else 1.0 - cost / best[0]
        best = cost, x.copy(), linear
        new = np.clip(x + prior * _step(linear, weight, (low - x) / prior, (high - x) / prior), low, high)
        if not x.size or gained < 1e-3 or np.abs((new - x) / prior).max() < 2e-3:
            break
        x = new
    if best is None:
        return None
    _, x, linear = best
    units = np.concatenate([(s / bench.sigma).ravel() for s in bench.scale])
    score, left, levels = _held_out(bench, linear, x.size, units)
    rest, begin = [], 0
    for run in bench.runs:
        part = slice(begin, begin + 9 * run.t.size)
        rest.append((linear.r[part] * units[part]).reshape(-1, 9))
        begin = part.stop
    return Fitted(hypothesis, x[:k], x[k:] if bench.free else own, tuple(rest), score, left, levels)


def _held_out(bench: Bench, linear: _Linear, size: int, units: Floats) -> tuple[float, float, Floats]:
    """``score``, ``left`` and ``levels`` of a :class:`Fitted`, on blocks that the last step of the fit has not seen,
    with what the clocks are asked to be off by spread over all of them.

    ``size``: how many parameters there are before the clocks; ``units`` (m,) noise and doubt over noise.
    """
    block, number = [], 0
    for run in bench.runs:
        own = np.floor((run.t - run.t[0]) / _BLOCK).astype(int) + number
        block.append(np.repeat(own, 9))
        number = int(own.max()) + 1
    place = np.concatenate(block)
    counted = np.tile(bench.sigma < 1e5, place.size // 9)
    a, missed = linear.a[:, :size], np.empty(place.size)
    for fold in range(_FOLDS):
        out = place % _FOLDS == fold
        step = _solve(a[~out], linear.r[~out], np.zeros(size))
        missed[out] = linear.r[out] - a[out] @ step
    asked = float(linear.x0[size:] @ linear.x0[size:]) / _pieces(bench)
    squares = (missed * units)[counted] ** 2
    total = np.bincount(place[counted], squares, number)
    members = np.bincount(place[counted], minlength=number)
    score = float((missed[counted] ** 2).mean())
    return score + asked, float(squares.mean()) + asked, np.asarray(total / np.maximum(members, 1)) + asked


def _pieces(bench: Bench) -> float:
    """Pieces of information that the runs hold, at most: repeats at one speed share what the model misses."""
    longest: dict[float, float] = {}
    for run in bench.runs:
        longest[run.speed] = max(longest.get(run.speed, 0.0), float(run.t[-1] - run.t[0]))
    return _INDEPENDENT * sum(longest.values())


def evidence(bench: Bench, f: Fitted) -> float:
    """Logarithm of how likely the runs are, but for a constant: noise and doubt are at least what is taken, they may be
    more."""
    worth = f.score if f.score < 1.0 else 1.0 + np.log(f.score)
    return -0.5 * _pieces(bench) * float(worth)


def calibrate_to(vehicle: TrackedVehicle, runs: Sequence[MarkerRun]) -> TrackedVehicle:
    """The vehicle with what is its own fitted to runs, from where it is."""
    found = fit(make_bench(vehicle, runs, (), free=True), NOTHING)
    if found is None:
        raise WorkError("tracked: no neighbour of the twin can be simulated on the reference runs")
    return own_vehicle(vehicle, found.own)
