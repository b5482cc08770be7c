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
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.gap.prepare import Prepared
from suspension_twin.road.centreline import Centreline, road_over
from suspension_twin.road.road import Road
from suspension_twin.road_estimation.inverse import Inverse, RoadPrior, Seen, Unknown, period_of
from suspension_twin.road_estimation.passes import Pass, line_of, make_pass
from suspension_twin.road_estimation.transfer import best_linear_approximation
from suspension_twin.vehicle.twin import Twin

__all__ = ["Estimate", "Settings", "estimate_road"]

Complex = NDArray[np.complex128]

STEP = 0.05  # m between the heights
MARGIN = 6.0  # m of line before the first and after the last place driven
_FLAT = 1.0 / 60.0  # cycles/m: longer waves are no steeper
_LOW, _HIGH = 0.3, 32.0  # Hz between which channels are compared
_FIRST_SHARE = 0.1  # of a channel's power that is noise at first: a calibrated twin leaves about that
_BAND = 1.0  # Hz over which a noise spectrum is averaged


@dataclass(frozen=True)
class Settings:
    """``iterations`` of simulation and inverse; ``samples`` of the posterior; ``seed``; ``local`` lets the road's level
    differ from place to place."""

    iterations: int = 6
    samples: int = 8
    seed: int = 0
    local: bool = True


@dataclass(frozen=True, eq=False)
class Estimate:
    """A road from drives: ``u`` (n,) m along ``line``, ``left`` and ``right`` (n,) m, draws of their errors
    (samples, 2, n) m."""

    line: Centreline
    heights: Floats
    errors: Floats
    passes: tuple[Pass, ...]
    shifts: tuple[Floats, ...]
    prior: RoadPrior
    noise: tuple[Floats, ...]
    track: float
    history: list[dict[str, Any]] = field(default_factory=list)


def lanes_road(line: Centreline, heights: Floats, track: float, name: str = "road") -> Road:
    """A road whose wheel paths, ``track`` m apart about the line, have heights (2, n) m of left and right."""
    held = min(0.35, 0.4 * track)
    half = 0.5 * track
    v = np.array([-half - 1.0, -half - held, -half + held, half - held, half + held, half + 1.0])
    left, right = heights
    return road_over(line, np.column_stack([right, right, right, left, left, left]), v, name)


def estimate_road(
    prepared: Sequence[Prepared],
    twin: Twin,
    settings: Settings | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Estimate:
    """Estimate the road of prepared drives."""
    settings = settings or Settings()
    rng = np.random.default_rng(settings.seed)
    line = line_of([p.trajectory for p in prepared], STEP, MARGIN)
    track = 0.5 * (twin.vehicle.front_track + twin.vehicle.rear_track)
    count = line.x.size
    plain = lanes_road(line, np.zeros((2, count)), track)
    passes = tuple(make_pass(p, plain) for p in prepared)
    period = period_of(count, STEP)
    n = np.asarray(np.fft.rfftfreq(period, STEP), dtype=np.float64)
    level = [64e-6, 16e-6]
    slopes = [2.0, 2.0]
    scale = np.ones((2, period))
    noise = [_first_noise(p) for p in passes]
    heights = np.zeros((2, count))  # mean and half difference
    shifts = [np.zeros(p.knots.shape[0]) for p in passes]
    history: list[dict[str, Any]] = []
    solution: Unknown | None = None
    errors = np.zeros((0, 2, count))
    for iteration in range(settings.iterations):
        progress(f"iteration {iteration + 1} of {settings.iterations}", iteration / settings.iterations)
        prior = RoadPrior(count, period, STEP, _power_law(n, level, slopes), scale)
        speed = float(np.median([p.speed for p in passes]))
        f, gain = best_linear_approximation(twin, 100.0, level[0] + level[1], speed, iteration)
        sides = np.array([heights[0] + heights[1], heights[0] - heights[1]])
        road = lanes_road(line, sides, track)
        rise = np.gradient(sides, STEP, axis=1)
        seen, residual = [], []
        for p, r, shift in zip(passes, noise, shifts, strict=True):
            wheels = p.placed(shift, 0.0, STEP, count)
            slope = np.array([w @ rise[i % 2] for i, w in enumerate(wheels)])
            seen.append(Seen(p, _at(p, f, gain), r, wheels, slope))
            left = p.measured - p.simulated(twin, road, shift)
            residual.append(left)
        inverse = Inverse(prior, seen)
        # About the road as it is: what the linear chain gives of it is added, so that the prior holds for all of it.
        target = []
        for i, (s, left) in enumerate(zip(seen, residual, strict=True)):
            target.append(s.whiten(left + s.channels(heights, shifts[i])))
        solution = inverse.solve(target)
        heights_new = prior.heights(solution.road)
        shifts_new = [inverse.shift(i, q) for i, q in enumerate(solution.shifts)]
        draws = [inverse.error_sample(rng) for _ in range(settings.samples)]
        errors = np.array([prior.heights(d.road) for d in draws])
        remaining = [
            left + s.channels(heights, shifts[i]) - s.channels(heights_new, shifts_new[i])
            for i, (s, left) in enumerate(zip(seen, residual, strict=True))
        ]
        history.append(
            {
                "residual": [
                    np.sqrt(np.mean((left * p.weight) ** 2, axis=1)).tolist()
                    for left, p in zip(residual, passes, strict=True)
                ],
                "level": list(level),
                "waviness": list(slopes),
                "iterations": inverse.iterations,
                "change": float(np.std(heights_new - heights)),
            }
        )
        heights, shifts = heights_new, shifts_new
        white = np.array([solution.road * scale] + [d.road * scale for d in draws])
        level, slopes = _levels(prior, solution, draws)
        if settings.local and iteration >= 1:
            scale = _local(white, settings.samples, count)
        noise = [
            _noise(p, left, [s.channels(prior.heights(d.road), inverse.shift(i, d.shifts[i])) for d in draws])
            for i, (p, s, left) in enumerate(zip(passes, seen, remaining, strict=True))
        ]
    both = np.array([heights[0] + heights[1], heights[0] - heights[1]])
    error_sides = np.stack([errors[:, 0] + errors[:, 1], errors[:, 0] - errors[:, 1]], axis=1)
    return Estimate(line, both, error_sides, passes, tuple(shifts), prior, tuple(noise), track, history)


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
    from suspension_twin.road_estimation.transfer import CHANNELS

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
    power = np.abs(rfft(solution.road, axis=1)) ** 2 / prior.period
    open_ = np.mean([np.abs(rfft(d.road, axis=1)) ** 2 / prior.period for d in draws], axis=0)
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


def _local(white: Floats, samples: int, count: int) -> Floats:
    """Scale (2, period) of the white noise from place to place, from its mean and draws a posteriori, both scaled.

    A variance from the samples within about a metre and a quarter of a prior that says one: Student's t in its
    effect, with few degrees of freedom.
    """
    power = white[0] ** 2 + np.mean(white[1:] ** 2, axis=0)
    window = 0.3 / STEP
    smooth = gaussian_filter1d(power, window, axis=1, mode="wrap")
    typical = np.median(smooth[:, :count], axis=1, keepdims=True)
    mixed = 0.25 * typical + 0.75 * smooth
    mean = mixed[:, :count].mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.maximum(mixed / mean, 1e-3)), dtype=np.float64)
