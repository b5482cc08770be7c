# SPDX-License-Identifier: Apache-2.0
"""How well one explanation of a tracked vehicle's gap fits: the numerics of ``diagnosis.tracked``.

Prediction of a run = model with the effect - model without + what is normal for this vehicle. Normal is the mean
of the reference runs at that speed, so that whatever the model gets wrong of a sound vehicle cancels; without
a reference it is the model itself. Each run's clock and true speed are nuisances with priors of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspension_twin.calibration.tracked_paper import simulate_runs, unit_values, values_at
from suspension_twin.calibration.tracked_runs import MarkerRun
from suspension_twin.drive.types import Floats
from suspension_twin.effects.tracked_effects import TRACKED_EFFECTS, apply_tracked, camera_of
from suspension_twin.errors import WorkError
from suspension_twin.vehicle.tracked import TrackedVehicle

__all__ = [
    "NOTHING",
    "Bench",
    "Fitted",
    "Hypothesis",
    "calibrate_to",
    "fit",
    "hypotheses_for",
    "make_bench",
    "together",
]

_LATE, _STRETCH = 0.015, 0.01  # s and share: what a camera's start and a driver's speed are off by
_FLOOR = np.repeat([0.8e-3, 0.01, 0.15], 3)  # m, m/s, m/s²: less noise than that no tool has
_UNEVEN = 0.01  # share of the motion by which two runs of one driver differ
_BLOCK = 0.5  # s of consecutive samples that are held out together
_FOLDS = 5
_SPREAD = 0.15  # of a track parameter's range, about the twin's value
_STEPS = 6


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
    """Runs of the gap beside what is normal. ``usual`` (n, 9) of each run and lateness and
    stretch of it against the model (``clocks``), ``sigma`` (9,) of displacement, velocity
    and acceleration of A, B, C; ``free``: the track's own parameters are fitted too, as there is no reference."""

    vehicle: TrackedVehicle
    runs: tuple[MarkerRun, ...]
    plain: tuple[MarkerRun, ...]
    usual: tuple[Floats, ...]
    clocks: tuple[tuple[float, float], ...]
    sigma: Floats
    free: bool


@dataclass(frozen=True)
class Fitted:
    """``x`` found, ``rest`` residual (n, 9) of each run in units of its noise; ``score`` mean square of what is left on
    held-out blocks, ``levels`` (blocks,) the same block by block; ``track`` (5,) places of the track's parameters."""

    hypothesis: Hypothesis
    x: Floats
    track: Floats
    rest: tuple[Floats, ...]
    score: float
    levels: Floats


def signals(run: MarkerRun) -> Floats:
    """(n, 9) displacement, velocity, acceleration of A, B, C."""
    return np.concatenate([run.markers, run.velocity, run.acceleration], axis=1)


def _moved(seen: Floats, t: Floats, late: float, stretch: float) -> Floats:
    """(n, 9) what would have been seen with clock and speed right."""
    at = t + late + stretch * t
    return np.stack([np.interp(at, t, c) for c in seen.T], axis=1)


def _shifts(seen: Floats, t: Floats) -> Floats:
    """(2, n, 9) change of a run per second of lateness and per unit of stretch."""
    slope = -np.gradient(seen, t, axis=0)
    return np.stack([slope, slope * t[:, None]])


def _align(measured: Floats, told: Floats, t: Floats, sigma: Floats) -> tuple[float, float]:
    """Lateness and stretch of a run against what is expected, two steps of least squares with priors."""
    late = stretch = 0.0
    for _ in range(3):
        at = t - late - stretch * t
        moved = np.stack([np.interp(at, t, c) for c in told.T], axis=1)
        a = (_shifts(moved, t) / sigma).reshape(2, -1).T * [_LATE, _STRETCH]
        r = ((measured - moved) / sigma).ravel()
        prior = np.array([late / _LATE, stretch / _STRETCH])
        step = np.linalg.solve(a.T @ a + 30.0 * np.eye(2), a.T @ r - 30.0 * prior)
        late, stretch = late + _LATE * step[0], stretch + _STRETCH * step[1]
    return late, stretch


def make_bench(
    vehicle: TrackedVehicle, runs: Sequence[MarkerRun], reference: Sequence[MarkerRun], free: bool | None = None
) -> Bench:
    """What is normal at the speed of each run: references at that speed, else the model.

    Raises WorkError where the vehicle diverges.
    """
    plain = simulate_runs([vehicle], runs)[0]
    if plain is None:
        raise WorkError("tracked: the twin as it stands diverges on these runs")
    usual: list[Floats] = []
    clocks, scatter = [], []
    for run, model in zip(runs, plain, strict=True):
        own, clock = signals(model), (0.0, 0.0)
        same = [ref for ref in reference if abs(ref.speed - run.speed) <= 0.02 * run.speed]
        if same:
            repeats = [np.stack([np.interp(run.t, r.t, c) for c in signals(r).T], axis=1) for r in same]
            mean = np.mean(repeats, axis=0)
            for _ in range(2):  # each with its own clock set by what all have in common
                right = [_moved(r, run.t, *_align(r, mean, run.t, _FLOOR)) for r in repeats]
                mean = np.mean(right, axis=0)
            if len(same) > 1:
                factor = (len(same) + 1) / (len(same) - 1)
                scatter.append(factor * np.mean([(r - mean) ** 2 for r in right], axis=(0, 1)))
            clock = _align(mean, own, run.t, 4 * _FLOOR)
            own = mean
        usual.append(own)
        clocks.append(clock)
    sigma = np.maximum(np.sqrt(np.mean(scatter, axis=0)), _FLOOR) if scatter else 4 * _FLOOR
    motion = np.sqrt(np.mean([u.var(axis=0) for u in usual], axis=0))
    sigma = np.hypot(sigma, _UNEVEN * motion)
    seen = np.tile(np.all([r.seen for r in runs], axis=0), 3)
    sigma = np.where(seen, sigma, 1e6)
    fitted = not reference if free is None else free
    return Bench(vehicle, tuple(runs), tuple(plain), tuple(usual), tuple(clocks), sigma, fitted)


def hypotheses_for(effect: str, vehicle: TrackedVehicle) -> list[Hypothesis]:
    """Every variant of one effect: one for each station that it can be about."""
    found = TRACKED_EFFECTS[effect]
    free = [p for p in found.parameters if not p.choices]
    starts = {"station_damper.share": 0.5, "track_wear.stiffness": 0.6, "payload.mass": 500.0}
    keys = tuple(f"{effect}.{p.name}" for p in free)
    low, high = np.array([p.low for p in free]), np.array([p.high for p in free])
    start = np.array([starts.get(k, p.neutral) for k, p in zip(keys, free, strict=True)])
    spread = np.array([p.spread for p in free])
    if not any(p.choices for p in found.parameters):
        return [Hypothesis((effect,), (), keys, low, high, start, spread)]
    places = [i for i, s in enumerate(vehicle.stations) if effect != "station_damper" or s.damping > 0]
    return [Hypothesis((effect,), ((f"{effect}.station", i + 1.0),), keys, low, high, start, spread) for i in places]


def together(a: Fitted, b: Fitted) -> Hypothesis:
    """Both explanations at once, from where each of them ended."""
    one, two = a.hypothesis, b.hypothesis
    return Hypothesis(
        (*one.effects, *two.effects), (*one.fixed, *two.fixed), (*one.keys, *two.keys),
        np.concatenate([one.low, two.low]), np.concatenate([one.high, two.high]), np.concatenate([a.x, b.x]),
        np.concatenate([one.spread, two.spread]),
    )  # fmt: skip


def _predict(bench: Bench, hypothesis: Hypothesis, points: Sequence[Floats]) -> list[list[Floats] | None]:
    """Expected (n, 9) of each run at points (k + 5 if free,); None where the vehicle cannot be or diverges."""
    k = len(hypothesis.keys)
    vehicles, at, givens = [], [], []
    for i, point in enumerate(points):
        given = hypothesis.given(np.clip(point[:k], hypothesis.low, hypothesis.high))
        vehicle = bench.vehicle
        if bench.free:
            vehicle = vehicle.with_changes(values_at(np.clip(point[k:], 0.0, 1.0)))
        vehicles.append(apply_tracked(vehicle, given))
        at.append(i)
        givens.append(given)
    out: list[list[Floats] | None] = [None] * len(points)
    for i, given, told in zip(at, givens, simulate_runs(vehicles, bench.runs), strict=True):
        if told is None:
            continue
        camera, predicted = camera_of(given), []
        for run, model, plain, usual, clock in zip(
            bench.runs, told, bench.plain, bench.usual, bench.clocks, strict=True
        ):
            full = usual + _moved(signals(model) - signals(plain), run.t, -clock[0], -clock[1])
            seen = camera.see(run.t, full[:, :3], full[:, 3:6], full[:, 6:], run.speed)
            predicted.append(np.concatenate(seen, axis=1))
        out[i] = predicted
    return out


@dataclass(frozen=True)
class _Linear:
    """Residual r (m,) and its change a (m, d) per unit of prior, ``x0`` (d,) where the priors' units stand."""

    r: Floats
    a: Floats
    x0: Floats


def _linear(bench: Bench, hypothesis: Hypothesis, x: Floats, prior: Floats, centre: Floats) -> _Linear | None:
    k = len(hypothesis.keys)
    size = 0.2 * prior  # contacts make anything nearer rough
    size[:k] = np.where(x[:k] + size[:k] > hypothesis.high, -size[:k], size[:k])
    size[k:] = np.where(x[k:] + size[k:] > 1.0, -size[k:], size[k:])
    points = [x, *(x + np.eye(x.size)[i] * size[i] for i in range(x.size))]
    told = _predict(bench, hypothesis, points)
    if told[0] is None:
        return None
    count = len(bench.runs)
    rows, columns = [], []
    for j, run in enumerate(bench.runs):
        here = told[0][j]
        rows.append(((signals(run) - here) / bench.sigma).ravel())
        own = np.zeros((here.size, x.size + 2 * count))
        for i in range(x.size):
            other = told[1 + i]
            if other is not None:
                own[:, i] = ((other[j] - here) / bench.sigma).ravel() * prior[i] / size[i]
        shifts = (_shifts(here, run.t) / bench.sigma).reshape(2, -1).T
        own[:, x.size + 2 * j : x.size + 2 * j + 2] = shifts * [_LATE, _STRETCH]
        columns.append(own)
    offset = np.concatenate([(x - centre) / prior, np.zeros(2 * count)])
    return _Linear(np.concatenate(rows), np.concatenate(columns), offset)


def _solve(a: Floats, r: Floats, x0: Floats, weight: float) -> Floats:
    """Step with priors: samples of a run are not independent, a prior counts ``weight`` of them."""
    return np.asarray(np.linalg.solve(a.T @ a + weight * np.eye(a.shape[1]), a.T @ r - weight * x0))


def fit(bench: Bench, hypothesis: Hypothesis, weight: float = 30.0) -> Fitted | None:
    """The best parameters, by Gauss-Newton with halved steps; None where it cannot be simulated."""
    k = len(hypothesis.keys)
    track = unit_values(bench.vehicle)
    x = np.concatenate([hypothesis.start, track]) if bench.free else hypothesis.start.copy()
    prior = np.concatenate([hypothesis.spread, np.full(5, _SPREAD)]) if bench.free else hypothesis.spread.copy()
    centre = np.concatenate([hypothesis.start, track]) if bench.free else hypothesis.start
    low = np.concatenate([hypothesis.low, np.zeros(5)]) if bench.free else hypothesis.low
    high = np.concatenate([hypothesis.high, np.ones(5)]) if bench.free else hypothesis.high
    # an effect's own prior is wide: what a fault is like is not known beforehand
    wide = np.where(np.arange(x.size) < k, 0.1, 1.0)
    best: tuple[float, Floats, _Linear, Floats] | None = None
    for _ in range(_STEPS):
        linear = _linear(bench, hypothesis, x, prior, centre)
        if linear is None:
            break
        x0 = linear.x0.copy()
        x0[: x.size] *= wide
        step = _solve(linear.a, linear.r, x0, weight)
        left = linear.r - linear.a[:, x.size :] @ _solve(linear.a[:, x.size :], linear.r, x0[x.size :], weight)
        cost = float(left @ left + weight * (x0[: x.size] @ x0[: x.size]))
        if best is not None and cost > best[0] * (1 + 1e-6):
            x = 0.5 * (x + best[1])
            if np.abs((x - best[1]) / prior).max(initial=0.0) < 1e-3:
                break
            continue
        gained = np.inf if best is None else 1.0 - cost / best[0]
        best = cost, x.copy(), linear, left
        moved = np.clip(x + prior * np.clip(step[: x.size], -2.0, 2.0), low, high)
        if not x.size or gained < 1e-3 or np.abs((moved - x) / prior).max() < 2e-3:
            break
        x = moved
    if best is None:
        return None
    _, x, linear, left = best
    score, levels = _held_out(bench, linear, weight)
    rest, begin = [], 0
    for run in bench.runs:
        rest.append(left[begin : begin + 9 * run.t.size].reshape(-1, 9))
        begin += 9 * run.t.size
    return Fitted(hypothesis, x[:k], x[k:] if bench.free else track, tuple(rest), score, levels)


def _held_out(bench: Bench, linear: _Linear, weight: float) -> tuple[float, Floats]:
    """Mean square on blocks that the last step of the fit has not seen, over all and block by block."""
    block, number = [], 0
    for run in bench.runs:
        own = np.floor((run.t - run.t[0]) / _BLOCK).astype(int) + number
        block.append(np.repeat(own, 9))
        number = int(own.max()) + 1
    place = np.concatenate(block)
    counted = np.tile(bench.sigma < 1e5, place.size // 9)
    squares = np.empty(place.size)
    for fold in range(_FOLDS):
        out = place % _FOLDS == fold
        step = _solve(linear.a[~out], linear.r[~out], np.zeros(linear.a.shape[1]), weight)
        squares[out] = (linear.r[out] - linear.a[out] @ step) ** 2
    total = np.bincount(place[counted], squares[counted], number)
    size = np.bincount(place[counted], minlength=number)
    return float(squares[counted].mean()), np.asarray(total / np.maximum(size, 1))


def calibrate_to(vehicle: TrackedVehicle, runs: Sequence[MarkerRun]) -> TrackedVehicle:
    """The vehicle with its track's five parameters fitted to runs, from where they are."""
    found = fit(make_bench(vehicle, runs, (), free=True), NOTHING)
    if found is None:
        raise WorkError("tracked: no neighbour of the twin can be simulated on the reference runs")
    return vehicle.with_changes(values_at(np.clip(found.track, 0.0, 1.0)))
