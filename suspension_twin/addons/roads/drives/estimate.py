# SPDX-License-Identifier: Apache-2.0
"""The road under both wheel paths from drives with a calibrated vehicle.

Each iteration simulates the twin over the road as it is known (with its own non-linear kernel),
solves the linear inverse for what remains of the measured channels, and estimates the level of the
road and of the noise anew from the result and its posterior (empirical Bayes, by expectation and
maximisation).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft
from scipy.ndimage import gaussian_filter1d

from suspension_twin.addons.roads.drives.alignment import banded, lags_along
from suspension_twin.addons.roads.drives.inverse import (
    Inverse,
    KnownHeights,
    RoadPrior,
    Seen,
    Unknown,
    period_of,
)
from suspension_twin.addons.roads.drives.known import known_heights
from suspension_twin.addons.roads.drives.passes import FINE, LANE_SIGMA, Pass, line_of, make_pass
from suspension_twin.addons.roads.drives.transfer import CHANNELS, best_linear_approximation
from suspension_twin.addons.roads.drives.vehicle import (
    PARAMETERS,
    VehicleEstimate,
    VehicleStep,
    scaled_twin,
    vehicle_estimate,
    vehicle_step,
)
from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.inference.observation import Observation
from suspension_twin.road.build import Centreline, road_over
from suspension_twin.road.recipe import Feature
from suspension_twin.road.road import Road
from suspension_twin.vehicle.twin import Twin

__all__ = ["Estimate", "Settings", "estimate_road"]

Complex = NDArray[np.complex128]

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
#: Standard deviation, m, of a receiver that knows how far beside each other drives lie; m between lines across, and how
#: many there are at most.
_KNOWS_LANE, _BETWEEN, _LINES = 0.05, 0.06, 5
_BAND = 1.0  # Hz over which a noise spectrum is averaged


@dataclass(frozen=True)
class Settings:
    """``iterations`` of simulation and inverse; ``samples`` of the posterior at the end; ``seed`` of its draws;
    ``local`` lets the road's level differ from place to place; ``vehicle`` relative standard deviation of the twin's
    gain from wheel to sensor, which all drives have in common and which therefore no drive shows (a prior:
    spring and damper rates of a calibrated twin are right to some per cent); ``strict`` refuses drives that do not
    lie on the road of the others, which are otherwise left out with a warning; ``joint`` estimates the vehicle as
    well, from these drives; ``bumps`` of known size on the road; ``lines`` across where drives lie beside each
    other."""

    iterations: int = 5
    samples: int = 10
    seed: int = 0
    local: bool = True
    vehicle: float = 0.03
    strict: bool = True
    joint: bool = False
    bumps: tuple[Feature, ...] = ()
    lines: bool = True


@dataclass(frozen=True, eq=False)
class Estimate:
    """A road from drives.

    ``line`` has n points; ``heights`` (2, n) m of the left and the right wheel path, ``track`` m apart about it;
    ``errors`` (samples, 2, n) m, draws of their errors; ``passes`` and the ``shifts`` (j,) m found at their knots;
    ``prior`` of the road and ``noise`` (3, k) of each pass as estimated; ``inflation`` (k,) at the frequencies of
    the prior: how many times as far as expected the passes are apart; ``history`` of the iterations;
    ``warnings``; ``vehicle`` where it was estimated as well. Where drives lie beside each other, ``surface``
    (2, lines, n) m has the heights on lines ``across`` (lines,) m to the left of each wheel path; None on one line.
    """

    line: Centreline
    heights: Floats
    errors: Floats
    passes: tuple[Pass, ...]
    shifts: tuple[Floats, ...]
    prior: RoadPrior
    noise: tuple[Floats, ...]
    track: float
    inflation: Floats
    history: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]
    vehicle: VehicleEstimate | None = None
    surface: Floats | None = None
    across: Floats = field(default_factory=lambda: np.zeros(1))

    @property
    def u(self) -> Floats:
        """(n,) m along the line."""
        return np.asarray(STEP * np.arange(self.line.x.size), dtype=np.float64)

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(n,) where both wheel paths were driven over on the move, by at least one pass."""
        return _covered(self.passes, self.line.x.size)

    @property
    def road(self) -> Road:
        """The road, NaN nowhere: waves that were not seen are level."""
        heights = self.heights if self.surface is None else self.surface
        return lanes_road(self.line, heights, self.track, across=self.across)

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
            low, high = 1.0 / longest, 2.0 / longest
            z, e = (banded(values, STEP, low, high)[..., k] for values in (self.heights, self.errors))
            rms, error = (float(np.sqrt(np.mean(values**2))) for values in (z, e))
            total = rms**2 + error**2
            out.append(
                {
                    "longest": longest,
                    "shortest": 0.5 * longest,
                    "rms": rms,
                    "sigma": error,
                    "known": max(0.0, 1.0 - error**2 / total) if total > 0.0 else 0.0,
                }
            )
        return out


def _covered(passes: Sequence[Pass], count: int) -> NDArray[np.bool_]:
    """(count,) where wheels of a pass on the move were."""
    seen = np.zeros(count, dtype=np.bool_)
    for p in passes:
        on = np.repeat(p.weight > 0.5, FINE)
        for row in p.u + p.base:
            at = np.rint(row[on] / STEP).astype(np.int64)
            at = at[(at >= 0) & (at < seen.size)]
            if at.size:
                seen[at.min() : at.max() + 1] = True
    return seen


def lanes_road(
    line: Centreline, heights: Floats, track: float, name: str = "road", across: Floats | None = None
) -> Road:
    """A road whose wheel paths, ``track`` m apart about the line, have heights (2, n) m of left and right, or
    (2, lines, n) m on lines ``across`` m to the left of each; beyond these they are held."""
    left, right = heights if heights.ndim == 3 else heights[:, None]
    places = np.zeros(1) if across is None else across
    held = min(0.35, 0.4 * track)
    inner = places if places.size > 1 else np.empty(0)
    low, high = np.array([places[0] - held]), np.array([places[-1] + held])
    path = np.concatenate([low, inner, high])
    outer = max(0.6, float(high[0]) + 0.1), max(0.6, 0.1 - float(low[0]))
    v = np.concatenate(
        [[-0.5 * track - outer[1]], path - 0.5 * track, path + 0.5 * track, [0.5 * track + outer[0]]]
    )

    def rows(side: Floats) -> list[Floats]:
        return [side[0], *(side if places.size > 1 else []), side[-1]]

    z = [right[0], *rows(right), *rows(left), left[-1]]
    return road_over(line, np.column_stack(z), v, name)


@dataclass
class _State:
    """What the iterations work on."""

    heights: Floats  # (2, lines, n) m, mean and half difference
    across: Floats  # (lines,) m
    shifts: list[Floats]
    noise: list[Floats]
    level: list[float]
    waviness: list[float]
    scale: Floats


@dataclass(frozen=True, eq=False)
class _Solved:
    """One iteration's inverse, with what it was asked (whitened, for every pass) and what it gave."""

    inverse: Inverse
    target: list[Floats]
    solution: Unknown
    residual: list[Floats]


def estimate_road(
    prepared: Sequence[Observation],
    twin: Twin,
    settings: Settings | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Estimate:
    """Estimate the road under both wheel paths from drives with a calibrated twin.

    Parameters
    ----------
    prepared : sequence of Observation
        The drives, prepared on any level road; the one that goes farthest gives the road's line.
    twin : Twin
        The calibrated twin.
    settings : Settings, optional
        Iterations, draws and the seed.
    progress : callable, optional
        Called with a text and the share of the work that is done.

    Returns
    -------
    Estimate
        Heights, draws of their errors, shifts of the drives along the road.

    Raises
    ------
    InputError
        A drive that does not lie on the road of the others, or hardly moves.
    """
    settings = settings or Settings()
    rng = np.random.default_rng(settings.seed)
    line = line_of([p.trajectory for p in prepared], STEP, MARGIN)
    track = 0.5 * (twin.vehicle.front_track + twin.vehicle.rear_track)
    count = line.x.size
    plain = lanes_road(line, np.zeros((2, count)), track)
    warnings: list[str] = []
    passes = _passes(prepared, plain, track, None if settings.strict else warnings)
    speed = float(np.median([p.speed for p in passes]))
    period = period_of(count, STEP)
    if len(passes) > 1 and max(p.shift_sigma for p in passes) >= LANE_SIGMA:
        progress("aligning the drives", 0.02)
        passes = _aligned(passes, twin, line, track, period, speed)
    if len(passes) == 1:
        warnings.append(
            "one drive: nothing checks its uncertainty, and errors of the vehicle are in the road"
        )
    across = lines_across(passes) if settings.lines else np.zeros(1)
    state = _State(
        np.zeros((2, across.size, count)),
        across,
        [np.zeros(p.knots.shape[0]) for p in passes],
        [_first_noise(p) for p in passes],
        [64e-6, 16e-6],
        [2.0, 2.0],
        np.ones((2, period)),
    )
    history: list[dict[str, Any]] = []
    total = settings.iterations + 2.0
    present, values, step = twin, np.zeros(len(PARAMETERS)), None
    known: tuple[KnownHeights, ...] = ()
    start = STEP * float(np.argmax(_covered(passes, count)))
    for iteration in range(settings.iterations):
        progress(f"iteration {iteration + 1} of {settings.iterations}", (iteration + 1) / total)
        if settings.bumps and iteration:
            middle = _sides(_at_line(state.heights, across))
            known = tuple(known_heights(f, middle, STEP, start, across.size) for f in settings.bumps)
        solved = _iterate(passes, present, line, track, speed, state, iteration, known)
        if settings.joint and iteration >= 2:
            progress(
                f"iteration {iteration + 1} of {settings.iterations}, vehicle", (iteration + 1.5) / total
            )
            step = _vehicle(passes, twin, values, solved, state, line, track)
        last = iteration == settings.iterations - 1
        draws = [solved.inverse.error_sample(rng) for _ in range(settings.samples if last else _DRAWS)]
        history.append(_update(passes, state, solved, draws, settings.local and iteration >= 1 and not last))
        if step is not None:
            history[-1]["vehicle"] = step.values.tolist()
            if not last:
                values, present = step.values, scaled_twin(twin, step.values)
    progress("comparing the drives", (total - 1.0) / total)
    prior = solved.inverse.prior
    errors = np.array([prior.heights(d.road) for d in draws])
    inflation = _inflation(solved, rng) if len(passes) > 1 else np.ones(prior.n.size)
    errors = _amplified(errors, inflation, prior) + _gain_errors(state.heights, settings, prior, rng)
    if step is not None:
        chol = np.linalg.cholesky(step.covariance)
        drawn = rng.standard_normal((settings.samples, len(PARAMETERS))) @ chol.T
        errors = errors + np.einsum("sk,klij->slij", drawn, step.roads)
    errors = _at_line(errors, across)
    sides = np.stack([errors[:, 0] + errors[:, 1], errors[:, 0] - errors[:, 1]], axis=1)
    heights = _at_line(state.heights, across)
    found = Estimate(
        line,
        _sides(heights),
        sides,
        passes,
        tuple(state.shifts),
        prior,
        tuple(state.noise),
        track,
        inflation,
        tuple(history),
        tuple(warnings),
        surface=_sides(state.heights) if across.size > 1 else None,
        across=across,
    )
    if step is None:
        return found
    step = replace(step, roads=_at_line(step.roads, across))
    vehicle = vehicle_estimate(twin, step, heights, found.covered, STEP, SEEN_BAND)
    return replace(found, vehicle=vehicle)


def lines_across(passes: Sequence[Pass]) -> Floats:
    """Where lines are to lie beside each other: one, or as many as the drives that lie apart can fill; m to the left of
    the wheel path."""
    if len(passes) < 2 or max(p.shift_sigma for p in passes) > _KNOWS_LANE:
        return np.zeros(1)
    beside = [float(np.median(p.v.mean(axis=0)[np.repeat(p.weight > 0.5, FINE)])) for p in passes]
    low, high = min(beside), max(beside)
    count = min(1 + round((high - low) / _BETWEEN), len(passes), _LINES)
    return np.linspace(low, high, count) if count > 1 else np.zeros(1)


def _at_line(heights: Floats, across: Floats) -> Floats:
    """Of heights (..., lines, n) those in the middle of the wheel path, (..., n)."""
    if across.size == 1:
        return heights[..., 0, :]
    place = float(np.interp(0.0, across, np.arange(across.size)))
    i = min(int(place), across.size - 2)
    out: Floats = (1.0 - place + i) * heights[..., i, :] + (place - i) * heights[..., i + 1, :]
    return out


def _vehicle(
    passes: Sequence[Pass],
    twin: Twin,
    values: Floats,
    solved: _Solved,
    state: _State,
    line: Centreline,
    track: float,
) -> VehicleStep:
    """A step of the vehicle's parameters about the road as it was before this iteration."""
    inverse = solved.inverse
    road = lanes_road(line, _sides(state.heights), track, across=state.across)
    left = [t - a for t, a in zip(solved.target, inverse.forward(solved.solution), strict=True)]
    repeats = _repeats(passes, inverse)
    return vehicle_step(passes, inverse, left, state.shifts, twin, values, road, repeats)


def _repeats(passes: Sequence[Pass], inverse: Inverse) -> float:
    """How often the noise says the same. A sensor's noise is new in every sample; what the twin's transfer function is
    wrong by is one number for every half octave, channel and drive, however long that is."""
    samples, numbers, shares = 0.0, 0.0, []
    for p, s in zip(passes, inverse.seen, strict=True):
        f = np.fft.rfftfreq(p.t.size, 1.0 / p.rate)
        used = s.whitening > 0.0
        band = f[used[0]]
        samples += 2.0 * float(used.sum()) * float(np.mean(p.weight))
        numbers += len(CHANNELS) * 2.0 * math.log2(band[-1] / band[0])
        floor = _floor(p)[used] * 0.5 * p.rate * s.whitening[used] ** 2
        shares.append(1.0 - float(np.mean(np.minimum(floor, 1.0))))
    return 1.0 + float(np.mean(shares)) * max(samples / numbers - 1.0, 0.0)


def _passes(
    prepared: Sequence[Observation], line: Road, track: float, left_out: list[str] | None
) -> tuple[Pass, ...]:
    """The drives as passes over one line; with ``left_out`` those that do not fit are told there and left out."""
    passes, error = [], None
    for one in prepared:
        try:
            passes.append(make_pass(one, line, track))
        except InputError as caught:
            error = caught
            if left_out is None:
                raise
            left_out.append(f"left out: {caught}")
    if not passes and error is not None:
        raise error
    return tuple(passes)


def _sides(heights: Floats) -> Floats:
    """Left and right of mean and half difference."""
    return np.array([heights[0] + heights[1], heights[0] - heights[1]])


def _iterate(
    passes: Sequence[Pass],
    twin: Twin,
    line: Centreline,
    track: float,
    speed: float,
    state: _State,
    iteration: int,
    known: Sequence[KnownHeights] = (),
) -> _Solved:
    """Simulate over the road as it is known, and solve for all of it."""
    count = line.x.size
    period = state.scale.shape[1]
    n = np.asarray(np.fft.rfftfreq(period, STEP), dtype=np.float64)
    prior = RoadPrior(
        count,
        period,
        STEP,
        _power_law(n, state.level, state.waviness),
        state.scale,
        state.across,
    )
    f, gain = best_linear_approximation(twin, passes[0].rate, sum(state.level), speed, iteration)
    sides = _sides(state.heights)
    road = lanes_road(line, sides, track, across=state.across)
    rise = np.gradient(sides, STEP, axis=2).reshape(2, -1)
    seen, residual = [], []
    for p, noise, shift in zip(passes, state.noise, state.shifts, strict=True):
        wheels = p.placed(shift, STEP, count, state.across)
        slope = np.array([w @ rise[i % 2] for i, w in enumerate(wheels)])
        seen.append(Seen(p, _at(p, f, gain), noise, wheels, slope))
        residual.append(p.measured - p.simulated(twin, road, shift))
    inverse = Inverse(prior, seen, known)
    # What the linear chain gives of the road as it is is added, so that the prior holds for all of it.
    target = [
        s.whiten(left + s.channels(state.heights, state.shifts[i]))
        for i, (s, left) in enumerate(zip(seen, residual, strict=True))
    ] + [k.target for k in known]
    return _Solved(inverse, target, inverse.solve(target), residual)


def _update(
    passes: Sequence[Pass], state: _State, solved: _Solved, draws: Sequence[Unknown], local: bool
) -> dict[str, Any]:
    """The road, its level and the noise anew (expectation and maximisation); returns the record."""
    inverse, solution = solved.inverse, solved.solution
    prior = inverse.prior
    heights = prior.heights(solution.road)
    shifts = [inverse.shift(i, q) for i, q in enumerate(solution.shifts)]
    noise = []
    for i, (p, s, left) in enumerate(zip(passes, inverse.seen, solved.residual, strict=True)):
        change = s.channels(heights - state.heights, shifts[i] - state.shifts[i])
        opened = [s.channels(prior.heights(d.road), inverse.shift(i, d.shifts[i])) for d in draws]
        noise.append(_noise(p, left - change, opened))
    record = {
        "residual": [
            np.sqrt(np.mean((left * p.weight) ** 2, axis=1)).tolist()
            for left, p in zip(solved.residual, passes, strict=True)
        ],
        "level": list(state.level),
        "waviness": list(state.waviness),
        "change": float(np.std(heights - state.heights)),
    }
    state.heights, state.shifts, state.noise = heights, shifts, noise
    state.level, state.waviness = _levels(prior, solution, draws)
    if local:
        white = np.array([u.road * prior.scale[:, None] for u in (solution, *draws)])
        state.scale = _local(white, prior.count)
    return record


def _inflation(solved: _Solved, rng: np.random.Generator) -> Floats:
    """How many times as far as expected the roads of single passes are apart, (k,) at the prior's frequencies.

    Each pass alone is solved for, with its own channels and with channels imagined from the prior and the noise;
    the power of the differences between passes is compared in octaves of wavelength. What all passes have wrong
    in the same way does not show.
    """
    inverse, prior = solved.inverse, solved.inverse.prior
    alone = [Inverse(prior, [s]) for s in inverse.seen]
    found = [prior.heights(a.solve([t]).road) for a, t in zip(alone, solved.target, strict=False)]
    imagined = []
    for _ in range(2):
        white = inverse.imagined(rng)[1]
        imagined.append([prior.heights(a.solve([w]).road) for a, w in zip(alone, white, strict=False)])
    pairs = [(i, j) for i in range(len(alone)) for j in range(i)]
    n = prior.n
    real, expected = np.zeros(n.size), np.zeros(n.size)
    for i, j in pairs:
        real += _power(found[i] - found[j], prior)
        expected += np.mean([_power(x[i] - x[j], prior) for x in imagined], axis=0)
    octave = np.log2(np.maximum(n, n[1]))
    out = np.ones(n.size)
    for k in range(n.size):
        near = np.abs(octave - octave[k]) < 0.5
        out[k] = math.sqrt(max(1.0, float(real[near].sum() / max(expected[near].sum(), 1e-30))))
    return out


def _power(heights: Floats, prior: RoadPrior) -> Floats:
    return np.asarray((np.abs(rfft(heights, prior.period, axis=2)) ** 2).sum(axis=(0, 1)), dtype=np.float64)


def _amplified(errors: Floats, inflation: Floats, prior: RoadPrior) -> Floats:
    return np.asarray(
        irfft(inflation * rfft(errors, prior.period, axis=3), prior.period, axis=3)[..., : prior.count],
        dtype=np.float64,
    )


def _gain_errors(heights: Floats, settings: Settings, prior: RoadPrior, rng: np.random.Generator) -> Floats:
    """What a wrong gain of the twin makes of the heights, (samples, 2, lines, count): one gain for each octave."""
    spectrum = rfft(heights, prior.period, axis=2)
    octave = np.floor(np.log2(np.maximum(prior.n, prior.n[1]) / prior.n[1])).astype(np.int64)
    drawn = settings.vehicle * rng.standard_normal((settings.samples, 1, 1, int(octave.max()) + 1))
    return np.asarray(
        irfft(drawn[..., octave] * spectrum, prior.period, axis=3)[..., : prior.count], dtype=np.float64
    )


def _aligned(
    passes: Sequence[Pass], twin: Twin, line: Centreline, track: float, period: int, speed: float
) -> tuple[Pass, ...]:
    """Passes moved along the road until the roads that they see lie on each other; the first stays."""
    count = line.x.size
    alone = []
    for p in passes:
        state = _State(
            np.zeros((2, 1, count)), np.zeros(1), [np.zeros(p.knots.shape[0])], [_first_noise(p)], [64e-6, 16e-6],
            [2.0, 2.0], np.ones((2, period)),
        )  # fmt: skip
        for iteration in range(2):
            solved = _iterate([p], twin, line, track, speed, state, iteration)
            state.heights = solved.inverse.prior.heights(solved.solution.road)
        alone.append(banded(state.heights[:, 0], STEP))
    out = [replace(passes[0], shift_sigma=_ALIGNED)]
    for p, own in zip(passes[1:], alone[1:], strict=True):
        at, lag, _ = lags_along(alone[0], own, STEP, REACH)
        # A place that the pass has at u + lag is at u in the first: the pass lies ``lag`` farther back than it says.
        base = -np.interp(p.u[2:].mean(axis=0), at + lag, lag)
        out.append(replace(p, base=base, shift_sigma=_ALIGNED))
    return tuple(out)


def _power_law(n: Floats, level: Sequence[float], slopes: Sequence[float]) -> Floats:
    at = np.maximum(n, _FLAT) / 0.1
    return np.array([g * at**-w for g, w in zip(level, slopes, strict=True)])


def _at(one: Pass, f: Floats, gain: Complex) -> Complex:
    """The twin's gain (k, 3, 4) at a pass's frequencies, with the filter that its channels went through."""
    own = np.fft.rfftfreq(one.t.size, 1.0 / one.rate)
    out = np.empty((own.size, 3, 4), dtype=np.complex128)
    for c in range(3):
        for w in range(4):
            out[:, c, w] = np.interp(own, f, gain[:, c, w]) * one.shaped
    return out


def _psd(one: Pass, channels: Floats) -> Floats:
    """One-sided PSD (3, k) of weighted channels, averaged over neighbouring frequencies."""
    share = float(np.mean(one.weight**2))
    power = np.abs(rfft(channels * one.weight, axis=1)) ** 2 / (0.5 * one.t.size * one.rate * share)
    width = _BAND * one.t.size / one.rate
    return np.asarray(gaussian_filter1d(power, 0.5 * width, axis=1), dtype=np.float64)


def _floor(one: Pass) -> Floats:
    """PSD (3, k) of the sensor's noise after the filter."""
    gain = one.shaped**2
    sigma = np.array([one.prepared.noise_rms[name] for name in CHANNELS])
    return sigma[:, None] ** 2 / (0.5 * one.rate) * gain / max(float(gain.mean()), 1e-6)


def _limited(one: Pass, noise: Floats) -> Floats:
    f = np.fft.rfftfreq(one.t.size, 1.0 / one.rate)
    return np.where((f >= _LOW) & (f <= min(_HIGH, 0.45 * one.rate)), noise, np.inf)


def _first_noise(one: Pass) -> Floats:
    return _limited(one, _floor(one) + _FIRST_SHARE**2 * 4 * _psd(one, one.measured))


def _noise(one: Pass, remaining: Floats, draws: Sequence[Floats]) -> Floats:
    """Noise PSD from what remains of the channels and how far the road is still open."""
    power = _psd(one, remaining) + np.mean([_psd(one, d) for d in draws], axis=0)
    return _limited(one, np.maximum(power, _floor(one)))


def _levels(prior: RoadPrior, solution: Unknown, draws: Sequence[Unknown]) -> tuple[list[float], list[float]]:
    """Level and waviness of mean and half difference: a line through octaves of their power a posteriori, each
    with the weight of what the channels say of it."""
    n = prior.n
    # Power of the white noise: 1 a priori.
    power = (np.abs(rfft(solution.road, axis=2)) ** 2 / prior.period).mean(axis=1)
    open_ = np.mean([np.abs(rfft(d.road, axis=2)) ** 2 / prior.period for d in draws], axis=(0, 2))
    edges = 2.0 ** np.arange(-5.0, 2.6, 0.5)
    level, slopes = [], []
    for i in range(2):
        x, y, weight = [], [], []
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            band = (n >= low) & (n < high)
            if band.sum() < 2:
                continue
            seen = max(1.0 - float(open_[i, band].mean()), 0.0)
            ratio = float((power[i, band] + open_[i, band]).mean())
            g = float(np.exp(np.mean(np.log(prior.spectrum[i, band]))))
            x.append(math.log(math.sqrt(low * high) / 0.1))
            y.append(math.log(max(ratio, 1e-9) * g))
            weight.append(seen * math.sqrt(band.sum()))
        w = np.array(weight) + 1e-6
        slope, intercept = np.polyfit(x, y, 1, w=w)
        slopes.append(float(np.clip(-slope, 1.2, 3.5)))
        if slopes[-1] != -slope:
            intercept = float(np.average(np.array(y) + slopes[-1] * np.array(x), weights=w**2))
        level.append(float(np.exp(intercept)))
    return level, slopes


def _local(white: Floats, count: int) -> Floats:
    """Scale (2, period) of the white noise from place to place, from its mean and draws a posteriori, both scaled.

    A variance from the samples within about a metre and a quarter of a prior that says one: Student's t in its
    effect, with few degrees of freedom.
    """
    power = (white[0] ** 2 + np.mean(white[1:] ** 2, axis=0)).mean(axis=1)
    window = 0.3 / STEP
    smooth = gaussian_filter1d(power, window, axis=1, mode="wrap")
    typical = np.median(smooth[:, :count], axis=1, keepdims=True)
    mixed = 0.25 * typical + 0.75 * smooth
    mean = mixed[:, :count].mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.maximum(mixed / mean, 1e-3)), dtype=np.float64)
