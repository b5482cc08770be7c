# SPDX-License-Identifier: Apache-2.0
"""The noise rms of a channel after the filter."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from suspension_twin.arrays import Floats, runs
from suspension_twin.signals.conditioner import Conditioner
from suspension_twin.signals.filters import FilterSpec

__all__ = ["floor_rms", "spectral_floor", "white_noise_sigma"]

_STANDSTILL = 3.0  # s of standstill needed for an estimate there
_WINDOW = 1.0  # s
_QUIETEST = 0.2  # quantile of the windows that have little road excitation near Nyquist
#: Frequencies over the cut-off above which little of a response is left, and of which a slope needs an octave. A
#: density grows with f^4 at most: white noise of a displacement that was differentiated twice.
_ABOVE, _OCTAVE, _STEEPEST = 1.5, 2.0, 4.0
_STEADY = (
    1.5  # power of the frequency up to which a density counts as constant: half of what a derivative adds
)


def floor_rms(
    raw: Floats, conditioner: Conditioner, standing: NDArray[np.bool_], filtered: Floats | None = None
) -> float:
    """Rms of the noise in ``conditioner.apply(raw)``, in the unit of ``raw`` (n,).

    From standstill where there are three seconds of it: the filtered signal's spread around its
    mean. Else from the fourth differences of the signal, a high-pass at the Nyquist frequency,
    where the road excitation is weak.
    """
    still = _still_on_grid(conditioner, standing)
    if np.count_nonzero(still) >= _STANDSTILL * conditioner.rate:
        values = conditioner.apply(raw) if filtered is None else filtered
        return _spread_within(values, still)
    return white_noise_sigma(raw, conditioner.rate) * _noise_gain(conditioner)


def spectral_floor(raw: Floats, conditioner: Conditioner) -> float:
    """Rms of the noise in ``conditioner.apply(raw)``, in the unit of ``raw`` (n,), of any colour.

    The density of the quietest windows in the octave below Nyquist is carried on into the pass band along a power of
    the frequency: constant, or rising (a displacement that was differentiated). Where it falls there, the channel has a
    low-pass of its own that hides its noise: then along the part that rises from the pass band on, or as it is next to
    it. Motion counts as noise there, so that a residual may lie below the floor.
    """
    rate, spec = conditioner.rate, conditioner.spec
    size = min(raw.size, max(16, round(_WINDOW * rate)))
    window = np.hanning(size)
    parts = np.lib.stride_tricks.sliding_window_view(raw, size)[:: max(1, size // 2)]
    powers = np.abs(np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * window, axis=1)) ** 2
    # a periodogram is distributed exponentially
    density = (
        np.quantile(powers, _QUIETEST, axis=0) / -np.log1p(-_QUIETEST) * 2.0 / (rate * np.sum(window**2))
    )
    f: Floats = np.fft.rfftfreq(size, 1.0 / rate).astype(np.float64)
    above = np.flatnonzero((f >= _ABOVE * spec.cutoff) & (f <= 0.9 * 0.5 * rate))
    if above.size < 4:
        return white_noise_sigma(raw, rate) * _noise_gain(conditioner)
    level = gaussian_filter1d(np.log(np.maximum(density[above], 1e-300)), 3.0, mode="nearest")
    x, begin = np.log(f[above]), float(f[above[0]])
    highest = x >= x[-1] - np.log(_OCTAVE)
    slope = float(np.polyfit(x[highest], level[highest], 1)[0])
    if slope < -_STEADY:
        highest = np.arange(x.size) <= int(np.argmax(level))
        rises = x[highest][-1] - x[0] >= np.log(_OCTAVE)
        slope = float(np.polyfit(x[highest], level[highest], 1)[0]) if rises else 0.0
        highest = highest if rises else x <= x[0] + np.log(_OCTAVE)
    power = min(slope, _STEEPEST) if slope > _STEADY else 0.0
    at_edge = float(np.mean(level[highest] - power * (x[highest] - x[0])))
    noise = np.exp(at_edge) * (f / begin) ** power
    passed = np.abs(_gain(spec, rate, f)) ** 4
    return float(np.sqrt(np.sum(noise[1:] * passed[1:]) * (f[1] - f[0])))


def _gain(spec: FilterSpec, rate: float, f: Floats) -> Floats:
    """Magnitude (k,) of one pass of a low-pass at ``f`` (k,) Hz."""
    z = np.exp(-2j * np.pi * f / rate)
    gain = np.ones(f.size)
    for b0, b1, b2, a0, a1, a2 in spec.sections(rate):
        gain *= np.abs((b0 + b1 * z + b2 * z * z) / (a0 + a1 * z + a2 * z * z))
    return gain


def white_noise_sigma(raw: Floats, rate: float) -> float:
    """Standard deviation of the white noise in ``raw`` (n,), from its quietest seconds."""
    size = max(16, int(_WINDOW * rate))
    return float(np.sqrt(_quiet_power(raw, size) / _quiet_power_of_one(size)))


def _quiet_power(raw: Floats, size: int) -> float:
    """Power of the fourth differences in the quieter of windows of ``size``, as if they were white noise."""
    difference = np.diff(raw, n=4) ** 2 / 70.0  # 70 is the sum of the squares of 1, -4, 6, -4, 1
    windows = [difference[i : i + size].mean() for i in range(0, max(1, difference.size - size + 1), size)]
    return float(np.quantile(windows, _QUIETEST))


@lru_cache(maxsize=16)
def _quiet_power_of_one(size: int) -> float:
    """The same for white noise of unit rms: the bias of the low quantile."""
    return _quiet_power(np.random.default_rng(0).standard_normal(400 * size), size)


def _noise_gain(conditioner: Conditioner) -> float:
    """Rms of the conditioned signal for white noise of rms one on the stamps."""
    noise = np.random.default_rng(0).standard_normal(conditioner.stamps.size)
    return float(np.sqrt(np.mean(conditioner.apply(noise) ** 2)))


def _still_on_grid(conditioner: Conditioner, standing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    nearest = np.clip(np.searchsorted(conditioner.stamps, conditioner.grid), 0, standing.size - 1)
    return np.asarray(standing[nearest] & conditioner.valid)


def _spread_within(values: Floats, still: NDArray[np.bool_]) -> float:
    """Rms about the mean of each standstill, so that grade and bias drift are not part of it."""
    squares, freedom = 0.0, 0
    for start, end in runs(still):
        part = values[start:end]
        squares += float(np.sum((part - part.mean()) ** 2))
        freedom += part.size - 1
    return float(np.sqrt(squares / max(freedom, 1)))
