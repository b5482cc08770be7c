# SPDX-License-Identifier: Apache-2.0
"""Signals by frequency: power spectral density, octave bands, the paper's spectrum."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = ["band_rms", "octave_bands", "power_density", "power_spectrum"]


def power_density(x: Floats, rate: float, segment: float = 2.0) -> tuple[Floats, Floats]:
    """Welch's one-sided power spectral density of (n, ...) along its first axis.

    Hann segments of ``segment`` s (the whole signal if it is shorter), half overlapping, mean removed.
    Returns ``frequency`` (k,) Hz and ``density`` (k, ...) in unit² / Hz; their integral is the variance.
    """
    x = np.asarray(x, dtype=np.float64)
    if len(x) < 8:
        raise InputError("spectrum", f"{len(x)} samples are too few")
    from scipy import signal  # half a second to import, which a calibration without a report does not need

    size = min(len(x), max(8, round(segment * rate)))
    frequency, density = signal.welch(x, fs=rate, nperseg=size, detrend="constant", axis=0)
    return np.asarray(frequency, dtype=np.float64), np.asarray(density, dtype=np.float64)


def power_spectrum(x: Floats, rate: float) -> tuple[Floats, Floats]:
    """The car paper's Fig. 11: the two-sided amplitude spectrum |X(f)| / n of (n,), zero in the middle.

    ``frequency`` (n,) from -rate/2 to rate/2 Hz and ``amplitude`` (n,) in the signal's unit, mean
    removed; the paper draws -10 to 10 Hz.
    """
    x = np.asarray(x, dtype=np.float64)
    if x.ndim != 1 or x.size < 8:
        raise InputError("spectrum", f"takes one signal of at least 8 samples, was given shape {x.shape}")
    amplitude = np.abs(np.fft.fftshift(np.fft.fft(x - x.mean()))) / x.size
    return np.fft.fftshift(np.fft.fftfreq(x.size, 1.0 / rate)), amplitude


def octave_bands(low: float = 0.5, high: float = 40.0, fraction: int = 3) -> Floats:
    """(k, 2) edges in Hz of the 1/``fraction`` octave bands whose centres lie from ``low`` to ``high`` Hz,
    base two, counted from 1 kHz as IEC 61260 has it."""
    if not 0 < low < high or fraction < 1:
        raise InputError("spectrum", "octave bands need 0 < low < high and a fraction of at least 1")
    first = int(np.ceil(fraction * np.log2(low / 1000.0) - 1e-9))
    last = int(np.floor(fraction * np.log2(high / 1000.0) + 1e-9))
    centre = 1000.0 * 2.0 ** (np.arange(first, last + 1) / fraction)
    half = 2.0 ** (0.5 / fraction)
    return np.column_stack([centre / half, centre * half])


def band_rms(x: Floats, rate: float, bands: Floats, segment: float = 4.0) -> Floats:
    """(k, ...) rms of (n, ...) in each of ``bands`` (k, 2) Hz, from its power spectral density."""
    frequency, density = power_density(x, rate, segment)
    step = frequency[1] - frequency[0]
    total = np.concatenate([np.zeros((1, *density.shape[1:])), np.cumsum(density, axis=0) * step])
    edges = np.concatenate([frequency - step / 2, [frequency[-1] + step / 2]])

    def below(limit: Floats) -> Floats:
        flat = total.reshape(len(total), -1)
        found = np.column_stack([np.interp(limit, edges, lane) for lane in flat.T])
        return found.reshape(len(limit), *density.shape[1:])

    power = below(bands[:, 1]) - below(bands[:, 0])
    return np.asarray(np.sqrt(np.maximum(power, 0.0)), dtype=np.float64)
