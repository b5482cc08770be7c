# SPDX-License-Identifier: Apache-2.0
"""Signals by frequency: power spectral density and the paper's amplitude spectrum."""

from __future__ import annotations

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = ["power_density", "power_spectrum"]


def power_density(x: Floats, rate: float, segment: float = 2.0) -> tuple[Floats, Floats]:
    """Estimate the one-sided power spectral density along the first axis (Welch).

    Parameters
    ----------
    x : (n, ...) array
        Signals, evenly sampled; their means are removed.
    rate : float
        Samples a second.
    segment : float
        Length of the Hann segments in s, half overlapping; the whole signal if it is shorter.

    Returns
    -------
    frequency : (k,) array
        Hz.
    density : (k, ...) array
        unit²/Hz; its integral is the variance.

    Raises
    ------
    InputError
        Too few samples.

    Examples
    --------
    >>> import numpy as np
    >>> f, density = power_density(np.sin(2 * np.pi * 5.0 * np.arange(0.0, 10.0, 0.01)), 100.0)
    >>> float(f[np.argmax(density)])
    5.0
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
