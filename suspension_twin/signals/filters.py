# SPDX-License-Identifier: Apache-2.0
"""Butterworth low-pass: causal sample by sample for live use, zero-phase over lanes for offline use.

Both run the same second-order sections in transposed direct form II. A live signal and an offline
one are never mixed silently: :class:`CausalLowPass` and :class:`LiveLowPass` delay, :func:`zero_phase` does not and
has the squared magnitude response (-6 dB instead of -3 dB at the cut-off).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError
from suspension_twin.signals.clock import LiveClock, Stamp

__all__ = [
    "CausalLowPass",
    "FilterSpec",
    "LiveLowPass",
    "filter_lanes",
    "settling_time",
    "zero_phase",
]


@dataclass(frozen=True)
class FilterSpec:
    """A Butterworth low-pass, the same live and offline.

    The default passes the body and wheel-hop modes (1 to 15 Hz) and stops a phone's noise.

    Parameters
    ----------
    order : int
        1 to 8.
    cutoff : float
        Hz, -3 dB in one direction.

    Raises
    ------
    InputError
        For an order or a cut-off that is impossible.

    Examples
    --------
    >>> round(float(FilterSpec(order=2, cutoff=20.0).delay(100.0)), 5)
    0.00973
    """

    order: int = 2
    cutoff: float = 20.0

    def __post_init__(self) -> None:
        if not 1 <= self.order <= 8 or int(self.order) != self.order:
            raise InputError("filter", "order", f"must be a whole number from 1 to 8, is {self.order}")
        if not (math.isfinite(self.cutoff) and self.cutoff > 0):
            raise InputError("filter", "cutoff", f"must be above 0 Hz, is {self.cutoff}")

    def sections(self, rate: float) -> Floats:
        """(s, 6) second-order sections at ``rate`` Hz; a cut-off at or above 0.49 of it is refused."""
        if not (math.isfinite(rate) and rate > 0):
            raise InputError("filter", "rate", f"must be above 0 Hz, is {rate}")
        if self.cutoff >= 0.49 * rate:
            raise InputError(
                "filter",
                "cutoff",
                f"{self.cutoff:g} Hz needs samples faster than {self.cutoff / 0.49:.0f} Hz, they come at "
                f"{rate:.4g} Hz: lower the cut-off",
            )
        return _designed(self.order, self.cutoff, rate).copy()

    def delay(self, rate: float) -> float:
        """Group delay in s at low frequency of one causal pass at ``rate`` Hz."""
        samples = 0.0
        for b0, b1, b2, _, a1, a2 in self.sections(rate):
            samples += (b1 + 2 * b2) / (b0 + b1 + b2) - (a1 + 2 * a2) / (1 + a1 + a2)
        return samples / rate


@lru_cache(maxsize=64)
def _designed(order: int, cutoff: float, rate: float) -> Floats:
    """Butterworth's analogue poles through the bilinear transform with the cut-off pre-warped, a section a
    pair, the least damped last (Oppenheim and Schafer, Discrete-Time Signal Processing, section 7.1).

    ``scipy.signal.butter`` gives the same numbers, but importing that package takes half a second, a
    tenth of a short calibration: nothing on the way from a drive to a calibrated twin imports it.
    """
    warped = math.tan(math.pi * cutoff / rate)
    sections = []
    if order % 2:
        sections.append([warped, warped, 0.0, 1.0 + warped, warped - 1.0, 0.0])
    for k in range(order // 2, 0, -1):
        damping = 2.0 * math.sin(math.pi * (2 * k - 1) / (2 * order))
        square = warped * warped
        poles = [1.0 + damping * warped + square, 2.0 * (square - 1.0), 1.0 - damping * warped + square]
        sections.append([square, 2 * square, square, *poles])
    sos: Floats = np.array(sections)
    return np.ascontiguousarray(sos / sos[:, 3:4])


@lru_cache(maxsize=64)
def settling_time(spec: FilterSpec, rate: float, rest: float = 0.01) -> float:
    """Seconds after which a causal pass has forgotten a step to ``rest`` of its height."""
    poles = np.concatenate([np.roots(section[3:]) for section in spec.sections(rate)])
    slowest = float(np.max(np.abs(poles)))
    return math.log(rest) / math.log(slowest) / rate if slowest > 0 else 0.0


@compiled
def steady_state(sos: Floats) -> Floats:  # pragma: no cover - compiled
    """(s, 2) section states of a cascade that has seen the constant 1 for ever."""
    zi = np.empty((sos.shape[0], 2))
    level = 1.0
    for s in range(sos.shape[0]):
        gain = (sos[s, 0] + sos[s, 1] + sos[s, 2]) / (1.0 + sos[s, 4] + sos[s, 5])
        zi[s, 1] = sos[s, 2] * level - sos[s, 5] * gain * level
        zi[s, 0] = sos[s, 1] * level - sos[s, 4] * gain * level + zi[s, 1]
        level *= gain
    return zi


@compiled
def filter_row(sos: Floats, state: Floats, row: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    """One sample of every channel: ``row`` and ``out`` (c,), ``state`` (s, 2, c) is advanced."""
    for c in range(row.size):
        value = row[c]
        for s in range(sos.shape[0]):
            y = sos[s, 0] * value + state[s, 0, c]
            state[s, 0, c] = sos[s, 1] * value - sos[s, 4] * y + state[s, 1, c]
            state[s, 1, c] = sos[s, 2] * value - sos[s, 5] * y
            value = y
        out[c] = value


@compiled
def settle(zi: Floats, state: Floats, row: Floats) -> None:  # pragma: no cover - compiled
    """Put ``state`` where it would be had ``row`` been there for ever."""
    for s in range(zi.shape[0]):
        for c in range(row.size):
            state[s, 0, c] = zi[s, 0] * row[c]
            state[s, 1, c] = zi[s, 1] * row[c]


@compiled
def _causal(sos: Floats, state: Floats, x: Floats, out: Floats) -> int:  # pragma: no cover - compiled
    """Rows one after the other; the index of the first that is not finite, or -1."""
    for i in range(x.shape[0]):
        for c in range(x.shape[1]):
            if not np.isfinite(x[i, c]):
                return i
        filter_row(sos, state, x[i], out[i])
    return -1


class CausalLowPass:
    """A low-pass for live signals.

    The first sample counts as having been there for ever, so there is no starting transient. A step and a
    block give the same bits. A sample that is not finite is refused and leaves the state unchanged.

    Parameters
    ----------
    spec : FilterSpec
        The low-pass.
    rate : float
        Measured rate in Hz.
    channels : int
        Number of signals.

    Raises
    ------
    InputError
        For a cut-off that is too high for the rate.

    Examples
    --------
    >>> low_pass = CausalLowPass(FilterSpec(), 100.0, 1)
    >>> [round(float(low_pass.step([v])[0]), 3) for v in (1.0, 1.0, 0.0)]
    [1.0, 1.0, 0.793]
    """

    def __init__(self, spec: FilterSpec, rate: float, channels: int) -> None:
        self.spec = spec
        self.rate = float(rate)
        self.channels = int(channels)
        self._sos = spec.sections(self.rate)
        self._zi = steady_state(self._sos)
        self._state = np.zeros((self._sos.shape[0], 2, self.channels))
        self._fresh = True

    def reset(self) -> None:
        """Forget everything; the next sample starts anew."""
        self._fresh = True

    def step(self, x: ArrayLike) -> Floats:
        """(channels,) in, (channels,) out."""
        return self._run(np.array(x, dtype=np.float64, ndmin=2)).reshape(self.channels)

    def process(self, x: ArrayLike) -> Floats:
        """(n, channels) in, (n, channels) out; (n,) too for one channel."""
        block: Floats = np.ascontiguousarray(x, dtype=np.float64)
        if block.ndim == 1 and self.channels == 1:
            return self._run(block[:, None])[:, 0]
        return self._run(block)

    def _run(self, block: Floats) -> Floats:
        if block.ndim != 2 or block.shape[1] != self.channels:
            raise InputError("filter", f"takes {self.channels} channels, was given shape {block.shape}")
        out = np.empty_like(block)
        if not len(block):
            return out
        if self._fresh and np.isfinite(block[0]).all():
            settle(self._zi, self._state, block[0])
            self._fresh = False
        bad = int(_causal(self._sos, self._state, block, out))
        if bad >= 0:
            raise InputError("filter", f"sample {bad} is not a finite number")
        return out


@compiled
def _both_ways(sos: Floats, zi: Floats, x: Floats, pad: int) -> Floats:  # pragma: no cover - compiled
    """Forward and backward over (n, c) extended oddly by ``pad`` rows at both ends, which the result still
    has; lanes in the inner loop."""
    n, c = x.shape
    m = n + 2 * pad
    ext = np.empty((m, c))
    for i in range(pad):
        for k in range(c):
            ext[i, k] = 2.0 * x[0, k] - x[pad - i, k]
            ext[m - 1 - i, k] = 2.0 * x[n - 1, k] - x[n - 1 - pad + i, k]
    for i in range(n):
        for k in range(c):
            ext[pad + i, k] = x[i, k]
    state = np.empty((2, c))
    for s in range(sos.shape[0]):
        b0, b1, b2, a1, a2 = sos[s, 0], sos[s, 1], sos[s, 2], sos[s, 4], sos[s, 5]
        for direction in range(2):
            first = 0 if direction == 0 else m - 1
            step = 1 if direction == 0 else -1
            for k in range(c):
                state[0, k] = zi[s, 0] * ext[first, k]
                state[1, k] = zi[s, 1] * ext[first, k]
            i = first
            for _ in range(m):
                for k in range(c):
                    v = ext[i, k]
                    y = b0 * v + state[0, k]
                    state[0, k] = b1 * v - a1 * y + state[1, k]
                    state[1, k] = b2 * v - a2 * y
                    ext[i, k] = y
                i += step
    return ext


@compiled
def _one_way(sos: Floats, zi: Floats, x: Floats) -> Floats:  # pragma: no cover - compiled
    out = np.empty_like(x)
    state = np.empty((sos.shape[0], 2, x.shape[1]))
    settle(zi, state, x[0])
    for i in range(x.shape[0]):
        filter_row(sos, state, x[i], out[i])
    return out


def _each(sos: Floats) -> Floats:
    """(s, 2) steady states of every section for an input of 1 into that section."""
    return np.vstack([steady_state(section[None, :])[0] for section in sos])


def filter_lanes(spec: FilterSpec, rate: float, x: Floats, *, zero_phase: bool = True) -> Floats:
    """Filter (n, ...) along its first axis at ``rate`` Hz; every lane on its own.

    ``zero_phase`` runs forward and backward with odd extension at the ends, else one causal pass
    that starts settled. Linear in ``x``.
    """
    if not len(x):
        return np.asarray(x, dtype=np.float64)
    sos = spec.sections(rate)
    lanes = np.ascontiguousarray(x, dtype=np.float64).reshape(len(x), -1)
    if zero_phase:
        pad = min(math.ceil(3.0 * settling_time(spec, rate) * rate), len(x) - 1)
        out = _both_ways(sos, _each(sos), lanes, pad)[pad : pad + len(x)]
    else:
        out = _one_way(sos, steady_state(sos), lanes)
    return np.asarray(out, dtype=np.float64).reshape(np.shape(x))


def zero_phase(spec: FilterSpec, rate: float, x: Floats) -> Floats:
    """Filter forward and backward along the first axis: no delay, offline only.

    Parameters
    ----------
    spec : FilterSpec
        The low-pass.
    rate : float
        Samples a second.
    x : (n, ...) array
        Signals, evenly sampled.

    Returns
    -------
    (n, ...) array
        The filtered signals.

    Raises
    ------
    InputError
        For a cut-off at or above 0.49 of the rate.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 2.0, 0.01)
    >>> slow, quick = np.sin(2 * np.pi * t), np.sin(2 * np.pi * 45.0 * t)
    >>> bool(np.abs(zero_phase(FilterSpec(), 100.0, slow + quick) - slow)[20:-20].max() < 0.05)
    True
    """
    return filter_lanes(spec, rate, x, zero_phase=True)


class _Section:
    """One second-order section in transposed direct form II. In plain numbers: for a single sample a
    compiled call costs more than the arithmetic."""

    def __init__(self, coefficients: list[float], rest: list[float]) -> None:
        self.b0, self.b1, self.b2, _, self.a1, self.a2 = coefficients
        self.rest = rest  # its state after the constant 1 for ever
        self.s0 = self.s1 = 0.0

    def step(self, x: float) -> float:
        y = self.b0 * x + self.s0
        self.s0 = self.b1 * x - self.a1 * y + self.s1
        self.s1 = self.b2 * x - self.a2 * y
        return y


class LiveLowPass:
    """A causal low-pass of one signal over samples as they come, jittered or missing.

    An answer for every sample, from the first: until the rate is known it is estimated from the
    few intervals there are. A cut-off that the rate cannot carry is lowered, as for the measured
    signal.
    """

    def __init__(self, spec: FilterSpec) -> None:
        self.spec = spec
        self._clock = LiveClock()
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next sample counts as having been there for ever."""
        self._clock.reset()
        self._sections: list[_Section] = []
        self._designed = math.nan
        self._known = False  # whether it is designed for a measured rate, not for a first guess
        self._first = math.nan
        self._count = 0
        self._last = 0.0
        self._out = 0.0

    def push(self, t: float, value: float) -> float:
        """``value`` at ``t`` s, filtered. A stamp that does not rise gives the last answer again.

        Raises InputError for what is not finite, and leaves the state as it was.
        """
        if not math.isfinite(t + value):
            raise InputError("filter", f"sample at {t} is not a finite number")
        previous = self._clock.last
        stamp = self._clock.classify(t)
        if stamp in (Stamp.LATE, Stamp.DUPLICATE):
            return self._out
        if stamp is Stamp.JUMP_BACK:
            self.reset()
            stamp = self._clock.classify(t)
        if stamp is Stamp.FIRST:
            self._first = t
            self._out = value
        else:
            self._count += 1
            if self._follow_rate(t):
                self._settle(self._last)
            if stamp is Stamp.GAP:
                self._settle(value)
            else:
                missing = round((t - previous) * self._designed) - 1
                for m in range(missing):
                    self._filter(self._last + (m + 1) / (missing + 1) * (value - self._last))
            self._out = self._filter(value)
        self._last = value
        return self._out

    def _filter(self, value: float) -> float:
        for section in self._sections:
            value = section.step(value)
        return value

    def _settle(self, value: float) -> None:
        for section in self._sections:
            section.s0, section.s1 = (value * r for r in section.rest)

    def _follow_rate(self, t: float) -> bool:
        """Design the sections for the rate as it is known now; whether they hold no past yet."""
        rate = self._clock.rate
        if rate is None:
            # Looked at again when twice as many intervals are known, not at every sample.
            if self._count & (self._count - 1) and not math.isnan(self._designed):
                return False
            rate = self._count / (t - self._first)
        if self._known == (self._clock.rate is not None) and abs(rate / self._designed - 1.0) <= 0.03:
            return False
        self._known = self._clock.rate is not None
        spec = self.spec
        if spec.cutoff >= 0.49 * rate:
            spec = FilterSpec(spec.order, 0.4 * rate)
        sos = spec.sections(rate)
        self._sections = [
            _Section(c, r) for c, r in zip(sos.tolist(), steady_state(sos).tolist(), strict=True)
        ]
        self._designed = rate
        return True
