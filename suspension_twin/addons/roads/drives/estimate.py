# SPDX-License-Identifier: Apache-2.0
"""The road under both wheel paths from drives with a calibrated vehicle.

Each iteration simulates the twin over the present road (with its own non-linear kernel), solves the linear
inverse problem for the remaining residual of the measured channels, and estimates the level of the road and of the
noise anew from the result and its posterior (empirical Bayes, by expectation and maximisation).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft
from scipy.ndimage import gaussian_filter1d

from suspension_twin.addons.roads.drives.inverse import (
    Complex,
    Inverse,
    KnownHeights,
    LinearPass,
    RoadPrior,
    known_heights,
    period_of,
    sides_of,
)
from suspension_twin.addons.roads.drives.passes import (
    LANE_SIGMA,
    RoadPass,
    banded,
    lags_along,
    make_pass,
)
from suspension_twin.addons.roads.drives.transfer import CHANNELS, best_linear_approximation
from suspension_twin.addons.roads.drives.vehicle import (
    PARAMETERS,
    VehicleEstimate,
    VehicleStep,
    scaled_twin,
    vehicle_estimate,
    vehicle_step,
)
from suspension_twin.addons.roads.recording import MOVING, Observation, line_of
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.check import on_itself
from suspension_twin.road.recipe import Feature
from suspension_twin.road.road import Road
from suspension_twin.vehicle.twin import Twin

__all__ = ["RoadEstimate", "RoadEstimateSettings", "WheelProfiles", "estimate_road"]

STEP = 0.05  # m between the heights
MARGIN = 6.0  # m of line before the first and after the last place driven
_FLAT = 1.0 / 60.0  # cycles/m: longer waves are no steeper
_LOW, _HIGH = 0.3, 32.0  # Hz between which channels are compared
_FIRST_SHARE = 0.1  # of a channel's power that is noise at first: a calibrated twin leaves about that
_DRAWS = 3  # of the posterior in every iteration but the last
#: Waves in which heights are compared, cycles/m.
SEEN_BAND = (0.1, 2.0)
#: m by which passes may be apart along the road, and how well they lie on each other once aligned.
REACH, _ALIGNED = 12.0, 0.15
#: Standard deviation, m, of a receiver that resolves how far beside each other drives lie; m between lines across, and
#: how many there are at most.
_KNOWS_LANE, _BETWEEN, _LINES = 0.05, 0.06, 5
_BAND = 1.0  # Hz over which a noise spectrum is averaged


@dataclass(frozen=True)
class RoadEstimateSettings:
    """Settings of :func:`estimate_road`.

    Parameters
    ----------
    iterations : int
        Of simulation and inverse.
    samples : int
        Draws of the posterior at the end.
    seed : int
        Of the draws.
    vehicle : float
        Relative standard deviation of the twin's gain from wheel to sensor, which all drives have in common and which
        therefore no drive shows (a prior: spring and damper rates of a calibrated twin are right to some per cent).
    strict : bool
        Refuse drives that do not lie on the road of the others, which are otherwise left out with a warning.
    joint : bool
        Estimate the vehicle as well, from these drives.
    bumps : tuple of Feature
        Bumps of known size on the road.
    lines : bool
        Lines across where drives lie beside each other.
    """

    iterations: int = 5
    samples: int = 10
    seed: int = 0
    vehicle: float = 0.03
    strict: bool = True
    joint: bool = False
    bumps: tuple[Feature, ...] = ()
    lines: bool = True


@dataclass(frozen=True, eq=False)
class WheelProfiles:
    """Heights of both wheel paths along a line.

    Parameters
    ----------
    line : Centreline
        n points every ``STEP`` m.
    track : float
        m between the wheel paths, which lie on both sides of the line.
    heights : (2, lines, n) array
        m, of the left and the right wheel path.
    across : (lines,) array
        m by which the lines lie to the left of their wheel path: one at 0, or several where drives lie beside each
        other.
    """

    line: Centreline
    track: float
    heights: Floats
    across: Floats = field(default_factory=lambda: np.zeros(1))

    @property
    def u(self) -> Floats:
        """(n,) m along the line."""
        return np.asarray(STEP * np.arange(self.line.x.size), dtype=np.float64)

    @property
    def middle(self) -> Floats:
        """(2, n) m in the middle of the wheel paths."""
        return _at_middle(self.heights, self.across)

    def road(self, name: str = "road") -> Road:
        """The wheel paths as a road; beyond their outermost lines heights are held."""
        left, right = self.heights
        several = self.across.size > 1
        held = min(0.35, 0.4 * self.track)
        low, high = self.across[0] - held, self.across[-1] + held
        path = np.array([low, *(self.across if several else ()), high])
        half = 0.5 * self.track
        v = np.array(
            [-half - max(0.6, 0.1 - low), *(path - half), *(path + half), half + max(0.6, high + 0.1)]
        )
        inner = [[side[0], *(side if several else ()), side[-1]] for side in (right, left)]
        z = [right[0], *inner[0], *inner[1], left[-1]]
        return road_over(self.line, np.column_stack(z), v, name)


def _at_middle(heights: Floats, across: Floats) -> Floats:
    """Of heights (..., lines, n) those in the middle of the wheel path, (..., n)."""
    shares = np.array([np.interp(0.0, across, row) for row in np.eye(across.size)])
    return np.asarray(np.einsum("l,...ln->...n", shares, heights), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class RoadEstimate:
    """A road from drives.

    Parameters
    ----------
    profiles : WheelProfiles
        The heights.
    errors : (samples, 2, n) array
        m, draws of the errors of the heights in the middle of the wheel paths.
    passes : tuple of RoadPass
        The drives.
    shifts : tuple of (j,) array
        Their shifts along the road in m at their knots.
    history : tuple of dict
        Of each iteration the rms ``residual`` of every pass's channels, ``level`` and ``waviness`` of the road, rms
        ``change`` of the heights in m, and the ``vehicle``'s values where they are estimated.
    warnings : tuple of str
        One line each.
    vehicle : VehicleEstimate or None
        Where it was estimated as well.
    """

    profiles: WheelProfiles
    errors: Floats
    passes: tuple[RoadPass, ...]
    shifts: tuple[Floats, ...]
    history: tuple[dict[str, object], ...]
    warnings: tuple[str, ...]
    vehicle: VehicleEstimate | None = None

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(n,) where both wheel paths were driven over on the move, by at least one pass."""
        return _covered(self.passes, self.profiles.line.x.size)

    def sigma(self) -> Floats:
        """(2, n) m standard deviation of the heights in the waves between 0.5 and 10 m, from draws within a metre."""
        band = banded(self.errors, STEP, *SEEN_BAND)
        power = gaussian_filter1d((band**2).mean(axis=0), 0.5 / STEP, axis=1)
        return np.asarray(np.sqrt(power), dtype=np.float64)

    def by_wavelength(self) -> list[dict[str, float]]:
        """For octaves of wavelength: rms of the heights and of their errors in m, mean of both wheel paths, and
        ``known``, the share of the road's power there that is no error."""
        k = self.covered
        out = []
        for longest in (40.0, 20.0, 10.0, 5.0, 2.5, 1.25, 0.625, 0.3125):
            pair = (
                banded(z, STEP, 1.0 / longest, 2.0 / longest)[..., k]
                for z in (self.profiles.middle, self.errors)
            )
            rms, error = (float(np.sqrt(np.mean(values**2))) for values in pair)
            total = rms**2 + error**2
            known = max(0.0, 1.0 - error**2 / total) if total > 0.0 else 0.0
            row = {"longest": longest, "shortest": 0.5 * longest, "rms": rms, "sigma": error, "known": known}
            out.append(row)
        return out


def _covered(passes: Sequence[RoadPass], count: int) -> NDArray[np.bool_]:
    """(count,) where wheels of a pass on the move were."""
    seen = np.zeros(count, dtype=np.bool_)
    for p in passes:
        for row in (p.u + p.base)[:, p.on_the_move]:
            at = np.rint(row / STEP).astype(np.int64)
            at = at[(at >= 0) & (at < seen.size)]
            if at.size:
                seen[at.min() : at.max() + 1] = True
    return seen


@dataclass(frozen=True, eq=False)
class _Problem:
    """Passes with a vehicle over a line of ``count`` points with wheel paths ``track`` m apart, on lines ``across``."""

    passes: tuple[RoadPass, ...]
    twin: Twin
    line: Centreline
    track: float
    across: Floats
    speed: float

    @property
    def count(self) -> int:
        return int(self.line.x.size)

    def road(self, heights: Floats) -> Road:
        """The road of heights (2, lines, count) m of mean and half difference."""
        return WheelProfiles(self.line, self.track, sides_of(heights), self.across).road()

    def first_state(self) -> _State:
        """A level road, and the noise of a calibrated twin."""
        return _State(
            np.zeros((2, self.across.size, self.count)),
            tuple(np.zeros(p.knots.shape[0]) for p in self.passes),
            tuple(_limited(p, _floor(p) + _FIRST_SHARE**2 * 4 * _psd(p, p.measured)) for p in self.passes),
            [64e-6, 16e-6],
            [2.0, 2.0],
            np.ones((2, period_of(self.count, STEP))),
        )


@dataclass(frozen=True, eq=False)
class _State:
    """The present estimate: ``heights`` (2, lines, n) m, mean and half difference; ``shifts`` and ``noise`` of each
    pass; ``level`` and ``waviness`` of mean and half difference; ``scale`` (2, period) from place to place."""

    heights: Floats
    shifts: tuple[Floats, ...]
    noise: tuple[Floats, ...]
    level: list[float]
    waviness: list[float]
    scale: Floats


@dataclass(frozen=True, eq=False)
class _Solved:
    """One iteration's inverse, its whitened ``target``, the ``solution`` and the ``residual`` of every pass before."""

    inverse: Inverse
    target: list[Floats]
    solution: Floats
    residual: list[Floats]


def estimate_road(
    prepared: Sequence[Observation],
    twin: Twin,
    settings: RoadEstimateSettings | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> RoadEstimate:
    """Estimate the road under both wheel paths from drives with a calibrated twin.

    Parameters
    ----------
    prepared : sequence of Observation
        The drives, prepared on any level road; the one that goes farthest gives the road's line.
    twin : Twin
        The calibrated twin.
    settings : RoadEstimateSettings, optional
        Iterations, draws and the seed.
    progress : callable, optional
        Called with a text and the share of the work that is done.

    Returns
    -------
    RoadEstimate
        Heights, draws of their errors, shifts of the drives along the road.

    Raises
    ------
    InputError
        A drive that does not lie on the road of the others, or hardly moves.
    """
    settings = settings or RoadEstimateSettings()
    rng = np.random.default_rng(settings.seed)
    warnings: list[str] = []
    problem = _problem(prepared, twin, None if settings.strict else warnings)
    if len(problem.passes) > 1 and max(p.shift_sigma for p in problem.passes) >= LANE_SIGMA:
        progress("aligning the drives", 0.02)
        problem = replace(problem, passes=_aligned(problem))
    if len(problem.passes) == 1:
        warnings.append(
            "one drive: nothing checks its uncertainty, and errors of the vehicle are in the road"
        )
    if settings.lines:
        problem = replace(problem, across=lines_across(problem.passes))
    across, state = problem.across, problem.first_state()
    history: list[dict[str, object]] = []
    total = settings.iterations + 2.0
    values: Floats = np.zeros(len(PARAMETERS))
    step: VehicleStep | None = None
    known: tuple[KnownHeights, ...] = ()
    start = STEP * float(np.argmax(_covered(problem.passes, problem.count)))
    for iteration in range(settings.iterations):
        text = f"iteration {iteration + 1} of {settings.iterations}"
        progress(text, (iteration + 1) / total)
        if settings.bumps and iteration:
            middle = sides_of(_at_middle(state.heights, across))
            known = tuple(known_heights(f, middle, STEP, start, across.size) for f in settings.bumps)
        solved = _iterate(problem, state, iteration, known)
        if settings.joint and iteration >= 2:
            progress(f"{text}, vehicle", (iteration + 1.5) / total)
            step = _vehicle(replace(problem, twin=twin), values, solved, state)
        last = iteration == settings.iterations - 1
        draws = [solved.inverse.error_sample(rng) for _ in range(settings.samples if last else _DRAWS)]
        state, record = _update(state, solved, draws, iteration >= 1 and not last)
        if step is not None:
            record["vehicle"] = step.values.tolist()
            if not last:
                values, problem = step.values, replace(problem, twin=scaled_twin(twin, step.values))
        history.append(record)
    progress("comparing the drives", (total - 1.0) / total)
    errors = np.array([solved.inverse.heights(d) for d in draws])
    prior = solved.inverse.prior
    if len(problem.passes) > 1:
        errors = _filtered(errors, _inflation(solved, rng), prior)
    errors = errors + _gain_errors(state.heights, settings, prior, rng)
    if step is not None:
        chol = np.linalg.cholesky(step.covariance)
        drawn = rng.standard_normal((settings.samples, len(PARAMETERS))) @ chol.T
        errors = errors + np.einsum("sk,klij->slij", drawn, step.roads)
    sides = sides_of(_at_middle(errors, across).swapaxes(0, 1)).swapaxes(0, 1)
    found = RoadEstimate(
        WheelProfiles(problem.line, problem.track, sides_of(state.heights), across),
        sides,
        problem.passes,
        state.shifts,
        tuple(history),
        tuple(warnings),
    )
    if step is None:
        return found
    step = replace(step, roads=_at_middle(step.roads, across))
    heights = _at_middle(state.heights, across)
    vehicle = vehicle_estimate(twin, step, heights, found.covered, STEP, SEEN_BAND)
    return replace(found, vehicle=vehicle)


def lines_across(passes: Sequence[RoadPass]) -> Floats:
    """Where lines are to lie beside each other: one, or as many as the drives that lie apart can fill; m to the left of
    the wheel path."""
    if len(passes) < 2 or max(p.shift_sigma for p in passes) > _KNOWS_LANE:
        return np.zeros(1)
    beside = [float(np.median(p.v.mean(axis=0)[p.on_the_move])) for p in passes]
    low, high = min(beside), max(beside)
    count = min(1 + round((high - low) / _BETWEEN), len(passes), _LINES)
    return np.linspace(low, high, count) if count > 1 else np.zeros(1)


def _vehicle(problem: _Problem, values: Floats, solved: _Solved, state: _State) -> VehicleStep:
    """A step of the vehicle's parameters about the road as it was before this iteration."""
    inverse, road = solved.inverse, problem.road(state.heights)
    left = [t - a for t, a in zip(solved.target, inverse.forward(solved.solution), strict=True)]

    def simulate(numbers: Floats) -> list[Floats]:
        other = scaled_twin(problem.twin, numbers)
        return [p.simulated(other, road, s) for p, s in zip(problem.passes, state.shifts, strict=True)]

    return vehicle_step(inverse, left, simulate, values, _repeats(inverse))


def _repeats(inverse: Inverse) -> float:
    """Samples for each independent one of the noise. A sensor's noise is new in every sample; the error of the twin's
    transfer function is one number for every half octave, channel and drive, however long that is."""
    samples, numbers, shares = 0.0, 0.0, []
    for s in inverse.linear:
        used = s.whitening > 0.0
        band = s.one.frequencies[used[0]]
        samples += 2.0 * float(used.sum()) * float(np.mean(s.one.weight))
        numbers += len(CHANNELS) * 2.0 * math.log2(band[-1] / band[0])
        floor = _floor(s.one)[used] * 0.5 * s.one.rate * s.whitening[used] ** 2
        shares.append(1.0 - float(np.mean(np.minimum(floor, 1.0))))
    return 1.0 + float(np.mean(shares)) * max(samples / numbers - 1.0, 0.0)


def _problem(prepared: Sequence[Observation], twin: Twin, left_out: list[str] | None) -> _Problem:
    """The drives as passes over one line; with ``left_out`` those that do not fit are named there and left out."""
    line = line_of([p.trajectory for p in prepared], STEP, MARGIN)
    track = 0.5 * (twin.vehicle.front_track + twin.vehicle.rear_track)
    level = WheelProfiles(line, track, np.zeros((2, 1, line.x.size))).road()
    beyond = round(MARGIN / STEP)
    if (places := on_itself(level.part(beyond, line.x.size - beyond))) is not None:
        text = _crossing(prepared, *(u - MARGIN for u in places))
        if left_out is None:
            raise InputError(text)
        left_out.append(text)
    passes, error = [], None
    for one in prepared:
        try:
            passes.append(make_pass(one, level, track))
        except InputError as caught:
            error = caught
            if left_out is None:
                raise
            left_out.append(f"left out: {caught}")
    if not passes and error is not None:
        raise error
    speed = float(np.median([p.speed for p in passes]))
    return _Problem(tuple(passes), twin, line, track, np.zeros(1), speed)


def _crossing(prepared: Sequence[Observation], first: float, second: float) -> str:
    """Sentence on the drive that gives the line and comes after ``second`` m to where it was after ``first`` m."""
    moments = []
    for one in prepared:
        path = one.trajectory
        ways = np.hypot(np.diff(path.x), np.diff(path.y)) * (path.speed[1:] > MOVING)
        moments.append((ways.sum(), one.name, path.t[1:] - path.t[0], np.cumsum(ways)))
    _, name, t, way = max(moments, key=lambda m: m[0])
    a, b = (float(np.interp(place, way, t)) for place in (first, second))
    return (
        f"{name}: comes after {b:.0f} s ({second:.0f} m) to where it was after {a:.0f} s ({first:.0f} m), and a road "
        "has one height at a place: take parts of it, DRIVE@START..END in s"
    )


def _iterate(problem: _Problem, state: _State, iteration: int, known: Sequence[KnownHeights] = ()) -> _Solved:
    """Simulate over the present road, and solve for all of it."""
    passes, twin, count = problem.passes, problem.twin, problem.count
    period = state.scale.shape[1]
    at = np.maximum(np.fft.rfftfreq(period, STEP), _FLAT) / 0.1
    spectrum = np.array([g * at**-w for g, w in zip(state.level, state.waviness, strict=True)])
    prior = RoadPrior(count, period, STEP, spectrum, state.scale, problem.across)
    f, gain = best_linear_approximation(twin, passes[0].rate, sum(state.level), problem.speed, iteration)
    road = problem.road(state.heights)
    rise = np.gradient(sides_of(state.heights), STEP, axis=2).reshape(2, -1)
    linear, residual = [], []
    for p, noise, shift in zip(passes, state.noise, state.shifts, strict=True):
        wheels = p.wheel_matrices(shift, STEP, count, problem.across)
        slope = np.array([w @ rise[i % 2] for i, w in enumerate(wheels)])
        linear.append(LinearPass(p, _gain_of(p, f, gain), noise, wheels, slope))
        residual.append(p.measured - p.simulated(twin, road, shift))
    inverse = Inverse(prior, linear, known)
    # The linear chain's channels of the present road are added, so that the prior holds for all of it.
    target = [
        s.whiten(left + s.channels(state.heights, shift))
        for s, left, shift in zip(linear, residual, state.shifts, strict=True)
    ] + [k.target for k in known]
    return _Solved(inverse, target, inverse.solve(target), residual)


def _update(
    state: _State, solved: _Solved, draws: Sequence[Floats], local: bool
) -> tuple[_State, dict[str, object]]:
    """The road, its level and the noise anew (expectation and maximisation), and the record of the iteration."""
    inverse, solution = solved.inverse, solved.solution
    heights, shifts = inverse.heights(solution), inverse.shifts(solution)
    drawn = [(inverse.heights(d), inverse.shifts(d)) for d in draws]
    noise = []
    for i, (s, left) in enumerate(zip(inverse.linear, solved.residual, strict=True)):
        change = s.channels(heights - state.heights, shifts[i] - state.shifts[i])
        open_ = np.mean([_psd(s.one, s.channels(z, moved[i])) for z, moved in drawn], axis=0)
        power = _psd(s.one, left - change) + open_
        noise.append(_limited(s.one, np.maximum(power, _floor(s.one))))
    record: dict[str, object] = {
        "residual": [
            np.sqrt(np.mean((left * s.one.weight) ** 2, axis=1)).tolist()
            for left, s in zip(solved.residual, inverse.linear, strict=True)
        ],
        "level": list(state.level),
        "waviness": list(state.waviness),
        "change": float(np.std(heights - state.heights)),
    }
    level, waviness = _levels(inverse, solution, draws)
    scale = _local_scale(inverse, [solution, *draws]) if local else state.scale
    return _State(heights, tuple(shifts), tuple(noise), level, waviness, scale), record


def _inflation(solved: _Solved, rng: np.random.Generator) -> Floats:
    """Ratio (k,) of the differences between the roads of single passes to their expected size, 1 at least.

    The road of each pass alone is solved for, with its own channels and with channels drawn from the prior and the
    noise; the power of the differences between passes is compared in octaves of wavelength. Errors that all passes
    have in common do not show.
    """
    inverse, prior = solved.inverse, solved.inverse.prior
    alone = [Inverse(prior, [s]) for s in inverse.linear]

    def apart(white: Sequence[Floats]) -> Floats:
        """Power (k,) of the differences between the roads of all pairs of passes."""
        found = [a.heights(a.solve([w])) for a, w in zip(alone, white, strict=False)]
        pairs = [found[i] - found[j] for i in range(len(found)) for j in range(i)]
        power = np.abs(rfft(pairs, prior.period, axis=3)) ** 2
        return np.asarray(power.sum(axis=(0, 1, 2)), dtype=np.float64)

    real = apart(solved.target)
    expected = np.mean([apart(inverse.imagined(rng)[1]) for _ in range(2)], axis=0)
    octave = np.log2(np.maximum(prior.n, prior.n[1]))
    near = [np.abs(octave - o) < 0.5 for o in octave]
    return np.sqrt([max(1.0, float(real[k].sum() / max(expected[k].sum(), 1e-30))) for k in near])


def _filtered(heights: Floats, gain: Floats, prior: RoadPrior) -> Floats:
    """Heights (..., count) with their spectrum times a gain (..., k)."""
    spectrum = gain * rfft(heights, prior.period, axis=-1)
    return np.asarray(irfft(spectrum, prior.period, axis=-1)[..., : prior.count], dtype=np.float64)


def _gain_errors(
    heights: Floats, settings: RoadEstimateSettings, prior: RoadPrior, rng: np.random.Generator
) -> Floats:
    """Errors (samples, 2, lines, count) of the heights from a wrong gain of the twin: one gain for each octave."""
    octave = np.floor(np.log2(np.maximum(prior.n, prior.n[1]) / prior.n[1])).astype(np.int64)
    drawn = settings.vehicle * rng.standard_normal((settings.samples, 1, 1, int(octave.max()) + 1))
    return _filtered(heights, drawn[..., octave], prior)


def _aligned(problem: _Problem) -> tuple[RoadPass, ...]:
    """Passes moved along the road until the roads that they see lie on each other; the first stays."""
    alone = []
    for p in problem.passes:
        single = replace(problem, passes=(p,))
        state = single.first_state()
        for iteration in range(2):
            solved = _iterate(single, state, iteration)
            state = replace(state, heights=solved.inverse.heights(solved.solution))
        alone.append(banded(state.heights[:, 0], STEP))
    out = [replace(problem.passes[0], shift_sigma=_ALIGNED)]
    for p, own in zip(problem.passes[1:], alone[1:], strict=True):
        at, lag, _ = lags_along(alone[0], own, STEP, REACH)
        # A place of the pass at u + lag is at u in the first, which is ``lag`` farther back than its receiver says.
        base = -np.interp(p.u[2:].mean(axis=0), at + lag, lag)
        out.append(replace(p, base=base, shift_sigma=_ALIGNED))
    return tuple(out)


def _gain_of(one: RoadPass, f: Floats, gain: Complex) -> Complex:
    """The twin's gain (k, 3, 4) at a pass's frequencies, with the filter that its channels went through."""
    columns = [np.interp(one.frequencies, f, column) * one.low_pass for column in gain.reshape(f.size, -1).T]
    return np.stack(columns, axis=1).reshape(-1, *gain.shape[1:])


def _psd(one: RoadPass, channels: Floats) -> Floats:
    """One-sided PSD (3, k) of weighted channels, averaged over neighbouring frequencies."""
    share = float(np.mean(one.weight**2))
    power = np.abs(rfft(channels * one.weight, axis=1)) ** 2 / (0.5 * one.size * one.rate * share)
    width = _BAND * one.size / one.rate
    return np.asarray(gaussian_filter1d(power, 0.5 * width, axis=1), dtype=np.float64)


def _floor(one: RoadPass) -> Floats:
    """PSD (3, k) of the sensor's noise after the filter."""
    gain = one.low_pass**2
    sigma = np.array([one.prepared.noise_rms[name] for name in CHANNELS])
    return np.asarray(sigma[:, None] ** 2 / (0.5 * one.rate) * gain / max(float(gain.mean()), 1e-6))


def _limited(one: RoadPass, noise: Floats) -> Floats:
    """A PSD (3, k) of noise, infinite beyond the band in which channels are compared."""
    f = one.frequencies
    return np.where((f >= _LOW) & (f <= min(_HIGH, 0.45 * one.rate)), noise, np.inf)


def _levels(inverse: Inverse, solution: Floats, draws: Sequence[Floats]) -> tuple[list[float], list[float]]:
    """Level and waviness of mean and half difference: a line through octaves of their power a posteriori, each
    weighted by how far the channels determine it."""
    prior, n = inverse.prior, inverse.prior.n
    # Power of the white noise: 1 a priori.
    power, *opened = (np.abs(rfft(inverse.white(u), axis=2)) ** 2 / prior.period for u in (solution, *draws))
    mean, open_ = power.mean(axis=1), np.mean(opened, axis=(0, 2))
    edges = 2.0 ** np.arange(-5.0, 2.6, 0.5)
    octaves = zip(edges[:-1], edges[1:], strict=True)
    bands = [(math.sqrt(low * high), (n >= low) & (n < high)) for low, high in octaves]
    level, slopes = [], []
    bands = [(middle, band) for middle, band in bands if band.sum() >= 2]
    x = np.array([math.log(middle / 0.1) for middle, _ in bands])
    for power_of, left, spectrum in zip(mean, open_, prior.spectrum, strict=True):
        ratio = [max(float((power_of[b] + left[b]).mean()), 1e-9) for _, b in bands]
        g = [float(np.exp(np.mean(np.log(spectrum[b])))) for _, b in bands]
        y = np.array([math.log(r * k) for r, k in zip(ratio, g, strict=True)])
        known = [max(1.0 - float(left[b].mean()), 0.0) * math.sqrt(b.sum()) for _, b in bands]
        w = np.array(known) + 1e-6
        slope, intercept = np.polyfit(x, y, 1, w=w)
        slopes.append(float(np.clip(-slope, 1.2, 3.5)))
        if slopes[-1] != -slope:
            intercept = float(np.average(y + slopes[-1] * x, weights=w**2))
        level.append(float(np.exp(intercept)))
    return level, slopes


def _local_scale(inverse: Inverse, unknowns: Sequence[Floats]) -> Floats:
    """Scale (2, period) of the white noise from place to place, from its mean and draws a posteriori.

    A variance from the samples within about a metre and a quarter of a prior that says one: Student's t in its
    effect, with few degrees of freedom.
    """
    prior = inverse.prior
    white = np.array([inverse.white(u) * prior.scale[:, None] for u in unknowns])
    power = (white[0] ** 2 + np.mean(white[1:] ** 2, axis=0)).mean(axis=1)
    smooth = gaussian_filter1d(power, 0.3 / STEP, axis=1, mode="wrap")
    typical = np.median(smooth[:, : prior.count], axis=1, keepdims=True)
    mixed = 0.25 * typical + 0.75 * smooth
    mean = mixed[:, : prior.count].mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.maximum(mixed / mean, 1e-3)), dtype=np.float64)
