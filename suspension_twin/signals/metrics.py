# SPDX-License-Identifier: Apache-2.0
"""How well two signals agree: the measures of both papers and of ISO/TS 18571.

``measured`` is (n,), ``simulated`` (n,) or (n, L) with a candidate in every lane; the result is a
float or (L,). Choose the samples (valid ones, one channel after the other) before calling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError
from suspension_twin.signals.iso18571 import rate_lanes
from suspension_twin.signals.spectra import power_density

__all__ = [
    "IsoRating",
    "correlation",
    "iso18571",
    "mean_squared_error",
    "rms_error",
    "spectral_distance",
]

#: Of corridor, phase, magnitude and slope in the overall rating.
ISO_WEIGHTS = np.array([0.4, 0.2, 0.2, 0.2])


def _pair(measured: Floats, simulated: Floats) -> tuple[Floats, Floats]:
    measured = np.asarray(measured, dtype=np.float64)
    simulated = np.asarray(simulated, dtype=np.float64)
    if (
        measured.ndim != 1
        or simulated.ndim not in (1, 2)
        or len(measured) != len(simulated)
        or not measured.size
    ):
        raise InputError(
            "agreement",
            f"measured must be (n,) and simulated (n,) or (n, L), are {measured.shape} and {simulated.shape}",
        )
    return (measured[:, None] if simulated.ndim == 2 else measured), simulated


def _given(values: Floats) -> Floats:
    """Lanes as an array, a single signal as a plain number (0-dimensional)."""
    return np.asarray(values, dtype=np.float64)


def mean_squared_error(measured: Floats, simulated: Floats) -> Floats:
    """Mean squared error, the car paper's validation figure (its section 5).

    Parameters
    ----------
    measured : (n,) array
        The measured signal.
    simulated : (n,) or (n, L) array
        One simulated signal or L of them.

    Returns
    -------
    float or (L,) array
        In the unit of the signals squared.

    Examples
    --------
    >>> import numpy as np
    >>> float(mean_squared_error(np.zeros(4), np.full(4, 2.0)))
    4.0
    """
    m, s = _pair(measured, simulated)
    return _given(np.mean((m - s) ** 2, axis=0))


def rms_error(measured: Floats, simulated: Floats) -> Floats:
    """Root of the mean squared error, in the unit of the signals."""
    return _given(np.sqrt(mean_squared_error(measured, simulated)))


def correlation(measured: Floats, simulated: Floats) -> Floats:
    """Correlation coefficient, the tracked paper's eqs (7) and (8).

    Parameters
    ----------
    measured : (n,) array
        The measured signal.
    simulated : (n,) or (n, L) array
        One simulated signal or L of them.

    Returns
    -------
    float or (L,) array
        -1 to 1; 0 where one of the signals is constant.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.sin(np.arange(50.0))
    >>> round(float(correlation(x, -2.0 * x)), 6)
    -1.0
    """
    m, s = _pair(measured, simulated)
    dm, ds = m - np.mean(m, axis=0), s - np.mean(s, axis=0)
    covariance = np.mean(dm * ds, axis=0)
    spread = np.sqrt(np.mean(dm**2, axis=0) * np.mean(ds**2, axis=0))
    return _given(np.where(spread > 0, covariance / np.where(spread > 0, spread, 1.0), 0.0))


def spectral_distance(
    measured: Floats,
    simulated: Floats,
    rate: float,
    low: float = 0.5,
    high: float = 25.0,
    segment: float = 2.0,
) -> Floats:
    """Root mean square difference of two power spectral densities in dB.

    It does not depend on phase, so neither on clocks nor on the position along the road.

    Parameters
    ----------
    measured : (n,) array
        The measured signal.
    simulated : (n,) or (n, L) array
        One simulated signal or L of them.
    rate : float
        Samples a second.
    low, high : float
        Range of frequencies in Hz.
    segment : float
        Length of the Welch segments in s.

    Returns
    -------
    float or (L,) array
        dB; densities below a thousandth of the measured peak do not count.

    Raises
    ------
    InputError
        No frequency of the spectra lies in the band.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(0).normal(size=1000)
    >>> round(float(spectral_distance(x, 2.0 * x, 100.0)), 2)
    6.02
    """
    m, s = _pair(measured, simulated)
    frequency, a = power_density(m, rate, segment)
    _, b = power_density(s, rate, segment)
    band = (frequency >= low) & (frequency <= high)
    if not band.any():
        raise InputError("agreement", f"no frequency between {low:g} and {high:g} Hz at {rate:g} Hz")
    floor = max(1e-3 * float(a[band].max()), np.finfo(np.float64).tiny)
    difference = 10.0 * np.log10(np.maximum(a[band], floor) / np.maximum(b[band], floor))
    return _given(np.sqrt(np.mean(difference**2, axis=0)))


@dataclass(frozen=True, eq=False)
class IsoRating:
    """ISO/TS 18571: four scores between 0 and 1 and their weighted sum ``overall`` (0.4, 0.2, 0.2, 0.2).

    Numbers for one simulated signal, arrays (L,) for lanes.
    """

    corridor: Floats
    phase: Floats
    magnitude: Floats
    slope: Floats
    overall: Floats


def iso18571(measured: Floats, simulated: Floats, rate: float) -> IsoRating:
    """Rate simulated signals against a measured one by ISO/TS 18571.

    Parameters
    ----------
    measured : (n,) array
        The measured signal, an event of a few seconds: time and memory grow with the square of n.
    simulated : (n,) or (n, L) array
        One simulated signal or L of them.
    rate : float
        Samples a second.

    Returns
    -------
    IsoRating
        Scores of corridor, phase, magnitude and slope and their weighted sum ``overall``, each 0 to 1.

    Raises
    ------
    InputError
        Fewer than ten samples, or a measured signal that is constant.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.sin(np.arange(0.0, 6.0, 0.02))
    >>> float(iso18571(x, x, 50.0).overall)
    1.0
    """
    m, s = _pair(measured, simulated)
    m = m.reshape(-1)
    if m.size < 10:
        raise InputError("agreement", "ISO/TS 18571 needs at least ten samples")
    if not np.ptp(m):
        raise InputError("agreement", "ISO/TS 18571 cannot rate against a constant signal")
    lanes = np.ascontiguousarray(s[None, :] if s.ndim == 1 else s.T)
    scores = rate_lanes(np.ascontiguousarray(m), lanes, float(rate))
    columns = [_given(c[0] if s.ndim == 1 else c) for c in (*scores.T, scores @ ISO_WEIGHTS)]
    return IsoRating(*columns)
