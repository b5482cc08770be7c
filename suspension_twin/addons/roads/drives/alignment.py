# SPDX-License-Identifier: Apache-2.0
"""Where passes lie along the road against each other: by the road that each of them sees.

A phone's receiver is metres off and wanders; two passes over one road see the same profile. Their
estimates are compared in windows at all lags, and the path of lags that correlates best and changes
slowly is found by dynamic programming.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt

from suspension_twin.arrays import Floats

__all__ = ["banded", "lags_along"]

_WINDOW, _HOP = 40.0, 5.0  # m
#: A lag may change by so much of the way: a receiver wanders by some centimetres in a metre.
_DRIFT = 0.08
#: Cost of a change of lag of one grid step from window to window, in units of correlation.
_PRICE = 0.004
_QUIET = 0.05  # of the typical power: a window that has less says nothing


def banded(z: Floats, step: float, low: float = 0.1, high: float = 1.0) -> Floats:
    """Heights (..., n) m every ``step`` m, waves between ``low`` and ``high`` cycles/m alone."""
    high = min(high, 0.4 / step)
    sections = butter(2, [low, high], "bandpass", fs=1.0 / step, output="sos")
    return np.asarray(sosfiltfilt(sections, z, axis=-1), dtype=np.float64)


def lags_along(reference: Floats, other: Floats, step: float, reach: float) -> tuple[Floats, Floats, Floats]:
    """Lag of one profile against another along the road.

    Parameters
    ----------
    reference, other : (lines, n) array
        Heights in m every ``step`` m, of the same band; 0 where nothing is known.
    step : float
        m.
    reach : float
        Largest lag looked for in m.

    Returns
    -------
    at, lag, correlation : (k,) array
        Middles of the windows in m from the first height, how many m farther on ``other`` has what ``reference``
        has there, and the correlation at that lag.
    """
    coarse = max(1, round(0.1 / step))
    a, b = (z[:, ::coarse] for z in (reference, other))
    d = step * coarse
    n, most = a.shape[1], round(reach / d)
    window, hop = round(_WINDOW / d), round(_HOP / d)
    lags = np.arange(-most, most + 1)
    padded = np.pad(b, ((0, 0), (most, most)))
    starts = np.arange(0, max(n - window, 0) + 1, hop)
    scores = np.zeros((starts.size, lags.size))
    products = np.array([(a * padded[:, i : i + n]).sum(axis=0) for i in range(lags.size)])
    total = np.concatenate([np.zeros((lags.size, 1)), np.cumsum(products, axis=1)], axis=1)
    power_a = np.concatenate([[0.0], np.cumsum((a**2).sum(axis=0))])
    power_b = np.concatenate([[0.0], np.cumsum((padded**2).sum(axis=0))])
    typical = (power_a[-1] / n) * window
    for k, s in enumerate(starts):
        end = min(s + window, n)
        pa = power_a[end] - power_a[s]
        pb = power_b[lags + most + end] - power_b[lags + most + s]
        scores[k] = (total[:, end] - total[:, s]) / np.sqrt(
            np.maximum(pa, _QUIET * typical) * np.maximum(pb, _QUIET * typical)
        )
    # Viterbi: the best path of lags whose steps are within the drift.
    allowed = max(1, round(_DRIFT * _HOP / d))
    best = scores[0].copy()
    origin = np.zeros(scores.shape, dtype=np.int64)
    for k in range(1, starts.size):
        options = np.full((2 * allowed + 1, lags.size), -np.inf)
        for j, move in enumerate(range(-allowed, allowed + 1)):
            low, high = max(0, move), min(lags.size, lags.size + move)
            options[j, low:high] = best[low - move : high - move] - _PRICE * abs(move)
        choice = options.argmax(axis=0)
        origin[k] = np.arange(lags.size) - (choice - allowed)
        best = options.max(axis=0) + scores[k]
    path = np.zeros(starts.size, dtype=np.int64)
    path[-1] = int(best.argmax())
    for k in range(starts.size - 1, 0, -1):
        path[k - 1] = origin[k, path[k]]
    at: Floats = np.asarray((starts + 0.5 * window) * d, dtype=np.float64)
    lag: Floats = np.asarray(lags[path] * d, dtype=np.float64)
    return at, lag, scores[np.arange(starts.size), path]
