# SPDX-License-Identifier: Apache-2.0
"""Agreement of two signals: the measures of both papers and of ISO/TS 18571, objective rating of non-ambiguous signals.

``measured`` is (n,), ``simulated`` (n,) or (n, L) with a candidate in every lane; the result is a
float or (L,). Choose the samples (valid ones, one channel after the other) before calling.

The package objective-rating-metrics (1.3) gives the same four scores of the standard to 1e-9, which the tests hold
this against. It is not used in its place: it compiles its time warping anew in every process (5.6 s of processor time,
against 1.7 s here once and 0.3 s from then on), takes 29 ms for a signal of 1000 samples against 2 ms, and rates one
signal at a time where a calibration by this objective has a hundred candidates a generation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled
from suspension_twin.errors import InputError
from suspension_twin.signals.spectra import power_density

__all__ = [
    "IsoRating",
    "correlation",
    "iso18571",
    "mean_squared_error",
    "rate_lanes",
    "rms_error",
    "spectral_distance",
]

INNER, OUTER = 0.05, 0.5  # corridors, shares of the largest measured value
CORRIDOR_POWER = 2.0
MAX_SHIFT = 0.2  # share of the samples
WARP = 0.1  # half width of the warping window, share of the samples
MAGNITUDE_LIMIT = 0.5
SLOPE_LIMIT = 2.0
SLOPE_MEAN = 9  # samples


def _corridor(m: Floats, s: Floats) -> Floats:
    """(L,) scores of lanes (L, n) by their distance from the measured signal (n,)."""
    inner, outer = INNER * np.abs(m).max(), OUTER * np.abs(m).max()
    inside = np.clip((outer - np.abs(m - s)) / (outer - inner), 0.0, 1.0)
    return np.asarray(np.mean(inside**CORRIDOR_POWER, axis=1))


@compiled
def _correlation(m: Floats, s: Floats) -> float:  # pragma: no cover - compiled
    mean_m = mean_s = 0.0
    for i in range(m.size):
        mean_m += m[i] / m.size
        mean_s += s[i] / m.size
    mm = ss = ms = 0.0
    for i in range(m.size):
        dm, ds = m[i] - mean_m, s[i] - mean_s
        mm += dm * dm
        ss += ds * ds
        ms += dm * ds
    spread = math.sqrt(mm * ss)
    return ms / spread if spread > 0.0 else -2.0


@compiled
def _shift(m: Floats, s: Floats) -> int:  # pragma: no cover - compiled
    """Samples by which the simulated signal lags (negative: leads) at the best correlation."""
    best, at = _correlation(m, s), 0
    n = m.size
    for k in range(1, math.floor(n * MAX_SHIFT) + 1):
        early = _correlation(m[: n - k], s[k:])
        if early > best:
            best, at = early, k
        late = _correlation(m[k:], s[: n - k])
        if late > best:
            best, at = late, -k
    return at


@compiled
def _magnitude(m: Floats, s: Floats) -> float:  # pragma: no cover - compiled
    """Score after dynamic time warping with squared distances within a band."""
    n = m.size
    half = math.ceil(WARP * n) - 1
    width = 2 * half + 1
    # Row i of the simulated signal meets columns i - half to i + half of the measured one.
    total = np.empty((n, width))
    for i in range(n):
        for c in range(width):
            total[i, c] = np.inf
        for c in range(max(0, half - i), min(width, n + half - i)):
            j = i - half + c
            cost = (s[i] - m[j]) ** 2
            if i == 0 and j == 0:
                total[i, c] = cost
                continue
            least = np.inf
            if i > 0 and c + 1 < width:
                least = total[i - 1, c + 1]
            if c > 0 and total[i, c - 1] < least:
                least = total[i, c - 1]
            if i > 0 and total[i - 1, c] < least:
                least = total[i - 1, c]
            total[i, c] = cost + least
    i, j = n - 1, n - 1
    off, size = abs(s[i] - m[j]), abs(m[j])
    while i > 0 or j > 0:
        c = j - i + half
        up = total[i - 1, c + 1] if i > 0 and c + 1 < width else np.inf
        back = total[i, c - 1] if c > 0 else np.inf
        both = total[i - 1, c] if i > 0 and j > 0 else np.inf
        if up <= back and up <= both:
            i -= 1
        elif back <= both:
            j -= 1
        else:
            i -= 1
            j -= 1
        off += abs(s[i] - m[j])
        size += abs(m[j])
    share = off / size if size > 0.0 else np.inf
    return max(0.0, (MAGNITUDE_LIMIT - share) / MAGNITUDE_LIMIT)


def _slopes(x: Floats, rate: float) -> Floats:
    """Central differences, averaged over nine samples, over fewer towards the ends."""
    total = np.concatenate([[0.0], np.cumsum(np.gradient(x, 1.0 / rate))])
    i = np.arange(x.size)
    reach = np.minimum(SLOPE_MEAN // 2, np.minimum(i, i[::-1]))
    return np.asarray((total[i + reach + 1] - total[i - reach]) / (2 * reach + 1))


def _slope(m: Floats, s: Floats, rate: float) -> float:
    dm, ds = _slopes(m, rate), _slopes(s, rate)
    size = float(np.abs(dm).sum())
    share = float(np.abs(dm - ds).sum()) / size if size > 0.0 else math.inf
    return max(0.0, (SLOPE_LIMIT - share) / SLOPE_LIMIT)


def rate_lanes(measured: Floats, lanes: Floats, rate: float) -> Floats:
    """(L, 4) corridor, phase, magnitude and slope scores of ``lanes`` (L, n) against ``measured`` (n,)."""
    n = measured.size
    out = np.empty((len(lanes), 4))
    out[:, 0] = _corridor(measured, lanes)
    for scores, s in zip(out, lanes, strict=True):
        shift = _shift(measured, s)
        m0, s0 = measured[max(-shift, 0) : n - max(shift, 0)], s[max(shift, 0) : n - max(-shift, 0)]
        phase = max(0.0, (n * MAX_SHIFT - abs(shift)) / (n * MAX_SHIFT))
        scores[1:] = phase, _magnitude(m0, s0), _slope(m0, s0, rate)
    return out


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
