# SPDX-License-Identifier: Apache-2.0
"""Starts of the search for tones: frequency, strength and phases of a harmonic effect from the residual's spectrum.

A tone of unknown frequency has a likelihood with a peak as narrow as the drive is long, which no scattered start meets.
For an angle 2 pi (f t + n s) at the time t and the travelled distance s, the whitened residual e of each channel c and
section k of the drives with the gap gives

    P(f, n) = sum_ck |sum_t v^p e exp(-2 pi i (f t + n s))|^2 / sum_t v^2p,

with v^p the growth of the tone with the speed: first of short sections over the whole range, by a fast Fourier
transform over t for each n, then about the largest peaks of longer and longer ones. Two simulations at each peak, a
quarter of a turn apart, give strength and phases by linear least squares.

An engine that idles below a speed has the frequency max(f, n v). Short sections then belong to f where their mean speed
is below f / n, and to n above: P is the sum of two spectra, of which each needs one dimension. About a peak the angle
is 2 pi (f t' + n s') with the time t' below that speed and the distance s' above it, to first order in both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import fft, next_fast_len

from suspension_twin.arrays import Floats
from suspension_twin.effects.base import Effect, Harmonic
from suspension_twin.inference.fit import LinearisedFit
from suspension_twin.inference.hypothesis import Hypothesis
from suspension_twin.inference.observation import VERTICAL
from suspension_twin.inference.problem import Problem, whitener_of
from suspension_twin.models.types import Excitation

__all__ = ["tone_peaks", "tone_starts"]

#: s of the first sections, and the factor from one stage to the next.
_SECTION, _LONGER = 12.0, 3.0
#: Grid points for each resolution, 1 / duration or 1 / distance: half a bin off loses a tenth of the power.
_FINE = 2.5
_PEAKS = 3  # that are followed
_AROUND = 4  # grid points on either side of a peak that belong to it, and in a later stage
_LEAST = 32  # samples of a section
_FLOORED = 4.0  # s of a section that has one side of a tone with a floor
_BLOCK = 0.5  # s of a sum: a tone that is a grid point off turns by less than a tenth meanwhile
_MOST = 48  # sections of all channels and drives together in the first stage
_SAMPLES = 2.3  # for each period of the highest frequency: above two (Nyquist)


@dataclass(frozen=True, eq=False)
class _Series:
    """One channel of one drive: whitened residual ``e`` (n,) at times ``clock`` s, with the weight ``g`` of the growth
    with the speed. A tone of f Hz and n 1/m turns by f ``t`` + n ``s``: time in s and distance in m."""

    clock: Floats
    t: Floats
    s: Floats
    e: Floats
    g: Floats

    @property
    def speed(self) -> Floats:
        """(n,) m/s."""
        return np.gradient(self.s, self.clock)

    def about(self, f: float, n: float) -> _Series:
        """The same for tones near one of the frequency max(f, n v): ``t`` counts below the speed f / n, ``s`` above."""
        v, step = self.speed, np.gradient(self.clock)
        above = v > f / n
        return replace(
            self, t=np.cumsum(np.where(above, 0.0, step)), s=np.cumsum(np.where(above, v * step, 0.0))
        )

    @property
    def weighted(self) -> Floats:
        """(n,) the summands of the power."""
        return np.asarray(self.e * self.g / np.sqrt(np.sum(self.g**2)))

    def demodulated(self, f: float, n: float) -> _Series:
        """Sums over every ``_BLOCK`` s of the weighted residual with a tone turned to rest: ``e`` is complex, ``g`` the
        root of the sum of squares."""
        turned = self.e * self.g * np.exp(-2j * np.pi * (f * self.t + n * self.s))
        block = ((self.clock - self.clock[0]) / _BLOCK).astype(int)
        count = np.bincount(block)
        kept = count > 0

        def mean(values: Floats) -> Floats:
            return np.asarray(np.bincount(block, values)[kept] / count[kept])

        real, imaginary = (np.bincount(block, part)[kept] for part in (turned.real, turned.imag))
        weight = np.sqrt(np.bincount(block, self.g**2)[kept])
        return _Series(mean(self.clock), mean(self.t), mean(self.s), real + 1j * imaginary, weight)

    def sections(self, seconds: float, least: int = _LEAST) -> list[_Series]:
        """Parts of equal duration, at most so many seconds each, with at least so many samples."""
        count = max(1, int(np.ceil((self.clock[-1] - self.clock[0]) / seconds)))
        edges = np.linspace(self.clock[0], self.clock[-1] + 1e-9, count + 1)
        cuts = np.searchsorted(self.clock, edges)
        return [
            _Series(self.clock[a:b], self.t[a:b], self.s[a:b], self.e[a:b], self.g[a:b])
            for a, b in zip(cuts[:-1], cuts[1:], strict=True)
            if b - a >= least
        ]


def tone_peaks(
    problem: Problem, residual: Floats, effect: Effect, corner: int = -1
) -> list[Mapping[str, float]]:
    """Parameters of the strongest tones in a whitened residual (R,), without strength and phase; none for an effect
    that is no tone. A tone that turns with a wheel turns with that at the ``corner``."""
    tone = effect.tone
    if tone is None:
        return []
    left = problem.twin.vehicle.wheel_positions[corner, 1] if tone.corner else 0.0
    series = _series(problem, residual, tone.power, left)
    found = [tone.parameters(f, n) for f, n in _peaks(series, tone, problem.measured.rate)]
    if tone.with_floor is not None:
        found += [tone.with_floor(f, n) for f, n in _floored_peaks(series, tone)]
    return found


def tone_starts(
    problem: Problem,
    base: LinearisedFit,
    hypothesis: Hypothesis,
    effect: str,
    peaks: Sequence[Mapping[str, float]],
) -> list[Floats]:
    """Unknowns of a hypothesis with one more effect than ``base``, whose residual has those ``peaks``: with the
    strength and phases that lower the sum of squares most, the best first."""
    if not peaks:
        return []
    tone, residual = hypothesis.effect(effect).tone, base.at.residual
    assert tone is not None
    rows = {key.split(".")[2]: i for i, key in enumerate(hypothesis.keys) if key.split(".")[1] == effect}
    strength, phases = rows[tone.strength], [i for name, i in rows.items() if name.startswith(tone.phase)]
    spread, p = hypothesis.searched[strength][1].prior.spread, problem.shared
    kept = hypothesis.neutral()
    kept[: base.x.size - p] = base.x[p:]
    kept[strength] = hypothesis.coordinate(strength, spread)
    points = np.repeat(kept[:, None], 2 * len(peaks), axis=1)
    for i in phases:
        points[i, ::2], points[i, 1::2] = (hypothesis.coordinate(i, turn) for turn in (0.0, 0.5 * np.pi))
    for k, parameters in enumerate(peaks):
        for name, value in parameters.items():
            points[rows[name], 2 * k : 2 * k + 2] = hypothesis.coordinate(rows[name], value)
    start = np.repeat(base.x[:p, None], points.shape[1], axis=1)
    tried, failed = problem.having(hypothesis).residuals(np.concatenate([start, points]))
    found: list[tuple[float, Floats]] = []
    for k in range(0, points.shape[1], 2):
        if failed[k : k + 2].any():
            continue
        parts = _of_drives(problem, residual, tried[:, k : k + 2] - residual[:, None])
        energy = sum(weight for weight, _, _ in parts.values())
        size = sum(weight * abs(a) ** 2 for weight, a, _ in parts.values()) / max(energy, 1e-300)
        at = points[:, k].copy()
        at[strength] = hypothesis.coordinate(strength, spread * float(np.sqrt(size)))
        for drive, i in enumerate(phases):
            if drive in parts:
                at[i] = hypothesis.coordinate(i, float(np.angle(parts[drive][1])))
        found.append((sum(gain for _, _, gain in parts.values()), np.concatenate([base.x[:p], at])))
    return [x for _, x in sorted(found, key=lambda pair: -pair[0])]


def _series(problem: Problem, residual: Floats, power: int, left: float) -> list[_Series]:
    """The channels of the drives with the gap, by the way of what is so many m ``left`` of the middle."""
    whitener = whitener_of(problem)
    t, s, v = (np.empty(len(problem.measured.values)) for _ in range(3))
    first = 0
    for part, rows in zip(problem.data.parts, problem.data.rows, strict=True):
        known, own = part.excitation, slice(first, first + rows.size)
        assert isinstance(known, Excitation)
        speed = known.motion[:, 5] - left * known.motion[:, 3]
        way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(known.t))])
        t[own] = part.t[rows] - known.t[0]
        s[own], v[own] = (np.interp(part.t[rows], known.t, values) for values in (way, speed))
        first += rows.size
    found = []
    for drive in (d for d, active in enumerate(problem.data.active) if active):
        for c in (problem.channels.index(name) for name in VERTICAL if name in problem.channels):
            own = (whitener.drive == drive) & (whitener.channel == c)
            rows = whitener.row[own]
            if rows.size < _LEAST:
                continue
            e = residual[own] / max(float(np.std(residual[own])), 1e-300)
            found.append(_Series(t[rows], t[rows], s[rows], e, np.maximum(np.abs(v[rows]), 0.1) ** power))
    return found


def _peaks(series: list[_Series], tone: Harmonic, rate: float) -> list[tuple[float, float]]:
    """(f, n) of the strongest tones: over the whole range by short sections, then by longer and longer ones."""
    if not series:
        return []
    duration = max(one.clock[-1] - one.clock[0] for one in series)
    seconds = min(_SECTION, duration)
    sections = []
    for own in (one.sections(seconds) for one in series):
        # as many of each series, spread over it
        count = min(max(1, _MOST // len(series)), len(own))
        sections += [own[i] for i in np.unique(np.linspace(0, len(own) - 1, count).round().astype(int))]
    if not sections:
        return []
    step = 1.0 / (_FINE * max(float(np.ptp(part.t)) for part in sections))
    pace = 1.0 / (_FINE * max(max(float(np.ptp(part.s)) for part in sections), 1.0))
    f, n, power = _over_range(sections, tone, rate, step, pace)
    return [
        _refined(series, tone, at, seconds, duration, (step, pace))
        for at in _maxima(power, (f, n), (step, pace))
    ]


def _maxima(
    power: Floats, grid: tuple[Floats, Floats], resolution: tuple[float, float]
) -> Iterator[tuple[float, float]]:
    """(f, n) of the largest values of ``power`` (N, F) on a ``grid`` f (F,), n (N,), the largest first; each leaves
    out its neighbours."""
    (f, n), (step, pace) = grid, resolution
    left = power.copy()
    for _ in range(_PEAKS):
        i, j = np.unravel_index(int(np.argmax(left)), left.shape)
        if not np.isfinite(left[i, j]):
            return
        yield float(f[j]), float(n[i])
        left[
            (np.abs(n - n[i]) < _AROUND * pace)[:, None] & (np.abs(f - f[j]) < _AROUND * step)[None, :]
        ] = -np.inf


def _floored_peaks(series: list[_Series], tone: Harmonic) -> list[tuple[float, float]]:
    """(f, n) of the strongest tones of the frequency max(f, n v) that are on both sides of f / n."""
    sections = [part for one in series for part in one.sections(_FLOORED)]
    if not sections:
        return []
    duration = max(one.clock[-1] - one.clock[0] for one in series)
    step = 1.0 / (_FINE * _FLOORED)
    pace = 1.0 / (_FINE * max(1.0, max(float(np.ptp(part.s)) for part in sections)))
    f = np.arange(max(tone.frequencies[0], step), tone.frequencies[1], step)
    n = np.arange(max(tone.wavenumbers[0], pace), tone.wavenumbers[1], pace)
    speed = np.array([float(part.speed.mean()) for part in sections])
    in_time = np.array([_power(f, part.t, part.weighted) for part in sections])
    in_space = np.array([_power(n, part.s, part.weighted) for part in sections])
    order = np.argsort(speed)
    below = np.concatenate([np.zeros((1, f.size)), np.cumsum(in_time[order], axis=0)])
    above = np.concatenate([np.cumsum(in_space[order][::-1], axis=0)[::-1], np.zeros((1, n.size))])
    # how many sections are slower than f / n
    slower = np.searchsorted(speed[order], f[None, :] / n[:, None])
    both = (slower > 0) & (slower < len(sections))
    power = below[slower, np.arange(f.size)] + above[slower, np.arange(n.size)[:, None]]
    power = np.where(both, power, -np.inf)
    found = []
    for at in _maxima(power, (f, n), (step, pace)):
        for _ in range(2):  # the second time with the speed that the first one found
            if not at[0] > 0.0 < at[1]:
                break
            parts = [one.about(*at) for one in series]
            at = _refined(parts, tone, at, _FLOORED, duration, (step, pace))
        if at[0] > 0.0 < at[1]:
            found.append(at)
    return found


def _power(grid: Floats, at: Floats, weighted: Floats) -> Floats:
    """(G,) power of a tone of each of so many turns per unit of ``at`` (n,)."""
    return np.asarray(np.abs(np.exp(-2j * np.pi * grid[:, None] * at[None, :]) @ weighted) ** 2)


def _over_range(
    sections: list[_Series], tone: Harmonic, rate: float, step: float, pace: float
) -> tuple[Floats, Floats, Floats]:
    """f (F,), n (N,) and the power (N, F) over the range of a tone."""
    (low_f, high_f), (low_n, high_n) = tone.frequencies, tone.wavenumbers
    n = np.arange(low_n, high_n + pace, pace) if high_n > low_n else np.array([low_n])
    if not high_f > low_f:
        only = sum(_power(n, part.s, part.weighted) for part in sections)
        return np.array([low_f]), n, np.asarray(only)[:, None]
    # of what is above the range nothing is left, nor of negative frequencies: so few samples are enough
    count = next_fast_len(int(np.ceil(_SAMPLES * high_f / step)))
    slow = count * step
    bins = np.fft.fftfreq(count, 1.0 / slow)
    kept = (bins >= low_f) & (bins <= high_f)
    power: Floats = np.zeros((n.size, int(kept.sum())))
    for part in sections:
        size = next_fast_len(int(np.ceil(rate / step)))
        grid = np.zeros(size)
        grid[np.round((part.t - part.t[0]) * rate).astype(int)] = part.weighted
        spectrum = np.fft.fft(grid)[: count // 2]
        spectrum[np.arange(spectrum.size) * rate / size > high_f] = 0.0
        analytic = np.fft.ifft(spectrum, count) * (count / size)
        at = np.arange(count) * (size / (rate * count))
        way = np.interp(at, part.t - part.t[0], part.s)
        turned = (analytic * np.exp(-2j * np.pi * n[:, None] * way[None, :])).astype(np.complex64)
        power += np.abs(fft(turned, axis=1)[:, kept]) ** 2
    return np.asarray(bins[kept], dtype=np.float64), n, power


def _refined(
    series: list[_Series],
    tone: Harmonic,
    at: tuple[float, float],
    seconds: float,
    duration: float,
    resolution: tuple[float, float],
) -> tuple[float, float]:
    """(f, n) near ``at`` by sections that grow from ``seconds`` to the whole ``duration``; ``resolution`` Hz, 1/m."""
    step, pace = resolution
    offsets = np.arange(-_AROUND, _AROUND + 1)
    free_f, free_n = (high > low for low, high in (tone.frequencies, tone.wavenumbers))
    slow = [one.demodulated(*at) for one in series]
    f, n = 0.0, 0.0
    while True:
        seconds = min(seconds * _LONGER, duration)
        step, pace = step / _LONGER, pace / _LONGER
        sections = [part for one in slow for part in one.sections(seconds, 1)]
        tried_f = f + step * offsets if free_f else np.zeros(1)
        tried_n = n + pace * offsets if free_n else np.zeros(1)
        power = np.zeros((tried_f.size, tried_n.size))
        for part in sections:
            in_time = np.exp(-2j * np.pi * tried_f[:, None] * part.t[None, :])
            in_space = np.exp(-2j * np.pi * tried_n[:, None] * part.s[None, :])
            power += np.abs((in_time * part.e) @ in_space.T) ** 2 / np.sum(part.g**2)
        i, j = np.unravel_index(int(np.argmax(power)), power.shape)
        f, n = float(tried_f[i]), float(tried_n[j])
        if seconds >= duration:
            return at[0] + f, at[1] + n


def _of_drives(
    problem: Problem, residual: Floats, changes: Floats
) -> dict[int, tuple[float, complex, float]]:
    """By drive with the gap the energy of the response to a tone of unit strength, the strength and phase that fit
    best as one complex number, and what they take off the sum of squares; ``changes`` (R, 2) at phases of 0 and a
    quarter of a turn."""
    found = {}
    for drive in (d for d, active in enumerate(problem.data.active) if active):
        own = whitener_of(problem).drive == drive
        both, left = changes[own], residual[own]
        gram = both.T @ both
        seen = both.T @ left
        weights = -np.linalg.solve(gram + 1e-9 * np.trace(gram) * np.eye(2) + 1e-300 * np.eye(2), seen)
        gain = float(-(2.0 * weights @ seen + weights @ gram @ weights))
        found[drive] = 0.5 * float(np.trace(gram)), complex(weights[0], weights[1]), gain
    return found
