# SPDX-License-Identifier: Apache-2.0
"""What separates car and twin when nothing is missing: the sensor's noise and the model's own error.

No model of seven degrees follows a car: what it leaves is a share of the motion itself, of the same
kind of spectrum, and it comes again on every pass. It is taken as a stationary process whose density
is that of the white sensor noise plus a share of the measured signal's. With drives from before the
gap the share is learnt there, band by band; without them it starts as the same for all bands and its
size stays unknown: hypotheses are then compared by what they leave, not by a noise that nobody knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, signal
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.identification.problem import Problem

__all__ = ["INDEPENDENT", "Whitener", "density", "shares"]

ORDER = 24
_SEGMENT = 256
#: Share of the samples that are independent: the low-pass at 20 Hz leaves 40 % of the band at 100 Hz.
INDEPENDENT = 0.4
#: Share of the motion that a twin misses where no reference says how much.
USUAL_SHARE = 0.15
_LEAST_SHARE, _MOST_SHARE = 0.02, 3.0


def density(values: Floats, stretches: Sequence[slice], rate: float) -> Floats:
    """(F,) one-sided power density of one channel (M,), its stretches' means taken out."""
    total, weight = np.zeros(_SEGMENT // 2 + 1), 0.0
    for s in stretches:
        part = values[s]
        if part.size >= 32:
            _, power = signal.welch(
                part, fs=rate, nperseg=min(_SEGMENT, part.size), nfft=_SEGMENT, detrend="linear"
            )  # type: ignore[call-overload]
            total += power * part.size
            weight += part.size
    smooth = gaussian_filter1d(total / max(weight, 1.0), 2.0, mode="nearest")
    return np.maximum(smooth, 1e-18)


def shares(problem: Problem, residual: Floats, parts: Sequence[int]) -> Floats:
    """(C, F) share of the motion's amplitude that is left in the given parts: residual (M, C) over measured."""
    stretches = [
        s for s, d in zip(problem.measured.stretches, problem.measured.drives, strict=True) if d in parts
    ]
    rate = problem.measured.rate
    out = np.empty((len(problem.channels), _SEGMENT // 2 + 1))
    for c in range(out.shape[0]):
        left = density(residual[:, c], stretches, rate)
        motion = density(problem.measured.values[:, c], stretches, rate)
        out[c] = np.clip(np.sqrt(left / motion), _LEAST_SHARE, _MOST_SHARE)
    return out


@dataclass(frozen=True, eq=False)
class Whitener:
    """Residuals (M, C, L) made white with unit variance where the noise model holds.

    ``filters`` (D, C, ORDER + 1) and ``sigma`` (D, C) by drive and channel; ``scale`` (C,) a common
    factor on each channel's noise. ``row``, ``channel`` and ``drive`` (R,) tell the sample, channel and drive
    of every whitened residual.
    """

    problem: Problem
    filters: Floats
    sigma: Floats
    scale: Floats
    row: np.ndarray
    channel: np.ndarray
    drive: np.ndarray

    @classmethod
    def designed(cls, problem: Problem, share: Floats, floors: Sequence[dict[str, float]]) -> Whitener:
        """From the share (C, F) of the motion that is missed and each drive's ``floors`` by channel."""
        drives = sorted(set(problem.measured.drives))
        rate = problem.measured.rate
        filters = np.empty((len(drives), len(problem.channels), ORDER + 1))
        sigma = np.empty((len(drives), len(problem.channels)))
        for d in drives:
            own = [
                s for s, e in zip(problem.measured.stretches, problem.measured.drives, strict=True) if e == d
            ]
            for c, name in enumerate(problem.channels):
                motion = density(problem.measured.values[:, c], own, rate)
                # white up to Nyquist although the low-pass took the noise's upper band: what lies there
                # says nothing and must not be raised
                floor = 2.0 * floors[d][name] ** 2 / rate / INDEPENDENT
                filters[d, c], sigma[d, c] = _predictor(share[c] ** 2 * motion + floor, rate)
        rows, channels, of = [], [], []
        for c in range(len(problem.channels)):
            for s, d in zip(problem.measured.stretches, problem.measured.drives, strict=True):
                if s.stop - s.start > 2 * ORDER:
                    of.append(np.full(s.stop - s.start - ORDER, d))
                    rows.append(np.arange(s.start + ORDER, s.stop))
                    channels.append(np.full(s.stop - s.start - ORDER, c))
        return cls(
            problem,
            filters,
            sigma,
            np.ones(len(problem.channels)),
            np.concatenate(rows),
            np.concatenate(channels),
            np.concatenate(of),
        )

    @cached_property
    def plain(self) -> Floats:
        """(R, n) what a unit of each of the problem's plain nuisances adds, whatever is simulated."""
        problem = self.problem
        still = [np.zeros((part.t.size, len(problem.channels), 1)) for part in problem.parts]
        rows = np.flatnonzero(problem.nuisances.plain)
        unit = np.zeros((len(problem.nuisances), 1 + rows.size))
        unit[rows, 1 + np.arange(rows.size)] = 1.0
        white = self.residuals(problem.compared(still, unit))
        return np.ascontiguousarray(white[:, 1:] - white[:, :1])

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) whitened residuals of candidates (M, C, L)."""
        measured = self.problem.measured
        simulated = np.ascontiguousarray(simulated)
        out = np.empty((self.row.size, simulated.shape[2]))
        at = 0
        for c in range(len(self.problem.channels)):
            for s, d in zip(measured.stretches, measured.drives, strict=True):
                if s.stop - s.start > 2 * ORDER:
                    taps = self.filters[d, c, ::-1] / (self.sigma[d, c] * self.scale[c])
                    end = at + s.stop - s.start - ORDER
                    _filtered(simulated, measured.values, c, s.start, taps, out[at:end])
                    at = end
        return out


@compiled
def _filtered(
    simulated: Floats, measured: Floats, c: int, start: int, taps: Floats, out: Floats
) -> None:  # pragma: no cover - compiled
    """``out`` (n - ORDER, L): the difference in channel c from ``start`` on by taps, the oldest sample's first."""
    n, lanes = out.shape
    order = taps.size - 1
    wide = lanes + (-lanes) % 8  # whole vectors
    x = np.zeros((order + n + 1, wide))
    for i in range(order + n):
        for lane in range(lanes):
            x[i, lane] = simulated[start + i, c, lane] - measured[start + i, c]
    t = np.zeros(taps.size + 5)
    t[: taps.size] = taps
    one, two = np.empty(wide), np.empty(wide)
    for i in range(0, n, 2):
        # two at a time: what is loaded for the one serves the other by the tap before
        one[:] = 0.0
        two[:] = 0.0
        for k in range(0, taps.size + 1, 4):
            e = t[k - 1] if k > 0 else 0.0
            t0, t1, t2, t3 = t[k], t[k + 1], t[k + 2], t[k + 3]
            last = order + n
            a, b, d, f = i + k, min(i + k + 1, last), min(i + k + 2, last), min(i + k + 3, last)
            for lane in range(wide):
                x0, x1, x2, x3 = x[a, lane], x[b, lane], x[d, lane], x[f, lane]
                one[lane] += t0 * x0 + t1 * x1 + t2 * x2 + t3 * x3
                two[lane] += e * x0 + t0 * x1 + t1 * x2 + t2 * x3
        for lane in range(lanes):
            out[i, lane] = one[lane]
        if i + 1 < n:
            for lane in range(lanes):
                out[i + 1, lane] = two[lane]


def _predictor(power: Floats, rate: float) -> tuple[Floats, float]:
    """Prediction-error filter and innovation's standard deviation of a process of this density."""
    covariance = np.fft.irfft(power) * rate / 2.0
    covariance = covariance[: ORDER + 1].copy()
    covariance[0] *= 1 + 1e-6
    weights = linalg.solve_toeplitz(covariance[:ORDER], covariance[1:])
    innovation = covariance[0] - float(np.sum(weights * covariance[1:]))
    return np.concatenate([[1.0], -weights]), float(np.sqrt(max(innovation, 1e-300)))
