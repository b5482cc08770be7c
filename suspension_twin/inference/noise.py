# SPDX-License-Identifier: Apache-2.0
"""Noise and model discrepancy as an autoregressive process; residuals are whitened in ``Whitener.residuals``.

The residual of a calibrated twin is not white. It is filtered sensor noise plus model discrepancy, whose spectrum is
like that of the motion and which repeats on every pass. A prediction-error filter a for each channel of each drive
whitens the residual r,

    e_k = (r_k + a_1 r_(k-1) + ... + a_n r_(k-n)) / sigma,

and the sum of e^2 is -2 log likelihood up to a constant: generalised least squares. The filter comes either from a
residual itself (Yule-Walker), where the remaining residual is noise, or from a design density

    S(f) = (c(f) s_motion(f))^2 + S_floor,

with the model discrepancy as a share c of the amplitude of the motion and the noise of the sensor. With reference
drives c is estimated on them, band by band; without, c is the same for all bands and its scale unknown.

Effective sample size: a low-pass of cut-off f_c leaves 2 f_c / rate independent samples per sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import WorkError
from suspension_twin.inference.objectives import Measured, Objective
from suspension_twin.inference.priors import SINGLE

__all__ = [
    "NEAR_FLOOR",
    "SEGMENT",
    "USUAL_SHARE",
    "ScaledObjective",
    "Whitener",
    "autoregression",
    "density",
    "shares",
]

#: Coefficients of a filter taken from a residual, and of one designed: their spectra agree within a decibel.
ORDER, DESIGN_ORDER = 16, 24
SEGMENT = 256  # samples of a segment of a spectrum
#: Model discrepancy as a share of the motion, without a reference.
USUAL_SHARE = SINGLE["discrepancy"]
_LEAST_SHARE, _MOST_SHARE = 0.02, 3.0
#: Residual rms over noise rms (median of the channels) up to which the residual counts as noise.
NEAR_FLOOR = 3.0
_ENOUGH = 30  # samples for each coefficient


def autoregression(parts: list[Floats], order: int) -> tuple[Floats, float]:
    """Prediction-error filter (order + 1,) and innovation standard deviation of segments of one process.

    Yule-Walker on the pooled autocovariance, which always gives a stable model.
    """
    count = sum(len(p) for p in parts)
    covariance = np.zeros(order + 1)
    for part in parts:
        for lag in range(min(order + 1, len(part))):
            covariance[lag] += float(part[: len(part) - lag] @ part[lag:])
    covariance /= max(count, 1)
    covariance[0] = covariance[0] * (1 + 1e-9) + 1e-300
    return _yule_walker(covariance)


def _yule_walker(covariance: Floats) -> tuple[Floats, float]:
    """Prediction-error filter and innovation standard deviation for an autocovariance (order + 1,)."""
    weights = linalg.solve_toeplitz(covariance[:-1], covariance[1:])
    innovation = covariance[0] - float(np.sum(weights * covariance[1:]))
    return np.concatenate([[1.0], -weights]), float(np.sqrt(max(innovation, 1e-300)))


def _predictor(power: Floats, rate: float) -> tuple[Floats, float]:
    """The same for a one-sided density (F,)."""
    covariance = np.fft.irfft(power)[: DESIGN_ORDER + 1] * rate / 2.0
    covariance[0] *= 1 + 1e-6
    return _yule_walker(covariance)


def density(values: Floats, segments: Sequence[slice], rate: float) -> Floats:
    """(F,) one-sided power density of one channel (M,) by Welch over ``segments``, smoothed over frequency."""
    from scipy import signal  # half a second of imports, which a calibration does not wait for

    total, weight = np.zeros(SEGMENT // 2 + 1), 0.0
    for s in segments:
        part = values[s]
        if part.size >= 32:
            _, power = signal.welch(
                part, fs=rate, nperseg=min(SEGMENT, part.size), nfft=SEGMENT, detrend="linear"
            )  # type: ignore[call-overload]
            total += power * part.size
            weight += part.size
    smooth = gaussian_filter1d(total / max(weight, 1.0), 2.0, mode="nearest")
    return np.maximum(smooth, 1e-18)


def shares(measured: Measured, residual: Floats, drives: Sequence[int]) -> Floats:
    """(C, F) amplitude of a residual (M, C) as a share of that of the motion, on the given drives."""
    own = [s for s, d in zip(measured.segments, measured.drives, strict=True) if d in drives]
    out = np.empty((len(measured.channels), SEGMENT // 2 + 1))
    for c in range(out.shape[0]):
        left, motion = (density(v[:, c], own, measured.rate) for v in (residual, measured.values))
        out[c] = np.clip(np.sqrt(left / motion), _LEAST_SHARE, _MOST_SHARE)
    return out


@dataclass(frozen=True, eq=False)
class Whitener:
    """Whitens residuals (M, C, L): unit variance where the noise model holds.

    ``filters`` (G, C, order + 1) and ``sigma`` (G, C) by group of drives and channel, ``group`` of each segment;
    ``scale`` (C,) a common factor on each channel's noise. ``row``, ``channel`` and ``drive`` (R,) are the sample,
    channel and drive of every whitened residual; each segment loses its first samples.
    """

    measured: Measured
    group: tuple[int, ...]
    filters: Floats
    sigma: Floats
    scale: Floats
    row: np.ndarray
    channel: np.ndarray
    drive: np.ndarray

    @classmethod
    def with_filters(
        cls, measured: Measured, group: Sequence[int], filters: Floats, sigma: Floats
    ) -> Whitener:
        """From given filters; WorkError where every segment is too short for them."""
        order = filters.shape[2] - 1
        rows, channels, of = [], [], []
        drives = measured.drives or (0,) * len(measured.segments)
        for c in range(len(measured.channels)):
            for s, d in zip(measured.segments, drives, strict=True):
                if s.stop - s.start > 2 * order:
                    rows.append(np.arange(s.start + order, s.stop))
                    channels.append(np.full(rows[-1].size, c))
                    of.append(np.full(rows[-1].size, d))
        if not rows:
            raise WorkError("the compared segments are too short to separate noise from motion")
        index = (np.concatenate(v) for v in (rows, channels, of))
        return cls(measured, tuple(group), filters, sigma, np.ones(len(measured.channels)), *index)

    @classmethod
    def of_residual(cls, measured: Measured, simulated: Floats, order: int = ORDER) -> Whitener:
        """Estimated from the residuals of ``simulated`` (M, C), by drive, or for all drives together where one is too
        short."""
        segments = measured.segments
        drives = measured.drives or (0,) * len(segments)
        length = {
            d: sum(s.stop - s.start for s, e in zip(segments, drives, strict=True) if e == d) for d in drives
        }
        own = [d for d in dict.fromkeys(drives) if length[d] >= _ENOUGH * order]
        if set(own) != set(drives):
            own = []
        group = tuple(own.index(d) if own else 0 for d in drives)
        count = max(1, len(own))
        filters = np.empty((count, len(measured.channels), order + 1))
        sigma = np.empty((count, len(measured.channels)))
        for c in range(len(measured.channels)):
            residual = simulated[:, c] - measured.values[:, c]
            for g in range(count):
                parts = [
                    residual[s] - residual[s].mean() for s, k in zip(segments, group, strict=True) if k == g
                ]
                filters[g, c], sigma[g, c] = autoregression(parts, order)
        return cls.with_filters(measured, group, filters, sigma)

    @classmethod
    def designed(cls, measured: Measured, share: Floats, floors: Sequence[Mapping[str, float]]) -> Whitener:
        """Designed for a model discrepancy of ``share`` (C, F) or (C,) of the motion and the noise rms ``floors`` of
        each drive, by channel."""
        drives, rate = sorted(set(measured.drives)), measured.rate
        filters = np.empty((len(drives), len(measured.channels), DESIGN_ORDER + 1))
        sigma = np.empty((len(drives), len(measured.channels)))
        for g, d in enumerate(drives):
            own = [s for s, e in zip(measured.segments, measured.drives, strict=True) if e == d]
            for c, name in enumerate(measured.channels):
                motion = density(measured.values[:, c], own, rate)
                # white up to Nyquist, although the low-pass removed the upper band: whitening must not amplify it
                floor = 2.0 * floors[d][name] ** 2 / rate / measured.independent
                filters[g, c], sigma[g, c] = _predictor(share[c] ** 2 * motion + floor, rate)
        return cls.with_filters(measured, [drives.index(d) for d in measured.drives], filters, sigma)

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) whitened residuals of candidates (M, C, L)."""
        measured, order = self.measured, self.filters.shape[2] - 1
        simulated = np.ascontiguousarray(simulated)
        out = np.empty((self.row.size, simulated.shape[2]))
        at = 0
        for c in range(len(measured.channels)):
            for s, g in zip(measured.segments, self.group, strict=True):
                if s.stop - s.start > 2 * order:
                    taps = self.filters[g, c, ::-1] / (self.sigma[g, c] * self.scale[c])
                    end = at + s.stop - s.start - order
                    _filtered(simulated, measured.values, c, s.start, taps, out[at:end])
                    at = end
        return out


@dataclass(frozen=True, eq=False)
class ScaledObjective:
    """Residuals of an objective in units of the remaining residual: least squares as an approximate likelihood."""

    objective: Objective
    scale: float

    @classmethod
    def at(cls, objective: Objective, compared: Floats) -> ScaledObjective:
        """With the scale of the residuals of ``compared`` signals (M, C)."""
        residual = objective.residuals(compared[:, :, None])
        variance = float(np.mean(residual**2)) / objective.measured.independent
        return cls(objective, float(np.sqrt(max(variance, 1e-300))))

    def residuals(self, simulated: Floats) -> Floats:
        """(R, L) of candidates (M, C, L)."""
        return np.asarray(self.objective.residuals(simulated) / self.scale)


@compiled
def _filtered(
    simulated: Floats, measured: Floats, c: int, start: int, taps: Floats, out: Floats
) -> None:  # pragma: no cover - compiled
    """``out`` (n - order, L): the residual in channel c from ``start`` on, filtered by ``taps`` (oldest sample
    first)."""
    n, lanes = out.shape
    order = taps.size - 1
    wide = lanes + (-lanes) % 8  # whole vectors
    x = np.zeros((order + n + 1, wide))
    for i in range(order + n):
        for lane in range(lanes):
            x[i, lane] = simulated[start + i, c, lane] - measured[start + i, c]
    t = np.zeros(taps.size + 5)
    for k in range(taps.size):  # the text of a slice's error would take two seconds to compile
        t[k] = taps[k]
    one, two = np.empty(wide), np.empty(wide)
    for i in range(0, n, 2):
        # two outputs at a time share their loads
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
